"""Judging trajectories by how well they predict readings that they were not fitted to.

Blocks all over the drive are predicted on maps of the few metres around them, which shows drift of odometry. Held-out
windows are predicted on maps of all visits of a place, which shows a trajectory that is bent as a whole.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .holding_out import FEWEST_BLOCKS, LEAST_SIGMAS, Gain, blocks_of, gain, held_out_blocks, predicted
from .passes import BLOCK, Progress
from .scans import Scans

SPAN = 6.0
"""Metres of progress before and after a block within which windows make its map."""

JUDGED_ON, HELD_OUT = 60, 40
"""Most blocks of `gain_over_drive`, and most held-out windows of `last_not_worse`."""

MOST_WORSE = 1.0
"""Standard errors by which a trajectory may predict readings worse and is still not called worse."""

MOST_WORSE_NEARBY, OUTWEIGHS = 2.0, 3.0
"""Standard errors by which a trajectory may predict readings worse within a few metres and still be accepted. With
corridors that are wrongly taken for straight ones it is 2 to 16, even if readings are predicted much better where the
robot came back. That outweighs it only by this many times as many standard errors."""

FIRST, FEWEST_FIRST, CLEAR = 3, 12, 2.0
"""One block of this many is compared first, if these are so many; the others only if the gain of all blocks is not
expected to be beyond the thresholds by this many σ. A local map for each block takes most of the time."""


def gain_over_drive(scans: Scans, before: Floats, after: Floats, watch: Progress) -> Gain:
    """Return the gain of one trajectory over another in predicting blocks all over the drive.

    Parameters
    ----------
    scans : Scans
    before, after : float64, shape (K, 3)
        Nodes; those of `after` may have only a few parameters that were fitted to the readings.
    watch : callable
        Receives the fraction of the work that is done.
    """
    blocks = blocks_of(len(before), BLOCK, JUDGED_ON)
    # without other visits: under drift their maps contradict this one, or lie too far off to matter
    return _compared(scans, before, after, blocks, (-MOST_WORSE, LEAST_SIGMAS), SPAN, watch)


def gain_at_revisits(scans: Scans, before: Floats, after: Floats, watch: Progress = lambda part: None) -> Gain:
    """Return the gain of one trajectory over another in predicting held-out windows, on maps of all visits.

    The parameters are those of `gain_over_drive`.
    """
    # the only proof in this case, so all held-out windows are used
    blocks = held_out_blocks(scans, len(before))
    return _gain(scans, before, after, blocks, np.inf, watch)


def gain_within_visits(scans: Scans, before: Floats, after: Floats, watch: Progress = lambda part: None) -> Gain:
    """Return the same as `gain_at_revisits`, but on maps of the few metres around, without other visits.

    A trajectory that does not come back to any place contradicts itself nowhere. Compared with one that does, and whose
    visits do not agree exactly, it predicts readings better on maps of all visits even if it is wrong.
    """
    return _gain(scans, before, after, held_out_blocks(scans, len(before)), SPAN, watch)


def is_worse_nearby(nearby: Gain, everywhere: Gain) -> bool:
    """Return whether a trajectory is refused, by its gains on maps of the few metres around and of all visits."""
    return nearby.sigmas < -MOST_WORSE_NEARBY and everywhere.sigmas < -OUTWEIGHS * nearby.sigmas


def last_not_worse(scans: Scans, first: Floats, *others: Floats) -> Floats:
    """Return the last trajectory that does not predict held-out windows worse than the one taken before it."""
    blocks, best = held_out_blocks(scans, HELD_OUT), first
    for nodes in others:
        if _compared(scans, best, nodes, blocks, (-MOST_WORSE, -MOST_WORSE)).sigmas > -MOST_WORSE:
            best = nodes
    return best


def _compared(
    scans: Scans,
    before: Floats,
    after: Floats,
    blocks: list[NDArray[np.int64]],
    thresholds: tuple[float, float],
    span: float = np.inf,
    watch: Progress = lambda part: None,
) -> Gain:
    """Return the gain of one trajectory over another in predicting blocks: of all, if some do not clearly decide.

    If n of N blocks have a gain of s standard errors, all are expected to have √(N/n) s ± √(N/n − 1).

    Parameters
    ----------
    thresholds : float, float
        The smallest and the largest number of standard errors that the caller compares the gain with.

    The others are as in `predicted` and `gain_over_drive`.
    """
    first, done = blocks[::FIRST], 0.0
    if len(first) >= FEWEST_FIRST:
        more = len(blocks) / len(first)
        better = _gain(scans, before, after, first, span, lambda part: watch(part / more))
        expected, margin = math.sqrt(more) * better.sigmas, CLEAR * math.sqrt(more - 1.0)
        if not thresholds[0] - margin < expected < thresholds[1] + margin:
            return better
        done = 1.0 / more
    return _gain(scans, before, after, blocks, span, lambda part: watch(max(part, done)))


def _gain(
    scans: Scans, before: Floats, after: Floats, blocks: list[NDArray[np.int64]], span: float, watch: Progress
) -> Gain:
    first = predicted(scans, before, blocks, span, lambda part: watch(part / 2))
    return gain(first, predicted(scans, after, blocks, span, lambda part: watch((1.0 + part) / 2)))


def gain_of_objective(scans: Scans, before: Floats, after: Floats) -> Gain:
    """Return the gain in J of one trajectory over another, nats a block; without held-out readings.

    Both trajectories were fitted to these readings, so a small gain means nothing. A large one shows that the other
    trajectory contradicts itself, within a metre or two or as a whole; `fitting` distinguishes these.
    """
    (value, windows), (more, of_more) = (scans.explained(nodes) for nodes in (before, after))
    blocks = np.add.reduceat(of_more - windows, np.arange(0, len(windows), BLOCK))
    if len(blocks) < FEWEST_BLOCKS:
        return Gain(0.0, np.inf)
    return Gain((more - value) / len(blocks), float(blocks.std(ddof=1) / np.sqrt(len(blocks))))
