"""Attempts at the trajectory of a drive by one method, and what the methods share."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats, Readings
from .holding_out import LEAST_SIGMAS, Gain
from .outcome import Differences, Refinement
from .poses import compose, inverse
from .scans import Scans
from .windows import Odometry, Windows, corrected

ACCURACY, EXACT = Differences(0.15, math.radians(2.0)), Differences(0.0, 0.0)
"""A trajectory is accepted only if it differs from odometry by more than the first: its own errors are about as large.
Over 4 m, a turn of 2° moves walls by as much."""


SMALLEST_GAIN = 0.0005
"""Smallest gain that is called better or worse if it is not significant, nats a reading; it has three decimals."""

UNMATCHED = '; it comes from walls alone, without loop closures: with these, readings are predicted worse'

CONTRADICTED = '; but the readings at corners contradict right angles, so the drive may be bent there'


class Drive(NamedTuple):
    """A drive, its windows and their scans."""

    readings: Readings
    odometry: Odometry
    windows: Windows
    scans: Scans

    def with_held_out(self, held_out: NDArray[np.bool_]) -> Drive:
        """Return the same drive with other windows held out, shape (K,)."""
        return self._replace(scans=self.scans.with_held_out(held_out))


class Attempt(NamedTuple):
    """The result by one method.

    Attributes
    ----------
    refinement : Refinement
    nodes : float64, shape (K, 3)
        Its nodes.
    sure : bool
        Whether it is so sure that no other method needs to be tried.
    by_votes : bool
        Whether it is accepted by the votes of walls alone: readings are not clearly predicted better.
    before_matching : bool
        Whether it was refused before anything was matched, because nothing showed that odometry is wrong.
    unproven : Attempt or None
        The trajectory that was refused after matching, because it did not show that odometry is wrong.
    start : float64, shape (K, 3), or None
        Nodes of a trajectory that was refused, from which other methods may start.
    matched : bool
        Whether matches and loop closures were used; otherwise readings were predicted worse with them.
    turns_contradicted : bool
        Whether readings contradict the turns at corners (`corners`).
    """

    refinement: Refinement
    nodes: Floats
    sure: bool = False
    by_votes: bool = False
    before_matching: bool = False
    unproven: Attempt | None = None
    start: Floats | None = None
    matched: bool = True
    turns_contradicted: bool = False


def refined(odometry: Odometry, windows: Windows, nodes: Floats) -> Odometry:
    """Return the trajectory: odometry corrected by nodes, moved so that its first pose is that of odometry."""
    w = windows
    pose = corrected(odometry.progress, odometry.pose, w.node_progress, w.node, nodes)
    home = compose(odometry.pose[0], inverse(pose[0]))
    pose = compose(home, pose)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Odometry(odometry.stamp, pose)


def gain_words(better: Gain) -> str:
    """Return the gain over odometry in words."""
    if not np.isfinite(better.error):
        return 'too few readings overlap with maps of other readings to compare the prediction with that of odometry'
    if abs(better.mean) < SMALLEST_GAIN and abs(better.sigmas) < LEAST_SIGMAS:
        return f'readings are predicted as well as with odometry, to ± {better.error:.3f} nats a reading'
    better_or_worse = 'better' if better.mean >= 0 else 'worse'
    return (
        f'readings are predicted {better_or_worse} than with odometry, by {abs(better.mean):.3f} ± {better.error:.3f} '
        f'nats a reading'
    )
