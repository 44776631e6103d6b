"""Scores of a map against its simulated world, as in the paper's experiments.

A map with any grid is scored at the cells of the world's lattice: a cell is occupied if any part of it is. Unless
stated otherwise, a wall is found if an occupied cell is at most one cell away, also diagonally.
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
"""A wall cell is visible if a ray hits it at most this many metres beyond the nearest hit of its cone."""


@dataclass(frozen=True)
class Scores:
    """Scores of a map; fractions are in [0, 1], and NaN if there is nothing to count.

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
        on every second or third cell lower it, but not recall.
    longest_gap : int
        Longest run of cells along such a wall that are not covered in this sense.
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
    """Return the wall cells that rays within the readings' cones hit within z_max, including smooth ones.

    Only walls stop a ray: cells that a person hid from a sweep are visible.

    Parameters
    ----------
    world : World
    readings : Readings
    depth : float
        Leave out cells more than this many metres behind the nearest wall of the same cone. A sonar measures only the
        nearest wall, so without a bound the surface contains walls that no reading could show.

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
    # the end of a wall is on a face of its cell, so rounding may put a hit into the adjacent free cell
    visible &= world.reference == 1
    return visible


def score_map(ml: Map, grid: Grid, world: World, visible: Mask) -> Scores:
    """Score a map against a world.

    Parameters
    ----------
    ml : int8, shape `grid.shape`
        1 occupied, 0 free, -1 unknown.
    grid : Grid
        Grid of the map, in the world's frame; any origin, size and resolution.
    world : World
    visible : bool, shape `world.grid.shape`
        The cells for recall, from `visible_surface`.
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
    """Return the map at the cells of `target`: the largest value in each, so that thin walls are kept."""
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


def _coverage(world: World, occupied: Mask, wanted: Mask) -> tuple[float, int]:
    """Return the fraction of `wanted` wall cells with an occupied cell across the wall, and the longest run without."""
    padded = np.pad(occupied, 1)
    covered: list[Mask] = []
    longest = 0
    for segment in world.segments:
        rows, columns = cells_along(segment, world.grid)
        up, right = (1, 0) if abs(segment[2] - segment[0]) >= abs(segment[3] - segment[1]) else (0, 1)
        across = [padded[rows + 1 + step * up, columns + 1 + step * right] for step in (-1, 0, 1)]
        hit = np.logical_or.reduce(across)
        longest = max(longest, _longest_run(wanted[rows, columns] & ~hit))
        covered.append(hit[wanted[rows, columns]])
    return _share(np.concatenate(covered)), longest


def _open_width(sampled: Map, grid: Grid, door: Door) -> float:
    """Return the width of the widest passage through the door that is free for two cells on both sides, metres."""
    field = sampled if door.axis == 'x' else sampled.T
    along, across = (door.x, door.y) if door.axis == 'x' else (door.y, door.x)
    first_along, first_across = (grid.column, grid.row) if door.axis == 'x' else (grid.row, grid.column)
    wall = math.floor(across / grid.resolution) - first_across
    low = round((along - door.width / 2) / grid.resolution) - first_along
    count = round(door.width / grid.resolution)
    # a door that is shifted by one cell still counts
    opening = field[max(wall - 2, 0) : wall + 3, max(low - 1, 0) : low + count + 1]
    run = _longest_run(np.all(opening == 0, axis=0))
    return round(min(run, count) * grid.resolution, 6)


def _longest_run(flags: Mask) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
