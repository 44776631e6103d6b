"""Poses that the user gives in a file, in place of those of a bag's odometry: a trajectory of SLAM or of a tracker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2
from ..files.output_folder import readable
from ..files.pose_files import poses_from_csv, poses_from_tum

MAP_FRAME = 'map'
"""What the frame of the poses is called, which such files do not name."""

LATEST = 9e9
"""Seconds that a stamp of 64 bit nanoseconds can hold, more or less."""


class GivenPoses(NamedTuple):
    """Poses of the robot's base in the map frame.

    Attributes
    ----------
    path : Path
        The file.
    stamp : int64, shape (M,)
        Nanoseconds, increasing.
    pose : float64, shape (M, 3)
        x, y in metres and yaw in radians.
    """

    path: Path
    stamp: NDArray[np.int64]
    pose: NDArray[np.float64]

    def between(self, begin: float, end: float, base_frame: str) -> Iterator[OdometryMessage]:
        """Yield the poses of these nanoseconds, as odometry would give them."""
        first, last = np.searchsorted(self.stamp, [begin, end]).tolist()
        for stamp, pose in zip(self.stamp[first:last].tolist(), self.pose[first:last].tolist(), strict=True):
            yield OdometryMessage(stamp, MAP_FRAME, base_frame, Pose2(*pose))


def read_given_poses(path: Path | str) -> GivenPoses:
    """Read poses in the format of the TUM benchmark, or as CSV, which is told by the commas of its first line.

    Raises
    ------
    InputError
        If the file cannot be read, a line is wrong, or there is no pose or no stamp that can be; says which.
    """
    path = Path(path)
    stamps, poses = poses_from_csv(path) if _is_csv(path) else poses_from_tum(path)
    if not len(stamps):
        raise InputError(f'{readable(path)} has no pose')
    if np.abs(stamps).max() > LATEST:
        raise InputError(
            f'{readable(path)} has the stamp {stamps[np.abs(stamps).argmax()]:g}, which is not possible for seconds; '
            'if stamps are in nanoseconds, use CSV and name the column stamp_ns'
        )
    stamp = np.rint(stamps * NANOSECONDS).astype(np.int64)
    # of poses with one stamp the first
    stamp, first = np.unique(stamp, return_index=True)
    return GivenPoses(path, stamp, poses[first])


def _is_csv(path: Path) -> bool:
    if not path.is_file():
        raise InputError(
            f'{readable(path)} is not a file with poses' if path.exists() else f'{readable(path)} does not exist'
        )
    try:
        with path.open(encoding='utf-8', errors='replace') as lines:
            first = next((line for line in lines if line.strip()), '')
    except OSError as error:
        raise InputError(f'{readable(path)} cannot be read: {error.strerror or error}') from None
    return ',' in first or ';' in first
