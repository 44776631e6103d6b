"""Poses of sensors on the robot from users: three numbers, which are checked for wrong units."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping
from numbers import Real

import numpy as np

from ..common.errors import ParameterError
from .message_types import Pose2

TURN = 2.0 * math.pi
"""Largest yaw of a sensor, radians (`more_than_a_turn`)."""

FARTHEST_MOUNT = 10.0
"""Largest distance of a sensor from the origin of the base frame, metres; 15 for 15 cm is more."""


def more_than_a_turn(yaw: float) -> bool:
    """Return whether a yaw of a sensor, radians, is more than a full turn; that of float32 is none more."""
    return abs(yaw) > TURN + 1e-6


def mount_from(name: str, values: object) -> Pose2:
    """Return the pose of a sensor in the robot's base frame (REP 103) from [x, y, yaw], metres and radians.

    Parameters
    ----------
    name : str
        Name of the sensor in error messages.
    values : object
        A list, a tuple or an array of three numbers; anything else is an error.

    Raises
    ------
    ParameterError
        If it is something else, or the numbers must be in other units.
    """
    numbers = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    good = [float(v) for v in numbers if isinstance(v, Real) and not isinstance(v, bool) and math.isfinite(v)]
    if len(good) != 3 or len(numbers) != 3:
        shown = values.tolist() if isinstance(values, (array, np.ndarray)) else values
        raise ParameterError(f'{name}: {shown!r} is not [x, y, yaw], three finite numbers (metres, radians)')
    pose = Pose2(*good)
    if more_than_a_turn(pose.yaw):
        raise ParameterError(
            f'{name}: a yaw of {pose.yaw:g} is in radians, which is more than a full turn; {pose.yaw:g} degrees are '
            f'{math.radians(pose.yaw):.4f}'
        )
    if math.hypot(pose.x, pose.y) > FARTHEST_MOUNT:
        raise ParameterError(
            f'{name}: the sensor would be {math.hypot(pose.x, pose.y):.3g} m away from the middle of the robot, more '
            f'than {FARTHEST_MOUNT:g} m; x and y are in metres'
        )
    return pose


def far_mounts(poses: Mapping[str, Pose2]) -> list[str]:
    """Return a warning about sensors that are farther away by TF than a parameter allows; `poses` are by frame.

    They are mapped nevertheless: the transforms of a crane may be right.
    """
    away = {frame: math.hypot(pose.x, pose.y) for frame, pose in poses.items()}
    far = sorted(frame for frame, distance in away.items() if distance > FARTHEST_MOUNT)
    if not far:
        return []
    return [
        f'transforms put {", ".join(far[:8])}{" and others" if len(far) > 8 else ""} up to {max(away.values()):.3g} m '
        'away from the middle of the robot: are they in millimetres? Transforms are in metres; correct the URDF or '
        f'the node that publishes them, or set sensors.{far[0]}.pose'
    ]
