#!/usr/bin/env python3
"""Time of EM: steps of the search, and single kernels on the resulting map.

usage: kernels.py [--runs 5] [--patience 0]

All on one thread. A kernel's time is also given per unit of its work.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from measuring import PATIENCE, machine, stream_seconds, timed

from forward_grid_mapper.core.common.constants import arc_depths
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, in_canonical_order
from forward_grid_mapper.core.evidence.cell_flip import find_observing, flip
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.pairs import WORDS_PER_RUN, make
from forward_grid_mapper.core.evidence.state import State
from forward_grid_mapper.core.evidence.tile_index import CHUNK, SHIFT
from forward_grid_mapper.core.evidence.updates import _add_to_free_zone, evaluate
from forward_grid_mapper.core.maps.traversed import traversed_cells
from forward_grid_mapper.core.search.flips import promising
from forward_grid_mapper.core.search.prior import wall_prior
from forward_grid_mapper.core.search.search import LEAST, Search
from forward_grid_mapper.core.sensor.cone_table import grid_of
from forward_grid_mapper.core.warm_up import warm_up
from forward_grid_mapper.simulation.drive import building_drive, corridor_drive

loop = numba.njit(nogil=True, error_model='numpy')

SAMPLE = 1000
"""Occupied cells that are flipped twice."""


@loop
def _make_all(s: State) -> None:
    for t in range(len(s.reading_states)):
        make(s.cones, s.lattice, s.normals, t, s.workspace.pairs, 0, s.workspace)


@loop
def _evaluate_all(s: State) -> None:
    for t in range(len(s.reading_states)):
        evaluate(s.model, s.reading_states[t], s.maps.occupied, s.pairs, s.reading_states[t].at, s.workspace)


@loop
def _push_bands(s: State, by: int) -> None:
    for t in range(len(s.reading_states)):
        m = np.uint64(s.reading_states[t].bands)
        cell = np.uint64(s.reading_states[t].at + WORDS_PER_RUN * s.reading_states[t].runs)
        for k in range(m):
            s.maps.evidence[s.pairs.cell[cell + k]] += by
            s.pairs.log[cell + m + m + k] += by


@loop
def _push_free_zones(s: State, by: int) -> None:
    for t in range(len(s.reading_states)):
        _add_to_free_zone(s.reading_states[t], s.pairs, s.reading_states[t].at, s.maps, (by, by))


@loop
def _observing(s: State, cells: Any) -> int:
    n = 0
    for c in cells:
        n += find_observing(s, c)
    return n


@loop
def _flip_all(s: State, cells: Any) -> None:
    for c in cells:
        flip(s, c)


@loop
def _touched(s: State, cells: Any, sizes: Any) -> int:
    """Return the number of pairs of all readings whose cones contain `cells`, with a reading counted for each cell."""
    n = 0
    for c in cells:
        for i in range(find_observing(s, c)):
            n += sizes[s.observing[i, 0]]
    return n


class Steps(Search):
    """A search that records the time of its steps."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.steps: dict[str, list[float]] = {}

    def _timed(self, name: str, step: Callable[..., Any], watch: Any) -> Any:
        begin = time.perf_counter()
        before = self.progress.flips + self.progress.shifts
        done = step(watch)
        row = self.steps.setdefault(name, [0.0, 0.0, 0.0])
        made = self.progress.flips + self.progress.shifts - before
        row[:] = row[0] + time.perf_counter() - begin, row[1] + 1, row[2] + made
        return done

    def _update_in_parallel(self, watch: Any) -> Any:
        return self._timed('parallel', super()._update_in_parallel, watch)

    def _update_in_sequence(self, watch: Any) -> Any:
        return self._timed('sequential', super()._update_in_sequence, watch)

    def _shift(self, watch: Any) -> Any:
        return self._timed('shifts', super()._shift, watch)

    def _close_gaps(self, watch: Any) -> Any:
        return self._timed('gap closing', super()._close_gaps, watch)


