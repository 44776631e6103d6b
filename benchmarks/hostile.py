"""Messages, transforms and parameters that no robot should send, for `fuzz.py`."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Range

from forward_grid_mapper.core.common.parameters import TABLE

FRAMES = ('sonar_left', 'sonar_right', 'tf_good', 'tf_late', 'tf_wild')
ODD_NAMES = (
    '',
    '/',
    '../../etc/passwd',
    'a' * 5000,
    '\u202e超音波\n',
    'sensors.x.pose',
    "'; DROP TABLE",
    '%s%n',
    'tf_none',
)
ODD_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-45, -1e-45, 3.4e38, -3.4e38, 1e-3, 1e9, -1.0)
ODD_SECONDS = (0, -1, -(2**31), 2**31 - 1, 3600)


class TransformFailed(Exception):
    """Base class of the exceptions of transforms."""


class ExtrapolationException(TransformFailed):
    """The frame is known, but not at this time."""


class Hostile:
    """A faulty robot: most of its messages are right, and the others are arbitrary."""

    def __init__(self, seed: int, fault_rate: float = 0.2) -> None:
        self.random = random.Random(seed)
        self._fault_rate = fault_rate
        self._now = 100.0
        self._pose = [0.0, 0.0, 0.0]

    def faulty(self) -> bool:
        """Return whether the next value is arbitrary, at random."""
        return self.random.random() < self._fault_rate

    def single(self) -> float:
        """Return an arbitrary float32."""
        if self.random.random() < 0.5:
            return self.random.choice(ODD_FLOATS)
        return float(struct.unpack('<f', self.random.randbytes(4))[0])

    def double(self) -> float:
        """Return an arbitrary float64."""
        if self.random.random() < 0.5:
            return self.random.choice((*ODD_FLOATS, 1e308, -1e308, 2e7, 1e4))
        return float(struct.unpack('<d', self.random.randbytes(8))[0])

    def name(self) -> str:
        """Return an arbitrary name."""
        kind = self.random.random()
        if kind < 0.6:
            return self.random.choice(ODD_NAMES)
        return ''.join(chr(self.random.randrange(1, 0xD000)) for _ in range(self.random.randrange(40)))

    def stamp(self, header: Any) -> None:
        """Set the stamp of a message to its time, or to an arbitrary one."""
        seconds = self._now
        if self.faulty() and self.faulty():
            seconds += self.random.choice((-0.5, 0.5, -2.0, 5.0, 1e4, -1e4))
        header.stamp.sec, header.stamp.nanosec = int(seconds), int(seconds % 1 * 1e9)
        if self.faulty() and self.faulty() and self.faulty():
            header.stamp.sec = self.random.choice(ODD_SECONDS)
            header.stamp.nanosec = self.random.choice((0, 999_999_999, 2**32 - 1))

    def range(self) -> Range:
        """Return a Range."""
        made = Range(min_range=0.05, max_range=4.0, field_of_view=0.3, range=self.random.uniform(0.0, 5.0))
        made.header.frame_id = self.random.choice(FRAMES)
        self.stamp(made.header)
        while self.faulty():
            field = self.random.choice(
                ('range', 'min_range', 'max_range', 'field_of_view', 'variance', 'frame_id', 'radiation_type')
            )
            if field == 'frame_id':
                made.header.frame_id = self.name()
            elif field == 'radiation_type':
                made.radiation_type = self.random.randrange(256)
            elif hasattr(made, field):
                setattr(made, field, self.single())
        return self._garbled(made)

    def odometry(self) -> Odometry:
        """Return an Odometry; time and robot advance."""
        self._now += self.random.choice((0.02, 0.02, 0.05, 0.0))
        for k in range(3):
            self._pose[k] += self.random.uniform(-0.02, 0.021)
        made = Odometry(child_frame_id='base_link')
        made.header.frame_id = 'odom'
        self.stamp(made.header)
        position, turn = made.pose.pose.position, made.pose.pose.orientation
        position.x, position.y = self._pose[:2]
        turn.z, turn.w = math.sin(self._pose[2] / 2), math.cos(self._pose[2] / 2)
        while self.faulty():
            part, field = self.random.choice(
                [(position, f) for f in 'xyz'] + [(turn, f) for f in 'xyzw'] + [(made, 'names')]
            )
            if field == 'names':
                made.header.frame_id, made.child_frame_id = self.name(), self.name()
            else:
                setattr(part, field, self.double())
        return self._garbled(made)

    def _garbled(self, message: Any) -> Any:
        """Return the message with some of its bytes changed, if it can still be deserialized."""
        if not (self.faulty() and self.faulty()):
            return message
        try:
            return deserialize_message(self.garbled_bytes(message), type(message))
        except Exception:  # such a message would not reach a callback
            return message

    def garbled_bytes(self, message: Any) -> bytes:
        """Return the serialized message, truncated, changed, or replaced by noise."""
        data = bytearray(serialize_message(message))
        kind = self.random.random()
        if kind < 0.2:
            # an empty one would block its own writer in the middleware
            return bytes(data[: self.random.randrange(1, len(data))])
        if kind < 0.4:
            return bytes(data[:4]) + self.random.randbytes(self.random.randrange(120))
        for _ in range(self.random.randrange(1, 8)):
            # after the encapsulation header, mostly in the numbers at the end
            data[self.random.randrange(4, len(data))] = self.random.randrange(256)
        return bytes(data)

    def parameter(self) -> Parameter:
        """Return a parameter with an invalid value."""
        row = self.random.choice(TABLE)
        values = (
            lambda: self.random.uniform(row.low, row.high) if math.isfinite(row.low + row.high) else 1.0,
            self.double,
            lambda: self.random.choice([True, False, 0, -1, 2**62, '', 'x' * 3000, 'reliable', row.default]),
            lambda: self.random.choice([[1.0, math.nan], ['a', ''], [True], [2**60]]),
        )
        value = self.random.choice(values)()
        value = list(value) if isinstance(value, tuple) else value
        name = row.name if self.random.random() < 0.9 else self.random.choice(['sensors.a.pose', 'sensors.b', 'p_hitt'])
        return Parameter(name, value=value)

    def clear(self) -> None:
        """Do nothing: no transform is stored."""

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        """Return a transform, or raise, as `tf2_ros.Buffer` does."""
        from geometry_msgs.msg import TransformStamped

        found = TransformStamped()
        if source == 'tf_late' and self.random.random() < 0.3:
            raise ExtrapolationException(source)
        if source == 'tf_wild':
            turn, offset = found.transform.rotation, found.transform.translation
            for part, field in ((turn, 'x'), (turn, 'y'), (turn, 'z'), (turn, 'w'), (offset, 'x'), (offset, 'y')):
                if self.random.random() < 0.2:
                    setattr(part, field, self.double())
        elif not source.startswith('tf_') or source == 'tf_none':
            raise TransformFailed(source)
        return found
