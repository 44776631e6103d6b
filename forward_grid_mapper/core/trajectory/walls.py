"""The direction of walls beside the robot, from the echoes of a short piece of the drive.

An echo of range z, taken at p, touches the wall with normal n and distance d where n lies within the cone:

    n · p + z = d

So over a few metres of driving the echoes of one wall agree in d for the right direction of n alone. For each direction
the echoes vote for d; n votes in one bin that agree by pairs count n (n − 1).
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


@kernel
def count_votes(echoes: Any, counts: Any, votes: Any) -> None:
    """Add up the votes of echoes.

    Parameters
    ----------
    echoes : float64, shape (N, 5)
        x, y, bearing, half angle and range of each echo, metres and radians.
    counts : float64, shape (BINS,)
        Workspace.
    votes : float64, shape (DIRECTIONS,)
        For directions of walls 0°, 1°, … modulo 90°.
    """
    votes[:] = 0.0
    for degree in range(360):
        angle = math.radians(degree)
        c, s = math.cos(angle), math.sin(angle)
        counts[:] = 0.0
        for t in range(len(echoes)):
            off = (echoes[t, 2] - angle + math.pi) % (2.0 * math.pi) - math.pi
            if abs(off) > echoes[t, 3]:
                continue
            at = (echoes[t, 4] + c * echoes[t, 0] + s * echoes[t, 1]) / BIN + BINS // 2
            below = int(math.floor(at))
            if 0 <= below < BINS - 1:
                part = at - below
                counts[below] += 1.0 - part
                counts[below + 1] += part
        total = 0.0
        for k in range(BINS):
            total += counts[k] * max(counts[k] - 1.0, 0.0)
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
        Relative to their mean; 1 where nothing can be said.
    """
    w = windows
    steps = np.floor(w.node_progress / EVERY)
    at = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)
    votes, counts, row = np.ones((len(at), DIRECTIONS)), np.empty(BINS), np.empty(DIRECTIONS)
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
        count_votes(np.column_stack([poses, r.half_angle[which], r.z[which]]), counts, row)
        if row.mean() > 0.0:
            votes[k] = row / row.mean()
    return at, votes
