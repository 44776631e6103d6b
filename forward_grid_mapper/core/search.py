"""The search for the maximum likelihood map: EM with flips in both directions, and moves.

Sweeps go over the cells whose gain may have changed, most promising first, until no single flip gains anything; then
occupied cells are moved to neighbours, and so on until neither gains. Ties keep the state. The objective

    J(m) = log p(Z | m) + logit(prior) · (number of occupied cells)

never falls, and at the end no single flip raises it by more than `LEAST_GAIN` and the cell's share of `ROUNDING`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cone_index import ConeIndex, Floats, check
from .flips import FlipState, compute_gains, flip_in_order, mark_cells, refresh_all, shift_in_order
from .forward_model import Causes
from .parameters import SearchParameters

LEAST_GAIN = 1e-4
"""Nats that a flip must gain."""

ROUNDING = 1.2e-7
"""Nats that it must gain in addition for each of the cell's readings: what float32 ratios may be off, so that the
search cannot go round, not even where ten thousand readings are off to the same side."""


@dataclass(frozen=True)
class Progress:
    """Where a search stands: sweeps done, flips and moves made so far, gain in nats since the start."""

    sweeps: int
    flips: int
    shifts: int
    gain: float


@dataclass(frozen=True)
class SearchResult:
    """The map found, and how.

    Attributes
    ----------
    occupied : uint8, shape (cells,)
        1 occupied, 0 free; cells that no reading touches are 0.
    evidence : float64, shape (cells,)
        log p(Z | cell occupied, rest of the map) − log p(Z | cell free, rest of the map) in nats, 0 where untouched.
    progress : Progress
    converged : bool
        False when `max_sweeps` ended the search.
    """

    occupied: NDArray[np.uint8]
    evidence: Floats
    progress: Progress
    converged: bool


class Search:
    """One search; its map so far is `state.occupied`, which another thread may read at any time."""

    def __init__(
        self,
        index: ConeIndex,
        causes: Causes,
        width: int,
        parameters: SearchParameters,
        stop: NDArray[np.uint8] | None = None,
    ) -> None:
        """Start from the empty map; `stop` (uint8, shape (1,)) is set to 1 from any thread to cancel."""
        cells, readings = len(index.seen_start) - 1, len(index.free_start) - 1
        self.index, self._causes, self._width, self._parameters = index, causes, width, parameters
        self._prior = math.log(parameters.prior / (1 - parameters.prior))
        self.state = FlipState(
            occupied=np.zeros(cells, np.uint8),
            blocking=np.zeros(readings, np.int32),
            band_ratio=np.empty(len(index.band_cell), np.float32),
            occupy_ratio=np.empty(readings, np.float32),
            free_ratio=np.empty(readings, np.float32),
            changed=np.zeros(readings, np.uint8),
            dirty=np.ones(cells, np.uint8),
            settled=np.zeros(cells, np.uint8),
            gain=np.zeros(cells),
            stop=np.zeros(1, np.uint8) if stop is None else stop,
        )
        self.least = LEAST_GAIN + ROUNDING * (np.diff(index.seen_start) + np.diff(index.slot_start))
        self.progress = Progress(0, 0, 0, 0.0)

    def _gains(self) -> Floats:
        mark_cells(self.index, self.state)
        compute_gains(self.index, self.state, self._prior)
        return self.state.gain

    def _advance(self, sweeps: int, flips: int, shifts: int, gain: float, watch: Callable[[Progress], None]) -> None:
        check(self.state.stop)
        p = self.progress
        self.progress = Progress(p.sweeps + sweeps, p.flips + flips, p.shifts + shifts, p.gain + gain)
        watch(self.progress)

    def run(self, watch: Callable[[Progress], None] = lambda progress: None) -> SearchResult:
        """Search until no flip and no move gains; `watch` hears of every sweep.

        Raises
        ------
        Cancelled
            If `stop` was set.
        """
        refresh_all(self.index, self._causes, self.state)
        converged = False
        while self.progress.sweeps < self._parameters.max_sweeps:
            gains = self._gains()
            cells = np.flatnonzero(gains > self.least)
            if len(cells):
                order = cells[np.argsort(-gains[cells], kind='stable')]
                flips, gain = flip_in_order(self.index, self._causes, self.state, self._prior, self.least, order)
                self._advance(1, flips, 0, gain, watch)
                continue
            if not self._parameters.shift_moves or not self._shift(watch):
                converged = True
                break
        gains = self._gains()
        touched = np.isfinite(gains)
        sign = np.where(self.state.occupied == 1, -1.0, 1.0)
        evidence = np.where(touched, sign * np.where(touched, gains, 0.0) - self._prior, 0.0)
        return SearchResult(self.state.occupied, evidence, self.progress, converged)

    def _shift(self, watch: Callable[[Progress], None]) -> int:
        occupied = np.flatnonzero(self.state.occupied & ~self.state.settled)
        # an order that a mirrored or turned map has too
        cells = occupied[np.argsort(-self.state.gain[occupied], kind='stable')]
        shifts, gain = shift_in_order(self.index, self._causes, self.state, self._prior, self.least, cells, self._width)
        self._advance(1, 0, shifts, gain, watch)
        return shifts
