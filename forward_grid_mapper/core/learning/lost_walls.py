"""Walls that are on one map and missing on another.

If p_hit is learned together with the map, it can converge to a local optimum without smooth walls: only few readings of
such a wall have an echo. With a larger p_hit, those without echo outweigh them, and the wall disappears. Then its
echoes are random measurements, the remaining obstacles return echoes more often, and p_hit grows further.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid
from ..common.readings import Floats, Readings
from ..maps.map_set import MapSet

Mask = NDArray[np.bool_]

LEAST_ECHOES = 3
"""Fewest echoes that support a cell of a wall."""
LEAST_LENGTH = 0.5
"""Shortest stretch of wall that is worth a warning, metres."""
_JOINED = 2
"""Largest distance of cells of one stretch, in rows and columns."""
_TRAVERSED = 0.3
"""Metres around the positions of sensors in which no wall can be: what disappeared there was a person."""
_CHUNK, _USUAL_FAN = 4096, 81


@dataclass(frozen=True)
class Stretch:
    """A stretch of wall that was lost.

    Attributes
    ----------
    cells : int
    length : float
        The longer side of its bounding box, metres.
    start, end : (float, float)
        Corners of the bounding box of its cells' centres, metres in the map frame.
    echoes : int
        Number of readings that were its echoes and are now random measurements or lost echoes.
    """

    cells: int
    length: float
    start: tuple[float, float]
    end: tuple[float, float]
    echoes: int


def lost_walls(before: MapSet, after: MapSet) -> list[Stretch]:
    """Return the stretches of wall that `before` shows and `after` does not, the longest first.

    A cell is lost if at least `LEAST_ECHOES` readings are its echoes in `before`, `after` has no occupied cell within
    one cell of it, and no sensor was ever within 0.3 m of it. Stretches shorter than `LEAST_LENGTH`, and those whose
    echoes `after` explains by other obstacles, are left out.

    Parameters
    ----------
    before, after : MapSet
        Of the same readings, in any order, and the same resolution.
    """
    whole = before.grid.union(after.grid)
    old, new = np.zeros(whole.shape, bool), np.zeros(whole.shape, bool)
    old[whole.window(before.grid)] = before.ml == 1
    new[whole.window(after.grid)] = after.ml == 1
    readings = before.readings
    heard = before.forward_model().expectations(before.ml).hit > 0.5
    candidates = old & ~_grown(new, 1)
    rows, columns = whole.cells_of(readings.x, readings.y)
    traversed = np.zeros(whole.shape, bool)
    inside = (rows >= 0) & (rows < whole.height) & (columns >= 0) & (columns < whole.width)
    traversed[rows[inside], columns[inside]] = True
    candidates &= ~_grown(traversed, round(_TRAVERSED / whole.resolution))
    reading, cell = _arcs(readings, np.flatnonzero(heard & readings.echo), whole, candidates)
    lost = candidates & (np.bincount(cell, minlength=whole.size).reshape(whole.shape) >= LEAST_ECHOES)
    now = after.forward_model().expectations(after.ml)
    turned = now.random + now.lost > 0.5
    x, y = whole.centers()
    found = []
    for part in _stretches(lost):
        row, column = np.divmod(part, whole.width)
        length = (max(np.ptp(row), np.ptp(column)) + 1) * whole.resolution
        echoes = np.unique(reading[np.isin(cell, part)])
        # if the new map explains its echoes by other obstacles, the wall was moved, not lost
        if length >= LEAST_LENGTH and turned[echoes].sum() >= LEAST_ECHOES:
            start = float(x[column.min()]), float(y[row.min()])
            end = float(x[column.max()]), float(y[row.max()])
            found.append(Stretch(len(part), float(length), start, end, int(turned[echoes].sum())))
    return sorted(found, key=lambda stretch: -stretch.length)


def _arcs(
    readings: Readings, which: NDArray[np.int64], grid: Grid, wanted: Mask
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (reading, flat cell) of the cells of `wanted` within one cell of the arcs of the readings `which`."""
    pairs: list[NDArray[np.int64]] = []
    widest = float((readings.half_angle[which] * readings.z[which]).max(initial=0.0)) / grid.resolution
    # two points for each cell of the arc
    fan = np.linspace(-1.0, 1.0, 2 * (2 * int(widest) + 1) + 1)
    at_once = max(_CHUNK * _USUAL_FAN // len(fan), 1)
    for begin in range(0, len(which), at_once):
        numbers = which[begin : begin + at_once]
        part = readings.select(numbers)
        angles = part.yaw[:, None] + part.half_angle[:, None] * fan
        for shift in (-grid.resolution, 0.0, grid.resolution):
            z: Floats = np.maximum(part.z + shift, 0.0)[:, None]
            rows, columns = grid.cells_of(part.x[:, None] + z * np.cos(angles), part.y[:, None] + z * np.sin(angles))
            good = (rows >= 0) & (rows < grid.height) & (columns >= 0) & (columns < grid.width)
            good[good] = wanted[rows[good], columns[good]]
            key = np.broadcast_to(numbers[:, None], rows.shape)[good] * grid.size
            pairs.append(np.unique(key + rows[good] * grid.width + columns[good]))
    keys = np.unique(np.concatenate(pairs)) if pairs else np.empty(0, np.int64)
    reading, cell = np.divmod(keys, grid.size)
    return reading, cell


def _grown(cells: Mask, by: int) -> Mask:
    """Return `cells` and all within `by` rows and columns of them."""
    grown = cells.copy()
    for axis in (0, 1):
        wide = grown.copy()
        for step in range(1, by + 1):
            for to, of in ((slice(step, None), slice(None, -step)), (slice(None, -step), slice(step, None))):
                target = wide[to] if axis == 0 else wide[:, to]
                target |= grown[of] if axis == 0 else grown[:, of]
        grown = wide
    return grown


def _stretches(cells: Mask) -> list[NDArray[np.int64]]:
    """Return the flat cells of each connected group."""
    width = cells.shape[1]
    remaining = {(int(row), int(column)) for row, column in np.argwhere(cells)}
    steps = [(r, c) for r in range(-_JOINED, _JOINED + 1) for c in range(-_JOINED, _JOINED + 1)]
    groups = []
    while remaining:
        front, group = [remaining.pop()], []
        while front:
            row, column = front.pop()
            group.append(row * width + column)
            near = {(row + r, column + c) for r, c in steps} & remaining
            remaining -= near
            front += near
        groups.append(np.array(sorted(group), np.int64))
    return groups
