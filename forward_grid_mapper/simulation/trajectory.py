"""Motion along waypoints at constant speed, with turns on the spot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..core.common.readings import Floats

SPEED = 0.5  # m/s
TURN_RATE = 1.0  # rad/s
REST = 0.2  # seconds without motion before and after, so that odometry brackets every sweep


@dataclass(frozen=True)
class Trajectory:
    """Poses between which position and (unwrapped) yaw change linearly with time.

    Attributes
    ----------
    time : float64, shape (K,)
        Seconds since the start, increasing.
    pose : float64, shape (K, 3)
        x, y, yaw in the map frame, metres and radians.
    leg_time, leg_start : float64, shape (L,)
        Start of each straight leg, seconds, and its distance along the path, metres.
    length : float
        Of the whole path, metres.
    """

    time: Floats
    pose: Floats
    leg_time: Floats
    leg_start: Floats
    length: float

    @classmethod
    def through(cls, waypoints: Floats) -> Trajectory:
        """Return the motion through waypoints, shape (P, 2), P > 1, metres; successive ones must differ."""
        steps = np.diff(waypoints, axis=0)
        lengths = np.hypot(*steps.T)
        if not len(lengths) or lengths.min() <= 0.0:
            raise ValueError('a path needs two waypoints or more, successive ones apart')
        yaw = math.atan2(steps[0, 1], steps[0, 0])
        time, leg_time = REST, []
        knots = [(0.0, *waypoints[0], yaw)]
        for start, step, length in zip(waypoints[:-1], steps, lengths, strict=True):
            turn = math.remainder(math.atan2(step[1], step[0]) - yaw, math.tau)
            if turn:
                knots.append((time, *start, yaw))
            time, yaw = time + abs(turn) / TURN_RATE, yaw + turn
            knots.append((time, *start, yaw))
            leg_time.append(time)
            time += length / SPEED
        knots += [(time, *waypoints[-1], yaw), (time + REST, *waypoints[-1], yaw)]
        table = np.array(knots)
        starts = np.concatenate([[0.0], np.cumsum(lengths)])
        return cls(table[:, 0], table[:, 1:], np.array(leg_time), starts[:-1], float(starts[-1]))

    def time_at(self, distance: Floats) -> Floats:
        """Return the time at a distance along the path, metres, in seconds; before the turn, if there is one."""
        leg = np.clip(np.searchsorted(self.leg_start, distance) - 1, 0, None)
        time: Floats = self.leg_time[leg] + (distance - self.leg_start[leg]) / SPEED
        return time

    def pose_at(self, time: Floats) -> Floats:
        """Return x, y, yaw at times in seconds, shape (T, 3)."""
        return np.stack([np.interp(time, self.time, column) for column in self.pose.T], axis=1)
