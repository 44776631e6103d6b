"""Poses of sensors on the robot as people write them: three numbers that may be in other units than is thought."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from numbers import Real

from ..common.errors import ParameterError
from .message_types import Pose2

TURN = 2.0 * math.pi
"""Radians; no sensor is turned by more. A float32 of it passes, too."""

FARTHEST = 10.0
"""Metres from the middle of the robot's base to a sensor, at the most; 15 cm that are written as 15 are more."""


def mount_from(name: str, values: object) -> Pose2:
    """Return the pose of a sensor in the robot's base frame (REP 103) from [x, y, yaw], metres and radians.

    Parameters
    ----------
    name : str
        What it is called in errors.
    values : object
        What should be a list, a tuple or an array of three numbers.

    Raises
    ------
    ParameterError
        If it is not that, or the numbers can only be of other units.
    """
    numbers = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    good = [float(v) for v in numbers if isinstance(v, Real) and not isinstance(v, bool) and math.isfinite(v)]
    if len(good) != 3 or len(numbers) != 3:
        raise ParameterError(f'{name}: {values!r} is not [x, y, yaw], three finite numbers (metres, radians)')
    pose = Pose2(*good)
    if abs(pose.yaw) > TURN + 1e-6:
        raise ParameterError(
            f'{name}: a yaw of {pose.yaw:g} is in radians, which is more than a full turn; {pose.yaw:g} degrees are '
            f'{math.radians(pose.yaw):.4f}'
        )
    if math.hypot(pose.x, pose.y) > FARTHEST:
        raise ParameterError(
            f'{name}: the sensor would be {math.hypot(pose.x, pose.y):.3g} m away from the middle of the robot, more '
            f'than {FARTHEST:g} m; x and y are in metres'
        )
    return pose


def far_mounts(poses: Mapping[str, Pose2]) -> list[str]:
    """Return a warning of sensors that transforms put so far away as a parameter may not; `poses` are by frame.

    They are mapped all the same: a crane's transforms may be right.
    """
    away = {frame: math.hypot(pose.x, pose.y) for frame, pose in poses.items()}
    far = sorted(frame for frame, distance in away.items() if distance > FARTHEST)
    if not far:
        return []
    return [
        f'transforms put {", ".join(far[:8])}{" and others" if len(far) > 8 else ""} up to {max(away.values()):.3g} m '
        'away from the middle of the robot: are they in millimetres? Transforms are in metres; correct the URDF or '
        f'the node that publishes them, or set sensors.{far[0]}.pose'
    ]
