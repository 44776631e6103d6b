"""Votes for the direction of walls beside the robot, from the echoes of a short piece of the drive.

An echo of range z, taken at p, touches the wall with normal n and distance d where n lies within the cone:

    n · p + z = d

Over a few metres of driving, the echoes of one wall agree in d only for the right direction of n. For each direction,
a histogram of d is made (a Hough transform); N echoes in one bin count as N (N − 1) agreeing pairs.

Echoes of a post, a corner or the end of a wall also agree in d, for directions near the axis of the cone, as long as
the object is in one cone. But they all come from the same point, so their spread along the supposed wall, t · p with t
at right angles to n, is at most the width of the cone. With half angle φ, a point anywhere in the cone has the variance
(φ z)² / 3. With the size of objects, v = (φ z)² / 3 + `THING`, and pairs count

    N' (N' − 1) · max(0, 1 − 2 mean(v) / var(t · p))          N' = N − λ − 2 √λ

where λ is the number of echoes in each bin for random ranges. Otherwise sensors would vote for their own axes.

The sonars of many robots all look past the walls of a corridor: three that look ahead, or eight at equal angles of
which none looks to a side. The edge of such a cone meets a rough wall at a slant, and the echo is still received: with
s the angle from the edge to n,

    n · p + z cos s = d
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..runtime.jit import kernel
from .poses import compose, relative
from .windows import Windows

DIRECTIONS = 90
"""Directions, one for each degree of a right angle: walls at right angles to each other vote for the same one."""

SPAN = 3.0
"""Metres of progress whose echoes vote together."""

EVERY = 1.2
"""Metres of progress between two places with votes."""

BIN = 0.06
"""Size of the bins of d, metres."""

BINS = 400

LONGEST_VOTE = 3.5
"""Longest range of an echo that votes, metres: farther away, too many objects are in the cone."""

FEWEST = 9
"""Fewest echoes of a place with votes."""

CHANCE = 2.0
"""Standard deviations of the number of echoes of a bin by chance that are subtracted, beside its mean."""

POINT = 2.0
"""Echoes count if their variance along the wall is more than this many times that of an object."""

THING = 0.5**2 / 12
"""Variance of points on an object of half a metre, m²: it has sides but is no wall."""

TENTHS = 3600
"""Tenths of a degree in a full turn; cones are compared in integers of this unit, so that left and right are treated
the same."""

BESIDE, COUNTS = math.radians(30.0), 0.5
"""If no sensor looks straight to a side, the normal of a wall may lie up to this many radians beside a cone, and such
an echo has this weight. With a sensor to a side, votes are sharper without such echoes."""

WELL_INSIDE = 30
"""A sensor looks straight to a side if this direction is at least this many tenths of a degree inside of its cone,
since yaws vary."""

USUAL = 0.05
"""Fraction of the median number of votes that is added to all directions of a place: without it, places where hardly
any echoes agree would weigh as much as others."""


@kernel
def count_votes(echoes: Any, counts: Any, votes: Any) -> None:
    """Add up the votes of echoes.

    Parameters
    ----------
    echoes : float64, shape (N, 7)
        x, y, bearing, half angle and range of each echo, and how far beside its cone the normal may lie, to the right
        and to the left; metres and radians.
    counts : float64, shape (BINS, 4)
        Workspace: for each bin the number of echoes, the sum of t · p and of its squares, and the sum of v.
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
        total, even = 0.0, heard * BIN / LONGEST_VOTE
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

    It is the angle that no other cone covers, at most `BESIDE`; 0 if a sensor looks straight to a side of the robot.

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
    # a sensor that turns on the robot has as many cones as readings, so this is vectorised
    first, last = middle - wide, middle + wide
    changes = np.bincount(first % TENTHS, minlength=TENTHS) - np.bincount((last + 1) % TENTHS, minlength=TENTHS)
    held = np.cumsum(changes) + np.count_nonzero(first % TENTHS > (last + 1) % TENTHS) > 0
    far = np.arange(10, round(math.degrees(BESIDE) * 10.0) + 1, 10)
    out = np.empty((len(cones), 2))
    for k, edge in enumerate((first[:, None] - far, last[:, None] + far)):
        # degrees from the edge on, until the first one that another cone covers
        out[:, k] = np.radians(np.logical_and.accumulate(~held[edge % TENTHS], axis=1).sum(1))
    return out[which]


def wall_votes(windows: Windows, held_out: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Floats]:
    """Return the nodes at which there are votes, and the votes in the frame of the node.

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
        Relative to their mean: 1 without information, and closer to 1 the fewer echoes agree.
    """
    w = windows
    steps = np.floor(w.node_progress / EVERY)
    at = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)
    votes, counts = np.zeros((len(at), DIRECTIONS)), np.empty((BINS, 4))
    r = w.readings
    usable = r.echo & (r.z < LONGEST_VOTE) & ~np.repeat(held_out, np.diff(w.first))
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


def votes_for(votes: Floats, degrees: Floats) -> Floats:
    """Return the votes of each place for directions of walls, interpolated linearly.

    Parameters
    ----------
    votes : float64, shape (B, DIRECTIONS)
        From `wall_votes`; B may be 0.
    degrees : float64, shape (B, …)
        Directions in the frame of the node, modulo 90°.
    """
    whole, ends = np.arange(DIRECTIONS + 1), np.column_stack([votes, votes[:, :1]])
    out = np.empty(degrees.shape)
    for k, (place, row) in enumerate(zip(degrees % DIRECTIONS, ends, strict=True)):
        out[k] = np.interp(place, whole, row)
    return out
