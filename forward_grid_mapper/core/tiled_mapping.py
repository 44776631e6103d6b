"""From readings to the three maps in tiles: block coordinate ascent over windows of the map.

    normals        of the core of each tile, from the readings that reach into it; equal to those of the whole map
    first maps     of each tile with its halo, independently and in parallel; the cores are put together
    rounds         colour by colour, each stale tile is searched with all others fixed, until no tile changes
    final maps     of each core, from the readings that reach into it
    evaluation     of each reading, by the tile in whose core its sensor was

The objective is a sum over readings and a local prior. So the gain of a window is that of the whole map, which
increases with each change, and when no tile changes any more, no single flip gains. Tiles of one colour do not affect
each other, so the maps do not depend on how many are searched in parallel. They depend on the size of the tiles, like
any local search on its initial map.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from .common.parameters import Parameters
from .common.readings import Readings, in_canonical_order
from .evidence.neighbourhood import patterns
from .mapping import Watch
from .maps.log_odds_map import LogOddsMap, map_grid
from .maps.map_set import MapSet
from .runtime.cancelling import check
from .runtime.threads import cores
from .search.prior import log_prior, wall_prior
from .search.search import Progress
from .tiles.mosaic import Each, Mosaic
from .tiles.tile_steps import (
    TileInput,
    estimate_normals,
    finish_core,
    judge_readings,
    search_alone,
    search_with_neighbours,
)

T = TypeVar('T')


class TiledMapper:
    """Runs from readings to maps, tile by tile; can be cancelled from another thread."""

    def __init__(self, parameters: Parameters, size: float, each: Each[Any] = map, at_once: int = 1) -> None:
        """Prepare runs.

        Parameters
        ----------
        parameters : Parameters
        size : float
            Side of a tile, metres. The smaller the tiles, the more readings belong to several of them.
        each : callable, optional
            `map`, which processes tiles one after the other, or the `map` of an executor.
        at_once : int
            Number of tiles that `each` processes in parallel; they share the cores.
        """
        self._size, self._each = size, each
        threads = max((parameters.search.threads or cores()) // at_once, 1)
        self._parameters = parameters
        self._of_a_tile = dataclasses.replace(
            parameters, search=dataclasses.replace(parameters.search, threads=threads)
        )
        self._stop = np.zeros(1, np.uint8)
        self._seconds: dict[str, float] = {}
        self._visits = 0
        self._progress = Progress(0, 0, 0, 0.0)
        self._watch: Watch = lambda stage, progress: None

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` after the tiles in progress; may be called from any thread."""
        self._stop[0] = 1

    def run(self, readings: Readings, watch: Watch = lambda stage, progress: None) -> MapSet:
        """Return the maps of `readings`; `watch` is as for `core.mapping.Mapper.run`.

        Raises
        ------
        InputError
            If there are no readings, or they span too large a map.
        Cancelled
            If `cancel` was called.
        """
        self._watch, self._seconds, self._visits = watch, {}, 0
        self._progress = Progress(0, 0, 0, 0.0)
        p = self._parameters
        readings = in_canonical_order(readings)
        mosaic = Mosaic(readings, map_grid(readings, p), p, self._size)
        self._visit('normals', mosaic, mosaic.filled, estimate_normals, mosaic.store_normals)
        converged = self._search(mosaic)
        self._visit('maps of tiles', mosaic, range(len(mosaic.tiling.tiles)), finish_core, self._finish(mosaic))
        self._visit('uncertainty', mosaic, mosaic.filled, judge_readings, mosaic.store_judged)
        begun = time.perf_counter()
        watch('standard map', None)
        live = LogOddsMap(p)
        live.add(readings)
        shown = live.probability(mosaic.grid)
        self._seconds['standard map'] = time.perf_counter() - begun
        return self._maps(mosaic, shown, converged)

    def _visit(
        self,
        stage: str,
        mosaic: Mosaic,
        numbers: Iterable[int],
        work: Callable[..., T],
        store: Callable[[int, T], None],
        input_of: Callable[[int], TileInput] | None = None,
    ) -> None:
        """Process tiles, and store the results."""
        check(self._stop)
        self._watch(stage, None)
        begun = time.perf_counter()
        numbers = list(numbers)
        found = self._each(partial(work, parameters=self._of_a_tile), map(input_of or mosaic.input_of, numbers))
        for number, result in zip(numbers, found, strict=True):
            check(self._stop)
            store(number, result)
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - begun

    def _search(self, mosaic: Mosaic) -> bool:
        """Search until no tile changes; return whether all searches converged."""
        open_ends = 0

        def count(progress: Progress, converged: bool) -> None:
            nonlocal open_ends
            self._visits += 1
            open_ends += not converged
            p = self._progress
            self._progress = Progress(
                p.iterations + progress.iterations,
                p.flips + progress.flips,
                p.shifts + progress.shifts,
                p.gain + progress.gain,
            )
            self._watch('search', self._progress)

        def first(number: int, found: Any) -> None:
            mosaic.store_first(number, found)
            count(found.progress, found.converged)

        def improve(number: int, found: Any) -> None:
            mosaic.store_window(number, found)
            count(found.progress, found.converged)

        self._visit('search', mosaic, mosaic.filled, search_alone, first, mosaic.first_input_of)
        while mosaic.schedule.stale:
            for colour in mosaic.tiling.colours:
                if numbers := mosaic.schedule.stale_of(colour):
                    self._visit('search', mosaic, numbers, search_with_neighbours, improve)
        return not open_ends

    def _finish(self, mosaic: Mosaic) -> Callable[[int, Any], None]:
        self._pairs = self._bytes = self._unstored = 0
        self._searched = 0.0

        def take(number: int, found: Any) -> None:
            mosaic.store_finished(number, found)
            self._pairs += found.pairs
            self._bytes += found.nbytes
            self._unstored += found.unstored
            self._searched += found.log_likelihood

        return take

    def _maps(self, mosaic: Mosaic, live: Any, converged: bool) -> MapSet:
        p, ml = self._parameters, mosaic.ml
        mosaic.dynamic[ml != 0] = 0.0
        prior = wall_prior(p.search, mosaic.traversed.ravel(), mosaic.grid.resolution)

        def of_prior(occupied: Any) -> float:
            return log_prior(prior, occupied.ravel(), patterns(occupied, mosaic.grid.shape))

        occupied = (ml == 1).astype(np.uint8)
        log_likelihood, exponent = float(mosaic.log_likelihood.sum()), p.model.likelihood_exponent
        return MapSet(
            grid=mosaic.grid,
            live=live,
            ml=ml,
            uncertainty=mosaic.uncertainty,
            readings=mosaic.readings,
            unexplained=mosaic.unexplained,
            log_likelihood=log_likelihood,
            objective=exponent * log_likelihood + of_prior(occupied),
            parameters=p,
            searched=mosaic.searched,
            dynamic=mosaic.dynamic,
            normals=mosaic.all_normals(),
            statistics={
                'pairs': self._pairs,
                'bytes_per_pair': self._bytes / max(self._pairs, 1),
                'readings_not_stored': self._unstored,
                'searched_log_likelihood': self._searched,
                'searched_objective': exponent * self._searched + of_prior(mosaic.occupied),
                'flips': self._progress.flips,
                'shifts': self._progress.shifts,
                'iterations': self._progress.iterations,
                'converged': converged,
                'tiles': len(mosaic.filled),
                'searches_of_tiles': self._visits,
                'evaluations_of_a_reading': mosaic.halo,
                'seconds': self._seconds,
                'occupied': int(occupied.sum()),
            },
        )
