"""Which cells lie in which cone, and which readings see a cell: the table that the search runs on.

A reading of range z splits its cone. In the *free zone*, nearer than z − cut·σ, the noise density is nil: an occupied
cell there acts only by standing in the way, so its distance does not matter and a pair is a pair of ids. In the
*band* around z lie the cells that can explain the reading, sorted by distance. Cells beyond the band cannot matter,
unless z is near z_max: then all cells up to z_max stand in the way of the max-range cause.

The table is kept twice. By reading: free cells, and band cells with their density. By cell: the readings that have
it in their free zone, and its band slots, so that the flip evaluation reads each cell's share front to back.

Memory: 8 bytes a free pair, 20 a band pair, about 80 a reading and 30 a cell, what the search keeps included.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cone import axis_run, distance, make_cone, wedge_run
from .errors import Cancelled, InputError
from .grid import Grid, cone_boxes
from .jit import kernel
from .parameters import GridParameters, ModelParameters
from .readings import Readings

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Offsets = NDArray[np.int64]


class ConeTable(NamedTuple):
    """The cones of N readings on a grid, in cells; what the kernels need to walk them.

    All float64, shape (N,): apex, axis and half angle; `z`, `z_max`, `sigma`; `free`, the end of the free zone;
    `reach`, beyond which no cell matters.
    """

    x: Floats
    y: Floats
    yaw: Floats
    half_angle: Floats
    z: Floats
    z_max: Floats
    sigma: Floats
    free: Floats
    reach: Floats


class ConeIndex(NamedTuple):
    """Pairs of cells and readings, in both orders. Offsets are int64, ids and slots int32, densities float32.

    Attributes
    ----------
    free_start, free_cell
        Reading t has the cells ``free_cell[free_start[t]:free_start[t + 1]]`` in its free zone.
    band_start, band_cell, band_density, band_slot
        The same for its band, nearest first: cell, N(z; d, σ) in 1/m, and the pair's slot in the order by cell.
    seen_start, seen_reading
        Cell c lies in the free zone of the readings ``seen_reading[seen_start[c]:seen_start[c + 1]]``.
    slot_start, slot_reading
        Cell c has the band slots ``slot_start[c]:slot_start[c + 1]``, and the reading of each.
    """

    free_start: Offsets
    free_cell: Ints
    band_start: Offsets
    band_cell: Ints
    band_density: NDArray[np.float32]
    band_slot: Ints
    seen_start: Offsets
    seen_reading: Ints
    slot_start: Offsets
    slot_reading: Ints

    @property
    def pairs(self) -> int:
        """Number of pairs of a cell and a reading."""
        return len(self.free_cell) + len(self.band_cell)

    @property
    def nbytes(self) -> int:
        """Memory of all arrays in bytes."""
        return sum(array.nbytes for array in self)


def effective_sigma(readings: Readings, model: ModelParameters, resolution: float) -> Floats:
    """Return each reading's σ in metres: its own or the model's, but not less than half a cell (ALGORITHM §9)."""
    return np.maximum(np.where(readings.sigma > 0, readings.sigma, model.sigma), resolution / 2)


def reach_of(readings: Readings, sigma: Floats, cut: float) -> Floats:
    """Return the distance in metres beyond which no cell of each cone matters, shape (N,).

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


def cone_table(readings: Readings, grid: Grid, model: ModelParameters) -> ConeTable:
    """Return the readings' cones in cells of `grid`."""
    sigma = effective_sigma(readings, model, grid.resolution)
    scale = 1.0 / grid.resolution
    return ConeTable(
        x=readings.x * scale - grid.column,
        y=readings.y * scale - grid.row,
        yaw=np.ascontiguousarray(readings.yaw),
        half_angle=np.ascontiguousarray(readings.half_angle),
        z=readings.z * scale,
        z_max=readings.z_max * scale,
        sigma=sigma * scale,
        free=(readings.z - model.cut * sigma) * scale,
        reach=reach_of(readings, sigma, model.cut) * scale,
    )


@kernel
def walk(table: Any, t: int, shape: Any, nearest: bool, cells: Any, distances: Any) -> int:
    """Write the cells of reading t and their distances; return their number, even where the arrays are too short."""
    height, width = shape
    # the corners of a cell may be nearer than its centre
    reach = table.reach[t] + (0.7072 if nearest else 0.0)
    cone = make_cone(table.x[t], table.y[t], table.yaw[t], table.half_angle[t], reach)
    n = 0
    for row in range(max(cone.bottom, 0), min(cone.top, height - 1) + 1):
        a, b = wedge_run(cone, row)
        c, d = axis_run(cone, row)
        if b < a:
            a, b = c, d
        elif d < c:
            c, d = a, b
        dv = row + 0.5 - cone.y
        for column in range(max(min(a, c), 0), min(max(b, d), width - 1) + 1):
            if not (a <= column <= b or c <= column <= d):
                continue
            away = distance(column + 0.5 - cone.x, dv, nearest)
            if away <= table.reach[t]:
                if n < len(cells):
                    cells[n] = row * width + column
                    distances[n] = away
                n += 1
    return n


