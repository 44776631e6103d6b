"""The geometry of one cone on the lattice: which cells belong to a reading, and how far away they are.

A cell belongs to a cone if its centre lies within the half angle of the axis and within reach. Near the sensor a thin
cone has no centre in it at all, so the cells that the axis crosses belong too (ALGORITHM §2). In every row of the
lattice each of the two kinds forms one run, which is found without testing cells one by one.

All lengths here are in cells, relative to the grid's lower left corner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..runtime.jit import kernel

HALF_WIDTH = 0.75
"""Least half width in cells that a cone is taken to have when its strength is asked for."""


class Cone(NamedTuple):
    """A circular sector: apex `x`, `y`, radius `reach`, unit vectors of its axis and its two edges, row limits."""

    x: float
    y: float
    reach: float
    axis_x: float
    axis_y: float
    right_x: float
    right_y: float
    left_x: float
    left_y: float
    bottom: int
    top: int


@kernel
def make_cone(x: float, y: float, axis: tuple[float, float], half: tuple[float, float], reach: float) -> Cone:
    """Return the sector of a reading; `axis` is a unit vector, `half` sine and cosine of the half angle in (0, π/2)."""
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
        axis_x,
        axis_y,
        right_x,
        right_y,
        left_x,
        left_y,
        int(math.floor(y + reach * bottom)),
        int(math.floor(y + reach * top)),
    )


@kernel
def _clip(a: float, b: float, low: float, high: float) -> tuple[float, float]:
    """Clip [low, high] to the u with a * u + b >= 0."""
    if a > 0.0:
        return max(low, -b / a), high
    if a < 0.0:
        return low, min(high, -b / a)
    if b < 0.0:
        return 1.0, 0.0
    return low, high


@kernel
def wedge_run(cone: Cone, row: int) -> tuple[int, int]:
    """Return the first and last column of a row whose cell centres lie in the sector; last < first if none does."""
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


@kernel
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


@kernel
def within(x: float, v: float, radius: float, nearest: bool) -> tuple[int, int]:
    """Return the first and last column of a row whose cells are at most `radius` away; last < first if none is.

    `x` is the apex, `v` the row's height above it; the distance is that of `distance`.
    """
    v = max(abs(v) - 0.5, 0.0) if nearest else v
    chord = radius * radius - v * v
    if radius < 0.0 or chord < 0.0:
        return 0, -1
    half = math.sqrt(chord) + (0.5 if nearest else 0.0)
    return int(math.ceil(x - half - 0.5)), int(math.floor(x + half - 0.5))


@kernel
def row_runs(cone: Cone, row: int, radius: float, width: int, nearest: bool) -> tuple[int, int, int, int]:
    """Return the cells of the cone in a row, at most `radius` away and on the grid, as two runs: first, last, twice.

    The first run is left of the second. A run is empty where its last column is before its first; one run is the rule.
    """
    first, last = within(cone.x, row + 0.5 - cone.y, radius, nearest)
    first, last = max(first, 0), min(last, width - 1)
    a, b = wedge_run(cone, row)
    c, d = axis_run(cone, row)
    a, b, c, d = max(a, first), min(b, last), max(c, first), min(d, last)
    if b < a:
        return c, d, 0, -1
    if d < c:
        return a, b, 0, -1
    if c <= b + 1 and a <= d + 1:
        return min(a, c), max(b, d), 0, -1
    if a < c:
        return a, b, c, d
    return c, d, a, b


@kernel
def distance(du: float, dv: float, nearest: bool) -> float:
    """Return the distance to a cell whose centre is (du, dv) away: to its centre or to its nearest point."""
    if nearest:
        du = max(abs(du) - 0.5, 0.0)
        dv = max(abs(dv) - 0.5, 0.0)
    return math.sqrt(du * du + dv * dv)


@kernel
def strength(axis_x: float, axis_y: float, sine2: float, du: float, dv: float) -> float:
    """Return how much of a beam there is (du, dv) from its apex: 1 on the axis, 0 at the edge and beyond.

    With φ the angle off the axis and β the half angle it is 1 − (sin φ / sin β)² (after Moravec and Elfes 1985, who
    have the angles themselves). β is taken as large enough for the cone to be one and a half cells wide there, since a
    thin beam fills the cells it crosses. `sine2` is the square of sin β.
    """
    across = axis_x * dv - axis_y * du
    width2 = max(sine2 * (du * du + dv * dv), HALF_WIDTH * HALF_WIDTH)
    return max(1.0 - across * across / width2, 0.0)
