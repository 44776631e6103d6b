"""Odometry recovered from readings that were placed by it; after a restart from a journal, its messages are lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats, Readings
from .poses import compose, inverse, wrapped
from .windows import Odometry

ELSEWHERE = 0.1
"""Metres, and radians; interpolation between poses of odometry is off by less."""


def recovered(odometry: Odometry, readings: Readings, mounts: Mapping[str, Sequence[float]]) -> Odometry:
    """Return the odometry, extended back to the first reading of a sensor that is fixed to the robot.

    Such a reading has the pose of the robot by odometry:

        robot = sensor · mount⁻¹

    Parameters
    ----------
    odometry : Odometry
    readings : Readings
        Placed by odometry, in the odometry frame.
    mounts : mapping of str to (x, y, yaw)
        Poses of fixed sensors on the robot, by frame; readings of other sensors are not used.

    Returns
    -------
    Odometry
        `odometry` itself if there is no earlier reading of a fixed sensor.
    """
    stamp, robot = _robot(readings, mounts)
    early = stamp < odometry.stamp[0] if len(odometry.stamp) else np.ones(len(stamp), np.bool_)
    if not early.any():
        return odometry
    return Odometry.of(np.concatenate([stamp[early], odometry.stamp]), np.concatenate([robot[early], odometry.pose]))


def that_placed(readings: Readings, odometry: Odometry, mounts: Mapping[str, Sequence[float]]) -> Odometry:
    """Return the odometry after the last reading that it did not place, as it is after the clock jumped back.

    The robot was elsewhere when the clock showed that time before. The parameters are those of `recovered`.
    """
    if not len(odometry.stamp):
        return odometry
    stamp, robot = _robot(readings, mounts)
    within = (stamp >= odometry.stamp[0]) & (stamp <= odometry.stamp[-1])
    stamp, robot = stamp[within], robot[within]
    off = robot - odometry.at(stamp)
    elsewhere = (np.hypot(off[:, 0], off[:, 1]) > ELSEWHERE) | (np.abs(wrapped(off[:, 2])) > ELSEWHERE)
    after = int(stamp[elsewhere].max(initial=-1)) + 1
    return odometry.between(after, int(odometry.stamp[-1])) if elsewhere.any() else odometry


def _robot(readings: Readings, mounts: Mapping[str, Sequence[float]]) -> tuple[NDArray[np.int64], Floats]:
    """Return the stamps of the readings of fixed sensors, and the poses of the robot that placed them, shape (N, 3)."""
    poses = [mounts.get(name.lstrip('/'), mounts.get(name)) for name in readings.sensor_names]
    known = np.array([pose is not None for pose in poses], np.bool_)
    which = np.flatnonzero(known[readings.sensor]) if len(known) else np.zeros(0, np.int64)
    if not len(which):
        return np.zeros(0, np.int64), np.zeros((0, 3))
    back = np.array([inverse(np.array(pose, np.float64)) if pose is not None else np.zeros(3) for pose in poses])
    sensors = np.stack([readings.x[which], readings.y[which], readings.yaw[which]], axis=1)
    return readings.stamp[which], compose(sensors, back[readings.sensor[which]])
