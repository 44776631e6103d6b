"""The windows of a drive: pieces so short that odometry is accurate within them, each with a node in its middle.

    u = travel / 0.4 m + |turn| / 90°

grows about as the errors of odometry do. A window is a step of 1 in u. Its *node* (keyframe) is the pose of the robot
in the middle of the step. The trajectory is a pose for each node. Between nodes, the correction of the odometry is
interpolated linearly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats, Readings
from ..runtime.jit import kernel
from .poses import compose, interpolated, relative

TRAVEL = 0.4
"""Metres of a window in which the robot does not turn."""

TURN = math.radians(90.0)
"""Radians of a window in which the robot turns on the spot."""

TURN_AS_TRAVEL = 0.3
"""Metres of progress for each radian of turning; corrections are interpolated over progress."""

STILL = 0.01
"""Metres, and radians: a reading is left out if the robot moved by less since the last one of the same sensor."""


@dataclass(frozen=True)
class Odometry:
    """A path: poses of the robot with time stamps, as measured by odometry, or of a trajectory.

    Attributes
    ----------
    stamp : int64, shape (M,)
        Nanoseconds, increasing.
    pose : float64, shape (M, 3)
        In the odometry frame, or that of the map; metres, and unwrapped radians.
    """

    stamp: NDArray[np.int64]
    pose: Floats

    @classmethod
    def of(cls, stamp: NDArray[np.int64], pose: Floats) -> Odometry:
        """Return the odometry with its poses sorted by time, one for each stamp, and its yaw unwrapped."""
        order = np.argsort(stamp, kind='stable')
        stamp, pose = np.asarray(stamp, np.int64)[order], np.array(pose, np.float64)[order]
        pose = pose.reshape(-1, 3)
        first = np.ones(len(stamp), np.bool_)
        first[1:] = stamp[1:] > stamp[:-1]
        stamp, pose = stamp[first], pose[first]
        pose[:, 2] = np.unwrap(pose[:, 2])
        return cls(stamp, pose)

    def seconds(self, stamp: NDArray[np.int64]) -> Floats:
        """Return seconds since the first pose."""
        return np.asarray((stamp - self.stamp[0]) * 1e-9)

    def at(self, stamp: NDArray[np.int64]) -> Floats:
        """Return the poses at stamps, shape (N, 3)."""
        return interpolated(self.seconds(stamp), self.seconds(self.stamp), self.pose)

    def between(self, first: int, last: int) -> Odometry:
        """Return the poses from one stamp to another, nanoseconds, both included."""
        within = (self.stamp >= first) & (self.stamp <= last)
        return Odometry(self.stamp[within], self.pose[within])

    @property
    def travel(self) -> Floats:
        """Metres driven until each pose."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.pose[:, :2], axis=0).T))])

    @property
    def turn(self) -> Floats:
        """Radians turned until each pose; left and right turns add up."""
        return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(self.pose[:, 2])))])

    @property
    def progress(self) -> Floats:
        """Progress until each pose, metres: travel + `TURN_AS_TRAVEL` · turn."""
        out: Floats = self.travel + TURN_AS_TRAVEL * self.turn
        return out


@dataclass(frozen=True)
class Windows:
    """A drive in windows: K nodes and N readings. Readings taken at standstill are left out.

    Attributes
    ----------
    readings : Readings
        Sorted by time. Only ranges and limits are used; their poses are those of odometry.
    robot : float64, shape (N, 3)
        Pose of the robot at each reading, by odometry.
    mount : float64, shape (N, 3)
        Pose of the sensor on the robot.
    progress : float64, shape (N,)
        Of each reading, metres (`Odometry.progress`).
    first : int64, shape (K + 1,)
        The readings of window k are those from `first[k]` to `first[k + 1]` − 1.
    node : float64, shape (K, 3)
        Pose of each node, by odometry.
    node_progress : float64, shape (K,)
    node_stamp : int64, shape (K,)
        Nanoseconds.
    travel, turn : float64, shape (K,)
        Metres and radians until each node.
    """

    readings: Readings
    robot: Floats
    mount: Floats
    progress: Floats
    first: NDArray[np.int64]
    node: Floats
    node_progress: Floats
    node_stamp: NDArray[np.int64]
    travel: Floats
    turn: Floats

    def __len__(self) -> int:
        return len(self.node)

    def corrected(self, progress: Floats, odometry: Floats, nodes: Floats) -> Floats:
        """Return poses of odometry, shape (N, 3), corrected so that the nodes are at `nodes`, shape (K, 3)."""
        return corrected(progress, odometry, self.node_progress, self.node, nodes)


