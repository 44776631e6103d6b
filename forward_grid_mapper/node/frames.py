"""Poses of sensors and the map frame: from parameters first, then from TF if tf2_ros is installed."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

from ..core.messages.extrinsics import LATE, LATER, Later, mount_of
from ..core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, planar_pose, stamp_of
from ..core.messages.quaternions import rotation_of
from ..core.messages.stamp_order import GOES_ON, JUMPED_BACK, StampOrder

TF, TF_STATIC = '/tf', '/tf_static'

LOOK_UP_AGAIN_AFTER = 0.2
"""Seconds before a frame that TF did not know is looked up again, so that a missing frame costs little."""


QUEUE = 2000
"""Most messages of TF that may wait for the node in the middleware, as for readings; tf2's own listener has 100, and
interpolates over those that were dropped."""

CACHE_SECONDS = 30
"""Seconds of transforms that are kept, by stamps; with tf2's 10 s, those of a bag that is played ten times as fast are
gone after a pause of a second."""

MOST_UNTRANSFORMED = 10_000
"""Most odometry messages that wait for a transform."""

LOOKUPS = 100
"""Most lookups of transforms for each odometry message, so that late transforms do not block the executor."""

TILTED = Later('bad_pose')
"""Result for a transform to the map frame that is not a pose on a floor."""

FIXED_TOLERANCE = 1e-3
"""Largest change, metres or radians, of the pose of a sensor that is fixed to the robot."""

MOST_MISSING = 1000
"""Most frames that are remembered as missing, or with a pose, so that invented names do not fill the memory."""


NO_TRANSFORM_FOR = 3.0
"""Seconds without a transform to the map frame before a warning."""


class Transforms:
    """Looks up transforms in a tf2 buffer, without waiting; finds none without tf2_ros.

    Attributes
    ----------
    topics : list of str
        Topics of the transforms, as the node resolves their names.
    """

    def __init__(self, buffer: Any = None, error: type[Exception] = Exception, topics: tuple[str, ...] = ()) -> None:
        """`buffer` is a `tf2_ros.Buffer`, `error` the base of its exceptions."""
        self._buffer, self._error = buffer, error
        self.topics = topics
        self._missing: dict[tuple[str, str], float] = {}
        self._order = StampOrder()

    @classmethod
    def of(cls, node: Any) -> Transforms:
        """Subscribe to TF for a node, if tf2_ros is installed."""
        try:
            import tf2_ros
        except ImportError:
            return cls()
        from rclpy.duration import Duration
        from rclpy.qos import QoSProfile

        buffer = tf2_ros.Buffer(Duration(seconds=CACHE_SECONDS))
        # so that the listener lives as long as the buffer
        buffer.listener = tf2_ros.TransformListener(buffer, node, spin_thread=False, qos=QoSProfile(depth=QUEUE))
        _listen_to_volatile(buffer, node)
        return cls(buffer, tf2_ros.TransformException, tuple(map(node.resolve_topic_name, (TF, TF_STATIC))))

    @property
    def available(self) -> bool:
        """Whether there is a TF buffer."""
        return self._buffer is not None

    def check_stamp(self, stamp: int) -> str:
        """Process the stamp of a message, nanoseconds; if the clock jumped back, forget all transforms before.

        TF refuses transforms that are much older than its newest ones, and interpolates others with those before the
        jump. Static transforms remain: tf2 never forgets them.

        Returns
        -------
        str
            Relation of the stamp to earlier ones (`stamp_order.order_of`).
        """
        order = self._order.take(stamp)
        if order == JUMPED_BACK and self._buffer is not None:
            self._buffer.clear()
        return order

    def lookup(self, target: str, source: str, stamp: int) -> Any | Later:
        """Return the `geometry_msgs/Transform` of `source` in `target` at `stamp`, nanoseconds, or a `Later`."""
        key = (target, source)
        # rclpy's Time raises for stamps before 1970, and TF has no transforms of that time
        if self._buffer is None or stamp < 0 or time.monotonic() < self._missing.get(key, 0.0):
            return LATER
        if len(self._missing) > MOST_MISSING:
            self._missing.clear()
        from rclpy.time import Time

        try:
            found = self._buffer.lookup_transform(target.lstrip('/'), source.lstrip('/'), Time(nanoseconds=stamp))
        except self._error as error:
            if 'xtrapolation' in type(error).__name__:
                return LATE
            self._missing[key] = time.monotonic() + LOOK_UP_AGAIN_AFTER
            return LATER
        return found.transform

    def latest(self, target: str, source: str) -> int | None:
        """Return the stamp of the newest transform of `source` in `target`, nanoseconds; None if there is none.

        It is 0 if a transform between them was ever static.
        """
        if self._buffer is None:
            return None
        from rclpy.time import Time

        try:
            found = self._buffer.lookup_transform(target, source, Time())
        except self._error:
            return None
        return stamp_of(found.header)


class TfExtrinsics:
    """Poses of the sensors on the robot: parameters take precedence over TF."""

    def __init__(self, given: Mapping[str, Pose2], transforms: Transforms) -> None:
        self._given = {frame.lstrip('/'): pose for frame, pose in given.items()}
        self._transforms = transforms
        self._used: dict[str, Pose2] = {}
        self._moved: set[str] = set()
        self.unusable: set[str] = set()

    @property
    def used(self) -> dict[str, Pose2 | None]:
        """Poses of the sensors that were looked up, by frame; None for those that moved on the robot."""
        return {frame: None if frame in self._moved else pose for frame, pose in self._used.items()}

    @property
    def fixed(self) -> dict[str, Pose2]:
        """Poses of the sensors that were looked up and did not move on the robot, by frame."""
        return {frame: pose for frame, pose in self.used.items() if pose is not None}

    @property
    def known(self) -> dict[str, Pose2]:
        """The poses in `fixed`, and those given as parameters."""
        return {**self._given, **{frame.lstrip('/'): pose for frame, pose in self.fixed.items()}}

    def forget(self) -> None:
        """Forget what was looked up, since a new drive begins, for which a wrong transform may have been corrected."""
        self._used.clear()
        self._moved.clear()
        self.unusable.clear()

    def __call__(self, base_frame: str, frame: str, stamp: int) -> Pose2 | Later | str | None:
        """Return the pose of a sensor at a stamp, as defined by `ExtrinsicsLookup`."""
        pose = self._look_up(base_frame, frame, stamp)
        if isinstance(pose, Pose2) and (frame in self._used or len(self._used) < MOST_MISSING):
            first = self._used.setdefault(frame, pose)
            # what looks back may have a yaw of -180 degrees at one time and of 180 at another
            turned = math.remainder(pose.yaw - first.yaw, math.tau)
            if max(abs(pose.x - first.x), abs(pose.y - first.y), abs(turned)) > FIXED_TOLERANCE:
                self._moved.add(frame)
        return pose

    def _look_up(self, base_frame: str, frame: str, stamp: int) -> Pose2 | Later | str | None:
        given = self._given.get(frame.lstrip('/'))
        if given is not None:
            return given
        if not self._transforms.available:
            return None
        transform = self._transforms.lookup(base_frame, frame, stamp)
        if isinstance(transform, Later):
            return transform
        t, q = transform.translation, transform.rotation
        rotation = rotation_of(float(q.x), float(q.y), float(q.z), float(q.w))
        if rotation is None or not (math.isfinite(t.x) and math.isfinite(t.y)):
            self.unusable.add(frame)
            return None
        return mount_of(float(t.x), float(t.y), [row[0] for row in rotation])


class MapFrame:
    """Transforms odometry to another map frame, with TF at its stamp; messages wait until TF has the transform.

    Attributes
    ----------
    timeout : float
        Longest wait, seconds by stamps; may be changed.
    dropped : int
        Messages for which TF had no transform in time, since the start or the last `forget`.
    """

    def __init__(self, map_frame: str, transforms: Transforms, timeout: float) -> None:
        self._map_frame, self._transforms = map_frame, transforms
        self.timeout = timeout
        self._untransformed: deque[OdometryMessage] = deque()
        self.dropped = 0
        self._lack: Later | None = None
        self._frame = ''
        self._lacking = self._newest = 0.0

    @property
    def found(self) -> bool:
        """Whether TF had the transform of the last lookup."""
        return self._lack is None

    @property
    def lack(self) -> str:
        """The fault that keeps the newest odometry out of the map frame, in words, or ''."""
        if self._lack is None:
            return ''
        way = f'from {self._map_frame} (map_frame) to {self._frame}'
        waiting = f'{len(self._untransformed)} odometry messages wait for it, {self.dropped} were dropped'
        if self._lack is TILTED:
            what = 'is tilted, upside down or not finite, or its quaternion is not normalised'
            return f"TF's transform {way} {what}: {waiting}"
        if self._lack is LATE:
            return f"TF's transform {way} arrives later than pose_timeout, or has stopped: {waiting}"
        return f'TF has no transform {way}: {waiting}; is a localisation node running?'

    def fault(self) -> str:
        """Return the fault that has kept arriving odometry out of the map frame for some seconds, or ''."""
        now = time.monotonic()
        return '' if now - self._lacking < NO_TRANSFORM_FOR or now - self._newest > NO_TRANSFORM_FOR else self.lack

    def convert(self, message: OdometryMessage) -> list[OdometryMessage]:
        """Add an odometry message; return those whose pose in the map frame is known now, in order, at most `LOOKUPS`.

        The others wait for the next call.
        """
        order = self._transforms.check_stamp(message.stamp)
        if not self._map_frame or message.frame_id.lstrip('/') == self._map_frame.lstrip('/'):
            return [message]
        # the associator sorts messages that only overtook others; a stamp far ahead would block all others
        waiting = self._untransformed
        while order != GOES_ON and waiting and (order == JUMPED_BACK or waiting[-1].stamp > message.stamp):
            self.dropped += 1
            waiting.pop()
        self._untransformed.append(message)
        self._newest, self._frame = time.monotonic(), message.frame_id
        if len(self._untransformed) > MOST_UNTRANSFORMED:
            # messages with equal stamps never time out
            self._untransformed.popleft()
            self.dropped += 1
        ready = []
        for _ in range(min(len(self._untransformed), LOOKUPS)):
            first = self._untransformed[0]
            transform = self._transforms.lookup(self._map_frame, first.frame_id, first.stamp)
            pose = None if isinstance(transform, Later) else planar_pose(transform.translation, transform.rotation)
            self._note(transform, pose is not None)
            if pose is not None and first.pose is not None:
                ready.append(first._replace(frame_id=self._map_frame, pose=pose.compose(first.pose)))
            elif first.pose is None:
                ready.append(first)
            elif not isinstance(transform, Later):
                self.dropped += 1
            elif message.stamp - first.stamp <= self.timeout * NANOSECONDS:
                break
            else:
                self.dropped += 1
            self._untransformed.popleft()
        return ready

    def forget(self) -> None:
        """Forget the messages that wait, and the number of those dropped."""
        self._untransformed.clear()
        self.dropped = 0

    def _note(self, transform: Any | Later, planar: bool) -> None:
        """Note whether there is a planar transform, and since when there is none."""
        if isinstance(transform, Later) or not planar:
            if self._lack is None:
                self._lacking = time.monotonic()
            self._lack = transform if isinstance(transform, Later) else TILTED
        else:
            self._lack = None


def _listen_to_volatile(buffer: Any, node: Any) -> None:
    """Subscribe to static transforms of volatile publishers as well.

    tf2's own listener requests transient local durability, and is incompatible with other publishers, such as a bag
    recorded without its quality of service. Messages of transient local publishers arrive twice, which is harmless.
    """
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from tf2_msgs.msg import TFMessage

    def take(message: Any) -> None:
        for transform in message.transforms:
            buffer.set_transform_static(transform, 'default_authority')

    quality = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
    node.create_subscription(TFMessage, TF_STATIC, take, quality)
