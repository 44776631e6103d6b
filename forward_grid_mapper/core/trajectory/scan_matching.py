"""Scan matching: the nodes one after the other, each where its readings fit the map of the last metres best.

It takes no walls at right angles. A few readings from a few places fit nearly as well some degrees off, so the best
pose alone would be led astray by chance. The mean over all poses, weighted by how well they fit, is off by less. Errors
add up, but more slowly than those of odometry: what stands beside the robot for some metres holds its yaw.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .likelihood import scores
from .matching import grid_around
from .passes import FEWEST, Progress
from .poses import Floats, compose, relative
from .scans import Scans

BLOCK = 2
"""Windows that are matched at once: each has too few readings."""

BEHIND, ON_MAP = 8.0, 800
"""Metres of progress before a block that its map is made of, and readings of it at the most."""

FIRST = 6
"""Windows that stay as odometry has them: the first map is made of them."""

ALONG = 0.03, 0.03
"""σ of how far odometry is off, in any direction: metres at least, and metres a metre."""

YAW_OF_TURN, LEAST_YAW = 0.05, math.radians(0.5)
"""σ of the yaw of odometry: parts of a turn, and radians at least."""

MOST_OFF = 4.0
"""Nats that being off counts at the most, each way: wheels slip."""

STEPS = (0.1, 0.1, math.radians(2.0))
REACH, SIGMAS, FARTHEST = 0.1, 3.0, 0.5
"""How far poses are asked: metres either way, σ of the yaw, and radians at the most."""

EVALUATED = 60
"""Readings that are asked at each pose."""


class Trust(NamedTuple):
    """How much readings are trusted, and odometry.

    Attributes
    ----------
    counts : float
        What the log-likelihood of a reading counts: readings of one place depend on each other.
    yaw : float
        σ of the yaw of odometry, radians a √metre.
    """

    counts: float
    yaw: float


TRUSTS = (Trust(0.3, math.radians(4.0)), Trust(0.5, math.radians(5.5)))
"""What is tried, in this order: chance leads each astray in other places."""


def scan_matched(scans: Scans, trust: Trust, watch: Progress) -> Floats:
    """Return the nodes of a drive, from the first one as odometry has it on, float64, shape (K, 3).

    Parameters
    ----------
    scans : Scans
    trust : Trust
    watch : callable
        Receives how much is done, from 0 to 1.
    """
    w = scans.windows
    odometry, nodes = w.node, w.node.copy()
    for k in range(FIRST, len(nodes), BLOCK):
        watch(k / len(nodes))
        block, last = np.arange(k, min(k + BLOCK, len(nodes))), k - 1
        motion = relative(odometry[last], odometry[block])
        nodes[block] = compose(nodes[last], compose(_off(scans, nodes[:k], block, motion, trust), motion))
    return nodes


def _off(scans: Scans, nodes: Floats, block: NDArray[np.int64], motion: Floats, trust: Trust) -> Floats:
    """Return by how much the motion from the last node to a block is off, in the frame of that node, shape (3,)."""
    w, last = scans.windows, len(nodes) - 1
    behind = np.flatnonzero(w.node_progress[last + 1] - w.node_progress[: last + 1] < BEHIND)
    around = scans.map(behind, nodes[last], nodes, ON_MAP)
    if around is None or scans.count[block].sum() < FEWEST:
        return np.zeros(3)
    length, turn = w.travel[block[-1]] - w.travel[last], w.turn[block[-1]] - w.turn[last]
    away = ALONG[0] + ALONG[1] * length
    sigma = np.array([away, away, math.sqrt(trust.yaw**2 * length + (YAW_OF_TURN * turn) ** 2 + LEAST_YAW**2)])
    reach = np.array([REACH, REACH, min(SIGMAS * sigma[2], FARTHEST)])
    poses = grid_around(np.zeros(3), reach, STEPS)
    joint = scans.joint(block, motion)
    fits = trust.counts * scores(joint, around, poses, max(len(joint.readings) // EVALUATED, 1))
    value = fits - np.minimum(0.5 * (poses / sigma) ** 2, MOST_OFF).sum(1)
    weight = np.exp(value - value.max())
    out: Floats = weight @ poses / weight.sum()
    return out
