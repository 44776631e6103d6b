"""The tail: the last windows of a drive that is being followed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.readings import Floats, Readings
from .pose_graph import Edges
from .poses import axes_at, compose, interpolated
from .windows import TRAVEL, TURN, Odometry

ROUNDING = 1e-6
"""Largest rounding error of a window coordinate."""


class Tail(NamedTuple):
    """The last windows of a drive, in a frame whose axes are parallel to the walls.

    Attributes
    ----------
    odometry : Odometry
        From the start of the first window on.
    readings : Readings
        Of the complete windows, without those at standstill: there may be hours of them, and each step would sort them
        out again.
    nodes : float64, shape (K, 3)
        Of the complete windows.
    settled : int
        Number of the first nodes that are fixed.
    places : Edges
        Loop closures, as edges from the first node.
    u : float
        Window coordinate (module `windows`) at the end of odometry.
    """

    odometry: Odometry
    readings: Readings
    nodes: Floats
    settled: int
    places: Edges
    u: float

    @classmethod
    def of(cls, odometry: Odometry, readings: Readings, nodes: Floats, settled: int, places: Edges) -> Tail:
        """Return a tail; `u` is determined from odometry."""
        return cls(odometry, readings, nodes, settled, places, float(window_coordinate(odometry)[-1]))

    def moves_on(self, odometry: Odometry) -> bool:
        """Return whether the odometry after the tail may complete a window.

        Only the poses after the tail are looked at, since most calls complete none, and the tail may contain hours at
        standstill.
        """
        new = continued(Odometry(self.odometry.stamp[-1:], self.odometry.pose[-1:]), odometry)
        return self.u + float(window_coordinate(new)[-1]) > len(self.nodes) + 1 - ROUNDING


def window_coordinate(odometry: Odometry) -> Floats:
    """Return u of each pose (module `windows`), in which each window is a step of 1."""
    out: Floats = odometry.travel / TRAVEL + odometry.turn / TURN
    return out


def from_step(odometry: Odometry, begin: int) -> Odometry:
    """Return the odometry from u = `begin` on."""
    u = window_coordinate(odometry)
    first = int(np.searchsorted(u, begin, side='right'))
    part = (begin - u[first - 1]) / (u[first] - u[first - 1])
    stamp = odometry.stamp[first - 1] + round(part * (odometry.stamp[first] - odometry.stamp[first - 1]))
    pose = interpolated(np.array([begin]), u[first - 1 : first + 1], odometry.pose[first - 1 : first + 1])
    return Odometry(np.append(stamp, odometry.stamp[first:]), np.concatenate([pose, odometry.pose[first:]]))


def continued(tail: Odometry, odometry: Odometry) -> Odometry:
    """Return the odometry of the tail, continued with the poses of `odometry` after it."""
    first = int(np.searchsorted(odometry.stamp, tail.stamp[-1], side='right'))
    stamp = np.concatenate([tail.stamp, odometry.stamp[first:]])
    return Odometry.of(stamp, np.concatenate([tail.pose, odometry.pose[first:]]))


def edges_from(places: Edges, first: Floats, leaving: int, settled: int) -> Edges:
    """Return loop closures as edges from another first node; those of nodes that become settled are dropped.

    Parameters
    ----------
    places : Edges
        From the first node.
    first : float64, shape (3,)
        Pose of this node in the frame of the one that will be the first.
    leaving : int
        Number of nodes that leave the tail.
    settled : int
        Number of nodes that leave the tail or become settled.
    """
    stay, axes = places.second >= settled, axes_at(first[2])
    information = axes @ places.information[stay] @ axes.T
    return Edges(places.first[stay], places.second[stay] - leaving, compose(first, places.pose[stay]), information)
