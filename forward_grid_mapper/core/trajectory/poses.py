"""Planar poses in arrays of shape (…, 3): x, y in metres, yaw in radians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats


def wrapped(angle: Any) -> Any:
    """Return angles in [−π, π)."""
    return np.remainder(np.asarray(angle) + np.pi, 2 * np.pi) - np.pi


def compose(frame: Floats, pose: Floats) -> Floats:
    """Return frame ⊕ pose: `pose`, which is given in `frame`, in the parent frame of `frame`; shapes broadcast."""
    c, s = np.cos(frame[..., 2]), np.sin(frame[..., 2])
    x = frame[..., 0] + c * pose[..., 0] - s * pose[..., 1]
    y = frame[..., 1] + s * pose[..., 0] + c * pose[..., 1]
    return np.stack(np.broadcast_arrays(x, y, frame[..., 2] + pose[..., 2]), axis=-1)


def relative(frame: Floats, pose: Floats) -> Floats:
    """Return `pose` in the frame `frame`; both are given in the same parent frame. The yaw is in [−π, π)."""
    c, s = np.cos(frame[..., 2]), np.sin(frame[..., 2])
    dx, dy = pose[..., 0] - frame[..., 0], pose[..., 1] - frame[..., 1]
    return np.stack(
        np.broadcast_arrays(c * dx + s * dy, -s * dx + c * dy, wrapped(pose[..., 2] - frame[..., 2])), axis=-1
    )


def axes_at(yaw: float) -> Floats:
    """Return the rotation by `yaw` of (x, y, θ), shape (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def inverse(pose: Floats) -> Floats:
    """Return the inverse: the pose of the parent frame in the frame `pose`."""
    return relative(pose, np.zeros(3))


def interpolated(at: NDArray[Any], knots: NDArray[Any], poses: Floats) -> Floats:
    """Return poses interpolated linearly between those at `knots`, which increase; their yaw must be unwrapped."""
    return np.stack([np.interp(at, knots, column) for column in poses.T], axis=-1)


def rms_after_alignment(estimate: Floats, truth: Floats) -> float:
    """Return the absolute trajectory error (ATE): the rms distance of `estimate` from `truth` after rigid alignment.

    Both have the shape (N, ≥ 2).
    """
    a, b = estimate[:, :2] - estimate[:, :2].mean(0), truth[:, :2] - truth[:, :2].mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(turn), np.sin(turn)
    turned = a @ np.array([[c, s], [-s, c]])
    return float(np.sqrt(((turned - b) ** 2).sum(1).mean()))
