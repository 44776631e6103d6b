"""From placed readings to the three maps: the one function that the offline tool and the node call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .common.grid import Grid, part_of
from .common.parameters import Parameters, SearchParameters
from .common.readings import Readings, in_canonical_order
from .evidence.evidence import Evidence
from .learning.model_update import learn
from .maps.dynamic import dynamic_echoes
from .maps.log_odds_map import LogOddsMap, map_grid
from .maps.map_set import MapSet
from .maps.post_processing import post_process
from .maps.traversed import traversed_cells
from .maps.uncertainty import uncertainty_map
from .runtime.cancelling import check
from .runtime.memory import memory_for_pairs
from .runtime.threads import cores
from .search.prior import odds_given_neighbours
from .search.search import Progress, Search, SearchResult

Watch = Callable[[str, Progress | None], None]
"""Hears the name of each stage as it begins, and of every sweep of the search."""


class Mapper:
    """One run from readings to maps; can be cancelled from another thread."""

    def __init__(self, parameters: Parameters, learn_rounds: int = 0) -> None:
        """Prepare a run; `learn_rounds` > 0 alternates the search with updates of the model (`learning`)."""
        self._parameters, self._learn_rounds = parameters, learn_rounds
        self._search: Search | None = None
        self._stop = np.zeros(1, np.uint8)
        self._seconds: dict[str, float] = {}

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` soon; may be called from any thread."""
        self._stop[0] = 1

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return the grid and a copy of the ML map that the search has reached, or None before it; any thread."""
        search = self._search
        return None if search is None else (search.evidence.grid, search.evidence.observed())

    def run(
        self,
        readings: Readings,
        watch: Watch = lambda stage, progress: None,
        start: tuple[Grid, NDArray[np.int8]] | None = None,
    ) -> MapSet:
        """Return the maps of `readings`.

        Parameters
        ----------
        readings : Readings
        watch : callable
            Called from this thread as the work goes on.
        start : Grid and int8, optional
            A map to start the search from, 1 where occupied; by default the empty one.

        Raises
        ------
        InputError
            If there are no readings, or they span too large a map.
        Cancelled
            If `cancel` was called.
        """
        self._seconds = {}
        readings = in_canonical_order(readings)
        parameters = self._parameters
        evidence, result = self._find(readings, parameters, watch, start)
        for _ in range(self._learn_rounds):
            with self._stage('learning', watch):
                ml = result.occupied.reshape(evidence.grid.shape)
                parameters = dataclasses.replace(parameters, model=learn(readings, evidence.grid, ml, parameters.model))
            evidence, result = self._find(readings, parameters, watch)
        with self._stage('live map', watch):
            live = LogOddsMap(parameters)
            live.add(readings)
            live_map = live.probability(evidence.grid)
        with self._stage('uncertainty', watch):
            return self._collect(readings, parameters, evidence, result, live_map)

    def _find(
        self,
        readings: Readings,
        parameters: Parameters,
        watch: Watch,
        start: tuple[Grid, NDArray[np.int8]] | None = None,
    ) -> tuple[Evidence, SearchResult]:
        # the grid of the live map, so that all three maps are of one shape
        grid = map_grid(readings, parameters)
        asked = parameters.search
        with self._stage('index', watch):
            memory, threads = memory_for_pairs(parameters), asked.threads or cores()
            occupied = None if start is None else (part_of(*start, grid) == 1).astype(np.uint8)
            evidence = Evidence(grid, parameters.model, memory, threads, self._stop, occupied)
            evidence.extend(readings)
        with self._stage('search', watch):
            self._search = Search(evidence, asked, self._traversed(readings, grid, asked).ravel())
            return evidence, self._search.run(lambda progress: watch('search', progress))

    @staticmethod
    def _traversed(readings: Readings, grid: Grid, parameters: SearchParameters) -> NDArray[np.bool_]:
        return traversed_cells(readings, grid) if parameters.driven_cost > 0 else np.zeros(grid.shape, np.bool_)

    def _collect(
        self, readings: Readings, parameters: Parameters, evidence: Evidence, result: SearchResult, live_map: Any
    ) -> MapSet:
        search, grid = parameters.search, evidence.grid
        traversed = self._traversed(readings, grid, search)
        ml = post_process(evidence, search.extend, search.least_passed, traversed)
        neighbours = odds_given_neighbours(result.prior, ml == 1)
        unexplained = parameters.model.p_rand / readings.z_max > 0.5 * evidence.likelihoods
        return MapSet(
            grid=grid,
            live=live_map,
            ml=ml,
            uncertainty=uncertainty_map(result.evidence, neighbours, ml, search),
            readings=readings,
            unexplained=unexplained,
            dynamic=dynamic_echoes(readings, unexplained, grid, ml, parameters.model),
            log_likelihood=evidence.log_likelihood,
            objective=evidence.log_likelihood + result.log_prior,
            parameters=parameters,
            statistics={
                'pairs': evidence.pairs,
                'bytes_per_pair': evidence.nbytes / max(evidence.pairs, 1),
                'readings_not_stored': evidence.unstored,
                'occupied': int((ml == 1).sum()),
                'flips': result.progress.flips,
                'shifts': result.progress.shifts,
                'sweeps': result.progress.sweeps,
                'converged': result.converged,
                'seconds': self._seconds,
            },
        )

    def _stage(self, name: str, watch: Watch) -> _Stage:
        watch(name, None)
        check(self._stop)
        return _Stage(name, self._seconds)


class _Stage:
    """Adds the time spent inside to a table of seconds by stage."""

    def __init__(self, name: str, seconds: dict[str, float]) -> None:
        self._name, self._seconds = name, seconds

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        self._seconds[self._name] = self._seconds.get(self._name, 0.0) + time.perf_counter() - self._start
