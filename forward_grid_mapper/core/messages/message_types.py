"""The two messages that mapping needs, independent of ROS, and the conversion of ROS messages into them.

`sensor_msgs/Range` and `nav_msgs/Odometry` have the same attributes in rclpy and in rosbags (ROS 1 and ROS 2), so one
duck-typed conversion serves the node and the offline tool alike.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from .quaternions import yaw_of

NANOSECONDS = 1_000_000_000


class Pose2(NamedTuple):
    """Planar pose: `x`, `y` in metres, `yaw` in radians, counter-clockwise."""

    x: float
    y: float
    yaw: float

    def compose(self, other: Pose2) -> Pose2:
        """Return self ⊕ other: `other`, given in the frame of this pose, in the parent frame of this pose."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Pose2(
            self.x + c * other.x - s * other.y,
            self.y + s * other.x + c * other.y,
            self.yaw + other.yaw,
        )


class RangeMessage(NamedTuple):
    """One `sensor_msgs/Range` (REP 117): metres, radians, `stamp` in nanoseconds, `variance` in m², 0 = not stated."""

    stamp: int
    frame_id: str
    range: float
    min_range: float
    max_range: float
    field_of_view: float
    variance: float = 0.0


class OdometryMessage(NamedTuple):
    """One `nav_msgs/Odometry`: pose of `child_frame_id` in `frame_id`, `stamp` in nanoseconds.

    `pose` is None if `planar_pose` returns None.
    """

    stamp: int
    frame_id: str
    child_frame_id: str
    pose: Pose2 | None


def stamp_of(header: Any) -> int:
    """Return a header's stamp in nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def planar_pose(position: Any, orientation: Any) -> Pose2 | None:
    """Return a pose projected on the plane; its type may be that of any library.

    Parameters
    ----------
    position
        With attributes `x` and `y`, metres.
    orientation
        A quaternion with attributes `x`, `y`, `z` and `w`.

    Returns
    -------
    Pose2 or None
        `yaw` is the heading of the x axis. None if a number is not finite, the quaternion is not normalised, the x axis
        leaves the plane too steeply, or the z axis points down (`quaternions`).
    """
    q = orientation
    return planar_pose_of(float(position.x), float(position.y), float(q.x), float(q.y), float(q.z), float(q.w))


def planar_pose_of(x: float, y: float, qx: float, qy: float, qz: float, qw: float) -> Pose2 | None:
    """Return `planar_pose` from the position, metres, and the components of the quaternion."""
    yaw = yaw_of(qx, qy, qz, qw)
    return Pose2(x, y, yaw) if yaw is not None and math.isfinite(x) and math.isfinite(y) else None


def range_message(message: Any) -> RangeMessage:
    """Return the `RangeMessage` of a `sensor_msgs/Range` of any library."""
    return RangeMessage(
        stamp_of(message.header),
        str(message.header.frame_id),
        float(message.range),
        float(message.min_range),
        float(message.max_range),
        float(message.field_of_view),
        float(getattr(message, 'variance', 0.0)),
    )


def odometry_message(message: Any) -> OdometryMessage:
    """Return the `OdometryMessage` of a `nav_msgs/Odometry` of any library."""
    pose = message.pose.pose
    return OdometryMessage(
        stamp_of(message.header),
        str(message.header.frame_id),
        str(message.child_frame_id),
        planar_pose(pose.position, pose.orientation),
    )
