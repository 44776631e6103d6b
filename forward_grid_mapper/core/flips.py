"""Flips of single cells in O(1) a reading: the M-step with an exact mini E-step in both directions.

Write p(z_t | m) = c + T, where c gathers the causes that no map changes and T the obstacles and max range. For a cell
at distance d, let A be the share of T from occupied cells before it, W = share · (1 − p_hit)^(occupied cells before it)
and g = N(z; d, σ). Then flipping the cell makes of T

    occupy   T' = A + W p_hit g + (T − A) (1 − p_hit)
    free     T' = A + (T − A − W p_hit g) / (1 − p_hit)

and multiplies p(z_t | m) by (c + T') / (c + T) (ALGORITHM §5; eq 37-40 of the paper with its constants mended). These
ratios are kept: one for each band slot, in the order by cell, and two for each reading, which serve all cells of its
free zone (g = 0, A = 0). The gain of a flip is then the log of a product read front to back, and only an accepted flip
recomputes the ratios of the readings that see the cell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cone_index import ConeIndex, Floats
from .forward_model import Causes
from .jit import kernel

NEIGHBOURS = 8


class FlipState(NamedTuple):
    """The map under search and what is kept for each reading.

    Attributes
    ----------
    occupied : uint8, shape (cells,)
    blocking : int32, shape (N,)
        Occupied cells in each reading's free zone.
    band_ratio : float32, shape (band pairs,)
        Likelihood ratio of flipping the slot's cell.
    occupy_ratio, free_ratio : float32, shape (N,)
        Likelihood ratio of occupying, or freeing, one cell of the free zone.
    changed : uint8, shape (N,)
        Readings whose ratios changed since the last call of `mark_cells`.
    dirty : uint8, shape (cells,)
        Cells whose gain may have changed since it was last computed.
    settled : uint8, shape (cells,)
        Cells that no move helps, as long as none of their readings changes.
    gain : float64, shape (cells,)
        The last computed gain of flipping each cell, prior included, nats.
    stop : uint8, shape (1,)
        Set to 1 from any thread to cancel.
    """

    occupied: NDArray[np.uint8]
    blocking: NDArray[np.int32]
    band_ratio: NDArray[np.float32]
    occupy_ratio: NDArray[np.float32]
    free_ratio: NDArray[np.float32]
    changed: NDArray[np.uint8]
    dirty: NDArray[np.uint8]
    settled: NDArray[np.uint8]
    gain: Floats
    stop: NDArray[np.uint8]


@kernel
def _refresh(index: ConeIndex, causes: Causes, state: FlipState, t: int) -> None:
    """Recompute the ratios of reading t from the map."""
    p, q = causes.p_hit, 1.0 - causes.p_hit
    first, last = index.band_start[t], index.band_start[t + 1]
    begin = causes.share * q ** state.blocking[t]
    weight, total = begin, 0.0
    for k in range(first, last):
        if state.occupied[index.band_cell[k]]:
            total += weight * p * index.band_density[k]
            weight *= q
    total += weight * causes.no_echo[t]
    floor = causes.random[t] + causes.lost[t]
    scale = 1.0 / (floor + total)
    before, weight = 0.0, begin
    for k in range(first, last):
        term = weight * p * index.band_density[k]
        if state.occupied[index.band_cell[k]]:
            flipped = before + max(total - before - term, 0.0) / q
            before += term
            weight *= q
        else:
            flipped = before + term + max(total - before, 0.0) * q
        state.band_ratio[index.band_slot[k]] = (floor + flipped) * scale
    state.occupy_ratio[t] = (floor + total * q) * scale
    state.free_ratio[t] = (floor + total / q) * scale


@kernel
def refresh_all(index: ConeIndex, causes: Causes, state: FlipState) -> None:
    """Bring every reading's ratios in line with the map; all cells become dirty."""
    for t in range(len(state.blocking)):
        state.blocking[t] = 0
        for k in range(index.free_start[t], index.free_start[t + 1]):
            state.blocking[t] += state.occupied[index.free_cell[k]]
        _refresh(index, causes, state, t)
    state.changed[:] = 0
    state.dirty[:] = 1
    state.settled[:] = 0


