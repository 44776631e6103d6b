"""The correction of odometry: from the odometry frame to the map frame, during a refined trajectory and after its end.

The pose of the odometry frame in the map frame, T, is the transform `map` → `odom` (REP 105):

    T(t) = trajectory(t) · odometry(t)⁻¹

After the end of the trajectory, T keeps its last value.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..common.readings import Floats, Readings
from ..messages.odometry_record import hard_to_interpolate
from .local_map import at_poses
from .outcome import replaced
from .poses import compose, inverse, relative
from .windows import Odometry


class Correction:
    """The transform from the odometry frame to the map frame, over time.

    Parameters
    ----------
    odometry, trajectory : Odometry
        Poses of the robot in the odometry frame and in the map frame, at the same stamps.
    """

    def __init__(self, odometry: Odometry, trajectory: Odometry) -> None:
        self.odometry, self.trajectory = odometry, trajectory

    @property
    def end(self) -> int:
        """The last stamp of the trajectory, nanoseconds."""
        return int(self.trajectory.stamp[-1])

    @cached_property
    def last(self) -> Floats:
        """T at the end of the trajectory and after it, shape (3,): metres, radians."""
        pose = compose(self.trajectory.pose[-1], inverse(self.odometry.pose[-1]))
        pose[2] = np.remainder(pose[2] + np.pi, 2 * np.pi) - np.pi
        return pose

    @property
    def moved(self) -> float:
        """Metres between odometry and trajectory at the end."""
        return float(np.hypot(*(self.trajectory.pose[-1, :2] - self.odometry.pose[-1, :2])))

    def continued(self, odometry: Odometry, trajectory: Odometry) -> Correction:
        """Return the correction, continued with those poses of two paths that are after its end.

        The paths have the same stamps.
        """
        after = int(np.searchsorted(odometry.stamp, self.end, side='right'))
        return Correction(_joined(self.odometry, odometry, after), _joined(self.trajectory, trajectory, after))

    def bounded(self, most: int) -> Correction:
        """Return a correction of at most this many poses: those are dropped that interpolation replaces best."""
        odometry, path = self.odometry, self.trajectory
        while len(odometry.stamp) > most:
            stay = hard_to_interpolate(path.stamp, path.pose)
            odometry, path = (Odometry(one.stamp[stay], one.pose[stay]) for one in (odometry, path))
        return self if odometry is self.odometry else Correction(odometry, path)

    def until(self, stamp: int) -> Correction:
        """Return the correction that ends at a stamp, nanoseconds; it keeps at least one pose."""
        end = max(int(np.searchsorted(self.trajectory.stamp, stamp, side='right')), 1)
        before, after = self.odometry, self.trajectory
        return Correction(
            Odometry(before.stamp[:end], before.pose[:end]), Odometry(after.stamp[:end], after.pose[:end])
        )

    def along(self, odometry: Odometry) -> Odometry:
        """Return a path in the odometry frame, transformed to the map frame; its stamps may be any."""
        pose, early = compose(self.last, odometry.pose), odometry.stamp <= self.end
        stamp = odometry.stamp[early]
        off = relative(self.odometry.at(stamp), odometry.pose[early])
        pose[early] = compose(self.trajectory.at(stamp), off)
        pose[:, 2] = np.unwrap(pose[:, 2])
        return Odometry(odometry.stamp, pose)

    def apply(self, readings: Readings) -> Readings:
        """Return readings placed by odometry, transformed to the map frame."""
        sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
        placed = compose(self.last, sensors)
        early = readings.stamp <= self.end
        if early.any():
            before = replaced(readings.select(early), self.odometry, self.trajectory)
            placed[early] = np.stack([before.x, before.y, before.yaw], axis=1)
        return at_poses(readings, placed)

    def path_of(self, stamp: np.ndarray, pose: Floats) -> Floats:
        """Return the positions of `extended`, shape (P, 2), metres."""
        return self.extended(stamp, pose).pose[:, :2]

    def extended(self, stamp: np.ndarray, pose: Floats) -> Odometry:
        """Return the trajectory, and after its end poses of odometry transformed to the map frame.

        Parameters
        ----------
        stamp : int64, shape (M,)
            Nanoseconds, increasing.
        pose : float64, shape (M, 3)
            In the odometry frame.
        """
        after = int(np.searchsorted(stamp, self.end, side='right'))
        later = compose(self.last, pose[after:])
        path = self.trajectory
        return Odometry(np.concatenate([path.stamp, stamp[after:]]), np.concatenate([path.pose, later]))


def _joined(path: Odometry, later: Odometry, first: int) -> Odometry:
    """Return a path, followed by the poses of another one from index `first` on."""
    stamp = np.concatenate([path.stamp, later.stamp[first:]])
    return Odometry(stamp, np.concatenate([path.pose, later.pose[first:]]))
