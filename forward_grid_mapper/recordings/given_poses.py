"""Poses from a file that replace the odometry of a bag: a trajectory of SLAM or of a tracking system."""

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
"""Name of the frame of the poses, which such files do not name."""

LATEST = 9e9
"""Approximately the largest stamp of 64 bits of nanoseconds, seconds."""


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
        """Yield the poses between two stamps, nanoseconds, as messages of odometry."""
        first, last = np.searchsorted(self.stamp, [begin, end]).tolist()
        for stamp, pose in zip(self.stamp[first:last].tolist(), self.pose[first:last].tolist(), strict=True):
            yield OdometryMessage(stamp, MAP_FRAME, base_frame, Pose2(*pose))


def read_given_poses(path: Path | str) -> GivenPoses:
    """Read poses in the format of the TUM benchmark, or as CSV, if the first line that is no comment has commas.

    Raises
    ------
    InputError
        If the file cannot be read, a line is wrong, or there is no valid pose or stamp; names the reason.
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
    # of poses with the same stamp, the first
    stamp, first = np.unique(stamp, return_index=True)
    return GivenPoses(path, stamp, poses[first])


def _is_csv(path: Path) -> bool:
    if not path.is_file():
        raise InputError(
            f'{readable(path)} is not a file with poses' if path.exists() else f'{readable(path)} does not exist'
        )
    try:
        with path.open(encoding='utf-8', errors='replace') as lines:
            # the names of columns may be a comment, and so may a sentence with a comma
            first = ''
            for line in filter(str.strip, lines):
                first = line
                if not line.lstrip().startswith('#'):
                    break
    except OSError as error:
        raise InputError(f'{readable(path)} cannot be read: {error.strerror or error}') from None
    return ',' in first or ';' in first