def corrected(progress: Floats, odometry: Floats, at: Floats, node: Floats, nodes: Floats) -> Floats:
    """Return poses of odometry corrected so that the nodes are at `nodes`; linear between them.

    Parameters
    ----------
    progress, odometry : float64, shapes (N,) and (N, 3)
        Of the poses to correct.
    at, node, nodes : float64, shapes (K,), (K, 3) and (K, 3)
        Progress of the nodes, their odometry and their corrected poses.
    """
    if len(at) == 1:
        return compose(nodes[0], relative(node[0], odometry))
    left = np.clip(np.searchsorted(at, progress, side='right') - 1, 0, len(at) - 2)
    fraction = np.clip((progress - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)[:, None]
    before = compose(nodes[left], relative(node[left], odometry))
    after = compose(nodes[left + 1], relative(node[left + 1], odometry))
    after[:, 2] = before[:, 2] + np.remainder(after[:, 2] - before[:, 2] + np.pi, 2 * np.pi) - np.pi
    return before + fraction * (after - before)


def _still(odometry: Floats, sensor: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which readings were taken when the robot had not moved since an earlier one of the sensor, shape (N,)."""
    out = np.zeros(len(sensor), np.bool_)
    mark_still(odometry, sensor, np.full(int(sensor.max(initial=0)) + 1, -1, np.int64), out)
    return out


@kernel
def mark_still(odometry: Floats, sensor: NDArray[np.int32], last: NDArray[np.int64], out: NDArray[np.bool_]) -> None:
    """Set `out` to True for the readings of `_still`; a drive may contain hours of them.

    Parameters
    ----------
    odometry : float64, shape (N, 3)
    sensor : int32, shape (N,)
    last : int64, shape (S,)
        −1; becomes the last reading of each sensor that is not marked.
    out : bool, shape (N,)
    """
    for t in range(len(sensor)):
        s = sensor[t]
        k = last[s]
        if k >= 0:
            far = math.hypot(odometry[t, 0] - odometry[k, 0], odometry[t, 1] - odometry[k, 1])
            if far < STILL and abs(odometry[t, 2] - odometry[k, 2]) < STILL:
                out[t] = True
                continue
        last[s] = t


def cut(readings: Readings, odometry: Odometry) -> Windows:
    """Return the windows of a drive; the last window includes the rest of the drive, which is shorter than a window.

    Parameters
    ----------
    readings : Readings
        Placed by this odometry, in any order.
    odometry : Odometry
        Of the whole drive.
    """
    readings = readings.select(np.argsort(readings.stamp, kind='stable'))
    robot = odometry.at(readings.stamp)
    moved = ~_still(robot, readings.sensor)
    readings, robot = readings.select(moved), robot[moved]
    knots, travel, turn = odometry.seconds(odometry.stamp), odometry.travel, odometry.turn
    u = travel / TRAVEL + turn / TURN
    seconds = odometry.seconds(readings.stamp)
    count = max(int(u[-1]), 1)
    grows = np.diff(u) > 0
    came, went = np.concatenate([[True], grows]), np.concatenate([grows, [True]])
    half = np.arange(count) + 0.5
    # u does not grow while the robot stands; a node just after that gets a time within it, when readings were taken
    middle = np.interp(half, u[came], knots[came])
    again = np.concatenate([[False], np.diff(np.interp(middle, knots, u)) <= 0.0])
    # unless the node before it is there already, or lies in the same step, which may be many windows long
    again[1:] |= np.diff(np.searchsorted(u[came], half, side='right')) == 0
    middle[again] = np.interp(half[again], u[came | went], knots[came | went])
    of_reading = np.clip(np.interp(seconds, knots, u).astype(np.int64), 0, count - 1)
    first = np.searchsorted(of_reading, np.arange(count + 1))
    progress = odometry.progress
    sensors = np.stack([readings.x, readings.y, readings.yaw], axis=1)
    return Windows(
        readings=readings,
        robot=robot,
        mount=relative(robot, sensors),
        progress=np.interp(seconds, knots, progress),
        first=first,
        node=interpolated(middle, knots, odometry.pose),
        node_progress=np.interp(middle, knots, progress),
        node_stamp=odometry.stamp[0] + np.round(middle * 1e9).astype(np.int64),
        travel=np.interp(middle, knots, travel),
        turn=np.interp(middle, knots, turn),
    )