@kernel
def evidence(index: ConeIndex, state: FlipState, c: int) -> float:
    """Return log p(Z | m with cell c flipped) − log p(Z | m) in nats."""
    total = 0.0
    product = 1.0
    since = 0
    for slot in range(index.slot_start[c], index.slot_start[c + 1]):
        product *= state.band_ratio[slot]
        since += 1
        # sixteen ratios stay far inside the range of float64, and save fifteen logs
        if since == 16:
            total += math.log(product)
            product = 1.0
            since = 0
    ratio = state.free_ratio if state.occupied[c] else state.occupy_ratio
    for k in range(index.seen_start[c], index.seen_start[c + 1]):
        product *= ratio[index.seen_reading[k]]
        since += 1
        if since == 16:
            total += math.log(product)
            product = 1.0
            since = 0
    return total + math.log(product)


@kernel
def _gain(index: ConeIndex, state: FlipState, prior: float, c: int) -> float:
    return evidence(index, state, c) + (-prior if state.occupied[c] else prior)


@kernel
def flip(index: ConeIndex, causes: Causes, state: FlipState, c: int) -> None:
    """Flip cell c and bring the readings that see it up to date."""
    state.occupied[c] ^= 1
    step = 1 if state.occupied[c] else -1
    for k in range(index.seen_start[c], index.seen_start[c + 1]):
        t = index.seen_reading[k]
        state.blocking[t] += step
        _refresh(index, causes, state, t)
    for slot in range(index.slot_start[c], index.slot_start[c + 1]):
        _refresh(index, causes, state, index.slot_reading[slot])


@kernel
def mark_readings(index: ConeIndex, state: FlipState, c: int) -> None:
    """Note that the readings that see cell c changed."""
    for k in range(index.seen_start[c], index.seen_start[c + 1]):
        state.changed[index.seen_reading[k]] = 1
    for slot in range(index.slot_start[c], index.slot_start[c + 1]):
        state.changed[index.slot_reading[slot]] = 1


@kernel
def mark_cells(index: ConeIndex, state: FlipState) -> None:
    """Make all cells of the readings that changed dirty, and no longer settled."""
    for t in range(len(state.changed)):
        if state.changed[t]:
            state.changed[t] = 0
            for k in range(index.free_start[t], index.free_start[t + 1]):
                state.dirty[index.free_cell[k]] = 1
                state.settled[index.free_cell[k]] = 0
            for k in range(index.band_start[t], index.band_start[t + 1]):
                state.dirty[index.band_cell[k]] = 1
                state.settled[index.band_cell[k]] = 0


@kernel
def compute_gains(index: ConeIndex, state: FlipState, prior: float) -> None:
    """Compute the gain of every dirty cell; untouched cells have none and stay as they are."""
    for c in range(len(state.dirty)):
        if state.dirty[c]:
            state.dirty[c] = 0
            seen = index.seen_start[c + 1] - index.seen_start[c] + index.slot_start[c + 1] - index.slot_start[c]
            state.gain[c] = _gain(index, state, prior, c) if seen else -math.inf


@kernel
def flip_in_order(
    index: ConeIndex, causes: Causes, state: FlipState, prior: float, least: Floats, cells: NDArray[np.int64]
) -> tuple[int, float]:
    """Flip those of `cells`, in order, that gain more than their `least`; return their number and total gain."""
    flips, total = 0, 0.0
    for c in cells:
        if state.stop[0]:
            break
        gain = _gain(index, state, prior, c)
        if gain > least[c]:
            flip(index, causes, state, c)
            mark_readings(index, state, c)
            flips += 1
            total += gain
    return flips, total


@kernel
def shift_in_order(
    index: ConeIndex,
    causes: Causes,
    state: FlipState,
    prior: float,
    least: Floats,
    cells: NDArray[np.int64],
    width: int,
) -> tuple[int, float]:
    """Move occupied cells to the free neighbour that gains most; return the number of moves and their total gain.

    The two flips of a move are evaluated together: the cell is freed, its neighbours are asked, and it is occupied
    again when none of them gains more than `least`.
    """
    moves, total = 0, 0.0
    height = len(state.occupied) // width
    for c in cells:
        if state.stop[0]:
            break
        if not state.occupied[c]:
            continue
        loss = _gain(index, state, prior, c)
        flip(index, causes, state, c)
        row, column = c // width, c % width
        best, target = -loss, c
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if 0 <= row + dy < height and 0 <= column + dx < width:
                    other = c + dy * width + dx
                    if other != c and not state.occupied[other]:
                        gain = _gain(index, state, prior, other)
                        if gain > best + (least[c] + least[other] if target == c else 0.0):
                            best, target = gain, other
        flip(index, causes, state, target)
        if target == c:
            state.settled[c] = 1
        else:
            mark_readings(index, state, c)
            mark_readings(index, state, target)
            moves += 1
            total += loss + best
    return moves, total
