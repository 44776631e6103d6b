"""Scan matching: two windows after the other are matched with the map of the last metres.

It does not need walls at right angles. A few readings fit nearly as well at a yaw that is off by some degrees, so the
best pose alone has large random errors. The mean of all poses, weighted by their likelihood, has smaller ones. Errors
accumulate, but more slowly than those of odometry, because objects beside the robot stay on the map for some metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .likelihood import scores
from .matching import grid_around
from .passes import FEWEST, Progress
from .poses import compose, relative
from .scans import Scans

BLOCK = 2
"""Windows that are matched together, since one has too few readings."""

BEHIND, ON_MAP = 8.0, 800
"""Metres of progress before a block within which windows make its map, and most readings of the map."""

FIRST = 6
"""Windows that keep the poses of odometry: they make the first map."""

ALONG = 0.03, 0.03
"""σ of the position error of odometry along each axis: metres, and metres for each metre of driving."""

YAW_OF_TURN, LEAST_YAW = 0.05, math.radians(0.5)
"""σ of the yaw error of odometry: fraction of the turn, and smallest value, radians."""

MOST_OFF = 4.0
"""Upper limit of the negative log prior of each component, nats: wheels slip."""

STEPS = (0.1, 0.1, math.radians(2.0))
REACH, SIGMAS, LARGEST_TURN = 0.1, 3.0, 0.5
"""Half the size of the grid of poses: metres, σ of the yaw, and upper limit of this, radians."""

EVALUATED = 60
"""Readings that are evaluated at each pose."""


class Trust(NamedTuple):
    """The weights of readings and odometry.

    Attributes
    ----------
    counts : float
        Factor of the log-likelihood of a reading, below 1 because readings from one place are correlated.
    yaw : float
        σ of the yaw of odometry, radians a √metre.
    """

    counts: float
    yaw: float


TRUSTS = (Trust(0.3, math.radians(4.0)), Trust(0.5, math.radians(5.5)))
"""The weights that are tried, in this order; each fails in other places."""


def scan_matched(scans: Scans, trust: Trust, watch: Progress) -> Floats:
    """Return the nodes of a drive by scan matching, shape (K, 3); the first one is that of odometry.

    Parameters
    ----------
    scans : Scans
    trust : Trust
    watch : callable
        Receives the fraction of the work that is done, from 0 to 1.
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
    """Return the error of odometry from the last node to a block, in the frame of that node, shape (3,)."""
    w, last = scans.windows, len(nodes) - 1
    behind = np.flatnonzero(w.node_progress[last + 1] - w.node_progress[: last + 1] < BEHIND)
    around = scans.map(behind, nodes[last], nodes, ON_MAP)
    if around is None or scans.count[block].sum() < FEWEST:
        return np.zeros(3)
    length, turn = w.travel[block[-1]] - w.travel[last], w.turn[block[-1]] - w.turn[last]
    away = ALONG[0] + ALONG[1] * length
    sigma = np.array([away, away, math.sqrt(trust.yaw**2 * length + (YAW_OF_TURN * turn) ** 2 + LEAST_YAW**2)])
    reach = np.array([REACH, REACH, min(SIGMAS * sigma[2], LARGEST_TURN)])
    poses = grid_around(np.zeros(3), reach, STEPS)
    joint = scans.joint(block, motion)
    fits = trust.counts * scores(joint, around, poses, max(len(joint.readings) // EVALUATED, 1))
    value = fits - np.minimum(0.5 * (poses / sigma) ** 2, MOST_OFF).sum(1)
    weight = np.exp(value - value.max())
    out: Floats = weight @ poses / weight.sum()
    return out
