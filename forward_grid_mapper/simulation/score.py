"""Scores of a map against the world it was made in, as in the paper's experiments.

A map is scored at the cells of the world's lattice, whatever its own: a cell is occupied if any part of it is. Unless
said otherwise a wall counts as found where an occupied cell lies at most one cell away, diagonally too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.common.grid import UNKNOWN, Grid
from ..core.common.readings import Readings
from .rays import NOTHING, cast
from .world import Door, World, cells_along

Map = NDArray[np.int8]
Mask = NDArray[np.bool_]

VISIBLE_RAYS = 31

SURFACE_DEPTH = 0.2
"""A wall cell counts as visible if a ray meets it at most so many metres beyond the nearest one of its cone."""


@dataclass(frozen=True)
class Scores:
    """How well a map shows a world; shares lie in [0, 1] and are NaN where there is nothing to count.

    Attributes
    ----------
    precision : float
        Fraction of the map's occupied cells that lie at most one cell from a wall.
    recall : float
        Fraction of the visible wall cells that are found.
    f1 : float
        Harmonic mean of the two.
    false_dots : int
        Occupied cells of the map in free space, more than one cell from any wall.
    door_widths : tuple of float
        Metres of each door that the map shows as open, at most the door's width.
    doors_open : int
        Doors of which at least half the width is open.
    smooth_recall : float
        Recall on smooth walls alone.
    rough_coverage : float
        Recall on all other walls.
    column_coverage : float
        Fraction of the visible cells of the other walls with an occupied cell at most one cell *across* the wall. Dots
        on every second or third cell, which recall forgives, lower it.
    longest_gap : int
        Longest run along such a wall, in cells, without coverage in that sense.
    """

    precision: float
    recall: float
    f1: float
    false_dots: int
    door_widths: tuple[float, ...]
    doors_open: int
    smooth_recall: float
    rough_coverage: float
    column_coverage: float
    longest_gap: int


def threshold(probability: NDArray[np.floating]) -> Map:
    """Return 1 where a probability is above 0.65, 0 where it is below 0.35, -1 between and where it is NaN."""
    decided = np.full(probability.shape, UNKNOWN, np.int8)
    decided[probability > 0.65] = 1
    decided[probability < 0.35] = 0
    return decided


def visible_surface(world: World, readings: Readings, depth: float = math.inf) -> Mask:
    """Return the wall cells that rays within the readings' cones meet within z_max, smooth ones too.

    Nothing but walls stops a ray: what a person hid from a sweep counts as visible.

    Parameters
    ----------
    world : World
    readings : Readings
    depth : float
        Leave out what lies more than this many metres behind the nearest wall of the same cone. A sonar answers for the
        nearest wall alone, so without a bound the surface holds walls that no reading could show.

    Returns
    -------
    bool, shape `world.grid.shape`
    """
    visible = np.zeros(world.grid.shape, bool)
    fan = np.linspace(-1.0, 1.0, VISIBLE_RAYS)
    for start in range(0, len(readings), 10_000):
        part = readings.select(slice(start, start + 10_000))
        angles = part.yaw[:, None] + part.half_angle[:, None] * fan
        origins = np.stack([part.x, part.y], axis=1)
        distance, hit = cast(origins, angles, world.segments, float(part.z_max.max()))
        bound = np.minimum(part.z_max, distance.min(axis=1) + depth)
        met = (hit != NOTHING) & (distance <= bound[:, None])
        reading, _ = np.nonzero(met)
        x = part.x[reading] + distance[met] * np.cos(angles[met])
        y = part.y[reading] + distance[met] * np.sin(angles[met])
        visible[world.grid.cells_of(x, y)] = True
    # an end of a wall lies on a face, where rounding may tip a hit into the free cell beside it
    visible &= world.reference == 1
    return visible


def score_map(ml: Map, grid: Grid, world: World, visible: Mask) -> Scores:
    """Score a map against a world.

    Parameters
    ----------
    ml : int8, shape `grid.shape`
        1 occupied, 0 free, -1 unknown.
    grid : Grid
        Where the map lies, in the world's frame; any origin, size and resolution.
    world : World
    visible : bool, shape `world.grid.shape`
        The cells that recall asks for, from `visible_surface`.
    """
    whole, inner, reference = _around(world, grid)
    sampled = _sample(ml, grid, whole)
    occupied = sampled == 1
    near_wall, found = _grow(reference == 1), _grow(occupied)[inner]
    precision = _share(near_wall[occupied]) if occupied.any() else 0.0
    recall = _share(found[visible])
    total = precision + recall
    rough = visible & ~world.smooth_cells
    column_coverage, longest_gap = _coverage(world, occupied[inner], rough)
    widths = tuple(_open_width(sampled[inner], world.grid, door) for door in world.doors)
    return Scores(
        precision=precision,
        recall=recall,
        f1=2.0 * precision * recall / total if total else 0.0,
        false_dots=int((occupied & ~near_wall & (reference == 0)).sum()),
        door_widths=widths,
        doors_open=sum(width >= door.width / 2 - 1e-9 for width, door in zip(widths, world.doors, strict=True)),
        smooth_recall=_share(found[visible & world.smooth_cells]),
        rough_coverage=_share(found[rough]),
        column_coverage=column_coverage,
        longest_gap=longest_gap,
    )


def _share(hits: Mask) -> float:
    return float(hits.mean()) if hits.size else math.nan


def _around(world: World, grid: Grid) -> tuple[Grid, tuple[slice, slice], Map]:
    """Return the world's lattice extended over `grid`, the world's window in it, and the extended reference."""
    left, right, bottom, top = grid.extent
    hair = 1e-6
    cover = Grid.covering((left + hair, right - hair, bottom + hair, top - hair), world.grid.resolution)
    whole = world.grid.union(cover) if grid.size else world.grid
    inner = whole.window(world.grid)
    reference = np.full(whole.shape, UNKNOWN, np.int8)
    reference[inner] = world.reference
    return whole, inner, reference


def _sample(ml: Map, grid: Grid, target: Grid) -> Map:
    """Return the map on the cells of `target`: the largest value in each, so that small walls survive."""
    best = np.full(target.shape, UNKNOWN, np.int8)
    if not grid.size:
        return best
    x, y = target.centers()
    parts = max(1, math.ceil(target.resolution / grid.resolution - 1e-6))
    shifts = ((np.arange(parts) + 0.5) / parts - 0.5) * target.resolution
    for dy in shifts:
        for dx in shifts:
            rows, _ = grid.cells_of(np.zeros(1), y + dy)
            _, columns = grid.cells_of(x + dx, np.zeros(1))
            known = ((rows >= 0) & (rows < grid.height))[:, None] & ((columns >= 0) & (columns < grid.width))
            values = ml[np.clip(rows, 0, grid.height - 1)[:, None], np.clip(columns, 0, grid.width - 1)]
            best = np.maximum(best, np.where(known, values, UNKNOWN))
    return best


def _grow(cells: Mask) -> Mask:
    """Return `cells` and their eight neighbours."""
    padded = np.pad(cells, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    grown: Mask = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return grown


def _coverage(world: World, occupied: Mask, asked: Mask) -> tuple[float, int]:
    """Return the fraction of `asked` wall cells with an occupied cell across the wall, and the longest run without."""
    padded = np.pad(occupied, 1)
    covered: list[Mask] = []
    longest = 0
    for segment in world.segments:
        rows, columns = cells_along(segment, world.grid)
        up, right = (1, 0) if abs(segment[2] - segment[0]) >= abs(segment[3] - segment[1]) else (0, 1)
        across = [padded[rows + 1 + step * up, columns + 1 + step * right] for step in (-1, 0, 1)]
        hit = np.logical_or.reduce(across)
        longest = max(longest, _longest_run(asked[rows, columns] & ~hit))
        covered.append(hit[asked[rows, columns]])
    return _share(np.concatenate(covered)), longest


def _open_width(sampled: Map, grid: Grid, door: Door) -> float:
    """Return the widest run, in metres, of ways through the door that are free for two cells before and behind."""
    field = sampled if door.axis == 'x' else sampled.T
    along, across = (door.x, door.y) if door.axis == 'x' else (door.y, door.x)
    first_along, first_across = (grid.column, grid.row) if door.axis == 'x' else (grid.row, grid.column)
    wall = math.floor(across / grid.resolution) - first_across
    low = round((along - door.width / 2) / grid.resolution) - first_along
    count = round(door.width / grid.resolution)
    # a map that shows the door one cell aside still shows a door
    opening = field[max(wall - 2, 0) : wall + 3, max(low - 1, 0) : low + count + 1]
    run = _longest_run(np.all(opening == 0, axis=0))
    return round(min(run, count) * grid.resolution, 6)


def _longest_run(flags: Mask) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
