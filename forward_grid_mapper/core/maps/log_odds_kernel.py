"""The kernel of the live map: adds log-odds to the cells in the cones of readings, separately for each direction.

A plane has the log-odds from the readings of one direction. Planes of directions closer to the y axis are stored with x
and y exchanged, so that the cells of a cone lie in few long rows for any direction.

A cell in no cone has the value `UNTOUCHED`, −0. Adding anything to it, even +0, gives what was added, so the kernel
needs no test for it. Increments are rounded to `LOG_ODDS_UNIT`, so that float64 sums of them are exact.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone import HALF_WIDTH, axis_run, make_cone
from ..sensor.cone_table import COORDINATE_UNIT

LOG_ODDS_UNIT = 2.0**-20
_ROUNDER = 1.5 * 2.0**52 * LOG_ODDS_UNIT
"""Adding and subtracting it rounds to `LOG_ODDS_UNIT`, because float64 has no smaller steps at this size."""

UNTOUCHED = -0.0

PADDING = 3
"""Cells behind the last one of a plane, since the kernel processes four at a time; they stay untouched."""

_HALF_DIAGONAL = math.sqrt(0.5)

_LEVEL = 1e-300
"""Replaces the height 0 of an edge that is parallel to the rows."""


class Beams(NamedTuple):
    """The columns of `Readings` that the kernel needs, float64, shape (N,), metres and radians."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    yaw: NDArray[np.float64]
    half_angle: NDArray[np.float64]
    z: NDArray[np.float64]
    z_max: NDArray[np.float64]


class InverseModel(NamedTuple):
    """Increments of the log-odds of a cell on the axis of a reading, nats; lengths are in cells.

    `occupied` is for the arc of an echo, from `before` its range to `behind` it, if the arc is no longer than `width`.
    """

    occupied: float
    free: float
    free_no_echo: float
    before: float
    behind: float
    width: float


class StoredGrid(NamedTuple):
    """The stored grid: edge of a cell in metres, lattice indices of the lower left cell, and columns and rows."""

    resolution: float
    column: int
    row: int
    width: int
    height: int


class _Ends(NamedTuple):
    """Increments of one reading by the distance of a cell: squared radii in cells, increments in nats."""

    free2: float
    reach2: float
    free: float
    occupied: float


@inlined_kernel
def direction_of_yaw(yaw: float, directions: int) -> int:
    """Return which of `directions`, evenly spaced over half a turn, is closest to `yaw`, or to `yaw` + π."""
    return int(math.floor(yaw * directions / math.pi + 0.5)) % directions


@inlined_kernel
def is_steep(direction: int, directions: int) -> bool:
    """Return whether the plane of a direction is stored with x and y exchanged."""
    return directions < 4 * direction < 3 * directions


@inlined_kernel
def _lattice_place(metres: float, resolution: float) -> tuple[int, float]:
    """Return the lattice index of the cell of a coordinate, and the offset within it, cells.

    Coordinates are relative to the cell of the sensor, so that rounding does not depend on the corner of the grid.
    """
    cells = np.rint(metres * (1.0 / resolution) / COORDINATE_UNIT) * COORDINATE_UNIT
    cell = math.floor(cells)
    return int(cell), cells - cell


@inlined_kernel
def _add_run(
    plane: Any, cells: tuple[int, int], offset: tuple[float, float], beam: tuple[float, float, float], ends: _Ends
) -> None:
    """Add the increments of a run of cells in one row.

    Parameters
    ----------
    plane : float64
        Log-odds of all cells, row after row.
    cells
        The first cell, and the last one plus one.
    offset
        From the sensor to the centre of the first cell, cells.
    beam
        Unit vector of the axis, squared sine of the half angle.
    ends
    """
    first, end = cells
    u0, v = offset
    axis_x, axis_y, sine2 = beam
    free2, reach2, free, occupied = ends
    n = end - first
    # groups of four, which the compiler vectorises; rows are too short for its usual vector loops
    for k in range((n + 3) & ~3):
        u = u0 + k
        d2 = u * u + v * v
        across = axis_x * v - axis_y * u
        weight = max(1.0 - across * across / max(sine2 * d2, HALF_WIDTH * HALF_WIDTH), 0.0)
        gain = free if d2 < free2 else occupied
        step = (weight * gain + _ROUNDER) - _ROUNDER
        plane[np.uint64(first + k)] += step if (d2 <= reach2) & (k < n) else UNTOUCHED


