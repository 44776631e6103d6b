"""The cones of readings on a grid: their reach, the grid that contains them, and a loop over the cells of one.

The range z of a reading divides its cone. In the *free zone*, up to z − `CUT` σ, the noise density is 0: an occupied
cell there only blocks the sound, so its distance does not matter. The *band* around z has the cells that can explain
the reading. Cells beyond the band do not matter, unless z is near z_max: then all cells up to z_max block the max-range
cause.

Distances are those of cell centres. But the echo comes from the surface, which is in front of the centre, by an unknown
part of a cell. So lengths along a cone are longer here by `surface_offset` cells than the ranges of the sensor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.grid import Grid
from ..common.parameter_groups import GridParameters, ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import allocating_kernel, inlined_kernel, kernel
from .cone import Cone, make_cone, rows_of, runs_of
from .density import CUT

_FIELDS = ('x', 'y', 'axis_x', 'axis_y', 'sine', 'cosine', 'z', 'z_max', 'sigma', 'free', 'reach')

CONE = np.dtype([(name, np.float64) for name in _FIELDS], align=True)
"""The cone of a reading on a grid, in cells, for the kernels.

Apex; unit vector of the axis; sine and cosine of the half angle; range, largest range and σ; `free`, the end of the
free zone; `reach`, beyond which no cell matters. Lengths are to the centres of cells. It is an array of records because
kernels access readings in random order.
"""

Cones = NDArray[np.void]

COORDINATE_UNIT = 2.0**-32
"""Coordinates are rounded to this, cells; 20 bits of float64 remain for the index of a cell."""


def effective_sigma(readings: Readings, model: ModelParameters, resolution: float) -> Floats:
    """Return σ of each reading, metres: its own or that of the model, but at least half a cell."""
    return np.maximum(np.where(readings.sigma > 0, readings.sigma, model.sigma), resolution / 2)


def reach_of(readings: Readings, sigma: Floats) -> Floats:
    """Return the distance beyond which no surface in each cone matters, metres, shape (N,).

    Below z_max − `CUT` σ, the max-range cause has density 0, and only cells up to z + `CUT` σ matter.
    """
    ends = readings.z + CUT * sigma
    return np.where(ends < readings.z_max, ends, readings.z_max)


def grid_of(
    readings: Readings, model: ModelParameters, grid: GridParameters, within: Grid | None = None, beyond: float = 0.0
) -> Grid:
    """Return the grid that contains the cells of all cones, and `within`.

    It covers the bounding boxes of the cones up to their reach, and at least `beyond` metres more than the range.

    Raises
    ------
    InputError
        If there are no readings, or the grid would exceed `max_cells`.
    """
    if not len(readings):
        raise InputError('there are no readings, so there is nothing to map')
    reach = reach_of(readings, effective_sigma(readings, model, grid.resolution))
    reach = reach + model.surface_offset * grid.resolution
    reach = np.maximum(reach, readings.z + beyond if beyond else 0.0)
    made = Grid.covering(_box(readings, reach), grid.resolution)
    made = made.union(within) if within else made
    check_size(made, grid)
    return made


def check_size(made: Grid, grid: GridParameters) -> None:
    """Check that a grid does not exceed `max_cells`.

    Raises
    ------
    InputError
        If it does.
    """
    if made.size > grid.max_cells:
        raise InputError(
            f'the map would be {made.width * grid.resolution:.0f} x {made.height * grid.resolution:.0f} m: {made.size} '
            f'cells of {grid.resolution} m, more than max_cells = {grid.max_cells}; check the poses, or raise '
            f'resolution or max_cells'
        )


def _box(readings: Readings, reach: Floats) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the bounding box of all cones, metres."""
    r = readings
    box: tuple[float, float, float, float] = _widest(
        *(np.ascontiguousarray(v) for v in (r.x, r.y, r.yaw, r.half_angle, reach))
    )
    return box


