"""Flips of single cells: finding those that gain, and flipping many at once or one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..evidence.cell_flip import flip
from ..evidence.neighbourhood import NEIGHBOURS, neighbour
from ..evidence.state import BLOCK_SHIFT, State
from ..runtime.jit import allocating_kernel, inlined_kernel, kernel
from .prior import Prior, prior_gain


@inlined_kernel
def gain_of(s: State, prior: Prior, c: int) -> float:
    """Return the gain of flipping cell c, including the prior, nats."""
    data = s.maps.evidence[c] * s.model.nats
    return float(data + prior_gain(prior, s.maps.occupied, s.maps.pattern, c, s.lattice.width))


WORTH_WAITING = 0.5
"""A cell is flipped if it still gains at least this fraction of its gain at the start of the update."""


Least = tuple[float, float]
"""Nats that a flip must gain, and nats that it must gain in addition for each reading that observes the cell."""


@inlined_kernel
def least_gain(s: State, least: Least, c: int) -> float:
    """Return the least gain of a flip of cell c, nats."""
    return float(least[0] + least[1] * s.maps.seen[c])


@inlined_kernel
def any_above(evidence: Any, occupied: Any, pattern: Any, floor: Any, begin: int, end: int) -> bool:
    """Return whether any of some cells has evidence above `floor`, or is occupied, or has an occupied neighbour."""
    found = 0
    for c in range(np.uint64(begin), np.uint64(end)):
        # without a branch, so that the compiler vectorises it
        found |= (evidence[c] > floor) | (occupied[c] != 0) | (pattern[c] != 0)
    return found != 0


@kernel
def promising(s: State, prior: Prior, least: Least, window: tuple[int, int, int, int], cells: Any, gains: Any) -> int:
    """List the cells in `touched` blocks whose flip gains more than `least`, and the gains; return their number.

    `window` has begin and end of the rows, and of the columns. Its blocks are no longer `touched` then.
    """
    maps, width = s.maps, s.lattice.width
    occupied, evidence, seen, pattern = maps.occupied, maps.evidence, maps.seen, maps.pattern
    # least evidence for a flip of a free cell without neighbours; nearly all have less, and are skipped
    floor = np.int64((least[0] - prior.most - prior.shape[0]) / s.model.nats) - 1
    n = 0
    for row in range(window[0], window[1]):
        first, end = row * width + window[2], row * width + window[3]
        for block in range(first >> BLOCK_SHIFT, ((end - 1) >> BLOCK_SHIFT) + 1):
            begin, last = max(block << BLOCK_SHIFT, first), min((block + 1) << BLOCK_SHIFT, end)
            if not maps.touched[block] or not any_above(evidence, occupied, pattern, floor, begin, last):
                continue
            for c in range(np.uint64(begin), np.uint64(last)):
                if not seen[c]:
                    continue
                data = evidence[c] * s.model.nats
                if occupied[c] or pattern[c]:
                    cell: Any = np.int64(c)
                    gain = data + prior_gain(prior, occupied, pattern, cell, width)
                else:
                    gain = data + prior.local[c] + prior.shape[0]
                if gain > least[0] + least[1] * seen[c]:
                    cells[n] = c
                    gains[n] = gain
                    n += 1
    # at the end, since a block may extend over several rows
    for row in range(window[0], window[1]):
        first, end = row * width + window[2], row * width + window[3]
        maps.touched[first >> BLOCK_SHIFT : ((end - 1) >> BLOCK_SHIFT) + 1] = 0
    return n


@allocating_kernel
def highest(s: State, cells: NDArray[np.int64], gains: Floats, workspace: Floats) -> NDArray[np.bool_]:
    """Return which of `cells` have the largest gain among their eight neighbours; of equal ones, the first.

    `workspace` (float64, shape (cells of the map,)) must be 0, and is 0 afterwards.
    """
    height, width = s.lattice.height, s.lattice.width
    for i in range(len(cells)):
        workspace[cells[i]] = gains[i]
    chosen = np.ones(len(cells), np.bool_)
    for i in range(len(cells)):
        for k in range(NEIGHBOURS):
            o = neighbour(cells[i], k, height, width)
            if o >= 0 and (workspace[o] > gains[i] or (workspace[o] == gains[i] and o < cells[i])):
                chosen[i] = False
                break
    for i in range(len(cells)):
        workspace[cells[i]] = 0.0
    return chosen


@kernel
def _flip_above(s: State, prior: Prior, cells: NDArray[np.int64], needed: Floats) -> tuple[int, float]:
    """Flip those of `cells`, in order, that gain more than `needed` after the flips before."""
    flips, total = 0, 0.0
    for i in range(len(cells)):
        if s.stop[0]:
            break
        gain = gain_of(s, prior, cells[i])
        if gain > needed[i]:
            flip(s, cells[i])
            flips += 1
            total += gain
    return flips, total


def flip_in_order(s: State, prior: Prior, least: Least, cells: NDArray[np.int64], gains: Floats) -> tuple[int, float]:
    """Flip those of `cells`, in order, that still gain enough; return their number and total gain.

    `gains` are those at the start of the update. A cell that lost much of its gain by the flip of another one is left
    to the next update, in which a better cell may come first.
    """
    return _flip_above(s, prior, cells, np.maximum(least[0] + least[1] * s.maps.seen[cells], WORTH_WAITING * gains))


def free_unneeded(s: State, prior: Prior, least: Least, cells: NDArray[np.int64]) -> tuple[int, float]:
    """Free those of some occupied `cells` that can be freed without loss, within rounding; return number and gain.

    The loss is at most half of what a flip must gain, however many readings observe the cell. Otherwise occupying the
    cell again would gain, and the search would cycle.
    """
    cells = cells[s.maps.seen[cells] > 0]
    rounding = np.minimum(least[1] * s.maps.seen[cells], 0.5 * least[0])
    return _flip_above(s, prior, cells, np.nextafter(-rounding, -np.inf))
