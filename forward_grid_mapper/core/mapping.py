"""From placed readings to the three maps: the one function that the offline tool and the node call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cone_index import ConeIndex, build_cone_index, check, effective_sigma, grid_of
from .forward_model import causes_of, expectations
from .grid import Grid
from .learning import learn
from .live_map import LiveMap, arc_depth
from .maps import UNKNOWN, MapSet
from .parameters import Parameters
from .readings import Readings
from .search import Progress, Search, SearchResult
from .uncertainty import marginals

Watch = Callable[[str, Progress | None], None]
"""Hears the name of each stage as it begins, and of every sweep of the search."""


def in_canonical_order(readings: Readings) -> Readings:
    """Return the readings ordered by stamp, sensor name and values, so that the maps do not depend on arrival.

    Sums of floating point numbers depend on their order; two readings that are still equal are interchangeable.
    """
    rank = np.argsort(np.argsort(np.array(readings.sensor_names or ('',))))
    r = readings
    keys = (r.sigma, r.half_angle, r.z_max, r.yaw, r.y, r.x, r.z, rank[r.sensor], r.stamp)
    return readings.select(np.lexsort(keys))


class Mapper:
    """One run from readings to maps; can be cancelled from another thread."""

    def __init__(self, parameters: Parameters, learn_rounds: int = 0) -> None:
        """Prepare a run; `learn_rounds` > 0 alternates the search with updates of the model (`learning`)."""
        self._parameters, self._learn_rounds = parameters, learn_rounds
        self._search: Search | None = None
        self._grid: Grid | None = None
        self._stop = np.zeros(1, np.uint8)
        self._seconds: dict[str, float] = {}

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` soon; may be called from any thread."""
        self._stop[0] = 1

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return the grid and a copy of the ML map that the search has reached, or None before it; any thread."""
        search, grid = self._search, self._grid
        if search is None or grid is None:
            return None
        return grid, self._observed(search.index, search.state.occupied, grid)

    @staticmethod
    def _observed(index: ConeIndex, occupied: NDArray[np.uint8], grid: Grid) -> NDArray[np.int8]:
        seen = np.diff(index.seen_start) + np.diff(index.slot_start) > 0
        return np.where(seen, occupied.astype(np.int8), np.int8(UNKNOWN)).reshape(grid.shape)

    def run(self, readings: Readings, watch: Watch = lambda stage, progress: None) -> MapSet:
        """Return the maps of `readings`.

        Parameters
        ----------
        readings : Readings
        watch : callable
            Called from this thread as the work goes on.

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
        grid, index, result = self._find(readings, parameters, watch)
        for _ in range(self._learn_rounds):
            with self._stage('learning', watch):
                model = learn(readings, grid, result.occupied.reshape(grid.shape), parameters.model)
                parameters = dataclasses.replace(parameters, model=model)
            grid, index, result = self._find(readings, parameters, watch)
        with self._stage('live map', watch):
            live = LiveMap(parameters)
            live.add(readings)
            live_map = live.probability(grid)
        with self._stage('uncertainty', watch):
            return self._collect(readings, grid, parameters, index, result, live_map)

    def _find(self, readings: Readings, parameters: Parameters, watch: Watch) -> tuple[Grid, ConeIndex, SearchResult]:
        model = parameters.model
        # that of the live map, so that all three maps are of one shape
        grid = grid_of(readings, model, parameters.grid, beyond=arc_depth(parameters))
        with self._stage('index', watch):
            index = build_cone_index(readings, grid, model, self._stop)
        with self._stage('search', watch):
            causes = causes_of(readings, effective_sigma(readings, model, grid.resolution), model)
            self._search, self._grid = Search(index, causes, grid.width, parameters.search, self._stop), grid
            return grid, index, self._search.run(lambda progress: watch('search', progress))

    def _collect(
        self,
        readings: Readings,
        grid: Grid,
        parameters: Parameters,
        index: ConeIndex,
        result: SearchResult,
        live_map: Any,
    ) -> MapSet:
        ml = self._observed(index, result.occupied, grid)
        uncertainty = np.where(
            ml != UNKNOWN, marginals(result.evidence, parameters.search).reshape(grid.shape), np.float32(np.nan)
        )
        explained = expectations(readings, grid, ml, parameters.model)
        likelihood = float(explained.log_likelihood.sum())
        occupied = int((ml == 1).sum())
        prior = parameters.search.prior
        return MapSet(
            grid=grid,
            live=live_map,
            ml=ml,
            uncertainty=uncertainty,
            readings=readings,
            unexplained=explained.random > 0.5,
            log_likelihood=likelihood,
            objective=likelihood + occupied * float(np.log(prior / (1 - prior))),
            parameters=parameters,
            statistics={
                'pairs': index.pairs,
                'bytes_per_pair': (index.nbytes + 4 * len(index.band_cell)) / max(index.pairs, 1),
                'occupied': occupied,
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
