"""The evidence of each cell, given readings and a map; updated incrementally by new readings and by flips.

The class has two halves. `IndexedReadings`, its base, holds the cones, the index and the memory. `Evidence` evaluates
the readings on the map, and estimates the surface normals.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ..common.grid import UNKNOWN, Grid, Window, united
from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.cancelling import NEVER
from ..sensor.cone_table import cone_table
from ..sensor.surface_normals import SurfaceNormals, no_normals, on_larger_grid, window_of_influence
from .fixed_point import QUANTUM
from .indexed_readings import IndexedReadings, empty_maps
from .indexing import ALLOCATED_WORDS, LARGEST_CONE, UNUSED_WORDS, reading_state_table
from .learned_normals import first_normals, has_limit, keep_bearings, renewed_normals
from .neighbourhood import note_flips, set_patterns
from .pairs import WORDS_PER_BAND_PAIR
from .renewal import box_of, find_changed, renew
from .state import State
from .tile_index import no_tiles
from .updates import add_multiplicity, evaluate_all, evaluate_flipped

MOST_UNUSED = 0.25
"""Fraction of the allocated words that may be unused before all pairs are packed again."""

NO_INDICES = np.zeros(0, np.int64)


class Evidence(IndexedReadings):
    """Readings, a map, and the gain of flipping each of its cells.

    If a method fails (no memory, or `stop` was set), the evidence stays consistent with the map and the readings.

    Attributes
    ----------
    grid, model, state
        As in `IndexedReadings`.
    """

    def __init__(
        self,
        grid: Grid,
        model: ModelParameters,
        memory: float = math.inf,
        threads: int = 1,
        stop: NDArray[np.uint8] | None = None,
        start: NDArray[np.uint8] | None = None,
        renewable: bool = False,
        normals: SurfaceNormals | None = None,
    ) -> None:
        """Begin without readings, on an empty map or on the map `start` (1 occupied, shape `grid.shape`).

        Parameters
        ----------
        grid : Grid
            Cells outside of it are left out.
        model : ModelParameters
        memory : float
            Limit for the stored pairs, bytes.
        threads : int
            Most threads; the result does not depend on it.
        stop : uint8, shape (1,), optional
            Set to 1 from any thread to cancel.
        renewable : bool
            Whether surface normals can be renewed with later readings, which needs 24 bytes a cell. Otherwise they are
            estimated from the readings that are added first.
        normals : SurfaceNormals, optional
            Of the cells of `grid`, if known beforehand; then the grid cannot grow.
        """
        learns = has_limit(model)
        # of `surface_normals.gather`, if normals are renewable
        self._bearing_sums = np.zeros((3, grid.size), np.int64) if learns and renewable else None
        # contains the cones of all readings since the last renewal of the normals
        self._not_renewed: Window | None = None
        self._given_normals = normals is not None
        stop = np.zeros(1, np.uint8) if stop is None else stop
        occupied = np.zeros(grid.shape, np.uint8) if start is None else np.array(start, np.uint8)
        super().__init__(grid, model, memory, threads, stop, occupied, no_normals() if normals is None else normals)

    @property
    def tempered_log_likelihood(self) -> float:
        """The part of the readings in the objective: likelihood exponent times log p(Z | m), nats."""
        return self.model.likelihood_exponent * self.log_likelihood

    @property
    def log_likelihood(self) -> float:
        """Log p(Z | m) in nats."""
        return float(self._log_likelihoods().sum() * QUANTUM)

    @property
    def log_likelihoods(self) -> Floats:
        """Log p(z | m) of each reading, times its multiplicity, shape (N,), nats."""
        return np.asarray(self._log_likelihoods() * QUANTUM, np.float64)

    def log_likelihood_of(self, which: NDArray[np.bool_]) -> float:
        """Return the log-likelihood of the readings in a mask, shape (N,), nats; sums of subsets are exact."""
        return float(self._log_likelihoods()[which].sum() * QUANTUM)

    def _log_likelihoods(self) -> NDArray[np.int64]:
        """Return `log_likelihoods` in units of QUANTUM, whose sums are exact."""
        states = self.state.reading_states[: self._size]
        out: NDArray[np.int64] = states['likelihood'].astype(np.int64) * states['multiplicity']
        return out

    def of_occupancy(self) -> Floats:
        """Return γ [log p(Z | cell occupied, rest of the map) − log p(Z | cell free, rest of the map)], nats.

        Shape (cells,); 0 for cells without readings. γ is the likelihood exponent.
        """
        maps, nats = self.state.maps, self.state.model.nats
        out: Floats = np.where(maps.occupied == 1, -nats, nats) * maps.evidence
        return out

    def observed(self) -> NDArray[np.int8]:
        """Return a copy of the map, shape `grid.shape`: 1 occupied, 0 free, -1 without readings."""
        maps = self.state.maps
        return np.where(maps.seen > 0, maps.occupied.astype(np.int8), np.int8(UNKNOWN)).reshape(self.grid.shape)

    def extend(self, readings: Readings, again: NDArray[np.int64] = NO_INDICES) -> None:
        """Add readings; if it fails, none is added.

        Parameters
        ----------
        readings : Readings
        again : int64, shape (M,)
            Indices of readings, including those that are added now, whose multiplicity increases by one.

        Raises
        ------
        Cancelled
            If `stop` was set.
        MemoryError
        """
        begin, end = self._size, self._size + len(readings)
        self._check_indices(again, end)
        cones = cone_table(readings, self.grid, self.model)
        reading_states = reading_state_table(
            readings, cones['sigma'] * self.grid.resolution, self.model, self.grid.resolution
        )
        self._allocate_readings(end)
        s = self.state
        s.cones[begin:end], s.reading_states[begin:end] = cones, reading_states
        # the bearings of the first readings are added before their pairs are made
        later = s.cones[begin:end] if begin else s.cones[:0], s.cones[again]
        since = united(self._not_renewed, *(box_of(cones, self.grid) for cones in later))
        before = self._index_state()
        try:
            if not begin and not self._given_normals and has_limit(self.model):
                self._learn_normals(end)
            self._insert(begin, end)
            try:
                self._evaluate_and_add(begin, end, new=True)
                if len(again):
                    add_multiplicity(self.state, again)
            except BaseException:
                self._evaluate_from_scratch(begin)
                raise
        except BaseException:
            self._restore_index(begin, before)
            if not begin and self._bearing_sums is not None:
                self._bearing_sums[:] = 0
            raise
        self._size = end
        if self._bearing_sums is not None:
            for cones in later:
                keep_bearings(cones, self.grid, self._bearing_sums)
            self._not_renewed = since

    def add_multiplicity(self, readings: NDArray[np.int64]) -> None:
        """Increase the multiplicity of each of `readings` (indices, shape (N,)) by one."""
        self._check_indices(readings, self._size)
        repeated = self.state.cones[readings]
        since = united(self._not_renewed, box_of(repeated, self.grid))
        add_multiplicity(self.state, readings)
        if self._bearing_sums is not None:
            keep_bearings(repeated, self.grid, self._bearing_sums)
            self._not_renewed = since

    def grow(self, grid: Grid) -> None:
        """Change to a larger grid, whose new cells are free; if it fails, nothing is changed.

        Parameters
        ----------
        grid : Grid
            Contains the old one. Renewable normals are not changed, and then the old grid must contain all cones.

        Raises
        ------
        Cancelled
            If `stop` was set.
        MemoryError
        """
        old, s, totals, sums = self.grid, self.state, self._totals, self._bearing_sums
        window = grid.window(old)
        occupied = np.zeros(grid.shape, np.uint8)
        occupied[window] = s.maps.occupied.reshape(old.shape)
        cones = s.cones.copy()
        cones['x'][: self._size] += window[1].start
        cones['y'][: self._size] += window[0].start
        grown = s._replace(
            lattice=s.lattice._replace(height=grid.height, width=grid.width),
            normals=on_larger_grid(s.normals, old, grid),
            cones=cones,
            reading_states=s.reading_states.copy(),
            tiles=no_tiles(grid.height, grid.width),
            maps=empty_maps(grid, occupied),
        )
        larger = None
        if sums is not None:
            larger = np.zeros((3, grid.size), np.int64)
            larger.reshape(3, *grid.shape)[(slice(None), *window)] = sums.reshape(3, *old.shape)
        evaluating = False
        self.grid, self.state, self._totals, self._bearing_sums = grid, grown, np.zeros(6, np.int64), larger
        try:
            if sums is None and len(s.normals.known):
                self._learn_normals(self._size)
            self._insert(0, self._size)
            evaluating = True
            self._evaluate_and_add(0, self._size, new=True)
        except BaseException:
            self.grid, self.state, self._totals, self._bearing_sums = old, s, totals, sums
            if evaluating:
                # pairs of the larger grid were written over those of the old one
                self._evaluate_from_scratch(self._size, new=True)
            raise
        if self._not_renewed:
            up, right = window[0].start, window[1].start
            bottom, top, left, end = self._not_renewed
            self._not_renewed = bottom + up, top + up, left + right, end + right

    def rebuild(self) -> None:
        """Evaluate all readings again, after the map was changed from outside."""
        maps = self.state.maps
        set_patterns(maps.occupied, self.grid.shape, maps.pattern)
        maps.evidence[:] = 0
        try:
            self._evaluate_and_add(0, self._size, new=False)
        except BaseException:
            self._evaluate_from_scratch(self._size)
            raise

    def flip(self, cells: NDArray[np.int64]) -> None:
        """Flip different cells at once, and evaluate the readings that observe any of them again.

        Parameters
        ----------
        cells : int64, shape (N,)

        Raises
        ------
        Cancelled
            If `stop` was set; the cells are flipped nevertheless.
        MemoryError
        """
        maps, flipped = self.state.maps, np.zeros(self.grid.size, np.uint8)
        flipped[cells] = 1
        maps.occupied[cells] ^= 1
        if self.unstored:
            # the terms of such readings for the map before are not stored
            self.rebuild()
            return
        note_flips(maps.pattern, cells, self.grid.shape)

        def work(s: State, first: int, last: int, evidence: NDArray[np.int64]) -> None:
            evaluate_flipped(s._replace(maps=s.maps._replace(evidence=evidence)), first, last, flipped)

        try:
            self.sum_over_readings(0, self._size, work, maps.evidence)
        except BaseException:
            self._evaluate_from_scratch(self._size)
            raise

    def renew_normals(self) -> Window | None:
        """Estimate the surface normals from all readings so far, and make the pairs of affected readings again.

        The result is the same as if all readings had been added at once. Needs `renewable`.

        Returns
        -------
        window : first row, last one plus one, and columns likewise, or None
            Where the evidence changed.
        """
        if self._bearing_sums is None or self._not_renewed is None:
            return None
        s, shape = self.state, self.grid.shape
        # readings affect the normals around them, and these the limits of the incidence angle around them
        around = window_of_influence(window_of_influence(self._not_renewed, self.grid), self.grid)
        normals = renewed_normals(s, self._size, self.grid, self.model, self._bearing_sums, around)
        differ = np.zeros(shape, np.uint8)
        changed = np.zeros(self._size, np.uint8)
        find_changed(s, normals, around, differ, changed)
        readings = np.flatnonzero(changed)
        window = box_of(s.cones[readings], self.grid)
        # nothing can fail from here on: without memory, pairs are not stored
        done, words = 0, self._most_words
        while True:
            done = renew(self.state, normals, readings, (done, words), self._totals)
            if done == len(readings):
                break
            try:
                self._allocate_pairs(
                    int(self._totals[ALLOCATED_WORDS]) + WORDS_PER_BAND_PAIR * int(self._totals[LARGEST_CONE])
                )
            except MemoryError:
                words = len(self.state.pairs.cell)
        self.state = self.state._replace(normals=normals)
        self._not_renewed = None
        if self._totals[UNUSED_WORDS] > MOST_UNUSED * self._totals[ALLOCATED_WORDS]:
            # packing only saves memory, so it is skipped if there is none
            with suppress(MemoryError):
                self.grow(self.grid)
        return window

    def _evaluate_and_add(self, begin: int, end: int, new: bool) -> None:
        def work(s: State, first: int, last: int, evidence: NDArray[np.int64]) -> None:
            evaluate_all(s._replace(maps=s.maps._replace(evidence=evidence)), first, last, new)

        self.sum_over_readings(begin, end, work, self.state.maps.evidence)

    def _evaluate_from_scratch(self, end: int, new: bool = False) -> None:
        """Evaluate the readings up to `end` from scratch. It cannot fail: it is single-threaded and ignores `stop`."""
        self.state.maps.evidence[:] = 0
        evaluate_all(self.state._replace(stop=NEVER), 0, end, new)

    def _learn_normals(self, end: int) -> None:
        """Estimate normals and limits of the incidence angle from the first readings."""
        self._indexed = 0
        sums = np.zeros((3, self.grid.size), np.int64) if self._bearing_sums is None else self._bearing_sums
        normals = first_normals(self.state, end, self.grid, self.model, sums, self.sum_over_readings)
        self.state = self.state._replace(normals=normals)