@kernel
def walk_with_room(
    table: Any, t: int, shape: Any, nearest: bool, cells: Any, distances: Any
) -> tuple[int, NDArray[np.int32], Floats]:
    """Do as `walk` does; where the arrays are too short, go on with longer ones. Return them after the number."""
    n = walk(table, t, shape, nearest, cells, distances)
    if n > len(cells):
        cells, distances = np.empty(2 * n, np.int32), np.empty(2 * n, np.float64)
        n = walk(table, t, shape, nearest, cells, distances)
    return n, cells, distances


@kernel
def _count(table: Any, shape: Any, nearest: bool, starts: Any, stop: Any) -> int:
    """Count the pairs by reading and by cell, each into the place after its own; return the largest cone.

    `starts` are the offsets of a `ConeIndex` in its order: free_start, band_start, seen_start, slot_start.
    """
    free_start, band_start, seen_start, slot_start = starts
    cells, distances = np.empty(1024, np.int32), np.empty(1024, np.float64)
    largest = 0
    for t in range(len(table.x)):
        if stop[0]:
            break
        n, cells, distances = walk_with_room(table, t, shape, nearest, cells, distances)
        largest = max(largest, n)
        for k in range(n):
            if distances[k] < table.free[t]:
                free_start[t + 1] += 1
                seen_start[cells[k] + 1] += 1
            else:
                band_start[t + 1] += 1
                slot_start[cells[k] + 1] += 1
    return largest


@kernel
def _fill(
    table: Any, shape: Any, nearest: bool, cut: float, resolution: float, index: Any, largest: int, stop: Any
) -> None:
    """Write every pair at the place that the counts gave it; the offsets by cell move on and are put back."""
    cells, distances = np.empty(largest, np.int32), np.empty(largest, np.float64)
    band = np.empty(largest, np.int32)
    keys = np.empty(largest, np.float64)
    for t in range(len(table.x)):
        if stop[0]:
            break
        n = walk(table, t, shape, nearest, cells, distances)
        at = index.free_start[t]
        m = 0
        for k in range(n):
            cell = cells[k]
            if distances[k] < table.free[t]:
                index.free_cell[at] = cell
                at += 1
                index.seen_reading[index.seen_start[cell]] = t
                index.seen_start[cell] += 1
            else:
                band[m] = cell
                keys[m] = distances[k]
                m += 1
        order = np.argsort(keys[:m], kind='mergesort')
        sigma = table.sigma[t]
        peak = 1.0 / (math.sqrt(2.0 * math.pi) * sigma * resolution)
        at = index.band_start[t]
        for k in range(m):
            cell = band[order[k]]
            error = (table.z[t] - keys[order[k]]) / sigma
            slot = index.slot_start[cell]
            index.slot_start[cell] += 1
            index.slot_reading[slot] = t
            index.band_cell[at] = cell
            index.band_slot[at] = slot
            index.band_density[at] = peak * math.exp(-0.5 * error * error) if abs(error) <= cut else 0.0
            at += 1
    for starts in (index.seen_start, index.slot_start):
        for c in range(len(starts) - 1, 0, -1):
            starts[c] = starts[c - 1]
        starts[0] = 0


def check(stop: NDArray[np.uint8]) -> None:
    """Raise `Cancelled` if `stop` is set."""
    if stop[0]:
        raise Cancelled('the work was cancelled; nothing was changed')


def build_cone_index(
    readings: Readings, grid: Grid, model: ModelParameters, stop: NDArray[np.uint8] | None = None
) -> ConeIndex:
    """Index the cones of `readings` on `grid`; cells outside the grid are left out.

    Cost and memory are linear in the number of pairs of a cell and a reading.

    Parameters
    ----------
    readings : Readings
    grid : Grid
    model : ModelParameters
    stop : uint8, shape (1,), optional
        Set to 1 from any thread to cancel.

    Raises
    ------
    Cancelled
        If `stop` was set.
    InputError
        If there are more than 2³¹ pairs.
    """
    stop = np.zeros(1, np.uint8) if stop is None else stop
    table = cone_table(readings, grid, model)
    nearest = model.cell_distance == 'nearest'
    n = len(readings)
    starts = tuple(np.zeros(size + 1, np.int64) for size in (n, n, grid.size, grid.size))
    largest = _count(table, grid.shape, nearest, starts, stop)
    check(stop)
    free_start, band_start, seen_start, slot_start = (np.cumsum(start) for start in starts)
    free, band = int(free_start[-1]), int(band_start[-1])
    if max(free, band) > np.iinfo(np.int32).max:
        raise InputError(
            f'{free + band} pairs of cells and readings are more than the {np.iinfo(np.int32).max} that fit: raise '
            f'resolution, or map fewer readings at once'
        )
    index = ConeIndex(
        free_start=free_start,
        free_cell=np.empty(free, np.int32),
        band_start=band_start,
        band_cell=np.empty(band, np.int32),
        band_density=np.empty(band, np.float32),
        band_slot=np.empty(band, np.int32),
        seen_start=seen_start,
        seen_reading=np.empty(free, np.int32),
        slot_start=slot_start,
        slot_reading=np.empty(band, np.int32),
    )
    _fill(table, grid.shape, nearest, model.cut, grid.resolution, index, largest, stop)
    check(stop)
    return index
