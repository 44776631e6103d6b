"""The robot's pose in the map frame for other nodes: the transform from map to odometry, and the path.

As with other SLAM nodes, the stamp of the transform is a little later than that of odometry, so that lookups of the
current pose need not wait for the next one. While odometry is silent, the transform is repeated, so that late
subscribers get the map frame as well; a transform for a later time would be a guess.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Path
from rclpy.qos import QoSProfile

from ..core.common.readings import Floats
from ..core.messages.message_types import NANOSECONDS, Pose2, stamp_of
from ..core.messages.stamp_order import JUMP
from ..core.trajectory.windows import Odometry
from .map_publishers import LATCHED

PERIOD = 0.05
"""Seconds between two transforms."""

REPEAT = 1.0
"""Seconds after which the transform is repeated if nothing is new."""

REMEMBERED = 2000
"""Most stamps of transforms sent that are remembered: those of 100 s."""

TOLERANCE = NANOSECONDS // 5
"""Nanoseconds from odometry's stamp to the stamp of the transform."""

LATEST = (1 << 31) * NANOSECONDS - 1
"""The latest stamp that fits into a message."""

MOST_POINTS = 2000
"""Most poses of the path: with more, the middleware would block the executor for long."""

STEP = 0.1
"""Shortest distance between two of them, metres."""

TRANSFORMS = QoSProfile(depth=100)


def transform_sender(node: Any) -> Callable[[TransformStamped], object] | None:
    """Return a function that sends a transform on TF, by tf2_ros, or else by tf2_msgs; None without both."""
    try:
        from tf2_ros import TransformBroadcaster
    except ImportError:
        pass
    else:
        sender: Callable[[TransformStamped], object] = TransformBroadcaster(node).sendTransform
        return sender
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    out = node.create_publisher(TFMessage, '/tf', TRANSFORMS)
    return lambda transform: out.publish(TFMessage(transforms=[transform]))


class PosePublishers:
    """Publishes the pose of the robot in the map frame.

    Without tf2_ros and tf2_msgs the pose is published on `~/pose` instead of TF; its covariance is 0: unknown.
    """

    def __init__(self, node: Any) -> None:
        self._send = transform_sender(node)
        self._pose = None if self._send else node.create_publisher(PoseWithCovarianceStamped, '~/pose', 10)
        self._path = node.create_publisher(Path, '~/path', LATCHED)
        self._sent: tuple[int, tuple[float, ...]] = (-1, ())
        self._stamps, self._latest = deque[int](maxlen=REMEMBERED), -1
        self._due = 0.0

    @property
    def by_tf(self) -> bool:
        """Whether the transform goes to TF."""
        return self._send is not None

    def send(self, frames: tuple[str, str], correction: Floats, newest: tuple[int, Pose2], repeat: bool = True) -> None:
        """Send the transform, or the pose, if odometry or the correction is new, or to repeat it.

        Without a name of the odometry frame there is no transform: every listener on TF would reject it with an error.

        Parameters
        ----------
        frames : (str, str)
            Names of the map frame and the odometry frame.
        correction : float64, shape (3,)
            The pose of the odometry frame in the map frame.
        newest : (int, Pose2)
            The last pose of odometry.
        repeat : bool
            Whether it is repeated after `REPEAT` seconds.
        """
        stamp, pose = newest
        x, y, yaw = correction.tolist()
        sent_stamp, sent = self._sent
        now = time.monotonic()
        # if a stamp is far before the last one sent, that one was wrong
        if sent_stamp - JUMP <= stamp <= sent_stamp:
            if sent == (x, y, yaw) and not (repeat and now >= self._due):
                return
            # TF warns of a second transform with the same stamp, and odometry may have ended
            stamp = sent_stamp + 1
        self._sent, self._due = (stamp, (x, y, yaw)), now + REPEAT
        map_frame, odom_frame = (frame.lstrip('/') for frame in frames)
        if self._send is not None and not odom_frame:
            return
        if self._send is not None:
            transform = TransformStamped(child_frame_id=odom_frame)
            transform.header.frame_id = map_frame
            _set_stamp(transform.header.stamp, stamp + TOLERANCE)
            self._stamps.append(sent_at := stamp_of(transform.header))
            # a stamp far ahead stays the newest on TF
            self._latest = max(self._latest, sent_at)
            transform.transform.translation.x, transform.transform.translation.y = x, y
            _set_yaw(transform.transform.rotation, yaw)
            self._send(transform)
        elif self._pose is not None:
            there = Pose2(x, y, yaw).compose(pose)
            message = PoseWithCovarianceStamped()
            message.header.frame_id = map_frame
            _set_stamp(message.header.stamp, stamp)
            message.pose.pose.position.x, message.pose.pose.position.y = there.x, there.y
            _set_yaw(message.pose.pose.orientation, there.yaw)
            self._pose.publish(message)

    def sent_at(self, stamp: int) -> bool:
        """Return whether a transform with this stamp, nanoseconds, was sent on TF, lately or as the latest."""
        return stamp == self._latest or stamp in self._stamps

    def forget(self) -> None:
        """Send the next transform with any stamp, since the clock jumped."""
        self._sent = (-1, ())

    def publish_path(self, frame: str, trajectory: Odometry | None, stamp: Any) -> None:
        """Publish a trajectory as the path, with durability for late subscribers; None for an empty path."""
        self._path.publish(path_message(frame, trajectory, stamp))


def path_message(frame: str, trajectory: Odometry | None, stamp: Any) -> Path:
    """Return the path of a trajectory, with at most `MOST_POINTS` poses."""
    path = Path()
    path.header.frame_id, path.header.stamp = frame.lstrip('/'), stamp
    if trajectory is None or not len(trajectory.stamp):
        return path
    travel = trajectory.travel
    count = 1 + min(MOST_POINTS - 2, int(travel[-1] / STEP))
    # the first pose of each step, and the last one
    chosen = np.unique([*np.searchsorted(travel, np.linspace(0.0, travel[-1], count)).tolist(), len(travel) - 1])
    poses = []
    for k in chosen.tolist():
        pose = PoseStamped()
        pose.header.frame_id = path.header.frame_id
        _set_stamp(pose.header.stamp, int(trajectory.stamp[k]))
        x, y, yaw = trajectory.pose[k].tolist()
        pose.pose.position.x, pose.pose.position.y = x, y
        _set_yaw(pose.pose.orientation, yaw)
        poses.append(pose)
    path.poses = poses
    return path


def _set_stamp(stamp: Any, nanoseconds: int) -> None:
    stamp.sec, stamp.nanosec = divmod(min(nanoseconds, LATEST), NANOSECONDS)


def _set_yaw(rotation: Any, yaw: float) -> None:
    rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
