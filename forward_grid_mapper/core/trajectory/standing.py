"""Long stands of the robot, as at a dock: in an hour, small noise of odometry adds up to 100 m of driving."""

from __future__ import annotations

import math

import numpy as np

from ..messages.message_types import NANOSECONDS
from .windows import STILL, Odometry

LONG = 60.0
"""Seconds for which the robot stays within `STILL`."""


def without_stands(odometry: Odometry) -> Odometry:
    """Return the odometry with only the first and the last pose of each long stand; the same object if there is none.

    So a stand is no path whose errors add up, and its poses do not outweigh those of the drive.
    """
    stay, first = np.ones(len(odometry.stamp), np.bool_), 0
    stamps, poses = odometry.stamp.tolist(), odometry.pose.tolist()
    for k in range(1, len(stamps) + 1):
        if k < len(stamps):
            (x, y, yaw), (x_first, y_first, yaw_first) = poses[k], poses[first]
            if math.hypot(x - x_first, y - y_first) < STILL and abs(yaw - yaw_first) < STILL:
                continue
        if stamps[k - 1] - stamps[first] >= LONG * NANOSECONDS:
            stay[first + 1 : k - 1] = False
        first = k
    return odometry if stay.all() else Odometry(odometry.stamp[stay], odometry.pose[stay])
