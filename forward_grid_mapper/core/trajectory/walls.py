"""The direction of walls beside the robot, from the echoes of a short piece of the drive.

An echo of range z, taken at p, touches the wall with normal n and distance d where n lies within the cone:

    n · p + z = d

So over a few metres of driving the echoes of one wall agree in d for the right direction of n alone. For each direction
the echoes vote for d; N votes in one bin agree by N (N − 1) pairs.

A post, a corner or the end of a wall is heard by one sensor after the other, and so long as it lies in one cone its
echoes agree in d as well, for directions near the axis of that cone. But all of them touch the same point, so along the
wall that they seem to touch, t · p for t at right angles to n, they are spread by the width of the cone at most. With
φ half of its opening, the variance of a point that lies anywhere in it is (φ z)² / 3. Together with the width of the
things that stand about, v = (φ z)² / 3 + `THING`, and pairs count

    N' (N' − 1) · max(0, 1 − 2 mean(v) / var(t · p))          N' = N − λ − 2 √λ

where λ echoes are in each bin if ranges are random: sensors do not vote for their own axes, whatever they hear.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel
from .poses import Floats, compose, relative
from .windows import Windows

DIRECTIONS = 90
"""Directions in a right angle, a degree each: walls at right angles vote together."""

SPAN = 3.0
"""Metres of travel whose echoes vote together."""

EVERY = 1.2
"""Metres between two votes."""

BIN = 0.06
"""Metres that the distances of echoes of one wall may differ by."""

BINS = 400

FARTHEST = 3.5
"""Metres; echoes from farther hear too much at once."""

FEWEST = 9
"""Echoes that it takes to vote."""

CHANCE = 2.0
"""Standard deviations of the echoes that a bin has by chance, beyond their mean, that do not count."""

POINT = 2.0
"""Times the variance of a thing from where on echoes may be of a wall."""

THING = 0.5**2 / 12
"""Square metres: the variance of places on a thing of half a metre, which has sides but is no wall."""

USUAL = 0.05
"""Part of the usual mean of a place's votes that is added for all directions: where hardly any echoes agree, those that
do say little."""


@kernel
def count_votes(echoes: Any, counts: Any, votes: Any) -> None:
    """Add up the votes of echoes.

    Parameters
    ----------
    echoes : float64, shape (N, 5)
        x, y, bearing, half angle and range of each echo, metres and radians.
    counts : float64, shape (BINS, 4)
        Workspace: of each bin the echoes, Σ and Σ of squares of where they lie along the wall, Σ of v.
    votes : float64, shape (DIRECTIONS,)
        For directions of walls 0°, 1°, … modulo 90°.
    """
    votes[:] = 0.0
    for degree in range(360):
        angle = math.radians(degree)
        c, s = math.cos(angle), math.sin(angle)
        counts[:] = 0.0
        heard = 0
        for t in range(len(echoes)):
            off = (echoes[t, 2] - angle + math.pi) % (2.0 * math.pi) - math.pi
            if abs(off) > echoes[t, 3]:
                continue
            at = (echoes[t, 4] + c * echoes[t, 0] + s * echoes[t, 1]) / BIN + BINS // 2
            below = int(math.floor(at))
            if 0 <= below < BINS - 1:
                heard += 1
                part = at - below
                along = c * echoes[t, 1] - s * echoes[t, 0]
                thing = (echoes[t, 3] * echoes[t, 4]) ** 2 / 3.0 + THING
                for k, weight in ((below, 1.0 - part), (below + 1, part)):
                    counts[k, 0] += weight
                    counts[k, 1] += weight * along
                    counts[k, 2] += weight * along * along
                    counts[k, 3] += weight * thing
        total, even = 0.0, heard * BIN / FARTHEST
        chance = even + CHANCE * math.sqrt(even)
        for k in range(BINS):
            count = counts[k, 0]
            if count > 1.0 + chance:
                spread = counts[k, 2] - counts[k, 1] ** 2 / count
                if spread > POINT * counts[k, 3]:
                    total += (count - chance) * (count - chance - 1.0) * (1.0 - POINT * counts[k, 3] / spread)
        votes[degree % DIRECTIONS] += total


def wall_votes(windows: Windows, held_out: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Floats]:
    """Return at which nodes there are votes, and these in the frame of the node.

    Parameters
    ----------
    windows : Windows
    held_out : bool, shape (K,)
        Windows whose echoes do not vote.

    Returns
    -------
    at : int64, shape (B,)
        Nodes.
    votes : float64, shape (B, DIRECTIONS)
        Relative to their mean; 1 where nothing can be said, and nearer to 1 the less there is to vote.
    """
    w = windows
    steps = np.floor(w.node_progress / EVERY)
    at = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)
    votes, counts = np.zeros((len(at), DIRECTIONS)), np.empty((BINS, 4))
    r = w.readings
    usable = r.echo & (r.z < FARTHEST) & ~np.repeat(held_out, np.diff(w.first))
    for k, node in enumerate(at):
        near = np.abs(w.node_progress - w.node_progress[node]) <= SPAN / 2
        first, last = np.flatnonzero(near)[[0, -1]]
        which = np.arange(w.first[first], w.first[last + 1])
        which = which[usable[which]]
        if len(which) < FEWEST:
            continue
        poses = compose(relative(w.node[node], w.robot[which]), w.mount[which])
        count_votes(np.column_stack([poses, r.half_angle[which], r.z[which]]), counts, votes[k])
    mean = votes.mean(1, keepdims=True)
    if not mean.any():
        return at, np.ones_like(votes)
    added = USUAL * float(np.median(mean[mean > 0.0]))
    return at, (votes + added) / (mean + added)
