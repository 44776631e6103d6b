"""Odometry recovered from readings that were placed by it; after a restart from a journal, its messages are lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..common.readings import Readings
from .poses import compose, inverse
from .windows import Odometry


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
    poses = [mounts.get(name.lstrip('/'), mounts.get(name)) for name in readings.sensor_names]
    known = np.array([pose is not None for pose in poses], np.bool_)
    early = np.ones(len(readings), np.bool_)
    if len(odometry.stamp):
        early = readings.stamp < odometry.stamp[0]
    which = np.flatnonzero(early & known[readings.sensor]) if len(known) else np.zeros(0, np.int64)
    if not len(which):
        return odometry
    back = np.array([inverse(np.array(pose, np.float64)) if pose is not None else np.zeros(3) for pose in poses])
    sensors = np.stack([readings.x[which], readings.y[which], readings.yaw[which]], axis=1)
    robot = compose(sensors, back[readings.sensor[which]])
    return Odometry.of(np.concatenate([readings.stamp[which], odometry.stamp]), np.concatenate([robot, odometry.pose]))
