"""From readings in the map frame to the three maps, for both the offline tool and the node."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from .common.grid import Grid, part_of
from .common.parameters import Parameters
from .common.readings import Readings, in_canonical_order
from .evidence.evidence import Evidence
from .evidence.neighbourhood import patterns
from .maps.dynamic import dynamic_echoes
from .maps.final_maps import FinalMaps, final_maps
from .maps.log_odds_map import LogOddsMap, map_grid
from .maps.map_set import MapSet
from .maps.traversed import traversed_cells
from .runtime.cancelling import check
from .runtime.memory import memory_for_pairs
from .runtime.threads import cores
from .search.prior import log_prior
from .search.search import Progress, Search, SearchResult
from .sensor.forward_model import ForwardModel

Watch = Callable[[str, Progress | None], None]
"""Receives the name of each stage at its start, and the progress after each iteration of the search."""

P = ParamSpec('P')
R = TypeVar('R')


def _stage(name: str) -> Callable[[Callable[Concatenate[Mapper, P], R]], Callable[Concatenate[Mapper, P], R]]:
    """Make a method of `Mapper` a stage of its runs: it is reported and timed, and does not begin after `cancel`."""

    def wrap(step: Callable[Concatenate[Mapper, P], R]) -> Callable[Concatenate[Mapper, P], R]:
        def timed(self: Mapper, /, *args: P.args, **kwargs: P.kwargs) -> R:
            self._watch(name, None)
            check(self._stop)
            begun = time.perf_counter()
            out = step(self, *args, **kwargs)
            self._seconds[name] = time.perf_counter() - begun
            return out

        return functools.update_wrapper(timed, step)

    return wrap


@dataclass(frozen=True)
class _StageInput:
    """The input of all stages of a run.

    Attributes
    ----------
    readings : Readings
        In canonical order.
    grid : Grid
        Of all maps.
    traversed : bool, shape `grid.shape`
        Cells that the robot traversed.
    """

    readings: Readings
    grid: Grid
    traversed: NDArray[np.bool_]


class Mapper:
    """Runs from readings to maps; can be cancelled from another thread."""

    def __init__(self, parameters: Parameters) -> None:
        """Prepare runs with these parameters."""
        self._parameters = parameters
        self._evidence: Evidence | None = None
        self._stop = np.zeros(1, np.uint8)
        self._seconds: dict[str, float] = {}
        self._watch: Watch = lambda stage, progress: None

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` soon; may be called from any thread."""
        self._stop[0] = 1

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return the grid and a copy of the present map of the search, or None before it; for any thread."""
        evidence = self._evidence
        return None if evidence is None else (evidence.grid, evidence.observed())

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
            Called from this thread during the work.
        start : Grid and int8, optional
            Initial map of the search, 1 if occupied, like `MapSet.searched`; by default the empty map.

        Raises
        ------
        InputError
            If there are no readings, or they span too large a map.
        Cancelled
            If `cancel` was called.
        """
        self._watch, self._seconds = watch, {}
        given = self._prepare(readings)
        # first, since for a while it needs as much memory as the evidence
        live = self._standard_map(given)
        evidence = self._index(given, start)
        try:
            found = self._search(given, evidence)
            final = self._final_maps(given, evidence)
            return self._evaluate(given, evidence, found, live, final)
        finally:
            # it may take gigabytes, and callers may keep this object
            self._evidence = None

    def _prepare(self, readings: Readings) -> _StageInput:
        readings, p = in_canonical_order(readings), self._parameters
        # the grid of the standard map, so that all three maps have the same shape
        grid = map_grid(readings, p)
        return _StageInput(readings, grid, traversed_cells(readings, grid))

    @_stage('index')
    def _index(self, given: _StageInput, start: tuple[Grid, NDArray[np.int8]] | None) -> Evidence:
        p = self._parameters
        memory, threads = memory_for_pairs(p), p.search.threads or cores()
        occupied = None if start is None else (part_of(*start, given.grid) == 1).astype(np.uint8)
        evidence = Evidence(given.grid, p.model, memory, threads, self._stop, occupied)
        evidence.extend(given.readings)
        return evidence

    @_stage('search')
    def _search(self, given: _StageInput, evidence: Evidence) -> SearchResult:
        self._evidence = evidence
        search = Search(evidence, self._parameters.search, given.traversed.ravel())
        return search.run(lambda progress: self._watch('search', progress))

    @_stage('standard map')
    def _standard_map(self, given: _StageInput) -> NDArray[np.float32]:
        live = LogOddsMap(self._parameters)
        live.add(given.readings)
        return live.probability(given.grid)

    @_stage('post-processing')
    def _final_maps(self, given: _StageInput, evidence: Evidence) -> FinalMaps:
        return final_maps(evidence, self._parameters.search, given.traversed)

    @_stage('uncertainty')
    def _evaluate(
        self,
        given: _StageInput,
        evidence: Evidence,
        found: SearchResult,
        live: NDArray[np.float32],
        final: FinalMaps,
    ) -> MapSet:
        """Return the maps, with the likelihoods of the readings on them."""
        ml, p, prior = final.ml, self._parameters, found.prior
        occupied = (ml == 1).astype(np.uint8)
        forward = ForwardModel(given.readings, given.grid, p.model, evidence.state.normals, evidence.cones)
        e = forward.expectations(ml)
        log_likelihood = float(e.log_likelihood.sum())
        unexplained = e.random > 0.5
        return MapSet(
            grid=given.grid,
            live=live,
            ml=ml,
            uncertainty=final.uncertainty,
            readings=given.readings,
            unexplained=unexplained,
            log_likelihood=log_likelihood,
            objective=p.model.likelihood_exponent * log_likelihood
            + log_prior(prior, occupied.ravel(), patterns(occupied, given.grid.shape)),
            parameters=p,
            searched=evidence.observed(),
            dynamic=dynamic_echoes(forward, unexplained, ml),
            normals=forward.normals,
            statistics=self._statistics(evidence, found) | {'occupied': int(occupied.sum())},
        )

    def _statistics(self, evidence: Evidence, found: SearchResult) -> dict[str, Any]:
        return {
            'pairs': evidence.pairs,
            'bytes_per_pair': evidence.nbytes / max(evidence.pairs, 1),
            'readings_not_stored': evidence.unstored,
            'searched_log_likelihood': evidence.log_likelihood,
            'searched_objective': evidence.tempered_log_likelihood + found.log_prior,
            'flips': found.progress.flips,
            'shifts': found.progress.shifts,
            'iterations': found.progress.iterations,
            'converged': found.converged,
            'seconds': self._seconds,
        }