class _Edge(NamedTuple):
    """An edge of a cone: in a row v above the apex, the cone is at u from v * slope + low to v * slope + high."""

    slope: float
    low: float
    high: float


@inlined_kernel
def _edge(x: float, y: float) -> _Edge:
    """Return the edge along the unit vector (x, y) of a cone that lies to the left of it."""
    slope = x / (y if y != 0.0 else -math.copysign(_LEVEL, x))
    return _Edge(slope, -math.inf, 0.0) if y > 0.0 or (y == 0.0 and x < 0.0) else _Edge(slope, 0.0, math.inf)


@inlined_kernel
def _wedge_run(edges: tuple[_Edge, _Edge], reach2: float, x: float, v: float) -> tuple[int, int]:
    """Return the first and last column of a row whose centres lie in the sector, like `cone.wedge_run`."""
    right, left = edges
    half = math.sqrt(max(reach2 - v * v, 0.0))
    a, b = v * right.slope, v * left.slope
    low = max(-half, a + right.low, b + left.low)
    high = min(half, a + right.high, b + left.high)
    if low > high:
        return 0, -1
    return int(math.ceil(low + x - 0.5)), int(math.floor(high + x - 0.5))


@kernel
def add_readings(beams: Beams, model: InverseModel, lattice: StoredGrid, planes: Any) -> None:
    """Add the log-odds of readings.

    Parameters
    ----------
    beams : Beams
        Readings, all of whose cells lie on the lattice.
    model : InverseModel
    lattice : StoredGrid
    planes : float64, shape (directions, width * height + `PADDING`)
    """
    directions = len(planes)
    half_angle, sine, cosine = -1.0, 0.0, 1.0
    for t in range(len(beams.x)):
        if beams.half_angle[t] != half_angle:
            half_angle = beams.half_angle[t]
            sine, cosine = math.sin(half_angle), math.cos(half_angle)
        column, x = _lattice_place(beams.x[t], lattice.resolution)
        row, y = _lattice_place(beams.y[t], lattice.resolution)
        column, row = column - lattice.column, row - lattice.row
        axis_x, axis_y = math.cos(beams.yaw[t]), math.sin(beams.yaw[t])
        width, height = lattice.width, lattice.height
        k = direction_of_yaw(beams.yaw[t], directions)
        if is_steep(k, directions):
            x, y, axis_x, axis_y = y, x, axis_y, axis_x
            column, row, width, height = row, column, height, width
        z = beams.z[t] / lattice.resolution
        if beams.z[t] < beams.z_max[t]:
            reach, free = z + model.behind, max(z - model.before, 0.0)
            arc = model.width / max(2.0 * sine * z, model.width)
            ends = _Ends(free * free, reach * reach, model.free, model.occupied * arc)
        else:
            reach = z
            ends = _Ends(math.inf, reach * reach, model.free_no_echo, 0.0)
        axis, half = (axis_x, axis_y), (sine, cosine)
        cone = make_cone(x, y, axis, half, (reach, 0.0))
        # beyond this distance, the centres of all cells that the axis crosses are within the half angle
        thin = (_HALF_DIAGONAL * cosine + _HALF_DIAGONAL * sine) / sine + 0.1
        near = make_cone(x, y, axis, half, (min(reach, thin), 0.0))
        edges = _edge(cone.right_x, cone.right_y), _edge(-cone.left_x, -cone.left_y)
        beam, plane = (axis_x, axis_y, sine * sine), planes[k]
        for across in range(max(cone.bottom, -row), min(cone.top, height - 1 - row) + 1):
            v, begin = across + 0.5 - y, (row + across) * width + column
            first, last = _wedge_run(edges, ends.reach2, x, v)
            first, last = max(first, -column), min(last, width - 1 - column)
            if near.bottom <= across <= near.top:
                a, b = axis_run(near, across)
                a, b = max(a, -column), min(b, width - 1 - column)
                if a <= b and (last < first or a > last + 1 or first > b + 1):
                    _add_run(plane, (begin + a, begin + b + 1), (a + 0.5 - x, v), beam, ends)
                elif a <= b:
                    first, last = min(a, first), max(b, last)
            if first <= last:
                _add_run(plane, (begin + first, begin + last + 1), (first + 0.5 - x, v), beam, ends)
