"""Where the sensors sit on the robot, from the fixed transforms of a bag."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.messages.message_types import Pose2

_STEEPEST = math.radians(60.0)
Transform = NDArray[np.float64]  # homogeneous, shape (4, 4)


class StaticTransforms:
    """A tree of frames; names compare without a leading slash.

    Attributes
    ----------
    rejected : dict
        Child frames whose transform was not usable, and why; they matter only when one of them is looked up.
    """

    def __init__(self) -> None:
        self.rejected: dict[str, str] = {}
        self._parents: dict[str, tuple[str, Transform]] = {}

    def __len__(self) -> int:
        return len(self._parents)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted(set(self._parents) | {parent for parent, _ in self._parents.values()})

    def add(self, parent: str, child: str, translation_xyz: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
        """Add the pose of `child` in `parent`, in metres; a later one replaces an earlier one, as in tf2.

        Raises
        ------
        InputError
            If the quaternion is not normalised, a number is not finite, or a frame is its own parent.
        """
        parent, child = _plain(parent), _plain(child)
        what = f'The static transform from {parent!r} to {child!r}'
        x, y, z, w = (float(v) for v in quaternion_xyzw)
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not abs(norm - 1.0) < 0.01:
            raise InputError(f'{what} has a quaternion of length {norm:.3g} instead of 1; mend its publisher.')
        if not all(math.isfinite(v) for v in translation_xyz):
            raise InputError(f'{what} has a translation that is not finite; mend its publisher.')
        if parent == child or not child:
            raise InputError(f'{what} does not join two frames; mend its publisher.')
        transform = np.eye(4)
        transform[:3, :3] = _rotation(x / norm, y / norm, z / norm, w / norm)
        transform[:3, 3] = translation_xyz
        self._parents[child] = parent, transform
        self.rejected.pop(child, None)

    def lookup(self, base_frame: str, sensor_frame: str) -> Pose2 | None:
        """Return the pose of the sensor on the robot, projected on the base frame's plane.

        Returns
        -------
        Pose2 or None
            `yaw` is the direction of the sensor's x axis. None if the frames are not joined.

        Raises
        ------
        InputError
            If the sensor looks more than 60° up or down, or the frames are not joined because of a bad transform.
        """
        base_frame, sensor_frame = _plain(base_frame), _plain(sensor_frame)
        to_base, to_sensor = self._ancestors(base_frame), self._ancestors(sensor_frame)
        common = next((frame for frame in to_sensor if frame in to_base), None)
        if common is None:
            for frame in (*to_sensor, *to_base):
                if frame in self.rejected:
                    raise InputError(self.rejected[frame])
            return None
        pose = np.linalg.inv(to_base[common]) @ to_sensor[common]
        forward = pose[:3, 0]
        if math.asin(min(1.0, abs(forward[2]))) > _STEEPEST:
            raise InputError(
                f'Sensor {sensor_frame!r} looks {"up" if forward[2] > 0 else "down"}, more than 60° out of the plane '
                f'of {base_frame!r}; leave its topic out or mend its transform (the beam goes along x).'
            )
        return Pose2(float(pose[0, 3]), float(pose[1, 3]), math.atan2(forward[1], forward[0]))

    def _ancestors(self, frame: str) -> dict[str, Transform]:
        """Return the frame itself and all above it, nearest first, with the pose of `frame` in each."""
        transform = np.eye(4)
        found = {frame: transform}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in found:  # a loop; tf2 would not know better either
                break
            transform = step @ transform
            found[frame] = transform
        return found


def _plain(frame: str) -> str:
    return frame.lstrip('/')


def _rotation(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    """Return the rotation matrix of a normalised quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
