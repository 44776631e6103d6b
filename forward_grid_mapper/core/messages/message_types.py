"""The two messages that mapping needs, free of ROS, and their making from any ROS message.

`sensor_msgs/Range` and `nav_msgs/Odometry` have the same attributes in rclpy and in rosbags (ROS 1 and ROS 2), so one
duck-typed conversion serves the node and the offline tool alike.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

NANOSECONDS = 1_000_000_000


class Pose2(NamedTuple):
    """Planar pose: `x`, `y` in metres, `yaw` in radians, counter-clockwise."""

    x: float
    y: float
    yaw: float

    def compose(self, other: Pose2) -> Pose2:
        """Return `other`, given in the frame of this pose, in the frame this pose is given in."""
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

    `pose` is None when the message's own pose is not finite or its quaternion is not normalised.
    """

    stamp: int
    frame_id: str
    child_frame_id: str
    pose: Pose2 | None


def stamp_of(header: Any) -> int:
    """Return a header's stamp in nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def yaw_of(quaternion: Any) -> float | None:
    """Return the heading of the x axis in radians; None if the quaternion is not finite or not normalised."""
    x, y, z, w = (float(quaternion.x), float(quaternion.y), float(quaternion.z), float(quaternion.w))
    norm = x * x + y * y + z * z + w * w
    if not abs(norm - 1.0) < 0.05:
        return None
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


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
    position = message.pose.pose.position
    x, y, yaw = float(position.x), float(position.y), yaw_of(message.pose.pose.orientation)
    finite = math.isfinite(x) and math.isfinite(y) and yaw is not None
    return OdometryMessage(
        stamp_of(message.header),
        str(message.header.frame_id),
        str(message.child_frame_id),
        Pose2(x, y, yaw) if finite and yaw is not None else None,
    )
