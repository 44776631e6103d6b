"""Small maps of a part of a drive, with stamps or poses changed, to compare how well they explain its readings.

Poses, stamps and cones are changed, never ranges, so the likelihoods of all these maps can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings, in_canonical_order
from ..evidence.evidence import Evidence
from ..maps.log_odds_map import map_grid
from ..maps.traversed import traversed_cells
from ..messages.message_types import NANOSECONDS, Pose2
from ..runtime.memory import memory_for_pairs
from ..runtime.threads import cores
from ..search.search import Search

CELL, REACH = 0.1, 60.0
"""Smallest cells of these maps, metres, and most cells that the 0.9 quantile of ranges spans: they limit the cost."""

STEP = 0.05
"""Metres of driving over which a direction of travel is measured."""

BLOCKS = 40
"""Blocks of successive readings; the difference between two maps is independent from block to block."""


@dataclass(frozen=True)
class MountedReadings:
    """Readings, sorted by stamp, with the pose of the robot at each of them.

    `robot` and `extrinsics` have shape (3, N): x, y in metres and yaw in radians, of the robot in the map frame and of
    the sensor in the frame of the robot.
    """

    readings: Readings
    robot: Floats
    extrinsics: Floats

    @classmethod
    def of(cls, readings: Readings, extrinsics: Mapping[str, Pose2]) -> MountedReadings:
        """Return the readings of the sensors whose fixed poses on the robot are known, by `sensor_names`."""
        known = np.array([name in extrinsics for name in readings.sensor_names] or [False])
        chosen = np.flatnonzero(known[readings.sensor])
        readings = readings.select(chosen[np.argsort(readings.stamp[chosen], kind='stable')])
        nowhere = Pose2(0.0, 0.0, 0.0)
        table = np.array([extrinsics.get(name, nowhere) for name in readings.sensor_names] or [nowhere], np.float64)
        forward, left, turn = mounted = table[readings.sensor].T
        yaw = readings.yaw - turn
        cos, sin = np.cos(yaw), np.sin(yaw)
        robot = np.stack([readings.x - cos * forward + sin * left, readings.y - sin * forward - cos * left, yaw])
        return cls(readings, robot, mounted)

    def __len__(self) -> int:
        return len(self.readings)

    def part(self, which: slice | NDArray[np.int64]) -> MountedReadings:
        """Return some of the readings."""
        return MountedReadings(self.readings.select(which), self.robot[:, which], self.extrinsics[:, which])

    def moving_part(self, most: int) -> MountedReadings:
        """Return the `most` consecutive readings with the most driving and turning, where wrong poses matter most."""
        count = len(self)
        if count <= most:
            return self
        x, y, yaw = self.robot
        steps = np.hypot(np.diff(x), np.diff(y)) + np.abs(np.diff(np.unwrap(yaw)))
        moved = np.concatenate([[0.0], np.cumsum(steps)])
        # turns of the path count as well, in case the yaw is wrong
        at, directions = self.travel()
        if len(at) > 1:
            turns = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(directions))))])
            moved += np.interp(np.arange(count), at, turns)
        first = int(np.argmax(moved[most - 1 :] - moved[: count - most + 1]))
        return self.part(slice(first, first + most))

    def randomly_thinned(self, most: int) -> MountedReadings:
        """Return at most this many of the readings (`randomly_thinned`)."""
        return self if len(self) <= most else self.part(_few(len(self), most))

    def travel(self) -> tuple[NDArray[np.int64], Floats]:
        """Return indices of readings between which the robot drove `STEP`, and the direction of travel, radians."""
        x, y, _ = self.robot
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        # not by a list of all steps, of which there are millions if odometry jumps to and fro
        at = np.flatnonzero(np.diff(np.floor(driven / STEP), prepend=0.0))
        return at[:-1], np.arctan2(np.diff(y[at]), np.diff(x[at]))

    def placed(self, robot: Floats | None = None, extrinsics: Floats | None = None) -> Readings:
        """Return the readings with other poses of the robot, or of the sensors on it."""
        x, y, yaw = self.robot if robot is None else robot
        forward, left, turn = self.extrinsics if extrinsics is None else extrinsics
        cos, sin = np.cos(yaw), np.sin(yaw)
        return replace(
            self.readings, x=x + cos * forward - sin * left, y=y + sin * forward + cos * left, yaw=yaw + turn
        )

    def shifted(self, seconds: float) -> Readings:
        """Return the readings as if measured this many seconds after their stamps."""
        stamp = (self.readings.stamp - self.readings.stamp[0]) / NANOSECONDS
        known, first = np.unique(stamp, return_index=True)
        columns = (self.robot[0], self.robot[1], np.unwrap(self.robot[2]))
        return self.placed(robot=np.stack([np.interp(stamp + seconds, known, column[first]) for column in columns]))

    def moved(self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Readings:
        """Return the readings with all sensors moved on the robot, metres, and each turned on the spot, radians."""
        return self.placed(extrinsics=self.extrinsics + np.array([[forward], [left], [turn]]))

    def scaled(self, factor: float) -> Readings:
        """Return the readings as if the robot drove that much farther, from the same place."""
        x, y, yaw = self.robot
        return self.placed(robot=np.stack([x[0] + factor * (x - x[0]), y[0] + factor * (y - y[0]), yaw]))

    def rotated(self, angle: float) -> Readings:
        """Return the readings with all sensors rotated about the origin of the robot's frame, radians."""
        forward, left, turn = self.extrinsics
        cos, sin = math.cos(angle), math.sin(angle)
        return self.placed(extrinsics=np.stack([cos * forward - sin * left, sin * forward + cos * left, turn + angle]))


class TrialMap(NamedTuple):
    """How well a small map explains its readings.

    Attributes
    ----------
    objective : float
        That of the maximum likelihood map, nats; -inf if the map would be too large.
    blocks : float64, shape (BLOCKS,)
        The log-likelihoods of blocks of successive readings, nats.
    echoes : float
        The log-likelihood of the echoes alone, nats.
    """

    objective: float
    blocks: Floats
    echoes: float


def randomly_thinned(readings: Readings, most: int) -> Readings:
    """Return at most this many readings, chosen at random, so that no sensor is preferred."""
    return readings if len(readings) <= most else readings.select(_few(len(readings), most))


def _few(count: int, most: int) -> NDArray[np.int64]:
    """Return `most` of the indices below `count`, in order."""
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def coarse_parameters(parameters: Parameters, readings: Readings) -> Parameters:
    """Return the parameters of the small maps, with coarse cells if ranges are long."""
    reach = float(np.quantile(readings.z, 0.9))
    cell = max(parameters.grid.resolution, CELL, reach / REACH)
    return replace(parameters, grid=replace(parameters.grid, resolution=cell))


def trial_map(readings: Readings, parameters: Parameters) -> TrialMap:
    """Make the maximum likelihood map of readings."""
    readings = in_canonical_order(readings)
    try:
        grid = map_grid(readings, parameters)
    except InputError:
        return TrialMap(-math.inf, np.zeros(BLOCKS), 0.0)
    search = parameters.search
    evidence = Evidence(grid, parameters.model, memory_for_pairs(parameters), search.threads or cores())
    evidence.extend(readings)
    found = Search(evidence, search, traversed_cells(readings, grid).ravel()).run(lambda progress: None)
    each = evidence.log_likelihoods
    by_time = each[np.argsort(readings.stamp, kind='stable')]
    blocks = np.array([block.sum() for block in np.array_split(by_time, BLOCKS)])
    objective = float(evidence.tempered_log_likelihood + found.log_prior)
    return TrialMap(objective, blocks, float(each[readings.echo].sum()))
