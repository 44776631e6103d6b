"""The model of odometry: its calibration (systematic errors) and its noise.

A small motion has the components `ahead` and `aside` in the frame of the robot, and `turn`. The calibration c corrects
what odometry measured:

    ahead + i·aside  =  (1 + scale) e^{i·heading} (ahead + i·aside)_measured
    turn             =  (1 + turn_scale) turn_measured + bias · ahead_measured
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..common.readings import Floats
from .poses import relative, wrapped
from .windows import Odometry, Windows

CALIBRATION = ('scale', 'heading', 'bias', 'turn_scale')
"""The calibration: fraction, radians, radians a metre, fraction."""

CALIBRATION_SIGMA = np.array([0.03, math.radians(1.5), math.radians(1.5), 0.03])
"""σ of the prior of the calibration."""

PIECE, FEWEST_PIECES, LEAST_ERROR = 2.0, 8, math.radians(0.3)
"""Metres of progress of a piece whose yaw error is independent of that of others, fewest pieces, and smallest mean
absolute error, radians: that of the trajectory."""


@dataclass(frozen=True)
class Noise:
    """σ of the random errors of odometry, which grow with the square root of the distance.

    Attributes
    ----------
    yaw : float
        Radians a √metre.
    yaw_of_turn : float
        Radians a √radian.
    along, across : float
        In the direction of driving, and at right angles to it: metres a √metre.
    least : tuple of float
        Smallest σ of a window: metres and radians.
    """

    yaw: float = math.radians(3.0)
    yaw_of_turn: float = math.radians(2.0)
    along: float = 0.02
    across: float = 0.01
    least: tuple[float, float] = (0.01, math.radians(0.3))


def calibrated(odometry: Odometry, calibration: Floats) -> Odometry:
    """Return the odometry with a calibration applied; its first pose stays."""
    scale, heading, bias, turn_scale = calibration
    pose = odometry.pose
    turns = np.diff(pose[:, 2])
    # each motion is taken for an arc; its chord has the yaw of the middle
    middle = pose[:-1, 2] + turns / 2
    steps = np.diff(pose[:, :2], axis=0)
    c, s = np.cos(middle), np.sin(middle)
    ahead, aside = c * steps[:, 0] + s * steps[:, 1], -s * steps[:, 0] + c * steps[:, 1]
    turns = (1 + turn_scale) * turns + bias * ahead
    yaw = pose[0, 2] + np.concatenate([[0.0], np.cumsum(turns)])
    direction = yaw[:-1] + turns / 2 + heading
    c, s = (1 + scale) * np.cos(direction), (1 + scale) * np.sin(direction)
    moved = np.stack([c * ahead - s * aside, s * ahead + c * aside], axis=1)
    return Odometry(
        odometry.stamp,
        np.column_stack([np.concatenate([pose[:1, :2], pose[0, :2] + np.cumsum(moved, axis=0)]), yaw]),
    )


def with_yaw(odometry: Odometry, progress: Floats, correction: Floats) -> Odometry:
    """Return the odometry with corrected yaw; its motions are rotated by the same correction.

    Parameters
    ----------
    odometry : Odometry
    progress, correction : float64, shape (B,)
        Corrections of the yaw, radians, at these places, metres of progress; interpolated linearly between them.
    """
    pose = odometry.pose
    more = np.interp(odometry.progress, progress, correction)
    steps, turned = np.diff(pose[:, :2], axis=0), (more[1:] + more[:-1]) / 2
    c, s = np.cos(turned), np.sin(turned)
    moved = np.stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]], axis=1)
    ahead = np.concatenate([pose[:1, :2], pose[0, :2] + np.cumsum(moved, axis=0)])
    return Odometry(odometry.stamp, np.column_stack([ahead, pose[:, 2] + more]))


def motions(odometry: Odometry, windows: Windows) -> Floats:
    """Return the motion from each node to the next one, shape (K − 1, 3), in the frame of the first of the two."""
    node = odometry.at(windows.node_stamp)
    return relative(node[:-1], node[1:])


def sensitivity(odometry: Odometry, windows: Windows) -> Floats:
    """Return the derivatives of `motions` with respect to the calibration, shape (K − 1, 3, 4)."""
    before = motions(odometry, windows)
    out = np.empty((*before.shape, len(CALIBRATION)))
    for k in range(len(CALIBRATION)):
        small = np.zeros(len(CALIBRATION))
        small[k] = 1e-4
        change = motions(calibrated(odometry, small), windows) - before
        change[:, 2] = wrapped(change[:, 2])
        out[:, :, k] = change / 1e-4
    return out


def covariances(windows: Windows, noise: Noise) -> Floats:
    """Return the covariance of the motion from each node to the next one, shape (K − 1, 3, 3)."""
    length, turn = np.diff(windows.travel), np.diff(windows.turn)
    yaw = noise.yaw**2 * length + noise.yaw_of_turn**2 * turn + noise.least[1] ** 2
    out = np.zeros((len(length), 3, 3))
    out[:, 0, 0] = noise.along**2 * length + noise.least[0] ** 2
    # the yaw error is a random walk, and the error across is its integral
    out[:, 1, 1] = noise.across**2 * length + noise.least[0] ** 2 + yaw * length**2 / 3
    out[:, 1, 2] = out[:, 2, 1] = yaw * length / 2
    out[:, 2, 2] = yaw
    return out


def log_likelihood_of_yaw(windows: Windows, nodes: Floats) -> float:
    """Return the log-likelihood of the yaw of odometry if a trajectory is right, nats, without a constant.

    The errors of the yaw of pieces of the drive, without those that are constant for a metre of progress and for a
    turn, have a Laplace distribution, since wheels slip now and then. Its mean absolute error b is the likeliest one:

        log p  =  −n log b

    Parameters
    ----------
    windows : Windows
        Their nodes are the poses of odometry.
    nodes : float64, shape (K, 3)
        Of the trajectory.
    """
    ends = np.arange(windows.node_progress[0], windows.node_progress[-1], PIECE)
    measured, error = np.unwrap(windows.node[:, 2]), np.unwrap(wrapped(nodes[:, 2] - windows.node[:, 2]))
    turned, error = (np.diff(np.interp(ends, windows.node_progress, angle)) for angle in (measured, error))
    if len(error) < FEWEST_PIECES:
        return 0.0
    constant = np.stack([np.ones(len(error)), turned], axis=1)
    residual = error - constant @ np.linalg.lstsq(constant, error, rcond=None)[0]
    return -len(error) * math.log(max(float(np.abs(residual).mean()), LEAST_ERROR))