def profile(name: str, readings: Readings, runs: int) -> None:
    """Print the profile of one job."""
    p = Parameters()
    readings = in_canonical_order(readings)
    grid = grid_of(readings, p.model, p.grid, beyond=arc_depths(p.grid.resolution)[1])
    traversed = traversed_cells(readings, grid)
    begin = time.perf_counter()
    evidence = Evidence(grid, p.model)
    evidence.extend(readings)
    built = time.perf_counter() - begin
    search = Steps(evidence, p.search, traversed.ravel())
    begin = time.perf_counter()
    search.run()
    searched = time.perf_counter() - begin
    s, pairs = evidence.state, evidence.pairs
    s = s._replace(reading_states=s.reading_states[: len(evidence)], cones=s.cones[: len(evidence)])
    bands = int(s.reading_states['bands'].sum())
    free = pairs - bands
    print(
        f'\n{name}: {len(readings)} readings, {pairs} pairs, of which {bands / pairs:.0%} are in bands; '
        f'{evidence.nbytes / pairs:.2f} bytes a pair\n'
        f'evidence built in {built:.3f} s, search in {searched:.3f} s:'
    )
    for step, (seconds, count, made) in search.steps.items():
        fraction = seconds / searched
        print(f'  {step:12s}{seconds:9.3f} s {fraction:6.0%}{count:6.0f} times{made:9.0f} flips or moves')
    cells = np.flatnonzero(s.maps.occupied == 1)
    cells = np.random.default_rng(0).permutation(cells)[:SAMPLE]
    observing = _observing(s, cells)
    sizes = s.reading_states['bands'].astype(np.int64)
    for k in range(len(sizes)):
        words = s.pairs.cell[s.reading_states['at'][k] :][: 2 * s.reading_states['runs'][k]].astype(np.int64)
        sizes[k] += int((words[1::2] - words[::2] + 1).sum())
    touched = _touched(s, cells, sizes)
    scanned = _scanned(s, cells)
    found, gains = np.empty(grid.size, np.int64), np.empty(grid.size)
    window = (0, grid.height, 0, grid.width)
    prior = wall_prior(p.search, np.zeros(grid.size, np.bool_), grid.resolution)
    n = len(readings)
    kernels: tuple[tuple[str, Callable[[], Any], tuple[tuple[int, str], ...]], ...] = (
        ('make pairs', lambda: _make_all(s), ((n, 'reading'), (pairs, 'pair'))),
        ('evaluate', lambda: _evaluate_all(s), ((n, 'reading'), (bands, 'band pair'))),
        ('push to bands', lambda: _push_bands(s, 0), ((bands, 'band pair'),)),
        ('push to free zones', lambda: _push_free_zones(s, 0), ((free, 'free pair'),)),
        ('all readings anew', evidence.rebuild, ((n, 'reading'), (pairs, 'pair'))),
        (
            'find observing',
            lambda: _observing(s, cells),
            ((len(cells), 'cell'), (scanned, 'candidate'), (observing, 'reading that sees it')),
        ),
        (
            'flip',
            lambda: _flip_all(s, cells),
            ((len(cells), 'flip'), (observing, 'reading that sees it'), (touched, 'pair touched')),
        ),
        ('look for gains', lambda: promising(s, prior, LEAST, window, found, gains), ((grid.size, 'cell'),)),
    )
    print(
        f'  a flip has {scanned / len(cells):.0f} candidates, {observing / len(cells):.0f} readings that see the cell'
    )
    for kernel, work, units in kernels:
        work()
        seconds = timed(work, runs)
        each = ', '.join(f'{seconds / max(count, 1) * 1e9:,.1f} ns a {unit}' for count, unit in units)
        print(f'  {kernel:20s}{seconds:9.4f} s   {each}')
    print(f'  {"stream of the bytes":20s}{stream_seconds(evidence.nbytes, runs):9.4f} s')


def _scanned(s: State, cells: Any) -> int:
    """Return the number of readings in the lists of the cells' tiles."""
    total = 0
    for c in cells:
        row, column = divmod(int(c), s.lattice.width)
        tile = (row >> SHIFT) * s.tiles.across + (column >> SHIFT)
        chunk, fill = s.tiles.head[tile], int(s.tiles.fill[tile])
        while chunk >= 0:
            total += fill
            chunk, fill = s.tiles.chunks[chunk, CHUNK], CHUNK
    return total


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--patience', type=float, default=0.0, help='seconds to repeat what others disturb (default 0)')
    options = parser.parse_args()
    os.environ[PATIENCE] = str(options.patience)
    print(f'{machine()}\nkernels: medians of {options.runs} runs; search: one run')
    warm_up()
    profile('corridor', corridor_drive(0).readings, options.runs)
    profile('corridor, 17 passes', corridor_drive(0, passes=17).readings, options.runs)
    profile('building, 16 x 30 deg', building_drive(0).readings, options.runs)


if __name__ == '__main__':
    main()
