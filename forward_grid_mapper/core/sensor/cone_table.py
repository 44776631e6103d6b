"""The cones of readings on a grid: how far they reach, which grid holds them, and a walk over the cells of one.

A reading of range z splits its cone. In the *free zone*, up to z − `CUT` σ, the noise density is nil: an occupied cell
there acts only by standing in the way, so its distance does not matter. In the *band* around z lie the cells that can
evaluate the reading. Cells beyond the band cannot matter, unless z is near z_max: then all cells up to z_max stand in
the way of the max-range cause.

Distances are to the centres of cells, but it is a surface that echoes, and that lies before the centre: anywhere
between it and the near side, as far as the map knows. So lengths along a cone are longer by `surface_offset` cells
here than what the sensor reports.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.grid import Grid
from ..common.parameters import GridParameters, ModelParameters
from ..common.readings import Readings
from ..runtime.jit import allocating_kernel, kernel
from .cone import Cone, make_cone, rows_of, runs_of
from .density import CUT

Floats = NDArray[np.float64]


_FIELDS = ('x', 'y', 'axis_x', 'axis_y', 'sine', 'cosine', 'z', 'z_max', 'sigma', 'free', 'reach')

CONE = np.dtype([(name, np.float64) for name in _FIELDS], align=True)
"""The cone of a reading on a grid, in cells; what the kernels need to walk it.

Apex; unit vector of the axis; sine and cosine of the half angle; range, largest range and σ; `free`, the end of the
free zone; `reach`, beyond which no cell matters: all four lengths to the centres of cells. One record a reading, since
kernels come upon readings at random.
"""

Cones = NDArray[np.void]

UNIT = 2.0**-32
"""Cells; coordinates are rounded to it, which leaves 20 bits of float64 for the number of a cell."""


def effective_sigma(readings: Readings, model: ModelParameters, resolution: float) -> Floats:
    """Return each reading's σ in metres: its own or the model's, but not less than half a cell."""
    return np.maximum(np.where(readings.sigma > 0, readings.sigma, model.sigma), resolution / 2)


def reach_of(readings: Readings, sigma: Floats) -> Floats:
    """Return the distance in metres beyond which no surface in each cone matters, shape (N,).

    Short of z_max − `CUT` σ the max-range cause has no density, and only cells up to z + `CUT` σ count.
    """
    ends = readings.z + CUT * sigma
    return np.where(ends < readings.z_max, ends, readings.z_max)


def grid_of(
    readings: Readings, model: ModelParameters, grid: GridParameters, within: Grid | None = None, beyond: float = 0.0
) -> Grid:
    """Return a grid that holds every cell that a reading touches, and all of `within`.

    It follows the bounding boxes of the cones, out to where no cell matters and to `beyond` metres past the range.

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
    """Return left, right, bottom and top of all cones, metres."""
    r = readings
    box: tuple[float, float, float, float] = _widest(
        *(np.ascontiguousarray(v) for v in (r.x, r.y, r.yaw, r.half_angle, reach))
    )
    return box


@kernel
def _widest(x: Floats, y: Floats, yaw: Floats, half_angle: Floats, reach: Floats) -> tuple[float, float, float, float]:
    """Return the box of all sectors, as `cone_boxes` gives one for each."""
    quarter = math.pi / 2
    left, right, bottom, top = math.inf, -math.inf, math.inf, -math.inf
    for i in range(len(x)):
        u, v, r = x[i], y[i], reach[i]
        # a whole disc in there cannot make it larger: all but a few
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
    """Return the readings' cones in cells of `grid`, records of `CONE`, shape (N,)."""
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
    """Return coordinates in whole units, so that where a sensor is in a cell does not depend on the grid's corner."""
    out: Floats = np.round(cells / UNIT) * UNIT
    return out


@kernel
def cone_of(reading: Any) -> Cone:
    """Return the sector of a record of `CONE`."""
    axis, half = (reading.axis_x, reading.axis_y), (reading.sine, reading.cosine)
    return make_cone(reading.x, reading.y, axis, half, (reading.reach, reading.free))


@kernel
def walk(table: Any, t: int, shape: Any, cells: Any, distances: Any) -> int:
    """Write the cells of reading t and their distances; return their number, even where the arrays are too short."""
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
    """Do as `walk` does; where the arrays are too short, go on with longer ones. Return them after the number."""
    n = walk(table, t, shape, cells, distances)
    if n > len(cells):
        cells, distances = np.empty(2 * n, np.int32), np.empty(2 * n, np.float64)
        n = walk(table, t, shape, cells, distances)
    return n, cells, distances
