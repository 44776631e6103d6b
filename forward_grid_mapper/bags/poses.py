"""Poses of the robot in messages other than Odometry: stamped poses, and moving transforms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.messages.message_types import OdometryMessage, odometry_message, planar_pose, stamp_of
from .decoder import TF_MESSAGE
from .layouts import Path

ODOMETRY = 'nav_msgs/msg/Odometry'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

BASE_FRAMES = ('base_link', 'base_footprint')
"""Frames of a robot's base (REP 105), in order of preference. A pose without a child frame is of the first."""


def _pose(message: Any) -> OdometryMessage:
    return _stamped(message, message.pose)


def _pose_with_covariance(message: Any) -> OdometryMessage:
    return _stamped(message, message.pose.pose)


def _stamped(message: Any, pose: Any) -> OdometryMessage:
    header = message.header
    where = planar_pose(pose.position, pose.orientation)
    return OdometryMessage(stamp_of(header), str(header.frame_id), BASE_FRAMES[0], where)


def _transform(message: Any) -> OdometryMessage | None:
    """Return the pose of the robot's base in its parent frame; None if the message has none."""
    number = _of_base(message)
    if number is None:
        return None
    item = message.transforms[number]
    where = planar_pose(item.transform.translation, item.transform.rotation)
    return OdometryMessage(stamp_of(item.header), str(item.header.frame_id), str(item.child_frame_id), where)


def _of_base(message: Any) -> int | None:
    """Return the index of the transform that moves the robot's base."""
    for frame in BASE_FRAMES:
        for number, item in enumerate(message.transforms):
            if str(item.child_frame_id).lstrip('/') == frame:
                return number
    return None


_POSITION = [('position', name) for name in 'xy'] + [('orientation', name) for name in 'xyzw']
_TRANSFORM = [('translation', name) for name in 'xy'] + [('rotation', name) for name in 'xyzw']


def paths_of_pose(message: Any) -> tuple[Path, tuple[Path, ...]]:
    """Return the paths of the header of a message of `POSES`, and of x, y and the quaternion of its pose.

    If no transform is that of the robot's base, they are those of the first.

    Raises
    ------
    Exception
        Of many classes, if it is another message.
    """
    if hasattr(message, 'transforms'):
        item: Path = ('transforms', _of_base(message) or 0)
        return (*item, 'header'), tuple((*item, 'transform', *name) for name in _TRANSFORM)
    within: Path = ('pose', 'pose') if hasattr(message.pose, 'pose') else ('pose',)
    return ('header',), tuple((*within, *name) for name in _POSITION)


POSES: dict[str, Callable[[Any], OdometryMessage | None]] = {
    ODOMETRY: odometry_message,
    POSE: _pose,
    POSE_WITH_COVARIANCE: _pose_with_covariance,
    TF_MESSAGE: _transform,
}
"""Conversions of message types to poses of the robot, in order of preference."""
