"""Judging: whether readings speak for one trajectory rather than another, by what each predicts of readings not used.

All over the drive, maps of a few metres of it are compared: so the drift of odometry shows. At places seen before, maps
of all times are compared with windows that were held out: so a drive that is bent as a whole shows.
"""

from __future__ import annotations

import math

import numpy as np

from .holding_out import FEWEST_BLOCKS, Gain, blocks_of, gain, held_out_blocks, predicted
from .passes import BLOCK, Progress
from .poses import Floats, wrapped
from .scans import Scans
from .windows import Windows

SPAN = 6.0
"""Metres of progress before and after a block that the map is made of on which odometry is compared."""

JUDGED_ON, HELD_OUT = 60, 40
"""Blocks of `gain_over_drive`, and held-out windows of `last_not_worse`, at the most."""

MOST_WORSE = 1.0
"""Standard errors by which matching may predict what was held out worse."""

TURNED, LEAST_SIGMAS_OF_TURNS = math.radians(8.0), 1.5
"""Radians by which odometry must turn otherwise within `SPAN` for readings to tell it, and by how many standard errors
they must then be predicted better: with corners that are not square it is -4 to -6, with drift 2 to 7."""


def gain_over_drive(scans: Scans, before: Floats, after: Floats, watch: Progress) -> Gain:
    """Return by how much one trajectory predicts readings better than another, all over the drive.

    Parameters
    ----------
    scans : Scans
    before, after : float64, shape (K, 3)
        Nodes; those of `after` may owe readings a few figures for the whole drive, and nothing else.
    watch : callable
    """
    blocks = blocks_of(len(before), BLOCK, JUDGED_ON)
    # places of another time are left out: where they overlap by half they contradict, far apart they say nothing
    before_values = predicted(scans, before, blocks, SPAN)
    watch(0.5)
    return gain(before_values, predicted(scans, after, blocks, SPAN))


def gain_at_revisits(scans: Scans, before: Floats, after: Floats) -> Gain:
    """Return by how much what was held out is predicted better on maps of all times that the robot came by."""
    # it is the only proof, so all that was held out has a say
    blocks = held_out_blocks(scans, len(before))
    return gain(predicted(scans, before, blocks), predicted(scans, after, blocks))


def last_not_worse(scans: Scans, first: Floats, *others: Floats) -> Floats:
    """Return the last nodes that do not predict what was held out from them worse than those before."""
    blocks = held_out_blocks(scans, HELD_OUT)
    best, best_values = first, predicted(scans, first, blocks)
    for nodes in others:
        values = predicted(scans, nodes, blocks)
        if gain(best_values, values).sigmas > -MOST_WORSE:
            best, best_values = nodes, values
    return best


def gain_of_objective(scans: Scans, before: Floats, after: Floats) -> Gain:
    """Return by how much more J is along one trajectory than along another, nats a block of all readings but held-out.

    Either trajectory was fitted to these readings, so a small gain means nothing; a large one tells a trajectory that
    contradicts itself.
    """
    (value, windows), (more, of_more) = (scans.explained(nodes) for nodes in (before, after))
    blocks = np.add.reduceat(of_more - windows, np.arange(0, len(windows), BLOCK))
    if len(blocks) < FEWEST_BLOCKS:
        return Gain(0.0, np.inf)
    return Gain((more - value) / len(blocks), float(blocks.std(ddof=1) / np.sqrt(len(blocks))))


def turns_supported(scans: Scans, nodes: Floats) -> bool:
    """Return whether readings are predicted better where nodes turn within a few metres as odometry does not.

    So it is, too, where there are too few such turns to tell. A robot that goes around a corner which is not square
    looks as if its odometry were off by as much.
    """
    windows = scans.windows
    blocks = blocks_of(len(windows), BLOCK, len(windows))
    excess = np.array([_excess_turn(windows, nodes, block[len(block) // 2]) for block in blocks])
    sharp = [blocks[k] for k in np.sort(np.argsort(-excess, kind='stable')[:JUDGED_ON]) if excess[k] > TURNED]
    if len(sharp) < FEWEST_BLOCKS:
        return True
    better = gain(*(predicted(scans, each, sharp, SPAN) for each in (windows.node, nodes)))
    return bool(np.isinf(better.error)) or better.sigmas > LEAST_SIGMAS_OF_TURNS


def _excess_turn(windows: Windows, nodes: Floats, middle: int) -> float:
    """Return by how much nodes turn, radians, within `SPAN` about one of them, beyond what odometry has."""
    near = np.flatnonzero(np.abs(windows.node_progress - windows.node_progress[middle]) <= SPAN / 2)[[0, -1]]
    return float(abs(wrapped(np.diff(nodes[near, 2] - windows.node[near, 2])[0])))