@kernel
def _widest(x: Floats, y: Floats, yaw: Floats, half_angle: Floats, reach: Floats) -> tuple[float, float, float, float]:
    """Return the bounding box of all sectors; `cone_boxes` returns that of each."""
    quarter = math.pi / 2
    left, right, bottom, top = math.inf, -math.inf, math.inf, -math.inf
    for i in range(len(x)):
        u, v, r = x[i], y[i], reach[i]
        # most readings are skipped here: not even their full disc would enlarge the box
        if u - r >= left and u + r <= right and v - r >= bottom and v + r <= top:
            continue
        low, high = yaw[i] - half_angle[i], yaw[i] + half_angle[i]
        cos_low, cos_high, sin_low, sin_high = math.cos(low), math.cos(high), math.sin(low), math.sin(high)
        right = max(right, u + r * max(cos_low, cos_high, 0.0))
        top = max(top, v + r * max(sin_low, sin_high, 0.0))
        left = min(left, u + r * min(cos_low, cos_high, 0.0))
        bottom = min(bottom, v + r * min(sin_low, sin_high, 0.0))
        first, last = math.ceil(low / quarter), math.floor(high / quarter)
        for k in range(first, last + 1):
            if k % 4 == 0:
                right = max(right, u + r)
            elif k % 4 == 1:
                top = max(top, v + r)
            elif k % 4 == 2:
                left = min(left, u - r)
            else:
                bottom = min(bottom, v - r)
    return left, right, bottom, top


def cone_table(readings: Readings, grid: Grid, model: ModelParameters) -> Cones:
    """Return the cones of readings in cells of `grid`, records of `CONE`, shape (N,)."""
    sigma = effective_sigma(readings, model, grid.resolution)
    scale, offset = 1.0 / grid.resolution, model.surface_offset
    table = np.empty(len(readings), CONE)
    table['x'], table['y'] = _exact(readings.x * scale) - grid.column, _exact(readings.y * scale) - grid.row
    table['axis_x'], table['axis_y'] = np.cos(readings.yaw), np.sin(readings.yaw)
    table['sine'], table['cosine'] = np.sin(readings.half_angle), np.cos(readings.half_angle)
    table['z'], table['z_max'] = readings.z * scale + offset, readings.z_max * scale + offset
    table['sigma'] = sigma * scale
    table['free'] = (readings.z - CUT * sigma) * scale + offset
    table['reach'] = reach_of(readings, sigma) * scale + offset
    return table


def _exact(cells: Floats) -> Floats:
    """Return coordinates in whole `COORDINATE_UNIT`s: offsets in cells do not depend on the corner of the grid."""
    out: Floats = np.round(cells / COORDINATE_UNIT) * COORDINATE_UNIT
    return out


@inlined_kernel
def cone_of(reading: Any) -> Cone:
    """Return the sector of a record of `CONE`."""
    axis, half = (reading.axis_x, reading.axis_y), (reading.sine, reading.cosine)
    return make_cone(reading.x, reading.y, axis, half, (reading.reach, reading.free))


@kernel
def walk(table: Any, t: int, shape: Any, cells: Any, distances: Any) -> int:
    """Write the cells of reading t and their distances; return their number, even if the arrays are too short."""
    height, width = shape
    cone = cone_of(table[t])
    n = 0
    for row in range(*rows_of(cone, height)):
        v = row + 0.5 - cone.y
        runs = runs_of(cone, row, width)
        for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
            for column in range(first, last + 1):
                if n < len(cells):
                    u = column + 0.5 - cone.x
                    cells[n] = row * width + column
                    distances[n] = math.sqrt(u * u + v * v)
                n += 1
    return n


@allocating_kernel
def walk_resized(table: Any, t: int, shape: Any, cells: Any, distances: Any) -> tuple[int, NDArray[np.int32], Floats]:
    """Do the same as `walk`, with longer arrays if they are too short; return the number and the arrays."""
    n = walk(table, t, shape, cells, distances)
    if n > len(cells):
        cells, distances = np.empty(2 * n, np.int32), np.empty(2 * n, np.float64)
        n = walk(table, t, shape, cells, distances)
    return n, cells, distances
