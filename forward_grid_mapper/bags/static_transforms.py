"""Poses of the sensors on the robot, from the static transforms of a bag."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.messages.extrinsics import Mount, mount_of
from ..core.messages.quaternions import STEEPEST, rotation_of
from ..core.messages.rep117 import proper_name

Transform = NDArray[np.float64]  # homogeneous, shape (4, 4)


TRANSFORM_TOLERANCE = 1e-6
"""Largest difference between numbers of equal poses, metres, and sines of angles: some have single precision."""


class SteepSensorError(InputError):
    """The sensor's axis is too steep for a planar map; `side` is where it looks, up or down."""

    def __init__(self, frames: Sequence[str], side: str, base_frame: str) -> None:
        one = len(frames) == 1
        super().__init__(
            f'{"Sensor" if one else "Sensors"} {", ".join(map(repr, frames))} {"looks" if one else "look"} {side}, '
            f'more than {math.degrees(STEEPEST):.0f}° out of the plane of {base_frame!r}; fix '
            f'{"its transform" if one else "their transforms"} (the x axis is the direction of the beam), or leave out '
            f'{"the sensor" if one else "the sensors"}.'
        )
        self.side = side


class StaticTransforms:
    """A tree of frames; leading slashes of names are ignored.

    Attributes
    ----------
    rejected : dict
        Child frames with an invalid transform, and the reason; relevant only if one of them is looked up.
    contradicted : dict
        Child frames that have several poses, and which one is used; relevant only if looked up.
    """

    def __init__(self, topic: str = '/tf_static') -> None:
        self.rejected: dict[str, str] = {}
        self.contradicted: dict[str, str] = {}
        self._topic = topic
        self._parents: dict[str, tuple[str, Transform]] = {}
        self._topics: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._parents)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted(set(self._parents) | {parent for parent, _ in self._parents.values()})

    def add(self, parent: str, child: str, translation_xyz: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
        """Add the pose of `child` in `parent`, in metres; it replaces an earlier one, as in tf2.

        Raises
        ------
        InputError
            If the quaternion is not normalised, a number is not finite, a frame is its own parent, or a name is none.
        """
        parent, child = plain(parent), plain(child)
        if not all(proper_name(name) for name in (parent, child) if name):
            raise InputError(
                'A static transform has a frame whose name is too long or cannot be printed; fix its publisher.'
            )
        what = f'The static transform from {parent!r} to {child!r}'
        x, y, z, w = (float(v) for v in quaternion_xyzw)
        rotation = rotation_of(x, y, z, w)
        if rotation is None:
            length = math.sqrt(x * x + y * y + z * z + w * w)
            raise InputError(f'{what} has a quaternion of length {length:.4g} instead of 1; fix its publisher.')
        if not all(math.isfinite(v) for v in translation_xyz):
            raise InputError(f'{what} has a translation that is not finite; fix its publisher.')
        if parent == child or not child:
            raise InputError(f'{what} does not join two frames; fix its publisher.')
        transform = np.eye(4)
        transform[:3, :3] = rotation
        transform[:3, 3] = translation_xyz
        known = self._parents.get(child)
        if known is not None and not _same(known, (parent, transform)):
            self.contradicted[child] = (
                f'{self._topic} contains different poses of {child!r}; the last one is used for the whole drive. If '
                'the sensor was moved, map only a part with --start and --duration, and set --sensor'
            )
        self._parents[child] = parent, transform
        self.rejected.pop(child, None)

    def add_if_valid(
        self, parent: str, child: str, translation_xyz: Sequence[float], quaternion_xyzw: Sequence[float]
    ) -> None:
        """Add a pose as `add` does, or note in `rejected` why it is invalid."""
        try:
            self.add(parent, child, translation_xyz, quaternion_xyzw)
        except InputError as error:
            # a wrong transform elsewhere on the robot must not prevent a map that does not need it
            self.rejected[plain(child)] = str(error)

    def add_message(self, message: Any) -> None:
        """Apply `add_if_valid` to a `geometry_msgs/TransformStamped`."""
        offset, turn = message.transform.translation, message.transform.rotation
        parent, child = str(message.header.frame_id), str(message.child_frame_id)
        self.add_if_valid(parent, child, (offset.x, offset.y, offset.z), (turn.x, turn.y, turn.z, turn.w))

    def take(self, other: StaticTransforms) -> None:
        """Add the transforms of other topics, which take precedence."""
        self.contradicted |= other.contradicted
        for child, (parent, transform) in other._parents.items():
            known, topic = self._parents.get(child), other._topics.get(child, other._topic)
            if known is not None and not _same(known, (parent, transform)):
                self.contradicted[child] = (
                    f'{self._topics.get(child, self._topic)} and {topic} contain different poses of {child!r}; that of '
                    f'{topic} is used. If it belongs to another robot, set --sensor'
                )
            self._parents[child] = parent, transform
            self._topics[child] = topic
        self.rejected |= {child: why for child, why in other.rejected.items() if child not in self._parents}
        self.rejected = {child: why for child, why in self.rejected.items() if child not in self._parents}

    def top_of(self, frame: str) -> str:
        """Return the root of the tree that contains a frame: itself, if it is not known."""
        return next(reversed(self._ancestors(plain(frame))))

    def step(self, frame: str) -> tuple[str, Transform] | None:
        """Return the parent of a frame, by its name without a leading slash, and its pose there; None for a root."""
        return self._parents.get(frame)

    def doubts(self, base_frame: str, sensor_frame: str) -> list[str]:
        """Return the entries of `contradicted` for the frames that connect a sensor to the robot."""
        to_base, to_sensor = self._ancestors(plain(base_frame)), self._ancestors(plain(sensor_frame))
        # frames above the common ancestor do not matter
        common = next((frame for frame in to_sensor if frame in to_base), None)
        way = [frame for up in (to_sensor, to_base) for frame in takewhile(lambda frame: frame != common, up)]
        return [self.contradicted[frame] for frame in way if frame in self.contradicted]

    def lookup(self, base_frame: str, sensor_frame: str) -> Mount | None:
        """Return the pose of the sensor on the robot, projected on the base frame's plane.

        Returns
        -------
        Mount or None
            `yaw` is the direction of the sensor's x axis. None if the frames are not connected.

        Raises
        ------
        SteepSensorError
            If the sensor's axis points more than 60° up or down.
        InputError
            If the frames are not connected because of an invalid transform.
        """
        base_frame, sensor_frame = plain(base_frame), plain(sensor_frame)
        to_base, to_sensor = self._ancestors(base_frame), self._ancestors(sensor_frame)
        common = next((frame for frame in to_sensor if frame in to_base), None)
        if common is None:
            for frame in (*to_sensor, *to_base):
                if frame in self.rejected:
                    raise InputError(self.rejected[frame])
            return None
        pose = np.linalg.inv(to_base[common]) @ to_sensor[common]
        mount = mount_of(float(pose[0, 3]), float(pose[1, 3]), pose[:3, 0].tolist())
        if isinstance(mount, str):
            raise SteepSensorError([sensor_frame], 'up' if pose[2, 0] > 0 else 'down', base_frame)
        return mount

    def _ancestors(self, frame: str) -> dict[str, Transform]:
        """Return the frame itself and all its ancestors, nearest first, with the pose of `frame` in each."""
        transform = np.eye(4)
        found = {frame: transform}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in found:  # a loop, which tf2 cannot resolve either
                break
            transform = step @ transform
            found[frame] = transform
        return found


def _same(one: tuple[str, Transform], other: tuple[str, Transform]) -> bool:
    """Return whether two transforms of a frame, each with its parent, are equal."""
    return one[0] == other[0] and np.allclose(one[1], other[1], atol=TRANSFORM_TOLERANCE)


def way_up(frame: str, parent_of: Callable[[str], str | None]) -> list[str]:
    """Return a frame and its ancestors, nearest first; a loop of frames, which tf2 cannot resolve either, ends it."""
    found: list[str] = []
    at: str | None = plain(frame)
    while at is not None and at not in found:
        found.append(at)
        at = parent_of(at)
    return found


def plain(frame: str) -> str:
    """Return the name of a frame without leading slashes."""
    return frame.lstrip('/')
