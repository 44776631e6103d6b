"""Planar poses in arrays of shape (…, 3): x, y in metres, yaw in radians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def wrapped(angle: Any) -> Any:
    """Return angles in [−π, π)."""
    return np.remainder(np.asarray(angle) + np.pi, 2 * np.pi) - np.pi


def compose(frame: Floats, pose: Floats) -> Floats:
    """Return `pose`, given in `frame`, in the frame that `frame` is given in; shapes broadcast."""
    c, s = np.cos(frame[..., 2]), np.sin(frame[..., 2])
    x = frame[..., 0] + c * pose[..., 0] - s * pose[..., 1]
    y = frame[..., 1] + s * pose[..., 0] + c * pose[..., 1]
    return np.stack(np.broadcast_arrays(x, y, frame[..., 2] + pose[..., 2]), axis=-1)


def relative(frame: Floats, pose: Floats) -> Floats:
    """Return `pose` in `frame`, both given in a third one; the yaw is in [−π, π)."""
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
    """Return the pose of the frame that `pose` is given in, in the frame of `pose`."""
    return relative(pose, np.zeros(3))


def interpolated(at: NDArray[Any], knots: NDArray[Any], poses: Floats) -> Floats:
    """Return poses at increasing `knots`, linear between them; `poses` must have a continuous yaw."""
    return np.stack([np.interp(at, knots, column) for column in poses.T], axis=-1)


def rms_after_alignment(estimate: Floats, truth: Floats) -> float:
    """Return the rms distance of the points `estimate` from `truth`, both (N, ≥ 2), after the best rigid motion.

    It is the absolute trajectory error (ATE).
    """
    a, b = estimate[:, :2] - estimate[:, :2].mean(0), truth[:, :2] - truth[:, :2].mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(turn), np.sin(turn)
    turned = a @ np.array([[c, s], [-s, c]])
    return float(np.sqrt(((turned - b) ** 2).sum(1).mean()))
