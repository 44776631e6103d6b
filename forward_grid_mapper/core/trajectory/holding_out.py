"""Readings that are held out: how well a trajectory and the map along it predict readings that are not on the map.

A trajectory is judged by the mean log ratio of the readings of a block of windows, given the local map of all others
that are near in space. A trajectory that matching has fitted to these readings would be judged by what it was made of.
So the test is twofold. Odometry with the heading and the calibration found, a few figures for a whole drive and none of
them a place, is compared with odometry on blocks all over the drive. And what matching then makes of it is compared
with it on windows that were kept out of every match, map and vote, and lie where their neighbours put them.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .likelihood import scores
from .poses import Floats, relative
from .scans import Scans

EVERY = 8
"""One window in so many is held out."""

NEAR = 4.0
"""Metres between nodes of windows that belong on one map."""

LEAST_SIGMAS = 2.3
"""Standard errors by which readings must be predicted better: by chance it is so in one of 100."""

REVISIT_AFTER = 10.0
"""Metres of progress after which a place that the robot is at was seen before, rather than just now."""

FEWEST = 5
"""Readings of a block that are compared."""

FEWEST_BLOCKS = 5
"""Blocks that it takes to compare trajectories."""


def held_out(count: int) -> NDArray[np.bool_]:
    """Return which of so many windows are held out, shape (count,)."""
    out: NDArray[np.bool_] = np.arange(count) % EVERY == EVERY // 2
    return out


def predicted(scans: Scans, nodes: Floats, blocks: list[NDArray[np.int64]], span: float = np.inf) -> Floats:
    """Return the mean log ratio of the readings of each block, shape (n,), in nats; NaN where there is none.

    Parameters
    ----------
    scans : Scans
    nodes : float64, shape (K, 3)
    blocks : list of int64
        Windows, which are left out of their map.
    span : float
        Metres of progress before and after a block that its map is made of.
    """
    along = hashlib.sha256(nodes.tobytes()).digest()
    out = np.empty(len(blocks))
    for i, block in enumerate(blocks):
        key = along, block.tobytes(), span
        if key not in scans.predictions:
            scans.predictions[key] = _predicted(scans, nodes, block, span)
        out[i] = scans.predictions[key]
    return out


def _predicted(scans: Scans, nodes: Floats, block: NDArray[np.int64], span: float) -> float:
    """Return the mean log ratio of the readings of a block, nats, NaN where there is none."""
    progress, middle = scans.windows.node_progress, block[len(block) // 2]
    near = np.hypot(*(nodes[:, :2] - nodes[middle, :2]).T) < NEAR
    near &= np.abs(progress - progress[middle]) < span
    near[block] = False
    around = scans.map(np.flatnonzero(near), nodes[middle], nodes)
    count = sum(len(scans.scan[k].readings) for k in block)
    if around is None or count < FEWEST:
        return float('nan')
    total = [scores(scans.scan[k], around, relative(nodes[middle], nodes[k : k + 1]))[0] for k in block]
    return float(sum(total)) / count


class Gain(NamedTuple):
    """By how much readings are predicted better: mean and standard error in nats a reading."""

    mean: float
    error: float

    @property
    def sigmas(self) -> float:
        """How many standard errors the mean lies above zero."""
        return self.mean / self.error if self.error > 0.0 else 0.0


def gain(before: Floats, after: Floats) -> Gain:
    """Return the gain of one trajectory over another, by what `predicted` says of the same blocks."""
    difference = after - before
    difference = difference[np.isfinite(difference)]
    if len(difference) < FEWEST_BLOCKS:
        return Gain(0.0, np.inf)
    return Gain(float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference))))


def blocks_of(count: int, length: int, most: int) -> list[NDArray[np.int64]]:
    """Return blocks of so many windows, evenly over a drive of `count` windows, `most` of them at the most."""
    starts = np.arange(0, count, length)
    if len(starts) > most:
        starts = starts[np.linspace(0, len(starts) - 1, most).round().astype(np.int64)]
    return [np.arange(start, min(start + length, count)) for start in starts.tolist()]


def held_out_blocks(scans: Scans, most: int) -> list[NDArray[np.int64]]:
    """Return the windows that are held out, each as a block, `most` at the most, evenly over the drive."""
    chosen = np.flatnonzero(scans.held_out)
    return [chosen[k] for k in blocks_of(len(chosen), 1, most)]


def has_revisits(scans: Scans, nodes: Floats) -> bool:
    """Return whether the robot came back to places, along nodes of shape (K, 3).

    At least `FEWEST_BLOCKS` held-out windows must lie near a node more than `REVISIT_AFTER` away along the drive.
    """
    progress, count = scans.windows.node_progress, 0
    for k in np.flatnonzero(scans.held_out):
        near = np.hypot(*(nodes[:, :2] - nodes[k, :2]).T) < NEAR
        count += bool((near & (np.abs(progress - progress[k]) > REVISIT_AFTER)).any())
    return count >= FEWEST_BLOCKS
