"""The geometry of a cone on the lattice: the cells of a reading, and their distances.

A cell belongs to a cone if its centre is within the half angle of the axis and within reach. Near the sensor, a narrow
cone contains no centre, so the cells that the axis crosses belong to it as well. In each row of the lattice, the cells
of each kind form one run, which is computed without testing single cells.

All lengths are in cells, relative to the lower left corner of the grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..runtime.jit import inlined_kernel, kernel

HALF_WIDTH = 0.75
"""Smallest half width of a cone for its strength, cells."""


class Cone(NamedTuple):
    """A circular sector with the free zone at its apex.

    Attributes
    ----------
    x, y : float
        Apex.
    reach, free : float
        Radius of the sector, and of the free zone.
    axis_x, axis_y, right_x, right_y, left_x, left_y : float
        Unit vectors of the axis and of the two edges.
    bottom, top : int
        First and last row; they may be outside of the grid.
    """

    x: float
    y: float
    reach: float
    free: float
    axis_x: float
    axis_y: float
    right_x: float
    right_y: float
    left_x: float
    left_y: float
    bottom: int
    top: int


class Runs(NamedTuple):
    """The cells of a cone in one row: columns `first` to `last`, and `first2` to `last2` to the right of them.

    A run is empty if its last column is before its first; usually the second is. `inner` to `outer` are the columns
    of the row within the radius of the free zone, in the cone or not.
    """

    first: int
    last: int
    first2: int
    last2: int
    inner: int
    outer: int


@kernel
def make_cone(
    x: float, y: float, axis: tuple[float, float], half: tuple[float, float], lengths: tuple[float, float]
) -> Cone:
    """Return the sector of a reading.

    Parameters
    ----------
    x, y
        Apex.
    axis
        Unit vector.
    half
        Sine and cosine of the half angle in (0, π/2).
    lengths
        Radius of the sector, and of the free zone, which is empty if negative.
    """
    reach, free = lengths
    axis_x, axis_y = axis
    sine, cosine = half
    right_x, right_y = axis_x * cosine + axis_y * sine, axis_y * cosine - axis_x * sine
    left_x, left_y = axis_x * cosine - axis_y * sine, axis_y * cosine + axis_x * sine
    top = 1.0 if axis_y >= cosine else max(0.0, right_y, left_y)
    bottom = -1.0 if -axis_y >= cosine else min(0.0, right_y, left_y)
    return Cone(
        x,
        y,
        reach,
        free,
        axis_x,
        axis_y,
        right_x,
        right_y,
        left_x,
        left_y,
        int(math.floor(y + reach * bottom)),
        int(math.floor(y + reach * top)),
    )


@inlined_kernel
def _clip(a: float, b: float, low: float, high: float) -> tuple[float, float]:
    """Clip the interval [low, high] to those u with a * u + b >= 0."""
    if a > 0.0:
        return max(low, -b / a), high
    if a < 0.0:
        return low, min(high, -b / a)
    if b < 0.0:
        return 1.0, 0.0
    return low, high


@inlined_kernel
def wedge_run(cone: Cone, row: int) -> tuple[int, int]:
    """Return the first and last column of a row whose cell centres are in the sector; last < first if there is none."""
    v = row + 0.5 - cone.y
    chord = cone.reach * cone.reach - v * v
    if chord < 0.0:
        return 0, -1
    high = math.sqrt(chord)
    low, high = _clip(-cone.right_y, cone.right_x * v, -high, high)
    low, high = _clip(cone.left_y, -cone.left_x * v, low, high)
    if low > high:
        return 0, -1
    return int(math.ceil(low + cone.x - 0.5)), int(math.floor(high + cone.x - 0.5))


@inlined_kernel
def axis_run(cone: Cone, row: int) -> tuple[int, int]:
    """Return the first and last column of a row that the axis crosses; last < first if it crosses none."""
    begin, end = 0.0, cone.reach
    if abs(cone.axis_y) > 1e-12:
        a, b = (row - cone.y) / cone.axis_y, (row + 1 - cone.y) / cone.axis_y
        begin, end = max(begin, min(a, b)), min(end, max(a, b))
    elif not row <= cone.y < row + 1:
        return 0, -1
    if begin > end:
        return 0, -1
    a, b = cone.x + begin * cone.axis_x, cone.x + end * cone.axis_x
    return int(math.floor(min(a, b))), int(math.floor(max(a, b)))


@inlined_kernel
def within(x: float, v: float, radius: float) -> tuple[int, int]:
    """Return the first and last column of a row whose centres are at most `radius` away; last < first if none is.

    `x` is the apex, `v` the row's height above it.
    """
    chord = radius * radius - v * v
    if radius < 0.0 or chord < 0.0:
        return 0, -1
    half = math.sqrt(chord)
    return int(math.ceil(x - half - 0.5)), int(math.floor(x + half - 0.5))


@inlined_kernel
def rows_of(cone: Cone, height: int) -> tuple[int, int]:
    """Return the first row of the cone that is on the grid, and the last one plus one."""
    return max(cone.bottom, 0), min(cone.top, height - 1) + 1


@inlined_kernel
def runs_of(cone: Cone, row: int, width: int) -> Runs:
    """Return the cells of the cone in a row of the grid; all loops over a cone use `rows_of` and this."""
    v = row + 0.5 - cone.y
    inner, outer = within(cone.x, v, cone.free)
    first, last = within(cone.x, v, cone.reach)
    first, last = max(first, 0), min(last, width - 1)
    a, b = wedge_run(cone, row)
    c, d = axis_run(cone, row)
    a, b, c, d = max(a, first), min(b, last), max(c, first), min(d, last)
    if b < a:
        return Runs(c, d, 0, -1, inner, outer)
    if d < c:
        return Runs(a, b, 0, -1, inner, outer)
    if c <= b + 1 and a <= d + 1:
        return Runs(min(a, c), max(b, d), 0, -1, inner, outer)
    if a < c:
        return Runs(a, b, c, d, inner, outer)
    return Runs(c, d, a, b, inner, outer)


@inlined_kernel
def strength(axis_x: float, axis_y: float, sine2: float, du: float, dv: float) -> float:
    """Return the strength of a beam at (du, dv) from its apex: 1 on the axis, 0 at the edge and outside.

    With φ the angle to the axis and β the half angle, it is 1 − (sin φ / sin β)² (after Moravec and Elfes 1985, who use
    the angles themselves). The cone is taken to be at least one and a half cells wide, since a narrow beam fills the
    cells that it crosses. `sine2` is sin² β.
    """
    across = axis_x * dv - axis_y * du
    width2 = max(sine2 * (du * du + dv * dv), HALF_WIDTH * HALF_WIDTH)
    return max(1.0 - across * across / width2, 0.0)
