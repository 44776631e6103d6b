"""The loops of the paper's Table 2, compiled but otherwise unchanged, for comparison.

For every cell, for every reading whose cone contains it: cast the reading again, collect the occupied cells of its
cone, and compute its likelihood with the cell occupied and with the cell free. The cell gets the more likely value.
Sweeps over all cells are repeated until none flips. Model, cones and prior are those of the package. Errors of the
printed text are corrected as `docs/paper.md` describes, since there would be no map to compare otherwise. The list of
readings of each cell is made beforehand, and is not timed.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from forward_grid_mapper.core.common.constants import arc_depths
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.search.search import LEAST_GAIN
from forward_grid_mapper.core.sensor.cone_table import cone_table, grid_of, walk
from forward_grid_mapper.core.sensor.density import causes_of, density

LARGEST = 100_000
"""Most cells of a cone."""


class Table2(NamedTuple):
    """The result of the loops; `casts` counts readings cast again, two likelihoods each."""

    grid: Grid
    occupied: NDArray[np.uint8]
    seconds: float
    sweeps: int
    flips: int
    casts: int


@numba.njit(error_model='numpy')
def _lists(table: Any, shape: tuple[int, int]) -> Any:
    cells, distances = np.empty(LARGEST, np.int32), np.empty(LARGEST)
    begin = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for t in range(len(table)):
        for k in range(walk(table, t, shape, cells, distances)):
            begin[cells[k] + 1] += 1
    begin = np.cumsum(begin)
    readings, at = np.empty(begin[-1], np.int32), begin.copy()
    for t in range(len(table)):
        for k in range(walk(table, t, shape, cells, distances)):
            readings[at[cells[k]]] = t
            at[cells[k]] += 1
    return begin, readings


@numba.njit(error_model='numpy')
def _likelihood(reading: Any, hits: Any, causes: Any, t: int, resolution: float) -> float:
    """Return p(z | obstacles at the distances `hits`, ascending); `scale` is cut and resolution."""
    total, weight = causes.random[t] + causes.lost[t], causes.mixture_weight
    for distance in hits:
        total += weight * causes.p_hit * density((reading.z - distance) / reading.sigma, reading.sigma * resolution)
        weight *= 1.0 - causes.p_hit
    return float(total + weight * causes.max_range[t])


@numba.njit(error_model='numpy')
def _sweep(table: Any, lists: Any, causes: Any, occupied: Any, shape: tuple[int, int], numbers: Any) -> tuple[int, int]:
    """Visit all cells once; return the number of flips, and of casts."""
    begin, readings = lists
    prior, least, resolution = numbers
    cells, distances = np.empty(LARGEST, np.int32), np.empty(LARGEST)
    hits, others = np.empty(LARGEST), np.empty(LARGEST)
    flips, casts = 0, 0
    for c in range(len(occupied)):
        gain = prior
        for i in range(begin[c], begin[c + 1]):
            t = readings[i]
            casts += 1
            # with the cell occupied, and without it
            m, n = 0, 0
            for k in range(walk(table, t, shape, cells, distances)):
                if cells[k] == c or occupied[cells[k]]:
                    hits[m] = distances[k]
                    m += 1
                    if cells[k] != c:
                        others[n] = distances[k]
                        n += 1
            hits[:m].sort()
            others[:n].sort()
            gain += math.log(
                _likelihood(table[t], hits[:m], causes, t, resolution)
                / _likelihood(table[t], others[:n], causes, t, resolution)
            )
        if begin[c] < begin[c + 1] and (gain > least if not occupied[c] else gain < -least):
            occupied[c] ^= 1
            flips += 1
    return flips, casts


def search(readings: Readings, parameters: Parameters, most_sweeps: int = 200) -> Table2:
    """Return the map of the loops, from the empty one."""
    p = parameters
    grid = grid_of(readings, p.model, p.grid, beyond=arc_depths(p.grid.resolution)[1])
    table = cone_table(readings, grid, p.model)
    causes = causes_of(readings, table['sigma'] * grid.resolution, p.model, grid.resolution)
    lists = _lists(table, grid.shape)
    prior = math.log(p.search.prior / (1 - p.search.prior))
    numbers = (prior, LEAST_GAIN, grid.resolution)
    occupied = np.zeros(grid.size, np.uint8)
    # compiles without visiting a cell
    _sweep(table, lists, causes, occupied[:0], grid.shape, numbers)
    sweeps, flips, casts = 0, 0, 0
    start = time.perf_counter()
    while sweeps < most_sweeps:
        flipped, cast = _sweep(table, lists, causes, occupied, grid.shape, numbers)
        sweeps, flips, casts = sweeps + 1, flips + flipped, casts + cast
        if not flipped:
            break
    return Table2(grid, occupied.reshape(grid.shape), time.perf_counter() - start, sweeps, flips, casts)
