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

The sonars of many robots look past the walls of a corridor on both sides: three that look ahead do, or eight at equal
angles if none looks straight ahead. A rough wall is heard all the same, where the edge of the cone meets it first: with
s the angle from the edge to n, an echo then has

    n · p + z cos s = d
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

TENTHS = 3600
"""Tenths of a degree in a full turn; in whole numbers of them cones are compared, so that left mirrors right."""

BESIDE, COUNTS = math.radians(30.0), 0.5
"""Radians beside a cone up to which the normal of a wall may lie, and what such an echo counts, if no sensor looks
straight to a side. With one that does, votes are sharper without."""

WELL_INSIDE = 30
"""Tenths of a degree from the edge of its cone at least at which a sensor holds what lies straight to a side: yaws
waver."""

USUAL = 0.05
"""Part of the usual mean of a place's votes that is added for all directions: where hardly any echoes agree, those that
do say little."""


@kernel
def count_votes(echoes: Any, counts: Any, votes: Any) -> None:
    """Add up the votes of echoes.

    Parameters
    ----------
    echoes : float64, shape (N, 7)
        x, y, bearing, half angle and range of each echo, and how far beside its cone the normal may lie, to the right
        and to the left; metres and radians.
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
        heard = 0.0
        for t in range(len(echoes)):
            off = (echoes[t, 2] - angle + math.pi) % (2.0 * math.pi) - math.pi
            slant = max(abs(off) - echoes[t, 3], 0.0)
            if slant > echoes[t, 5 if off > 0.0 else 6]:
                continue
            at = (echoes[t, 4] * math.cos(slant) + c * echoes[t, 0] + s * echoes[t, 1]) / BIN + BINS // 2
            below = int(math.floor(at))
            if 0 <= below < BINS - 1:
                vote = 1.0 if slant == 0.0 else COUNTS
                heard += vote
                part = at - below
                along = c * echoes[t, 1] - s * echoes[t, 0]
                thing = (echoes[t, 3] * echoes[t, 4]) ** 2 / 3.0 + THING
                for k, weight in ((below, vote * (1.0 - part)), (below + 1, vote * part)):
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


def beside(bearing: Floats, half: Floats) -> Floats:
    """Return how far beside cones the normal of a wall may lie, to the right and to the left, shape (N, 2), radians.

    It is as far as no cone reaches, and at most `BESIDE`; nothing if a sensor looks straight to a side of the robot.

    Parameters
    ----------
    bearing, half : float64, shape (N,)
        Direction of each sensor on the robot, and half angle of its cone, radians.
    """
    middle, wide = (np.round(np.degrees(angle) * 10.0).astype(np.int64) for angle in (bearing, half))
    cones, which = np.unique(wide * TENTHS + middle % TENTHS, return_inverse=True)
    wide, middle = np.divmod(cones, TENTHS)
    from_a_side = np.abs(np.abs((middle + TENTHS // 2) % TENTHS - TENTHS // 2) - TENTHS // 4)
    if (from_a_side <= wide - WELL_INSIDE).any():
        return np.zeros((len(bearing), 2))
    # of a sensor that turns on the robot there are as many cones as readings
    first, last = middle - wide, middle + wide
    changes = np.bincount(first % TENTHS, minlength=TENTHS) - np.bincount((last + 1) % TENTHS, minlength=TENTHS)
    held = np.cumsum(changes) + np.count_nonzero(first % TENTHS > (last + 1) % TENTHS) > 0
    far = np.arange(10, round(math.degrees(BESIDE) * 10.0) + 1, 10)
    out = np.empty((len(cones), 2))
    for k, edge in enumerate((first[:, None] - far, last[:, None] + far)):
        # degree by degree from the edge on
        out[:, k] = np.radians(np.logical_and.accumulate(~held[edge % TENTHS], axis=1).sum(1))
    return out[which]


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
    past = beside(w.mount[:, 2], r.half_angle)
    for k, node in enumerate(at):
        near = np.abs(w.node_progress - w.node_progress[node]) <= SPAN / 2
        first, last = np.flatnonzero(near)[[0, -1]]
        which = np.arange(w.first[first], w.first[last + 1])
        which = which[usable[which]]
        if len(which) < FEWEST:
            continue
        poses = compose(relative(w.node[node], w.robot[which]), w.mount[which])
        count_votes(np.column_stack([poses, r.half_angle[which], r.z[which], past[which]]), counts, votes[k])
    mean = votes.mean(1, keepdims=True)
    if not mean.any():
        return at, np.ones_like(votes)
    added = USUAL * float(np.median(mean[mean > 0.0]))
    return at, (votes + added) / (mean + added)
