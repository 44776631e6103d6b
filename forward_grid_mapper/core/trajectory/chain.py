"""The nodes of a block, solved by themselves: odometry from one to the next, measured yaws, matches with one map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .matching import Match
from .pose_graph import ROBUST, ROBUST_ODOMETRY, ROBUST_YAW, Yaws
from .poses import Floats, compose, relative, wrapped

ITERATIONS = 4
LEAST_STEP = 1e-4
"""Metres and radians below which a step ends the iterations."""


def axes_at(yaw: float) -> Floats:
    """Return the rotation by `yaw` of (x, y, θ), shape (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def in_frame_of(origin: Floats, match: Match) -> Match:
    """Return a match in a map at `origin` in the frame that `origin` is given in."""
    axes = axes_at(origin[2])
    return match._replace(pose=compose(origin, match.pose), information=axes @ match.information @ axes.T)


class Chain:
    """What is known about nodes from one to the next; the objective is that of `pose_graph`.

    Parameters
    ----------
    motion : float64, shape (K − 1, 3)
        Calibrated odometry.
    covariance : float64, shape (K − 1, 3, 3)
    yaws : Yaws
    """

    def __init__(self, motion: Floats, covariance: Floats, yaws: Yaws) -> None:
        self.motion, self.covariance = motion, covariance
        self._information = np.linalg.inv(covariance)
        count = len(motion) + 1
        self._yaw, self._yaw_information = np.zeros(count), np.zeros(count)
        self._yaw[yaws.node], self._yaw_information[yaws.node] = yaws.yaw, yaws.information

    def solve(
        self, before: Floats, block: NDArray[np.int64], guess: Floats, matches: list[tuple[int, Match]]
    ) -> Floats:
        """Return the poses of a block's nodes that agree best with all, shape (n, 3).

        Parameters
        ----------
        before : float64, shape (3,)
            The node before the block, which stays.
        block : int64, shape (n,)
        guess : float64, shape (n, 3)
        matches : list of (int, Match)
            Place in the block, and a match in the frame of the poses.
        """
        x = guess.copy()
        for _ in range(ITERATIONS):
            h, b = np.zeros((len(block), 3, len(block), 3)), np.zeros((len(block), 3))
            for i, k in enumerate(block):
                self._add_motion(h, b, i, int(k), before if i == 0 else x[i - 1], x[i])
                self._add_yaw(h, b, i, int(k), x[i, 2])
            for i, match in matches:
                off = x[i] - match.pose
                off[2] = wrapped(off[2])
                w = match.information / (1.0 + off @ match.information @ off / ROBUST**2)
                h[i, :, i] += w
                b[i] -= w @ off
            size = 3 * len(block)
            step = np.linalg.solve(h.reshape(size, size) + 1e-9 * np.eye(size), b.ravel())
            x = x + step.reshape(-1, 3)
            if np.abs(step).max() < LEAST_STEP:
                break
        return x

    def _add_motion(self, h: Floats, b: Floats, i: int, k: int, last: Floats, here: Floats) -> None:
        """Add what odometry says of node k, at place i, given the node before it."""
        d = relative(last, here)
        off = d - self.motion[k - 1]
        off[2] = wrapped(off[2])
        w = self._information[k - 1]
        w = w / (1.0 + off @ w @ off / ROBUST_ODOMETRY**2)
        # ∂d / ∂ here, and ∂d / ∂ last
        of_here = axes_at(last[2]).T
        of_last = -of_here
        of_last[0, 2], of_last[1, 2] = d[1], -d[0]
        h[i, :, i] += of_here.T @ w @ of_here
        b[i] -= of_here.T @ w @ off
        if i:
            h[i - 1, :, i - 1] += of_last.T @ w @ of_last
            h[i - 1, :, i] += of_last.T @ w @ of_here
            h[i, :, i - 1] += of_here.T @ w @ of_last
            b[i - 1] -= of_last.T @ w @ off

    def _add_yaw(self, h: Floats, b: Floats, i: int, k: int, yaw: float) -> None:
        information = self._yaw_information[k]
        off = float(wrapped(yaw - self._yaw[k]))
        pull = information / (1.0 + off * off * information / ROBUST_YAW**2) ** 2
        h[i, 2, i, 2] += pull
        b[i, 2] -= pull * off
