"""The cones of readings on a grid: how far they reach, which grid holds them, and a walk over the cells of one.

A reading of range z splits its cone. In the *free zone*, up to z − cut·σ, the noise density is nil: an occupied cell
there acts only by standing in the way, so its distance does not matter. In the *band* around z lie the cells that can
evaluate the reading. Cells beyond the band cannot matter, unless z is near z_max: then all cells up to z_max stand in
the way of the max-range cause.

Distances are to the centres of cells, but it is a surface that echoes, and that lies before the centre: anywhere
between it and the near side, as far as the map knows. So lengths along a cone are longer by `surface_offset` cells
here than what the sensor reports.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.grid import Grid, cone_boxes
from ..common.parameters import GridParameters, ModelParameters
from ..common.readings import Readings
from ..runtime.jit import kernel
from .cone import Cone, distance, make_cone, row_runs

Floats = NDArray[np.float64]


_FIELDS = ('x', 'y', 'axis_x', 'axis_y', 'sine', 'cosine', 'z', 'z_max', 'sigma', 'free', 'reach')

CONE = np.dtype([(name, np.float64) for name in _FIELDS], align=True)
"""The cone of a reading on a grid, in cells; what the kernels need to walk it.

Apex; unit vector of the axis; sine and cosine of the half angle; range, largest range and σ; `free`, the end of the
free zone; `reach`, beyond which no cell matters: all four lengths to the centres of cells. One record a reading, since
kernels come upon readings at random.
"""

Cones = NDArray[np.void]


def effective_sigma(readings: Readings, model: ModelParameters, resolution: float) -> Floats:
    """Return each reading's σ in metres: its own or the model's, but not less than half a cell (ALGORITHM §9)."""
    return np.maximum(np.where(readings.sigma > 0, readings.sigma, model.sigma), resolution / 2)


def offset_of(model: ModelParameters) -> float:
    """Return how many cells the centre of an obstacle lies behind its surface."""
    return 0.0 if model.cell_distance == 'nearest' else model.surface_offset


def reach_of(readings: Readings, sigma: Floats, cut: float) -> Floats:
    """Return the distance in metres beyond which no surface in each cone matters, shape (N,).

    Short of z_max − cut·σ the max-range cause has no density, and only cells up to z + cut·σ count.
    """
    ends = readings.z + cut * sigma
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
        raise InputError('no reading was accepted, so there is nothing to map; the counts of rejected readings say why')
    reach = reach_of(readings, effective_sigma(readings, model, grid.resolution), model.cut)
    reach = reach + offset_of(model) * grid.resolution
    reach = np.maximum(reach, readings.z + beyond if beyond else 0.0)
    if model.cell_distance == 'nearest':
        # a cell may be within reach though its centre is not
        reach = reach + grid.resolution
    boxes = cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, reach)
    box = (float(boxes[0].min()), float(boxes[1].max()), float(boxes[2].min()), float(boxes[3].max()))
    made = Grid.covering(box, grid.resolution)
    made = made.union(within) if within else made
    if made.size > grid.max_cells:
        raise InputError(
            f'the map would be {made.width * grid.resolution:.0f} x {made.height * grid.resolution:.0f} m: {made.size} '
            f'cells of {grid.resolution} m, more than max_cells = {grid.max_cells}; check the poses, or raise '
            f'resolution or max_cells'
        )
    return made


def cone_table(readings: Readings, grid: Grid, model: ModelParameters) -> Cones:
    """Return the readings' cones in cells of `grid`, records of `CONE`, shape (N,)."""
    sigma = effective_sigma(readings, model, grid.resolution)
    scale, offset = 1.0 / grid.resolution, offset_of(model)
    table = np.empty(len(readings), CONE)
    table['x'], table['y'] = readings.x * scale - grid.column, readings.y * scale - grid.row
    table['axis_x'], table['axis_y'] = np.cos(readings.yaw), np.sin(readings.yaw)
    table['sine'], table['cosine'] = np.sin(readings.half_angle), np.cos(readings.half_angle)
    table['z'], table['z_max'] = readings.z * scale + offset, readings.z_max * scale + offset
    table['sigma'] = sigma * scale
    table['free'] = (readings.z - model.cut * sigma) * scale + offset
    table['reach'] = reach_of(readings, sigma, model.cut) * scale + offset
    return table


@kernel
def cone_of(reading: Any, nearest: bool) -> Cone:
    """Return the sector of a record of `CONE`, wide enough for every cell that is within reach."""
    # the corners of a cell may be nearer than its centre
    reach = reading.reach + (0.7072 if nearest else 0.0)
    axis, half = (reading.axis_x, reading.axis_y), (reading.sine, reading.cosine)
    return make_cone(reading.x, reading.y, axis, half, reach)


@kernel
def walk(table: Any, t: int, shape: Any, nearest: bool, cells: Any, distances: Any) -> int:
    """Write the cells of reading t and their distances; return their number, even where the arrays are too short."""
    height, width = shape
    cone = cone_of(table[t], nearest)
    n = 0
    for row in range(max(cone.bottom, 0), min(cone.top, height - 1) + 1):
        a, b, c, d = row_runs(cone, row, table[t].reach, width, nearest)
        v = row + 0.5 - cone.y
        for first, last in ((a, b), (c, d)):
            for column in range(first, last + 1):
                if n < len(cells):
                    cells[n] = row * width + column
                    distances[n] = distance(column + 0.5 - cone.x, v, nearest)
                n += 1
    return n


@kernel
def walk_resized(
    table: Any, t: int, shape: Any, nearest: bool, cells: Any, distances: Any
) -> tuple[int, NDArray[np.int32], Floats]:
    """Do as `walk` does; where the arrays are too short, go on with longer ones. Return them after the number."""
    n = walk(table, t, shape, nearest, cells, distances)
    if n > len(cells):
        cells, distances = np.empty(2 * n, np.int32), np.empty(2 * n, np.float64)
        n = walk(table, t, shape, nearest, cells, distances)
    return n, cells, distances
