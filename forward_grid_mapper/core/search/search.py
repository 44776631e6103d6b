"""The search for the maximum likelihood map: EM with flips in both directions, and block moves.

In other terms, this is iterated conditional modes (ICM) with block moves. The causes of the readings are marginalised,
so each step increases the exact marginal likelihood.

*Parallel updates* come first: all cells whose flip gains, and gains more than those of their neighbours, are flipped at
once. At first far too many cells become occupied, and then they are thinned out. This gives better maps than adding one
cell at a time, and takes a few passes over the readings. When they no longer help, *sequential updates* flip single
cells, those with the largest gain first, until no flip gains. *Block moves* follow: occupied cells move to neighbours
in one step. Sequential updates and block moves alternate until neither gains. Cells without gain or loss keep their
state, except at the end: then unneeded occupied cells are freed.

This is done twice: at first with independent cells, then, from the resulting map, with the prior for walls (`prior`).
The second part also closes gaps in walls, and removes short walls, when nothing else gains (`gap_closing`). In each
part the objective

    J(m) = γ log p(Z | m) + log p(m)

never decreases. γ is the likelihood exponent: readings are correlated, so their likelihood is tempered. Traversed cells
are never occupied. At the end, no single flip increases J by more than `LEAST_GAIN` plus `ROUNDING` for each reading of
the cell.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.constants import FORBIDDEN, LONGEST_GAP, SHORT_WALL
from ..common.grid import Window
from ..common.parameter_groups import SearchParameters
from ..common.readings import Floats
from ..evidence.evidence import Evidence
from ..evidence.neighbourhood import NEIGHBOURS
from ..evidence.state import State
from ..runtime.cancelling import check
from .flips import flip_in_order, free_unneeded, highest, promising
from .gap_closing import close_gaps, remove_short_walls
from .prior import Prior, has_walls, independent_prior, log_prior, wall_prior
from .shifts import best_shifts, mark_observing, ratio_batch, shift_in_order, try_shifts, unsettle

LEAST_GAIN = 1e-4
"""Nats that a flip must gain."""

ROUNDING = 2e-7
"""Nats that it must gain in addition for each reading of the cell: the error of float32 ratios, so that the search
cannot cycle, not even if ten thousand readings have the same error."""

LEAST = (LEAST_GAIN, ROUNDING)

FEW = 32
"""Fewest flips of a parallel update; with fewer, sequential ones are faster."""


LITTLE = 0.005
"""Another parallel update follows if the last one added more than this fraction of the total gain."""


@dataclass(frozen=True)
class Progress:
    """The state of a search: iterations, flips and moves so far, and gain since the start, nats."""

    iterations: int
    flips: int
    shifts: int
    gain: float


@dataclass(frozen=True)
class SearchResult:
    """Data about a search, whose map is in its evidence.

    Attributes
    ----------
    prior : Prior
        The one that the map was found with.
    log_prior : float
        Of the map, up to a constant.
    progress : Progress
    converged : bool
        False if `max_iterations` ended the search.
    """

    prior: Prior
    log_prior: float
    progress: Progress
    converged: bool


Watch = Callable[[Progress], None]


class Search:
    """One search. Its present map is `evidence.state.maps.occupied`, which another thread may read at any time."""

    def __init__(
        self,
        evidence: Evidence,
        parameters: SearchParameters,
        traversed: NDArray[np.bool_] | None = None,
        window: Window | None = None,
        hold: bool = False,
    ) -> None:
        """Start from the map in `evidence`.

        Parameters
        ----------
        evidence : Evidence
        parameters : SearchParameters
        traversed : bool, shape (cells,), optional
            Cells that the robot traversed.
        window : optional
            Begin and end of the rows, and of the columns, in which moves begin; by default all.
        hold : bool
            Whether all cells outside of the window keep their state; otherwise moves may end outside of it.
        """
        self.evidence, self._parameters = evidence, parameters
        height, width = evidence.grid.shape
        self._window = window or (0, height, 0, width)
        traversed = np.zeros(evidence.grid.size, np.bool_) if traversed is None else traversed
        self._prior = independent_prior(parameters, traversed)
        self._of_walls = wall_prior(parameters, traversed, evidence.grid.resolution)
        self._settled = np.zeros(evidence.grid.size, np.uint8)
        self._begin_with(self._prior)
        # workspaces, since in a small map allocating them takes longer than most steps
        bottom, top, left, right = self._window
        cells = (top - bottom) * (right - left)
        self._gaining, self._gains = np.empty(cells, np.int64), np.empty(cells)
        self._all_zero = np.zeros(evidence.grid.size)
        self._all_none: list[NDArray[np.int32]] = []
        self.progress = Progress(0, 0, 0, 0.0)
        occupied = evidence.state.maps.occupied
        if occupied[traversed].any():
            occupied[traversed] = 0
            evidence.rebuild()
        if hold:
            self._hold()

    def _hold(self) -> None:
        """Set the prior so that changes outside of the window cost more than they can gain."""
        bottom, top, left, right = self._window
        inside = np.zeros(self.evidence.grid.shape, np.bool_)
        inside[bottom:top, left:right] = True
        stay = np.where(self.evidence.state.maps.occupied == 1, FORBIDDEN, -FORBIDDEN)
        for prior in (self._prior, self._of_walls):
            np.copyto(prior.local, stay, where=~inside.ravel())

    def _begin_with(self, prior: Prior) -> None:
        """Use a prior, with which any flip and any shift may gain."""
        self._prior = prior
        self._settled[:] = 0
        self._tried_at = -1
        self.evidence.state.maps.touched[:] = 1

    def _advance(self, flips: int, shifts: int, gain: float, watch: Watch) -> None:
        check(self.evidence.state.stop)
        p = self.progress
        self.progress = Progress(p.iterations + 1, p.flips + flips, p.shifts + shifts, p.gain + gain)
        watch(self.progress)

    def _more(self) -> bool:
        return self.progress.iterations < self._parameters.max_iterations

    def _objective(self) -> float:
        maps = self.evidence.state.maps
        return self.evidence.tempered_log_likelihood + log_prior(self._prior, maps.occupied, maps.pattern)

    def run(self, watch: Watch = lambda progress: None) -> SearchResult:
        """Search until no flip and no move gains; `watch` is called after each iteration.

        If the initial map is a local maximum, it is the result: parallel updates would lead to another maximum.

        Raises
        ------
        Cancelled
            If `stop` was set.
        """
        if self.evidence.state.maps.occupied.any():
            independent = self._prior
            self._begin_with(self._of_walls)
            converged = self._climb(watch)
            if converged and not self.progress.flips and not self.progress.shifts:
                return self._result(converged)
            self._begin_with(independent)
        while self._more() and self._update_in_parallel(watch):
            pass
        return self.refine(watch)

    def refine(self, watch: Watch = lambda progress: None) -> SearchResult:
        """Search like `run`, but without the parallel updates at the beginning."""
        converged = self._climb(watch)
        if has_walls(self._parameters):
            self._begin_with(self._of_walls)
            converged = self._climb(watch)
        return self._result(converged)

    def improve(self, watch: Watch = lambda progress: None) -> SearchResult:
        """Continue from a map found by `run`, with the prior for walls only, until nothing gains."""
        self._begin_with(self._of_walls)
        return self._result(self._climb(watch))

    def _result(self, converged: bool) -> SearchResult:
        maps = self.evidence.state.maps
        of_map = log_prior(self._prior, maps.occupied, maps.pattern)
        return SearchResult(self._prior, of_map, self.progress, converged)

    def _climb(self, watch: Watch) -> bool:
        """Make moves of all kinds until nothing gains; return whether this converged."""
        walls = self._prior is self._of_walls and has_walls(self._parameters)
        while self._more():
            if self._update_in_sequence(watch) or self._shift(watch):
                continue
            if walls and (self._close_gaps(watch) or self._remove_short_walls(watch)):
                continue
            if not self._free(watch):
                return True
        return False

    def _occupied(self) -> NDArray[np.int64]:
        """Return the occupied cells in the window."""
        bottom, top, left, right = self._window
        width = self.evidence.grid.width
        # numpy.flatnonzero is several times faster for bool
        cells = np.flatnonzero(self.evidence.state.maps.occupied[bottom * width : top * width].view(np.bool_))
        cells += bottom * width
        column = cells % width
        return cells[(left <= column) & (column < right)]

    def _promising(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the cells whose flip gains, in the order of the map, and the gains; valid until the next call.

        Only touched blocks are searched: when all cells listed before were tried in sequence, no others can gain.
        """
        n = promising(self.evidence.state, self._prior, LEAST, self._window, self._gaining, self._gains)
        return self._gaining[:n], self._gains[:n]

    def _update_in_parallel(self, watch: Watch) -> bool:
        """Flip all cells that gain more than their neighbours; return whether another such update is worth while."""
        cells, gains = self._promising()
        # a flip at once may touch all blocks, and cells that are not flipped may still gain
        self.evidence.state.maps.touched[:] = 1
        cells = cells[highest(self.evidence.state, cells, gains, self._all_zero)]
        if len(cells) < FEW:
            return False
        before = self._objective()
        self.evidence.flip(cells)
        gain = self._objective() - before
        if gain <= 0:
            self.evidence.flip(cells)
            return False
        self._advance(len(cells), 0, gain, watch)
        return gain > LITTLE * self.progress.gain

    def _update_in_sequence(self, watch: Watch) -> int:
        cells, gains = self._promising()
        if not len(cells):
            return 0
        # the largest gain first
        order = np.argsort(-gains, kind='stable')
        flips, gain = flip_in_order(self.evidence.state, self._prior, LEAST, cells[order], gains[order])
        self._advance(flips, 0, gain, watch)
        return flips

    def _none(self) -> NDArray[np.int32]:
        """Return an array of -1 for all cells; callers reset it and return it to `_all_none`. For any thread."""
        with suppress(IndexError):
            return self._all_none.pop()
        return np.full(self.evidence.grid.size, -1, np.int32)

    def _shift(self, watch: Watch) -> int:
        evidence, s = self.evidence, self.evidence.state
        if self._tried_at >= 0:
            unsettle(s, self._tried_at, self._settled)
        self._tried_at = int(s.clock[0])
        cells = self._occupied()
        cells = cells[self._settled[cells] == 0]
        self._settled[cells] = 1
        slot = self._none()
        slot[cells] = np.arange(len(cells), dtype=np.int32)
        observing = np.ones(len(evidence), np.uint8)
        if s.maps.seen[cells].sum() < len(evidence):
            observing[:] = 0
            mark_observing(s, cells, observing)
        readings = np.flatnonzero(observing)
        joint = np.zeros(len(cells) * NEIGHBOURS, np.int64)

        def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
            place = self._none()
            try_shifts(s, readings[begin:end], slot, place, ratio_batch(), own)
            self._all_none.append(place)

        evidence.sum_over_readings(0, len(readings), work, joint, beside=slot.nbytes)
        slot[cells] = -1
        self._all_none.append(slot)
        targets, gains = best_shifts(s, self._prior, LEAST, cells, joint.reshape(-1, NEIGHBOURS))
        order = np.argsort(-gains, kind='stable')[: int((targets >= 0).sum())]
        shifts, gain = shift_in_order(s, self._prior, LEAST, cells[order], targets[order])
        self._advance(0, shifts, gain, watch)
        return shifts

    def _free(self, watch: Watch) -> int:
        """Free unneeded cells, which parallel updates leave if the prior of an occupied cell is not negative."""
        cells = self._occupied()
        flips, gain = free_unneeded(self.evidence.state, self._prior, LEAST, cells)
        if flips:
            self._advance(flips, 0, max(gain, 0.0), watch)
        return flips

    def _cells(self, length: float) -> int:
        """Return a length, metres, in cells."""
        return max(round(length / self.evidence.grid.resolution), 1)

    def _close_gaps(self, watch: Watch) -> int:
        s = self.evidence.state
        flips, gain = close_gaps(s, self._prior, LEAST, self._occupied(), self._cells(LONGEST_GAP))
        self._advance(flips, 0, gain, watch)
        return flips

    def _remove_short_walls(self, watch: Watch) -> int:
        s = self.evidence.state
        flips, gain = remove_short_walls(s, self._prior, LEAST, self._occupied(), self._cells(SHORT_WALL))
        self._advance(flips, 0, gain, watch)
        return flips
