"""Shifts: an occupied cell moves to a neighbour in one step, a block move of two cells.

A shift frees cell c and occupies its neighbour o. Its gain follows from the single flips, since T is linear in the term
of each cell. For a reading that observes both, with likelihood ratios r_c and r_o of the single flips and
q = 1 − p_hit, the ratio of both together is

    o behind c              r_c + (r_o − 1) / q
    o in front of c         r_o + q (r_c − 1)
    both in the free zone   1

So one pass over the readings gives the gains of all shifts, and only those with a gain are made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..evidence.cell_flip import find_observing, flip
from ..evidence.fixed_point import RatioWorkspace, quantise_logs, ratio_workspace_for
from ..evidence.neighbourhood import NEIGHBOURS, neighbour, note_flip
from ..evidence.pairs import WORDS_PER_RUN, Pairs
from ..evidence.state import State
from ..evidence.updates import pairs_of, ratios_and_logs
from ..runtime.jit import allocating_kernel, inlined_kernel, kernel
from .flips import Least, gain_of, least_gain
from .prior import Prior

LEAST_JOINT = 1e-9
"""Smallest ratio of a shift: ratios are differences, and rounding may make them 0."""

BATCH = 1024
"""Ratios whose logs are computed together."""


class RatioBatch(NamedTuple):
    """Ratios of shifts whose logs are still to be computed, up to `BATCH`.

    Attributes
    ----------
    waiting : int64, shape (1,)
        Their number.
    ratios : RatioWorkspace
    log : int32
        Their logs, in units of `fixed_point.QUANTUM`.
    single : int32
        The sum of the logs of the two flips, in the same units.
    times : int32
        Multiplicity of the reading.
    at : int64
        Index of the sum to add to.
    """

    waiting: NDArray[np.int64]
    ratios: RatioWorkspace
    log: NDArray[np.int32]
    single: NDArray[np.int32]
    times: NDArray[np.int32]
    at: NDArray[np.int64]


def ratio_batch() -> RatioBatch:
    """Return an empty batch."""
    return RatioBatch(
        waiting=np.zeros(1, np.int64),
        ratios=ratio_workspace_for(BATCH),
        log=np.empty(BATCH, np.int32),
        single=np.empty(BATCH, np.int32),
        times=np.empty(BATCH, np.int32),
        at=np.empty(BATCH, np.int64),
    )


@kernel
def unsettle(s: State, since: int, settled: Any) -> None:
    """Mark the cells of all readings that changed after the time `since` of the clock as not settled."""
    for t in range(len(s.reading_states)):
        reading_state = s.reading_states[t]
        if reading_state.changed > since:
            pairs, at = pairs_of(s, t)
            begin = at + WORDS_PER_RUN * reading_state.runs
            for k in range(at, begin, WORDS_PER_RUN):
                settled[pairs.cell[k] : pairs.cell[k + 1] + 1] = 0
            for k in range(begin, begin + reading_state.bands):
                settled[pairs.cell[k]] = 0


@kernel
def mark_observing(s: State, cells: NDArray[np.int64], observing: Any) -> None:
    """Mark in `observing` (uint8, shape (N,)) the readings that observe any of `cells`."""
    for c in cells:
        for i in range(find_observing(s, c)):
            observing[s.observing[i, 0]] = 1


@inlined_kernel
def _in_runs(pairs: Pairs, at: int, runs: int, c: int) -> bool:
    """Return whether cell c is in one of the runs from index `at` on."""
    for k in range(at, at + WORDS_PER_RUN * runs, WORDS_PER_RUN):
        if c <= pairs.cell[k + 1]:
            return bool(c >= pairs.cell[k])
    return False


@kernel
def _any_in_runs(pairs: Pairs, at: int, end: Any, slot: Any) -> bool:
    """Return whether any cell of the runs from index `at` to `end` is set in `slot`."""
    found = 0
    for k in range(np.uint64(at), end, np.uint64(WORDS_PER_RUN)):
        for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
            # without a branch, so that the compiler vectorises it
            found |= slot[c] >= 0
    return found != 0


@inlined_kernel
def _collect(
    s: State, t: int, pairs: Pairs, at: int, cell: tuple[int, int, int], place: Any, batch: RatioBatch
) -> None:
    """Add the ratios of shifting a cell to each of its neighbours to `batch`, which must have room for them.

    Parameters
    ----------
    t
        The reading; its ratios must be in the workspace (`ratios_and_logs`).
    cell
        The cell, its index in the band, or -1 if it is in the free zone, and its row of `joint`.
    place : int32, shape (cells,)
        Index of each cell in the band, -1 outside of it.
    """
    c, here, row = cell
    height, width = s.lattice.height, s.lattice.width
    q, n = 1.0 - s.model.p_hit, batch.waiting[0]
    reading_state, ratios = s.reading_states[t], s.workspace.ratios.ratio
    logs = at + WORDS_PER_RUN * reading_state.runs + 2 * reading_state.bands
    own = pairs.log[logs + here] if here >= 0 else reading_state.release
    # in the free zone, the ratio of occupying a cell, and that of freeing one, follow those of the band
    occupy = reading_state.bands
    ratio = ratios[here if here >= 0 else occupy + 1]
    for k in range(NEIGHBOURS):
        o = neighbour(c, k, height, width)
        if o < 0 or s.maps.occupied[o]:
            continue
        there = place[o]
        if there >= 0:
            log, other = pairs.log[logs + there], ratios[there]
            together = ratio + (other - 1.0) / q if there > here else other + q * (ratio - 1.0)
        elif _in_runs(pairs, at, reading_state.runs, o):
            log = reading_state.occupy
            together = ratios[occupy] + q * (ratio - 1.0) if here >= 0 else 1.0
        else:
            continue
        batch.ratios.ratio[n] = max(together, LEAST_JOINT)
        batch.single[n] = own + log
        batch.times[n] = reading_state.multiplicity
        batch.at[n] = NEIGHBOURS * row + k
        n += 1
    batch.waiting[0] = n


@kernel
def _sum_batch(batch: RatioBatch, joint: Any) -> None:
    """Add the logs of the ratios of a batch, minus those of the two flips, to `joint` (flat), and empty it."""
    n = batch.waiting[0]
    quantise_logs(batch.ratios, n, batch.log)
    for i in range(n):
        joint[batch.at[i]] += batch.times[i] * np.int64(batch.log[i] - batch.single[i])
    batch.waiting[0] = 0


@inlined_kernel
def _sum_full_batch(batch: RatioBatch, joint: Any) -> None:
    """Do the same if there is no room for the ratios of another cell."""
    if batch.waiting[0] > BATCH - NEIGHBOURS:
        _sum_batch(batch, joint)


@kernel
def try_shifts(s: State, readings: Any, slot: Any, place: Any, batch: RatioBatch, joint: Any) -> None:
    """Add the log ratios of shifts by some readings, minus those of the two flips, in units of `fixed_point.QUANTUM`.

    Parameters
    ----------
    readings : int64
        Indices of the readings.
    slot : int32, shape (cells,)
        Row of `joint` of each cell whose shifts are tried, -1 for others.
    place : int32, shape (cells,)
        Workspace; all -1 before and after the call.
    batch : RatioBatch
        Workspace; empty before and after the call.
    joint : int64, shape (rows * 8,)
        Sums by cell and neighbour; they are meaningless for occupied neighbours.
    """
    workspace = s.workspace
    for t in readings:
        if s.stop[0]:
            break
        reading_state = s.reading_states[t]
        pairs, at = pairs_of(s, t)
        cells = np.uint64(at + WORDS_PER_RUN * reading_state.runs)
        n = 0
        for k in range(np.uint64(reading_state.bands)):
            # without a branch, since it would often be predicted wrongly
            workspace.bucket[n] = k
            n += slot[pairs.cell[cells + k]] >= 0
        if not n and not (reading_state.blocking and _any_in_runs(pairs, at, cells, slot)):
            continue
        ratios_and_logs(s, t, pairs, at)
        for k in range(np.uint64(reading_state.bands)):
            place[pairs.cell[cells + k]] = k
        for i in range(n):
            k = workspace.bucket[i]
            c = pairs.cell[cells + k]
            cell: Any = np.int64(c), np.int64(k), np.int64(slot[c])
            _collect(s, t, pairs, at, cell, place, batch)
            _sum_full_batch(batch, joint)
        if reading_state.blocking:
            for k in range(np.uint64(at), cells, np.uint64(WORDS_PER_RUN)):
                for c in range(np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)]) + np.uint64(1)):
                    if slot[c] >= 0:
                        cell = np.int64(c), np.int64(-1), np.int64(slot[c])
                        _collect(s, t, pairs, at, cell, place, batch)
                        _sum_full_batch(batch, joint)
        for k in range(np.uint64(reading_state.bands)):
            place[pairs.cell[cells + k]] = -1
    _sum_batch(batch, joint)


@allocating_kernel
def best_shifts(
    s: State, prior: Prior, least: Least, cells: NDArray[np.int64], joint: Any
) -> tuple[NDArray[np.int64], Floats]:
    """Return for each of `cells` the free neighbour to which a shift gains most, -1 if none gains, and the gain."""
    height, width = s.lattice.height, s.lattice.width
    targets, gains = np.full(len(cells), -1, np.int64), np.zeros(len(cells))
    for i in range(len(cells)):
        c = cells[i]
        loss = gain_of(s, prior, c)
        # the prior of the neighbours depends on this cell
        s.maps.occupied[c] ^= 1
        note_flip(s.maps.pattern, c, height, width)
        for k in range(NEIGHBOURS):
            o = neighbour(c, k, height, width)
            if o < 0 or s.maps.occupied[o] or not s.maps.seen[o]:
                continue
            gain = loss + gain_of(s, prior, o) + joint[i, k] * s.model.nats
            if gain > max(gains[i], least_gain(s, least, c) + least_gain(s, least, o)):
                targets[i], gains[i] = o, gain
        s.maps.occupied[c] ^= 1
        note_flip(s.maps.pattern, c, height, width)
    return targets, gains


@kernel
def shift_in_order(
    s: State, prior: Prior, least: Least, cells: NDArray[np.int64], targets: NDArray[np.int64]
) -> tuple[int, float]:
    """Make those shifts, in order, that still gain; return their number and total gain."""
    moves, total = 0, 0.0
    for i in range(len(cells)):
        c, o = cells[i], targets[i]
        if s.stop[0]:
            break
        if not s.maps.occupied[c] or s.maps.occupied[o]:
            continue
        loss = gain_of(s, prior, c)
        flip(s, c)
        gain = loss + gain_of(s, prior, o)
        if gain > least_gain(s, least, c) + least_gain(s, least, o):
            flip(s, o)
            moves += 1
            total += gain
        else:
            flip(s, c)
    return moves, total
