"""Held-out readings: how well a trajectory, with the map along it, predicts readings that are not on the map.

The measure is the mean log-likelihood ratio of the readings of a block of windows, on the local map of all other
windows nearby. It is biased for readings that a trajectory was fitted to. So there are two tests. Odometry corrected
by heading and calibration is compared with plain odometry on blocks all over the drive: it has few parameters for the
whole drive, and none is a position. Then the matched trajectory is compared with that on held-out windows only, which
are used in no match, map or vote; their poses are interpolated from those of their neighbours.
"""

from __future__ import annotations

import hashlib
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..runtime.threads import in_order
from .likelihood import scores
from .passes import Progress
from .poses import relative
from .scans import Scans

EVERY = 8
"""One window of this many is held out."""

OTHERS = (0, 2)
"""The first held-out window of each further fold; in the first fold it is `EVERY` // 2."""

NEAR = 4.0
"""Metres around a block within which windows make its map."""

LEAST_SIGMAS = 2.3
"""Standard errors by which readings must be predicted better; by chance this happens in one of 100 cases."""

REVISIT_AFTER = 10.0
"""Metres of progress between two visits of a place."""

FEWEST = 5
"""Fewest readings of a block that is compared."""

FEWEST_BLOCKS = 5
"""Fewest blocks that trajectories are compared by."""


def held_out(count: int, first: int = EVERY // 2) -> NDArray[np.bool_]:
    """Return which of `count` windows are held out, shape (count,), beginning with window `first`."""
    out: NDArray[np.bool_] = np.arange(count) % EVERY == first
    return out


def predicted(
    scans: Scans,
    nodes: Floats,
    blocks: list[NDArray[np.int64]],
    span: float = np.inf,
    watch: Progress = lambda part: None,
) -> Floats:
    """Return the mean log-likelihood ratio of the readings of each block, shape (n,), nats; NaN if it has no map.

    Parameters
    ----------
    scans : Scans
    nodes : float64, shape (K, 3)
    blocks : list of int64
        Windows of each; they are left out of the map of their block.
    span : float
        Metres of progress before and after a block within which windows make its map.
    watch : callable
        Receives the fraction of the work that is done.
    """
    along = hashlib.sha256(nodes.tobytes()).digest()
    keys = [(along, block.tobytes(), span) for block in blocks]
    new = {key: block for key, block in zip(keys, blocks, strict=True) if key not in scans.predictions}
    work = [partial(_predicted, scans, nodes, block, span) for block in new.values()]
    for done, (key, value) in enumerate(zip(new, in_order(work, scans.threads), strict=True)):
        watch(done / len(new))
        scans.predictions[key] = value
    return np.array([scans.predictions[key] for key in keys], np.float64)


def _predicted(scans: Scans, nodes: Floats, block: NDArray[np.int64], span: float) -> float:
    """Return the mean log-likelihood ratio of the readings of one block, nats."""
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
    """How much better readings are predicted: mean and standard error, nats a reading."""

    mean: float
    error: float

    @property
    def sigmas(self) -> float:
        """The mean in units of the standard error."""
        return self.mean / self.error if self.error > 0.0 else 0.0


def gain(before: Floats, after: Floats) -> Gain:
    """Return the gain of one trajectory over another, from the values of `predicted` for the same blocks."""
    difference = after - before
    difference = difference[np.isfinite(difference)]
    if len(difference) < FEWEST_BLOCKS:
        return Gain(0.0, np.inf)
    return Gain(float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference))))


def blocks_of(count: int, length: int, most: int) -> list[NDArray[np.int64]]:
    """Return blocks of `length` windows, spread evenly over a drive of `count` windows; at most `most` blocks."""
    starts = np.arange(0, count, length)
    if len(starts) > most:
        starts = starts[np.linspace(0, len(starts) - 1, most).round().astype(np.int64)]
    return [np.arange(start, min(start + length, count)) for start in starts.tolist()]


def held_out_blocks(scans: Scans, most: int) -> list[NDArray[np.int64]]:
    """Return held-out windows, each as a block of its own, spread evenly over the drive; at most `most`."""
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


def tears_apart(scans: Scans, before: Floats, after: Floats) -> bool:
    """Return whether the robot comes back to places along the nodes `before`, and to none along `after`.

    Such a trajectory contradicts itself nowhere, so readings are predicted better along it even if it is wrong.
    """
    return has_revisits(scans, before) and not has_revisits(scans, after)
