"""Poses of sensors on moving joints, such as a servo, from transforms that change; between two, as tf2 interpolates."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.messages.extrinsics import LATE, Mount, mount_of
from ..core.messages.message_types import NANOSECONDS, stamp_of
from ..core.messages.quaternions import rotation_of
from .static_transforms import StaticTransforms, Transform, plain, way_up
from .transform_chain import Numbers, numbers_of

NEARLY_EQUAL = 0.9995
"""Cosine of half the angle between two rotations from which they are interpolated on a straight line."""


class _Joint:
    """The poses of a frame in its parent, by stamp; they are interpolated over at most `longest` nanoseconds."""

    def __init__(self, parent: str, longest: float) -> None:
        self.parent, self._longest = parent, longest
        self._poses: dict[int, Numbers] = {}
        self._stamps: list[int] = []

    def add(self, stamp: int, numbers: Numbers) -> None:
        self._poses[stamp] = numbers

    def at(self, stamp: int) -> Transform | None:
        """Return the pose at a stamp, nanoseconds; None before the first, after the last, and in a long gap."""
        if len(self._stamps) != len(self._poses):
            self._stamps = sorted(self._poses)
        after = bisect_left(self._stamps, stamp)
        if after == len(self._stamps):
            return None
        last = self._stamps[after]
        if last == stamp:
            return _matrix(self._poses[last])
        if not after:
            return None
        first = self._stamps[after - 1]
        if last - first > self._longest:
            return None
        return _matrix(_between(self._poses[first], self._poses[last], (stamp - first) / (last - first)))


class MovingTransforms:
    """The transforms of a bag's `/tf`, and its static ones, which take precedence.

    Parameters
    ----------
    fixed : StaticTransforms
    frames : collection of str
        Child frames whose transforms are kept; others are ignored.
    longest_gap : float
        Longest time between two transforms of a frame for interpolation, seconds.
    """

    def __init__(self, fixed: StaticTransforms, frames: Collection[str], longest_gap: float = math.inf) -> None:
        self._fixed, self._frames = fixed, frames
        self._longest = longest_gap * NANOSECONDS
        self._joints: dict[str, _Joint] = {}
        self._several: dict[str, str] = {}
        self._ways: dict[tuple[str, str], tuple[list[str], list[str]] | None] = {}

    @classmethod
    def between(
        cls,
        fixed: StaticTransforms,
        parents: Mapping[str, str],
        base_frame: str,
        sensor_frame: str,
        longest_gap: float,
    ) -> MovingTransforms:
        """Prepare for the frames that may connect a sensor to the robot.

        `parents` are the parents of all frames that moving transforms place; no frames are kept if they do not help.
        """

        def parent(frame: str) -> str | None:
            step = fixed.step(frame)
            return parents.get(frame) if step is None else step[0]

        to_sensor, to_base = (set(way_up(frame, parent)) for frame in (sensor_frame, base_frame))
        helps = not to_sensor.isdisjoint((*to_base, *parents))
        # what is above both does not matter
        return cls(fixed, to_sensor.symmetric_difference(to_base) if helps else (), longest_gap)

    @property
    def empty(self) -> bool:
        """Whether no frames are kept."""
        return not self._frames

    def add_message(self, message: Any) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`; invalid ones are left out."""
        for item in message.transforms:
            parent, child = plain(str(item.header.frame_id)), plain(str(item.child_frame_id))
            if child not in self._frames or parent == child:
                continue
            self._ways.clear()
            joint = self._joints.setdefault(child, _Joint(parent, self._longest))
            numbers = numbers_of(item.transform)
            if joint.parent != parent:
                self._several.setdefault(child, parent)
            elif all(map(math.isfinite, numbers)) and rotation_of(*numbers[3:]) is not None:
                joint.add(stamp_of(item.header), numbers)

    def connects(self, base_frame: str, sensor_frame: str) -> bool:
        """Return whether there is a way from the robot to a sensor, in which no frame has several parents."""
        ways = self._apart(base_frame, sensor_frame)
        return ways is not None and self._several.keys().isdisjoint((*ways[0], *ways[1]))

    def doubt(self, base_frame: str, sensor_frame: str) -> str:
        """Return which frame above the robot or a sensor has several parents, in words; '' if none has."""
        above = [*way_up(sensor_frame, self._parent), *way_up(base_frame, self._parent)]
        frame = next((each for each in above if each in self._several), None)
        if frame is None:
            return ''
        return (
            f'/tf has {frame} in two frames, {self._joints[frame].parent} and {self._several[frame]}: a frame has one '
            'parent; stop one of the publishers.'
        )

    def lookup(self, base_frame: str, sensor_frame: str, stamp: int) -> Mount | str | None:
        """Return the pose of the sensor on the robot at a stamp, nanoseconds.

        Returns
        -------
        Mount, str or None
            The reason why there is none at this stamp; None if the frames are not connected.
        """
        ways = self._apart(base_frame, sensor_frame)
        if ways is None:
            return None
        to_base, to_sensor = (self._pose_along(way, stamp) for way in ways)
        if to_base is None or to_sensor is None:
            return LATE.reason
        pose = np.linalg.inv(to_base) @ to_sensor
        return mount_of(float(pose[0, 3]), float(pose[1, 3]), pose[:3, 0].tolist())

    def _parent(self, frame: str) -> str | None:
        if (step := self._fixed.step(frame)) is not None:
            return step[0]
        return self._joints[frame].parent if frame in self._joints else None

    def _apart(self, base_frame: str, sensor_frame: str) -> tuple[list[str], list[str]] | None:
        """Return the ways up from the robot and from a sensor to where they meet; None if they do not."""
        key = base_frame, sensor_frame
        if key not in self._ways:
            to_base, to_sensor = (way_up(frame, self._parent) for frame in key)
            common = next((frame for frame in to_sensor if frame in to_base), None)
            self._ways[key] = None
            if common is not None:
                self._ways[key] = to_base[: to_base.index(common)], to_sensor[: to_sensor.index(common)]
        return self._ways[key]

    def _pose_along(self, way: list[str], stamp: int) -> NDArray[np.float64] | None:
        """Return the pose of the first frame in the parent of the last; None if a joint has none at this stamp."""
        whole = np.eye(4)
        for frame in way:
            step = self._fixed.step(frame)
            transform = self._joints[frame].at(stamp) if step is None else step[1]
            if transform is None:
                return None
            whole = transform @ whole
        return whole


def _between(one: Numbers, other: Numbers, part: float) -> Numbers:
    """Interpolate linearly between two translations, and by slerp between two rotations."""
    offset = tuple(a + part * (b - a) for a, b in zip(one[:3], other[:3], strict=True))
    cosine = sum(a * b for a, b in zip(one[3:], other[3:], strict=True))
    # a quaternion and its negative are the same rotation
    sign = -1.0 if cosine < 0.0 else 1.0
    if abs(cosine) > NEARLY_EQUAL:
        first, last = 1.0 - part, part
    else:
        angle = math.acos(abs(cosine))
        first, last = math.sin((1.0 - part) * angle) / math.sin(angle), math.sin(part * angle) / math.sin(angle)
    turn = [first * a + sign * last * b for a, b in zip(one[3:], other[3:], strict=True)]
    length = math.sqrt(sum(value * value for value in turn))
    return (*offset, *(value / length for value in turn))


def _matrix(numbers: Numbers) -> Transform:
    made = np.eye(4)
    made[:3, :3] = rotation_of(*numbers[3:])
    made[:3, 3] = numbers[:3]
    return made
