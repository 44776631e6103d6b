"""Drives through a world, recorded like those of a robot: odometry and range messages, with ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.common.readings import Floats, Readings
from ..core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from .rays import blocked, cast
from .sonar import NOISE_FREE, NOISY, PERSON_RADIUS, NoiseModel, SonarArray, measure, sonar_ring
from .trajectory import Trajectory
from .world import World, building_tour, building_world, corridor_world, door_world, doors_world

ODOM_FRAME = 'odom'
BASE_FRAME = 'base_link'
START = 1_700_000_000 * NANOSECONDS
ODOMETRY_RATE = 50.0  # Hz
_PERSON_DISTANCE = 1.0  # metres behind the robot


@dataclass(frozen=True)
class Recording:
    """The recording of a drive. The odometry is exact: its frame is that of the world.

    Attributes
    ----------
    world : World
    extrinsics : tuple of (str, Pose2)
        Frame and pose in `BASE_FRAME` of each sonar.
    odometry : list of OdometryMessage
        In order of time; one at each sweep, so interpolation is exact as well.
    ranges : list of RangeMessage
        Sweep by sweep, in the order of `extrinsics`; the sonars of a sweep fire at the same time.
    readings : Readings
        The same measurements, in the same order, with the exact poses of the sonars.
    robot : float64, shape (T, 3)
        Pose of the robot in `ODOM_FRAME` at each sweep, metres and radians.
    """

    world: World
    extrinsics: tuple[tuple[str, Pose2], ...]
    odometry: list[OdometryMessage]
    ranges: list[RangeMessage]
    readings: Readings
    robot: Floats


def drive(
    world: World,
    waypoints: Floats,
    sweep_spacing: float,
    sonars: SonarArray | None = None,
    noise: NoiseModel = NOISE_FREE,
    seed: int = 0,
    person: bool = False,
) -> Recording:
    """Drive straight from waypoint to waypoint, with a sweep of all sonars every `sweep_spacing` metres.

    Parameters
    ----------
    waypoints : float64, shape (P, 2)
        Metres in the map frame.
    sonars : SonarArray, optional
        Default: a ring of 24.
    person : bool
        Whether a person walks about a metre behind the robot; people are not on the true map.

    Raises
    ------
    ValueError
        If the path leads through a wall.
    """
    length = Trajectory.through(np.asarray(waypoints, np.float64)).length
    return drive_sweeps(world, waypoints, np.arange(0.0, length + 1e-9, sweep_spacing), sonars, noise, seed, person)


def drive_sweeps(
    world: World,
    waypoints: Floats,
    sweeps: Floats,
    sonars: SonarArray | None = None,
    noise: NoiseModel = NOISE_FREE,
    seed: int = 0,
    person: bool = False,
    walker: Floats | None = None,
    start: int = START,
    rate: float = ODOMETRY_RATE,
) -> Recording:
    """Drive as in `drive`, with a sweep at each of the increasing distances `sweeps` along the path, metres.

    `walker`, shape (T, 2), is the position of another person at each sweep, metres; NaN for none. `start` is the stamp
    at the start, nanoseconds, and `rate` that of odometry between the sweeps, Hz.
    """
    waypoints = np.asarray(waypoints, np.float64)
    if blocked(waypoints, world.segments):
        raise ValueError(f'the path leads through a wall of world {world.name}')
    sonars = sonar_ring() if sonars is None else sonars
    rng = np.random.default_rng(seed)
    trajectory = Trajectory.through(waypoints)
    ticks = np.round(trajectory.time_at(np.asarray(sweeps, np.float64)) * NANOSECONDS).astype(np.int64)
    robot = trajectory.pose_at(ticks / NANOSECONDS)
    people = _people(world, robot, rng) if person else walker
    ranges = measure(world, sonars, robot, noise, rng, people)
    stamps = start + ticks
    return Recording(
        world,
        sonars.extrinsics,
        _odometry(trajectory, ticks, start, rate),
        _range_messages(sonars, stamps, ranges),
        _readings(sonars, stamps, robot, ranges),
        robot,
    )


def door_drive(
    n: int = 1, noise: NoiseModel = NOISE_FREE, seed: int = 0, sonars: SonarArray | None = None
) -> Recording:
    """Pass the door of `door_world` with exactly `n` sweeps in front of it, as in the paper's Fig. 4.

    These sweeps are within 0.1 m of the door's axis; the others are 0.27 m apart, and at least 1 m away from it.
    """
    world = door_world()
    door = world.doors[0]
    start, end, y = 1.05, 11.15, 3.75
    passing = door.x - start
    regular = np.arange(0.0, end - start, 0.27)
    front = passing + (np.linspace(-0.1, 0.1, n) if n > 1 else np.zeros(n))
    sweeps = np.sort(np.concatenate([regular[np.abs(regular - passing) >= 1.0], front]))
    return drive_sweeps(world, np.array([[start, y], [end, y]]), sweeps, sonars, noise, seed)


def passing_drive(seed: int = 0, noise: NoiseModel = NOISY, sonars: SonarArray | None = None) -> Recording:
    """Drive along `doors_world` while a person comes from the other end and walks by, as in the paper's Fig. 5.

    The person walks twice as fast as the robot, on the other side of the corridor, and leaves where the robot started.
    """
    world = doors_world()
    start, end, y = 1.05, 10.35, 5.85
    sweeps = np.arange(0.0, end - start, 0.1)
    x = end - 2.0 * sweeps
    walker = np.stack([np.where(x > start, x, np.nan), np.full_like(x, y + 0.65)], axis=1)
    return drive_sweeps(world, np.array([[start, y], [end, y]]), sweeps, sonars, noise, seed, walker=walker)


def corridor_drive(
    seed: int = 0,
    passes: int = 1,
    noise: NoiseModel = NOISY,
    person: bool = True,
    sonars: SonarArray | None = None,
) -> Recording:
    """Drive `passes` times along `corridor_world`, to and fro: 500 sweeps or, with 24 sonars, 12 000 readings each."""
    world = corridor_world()
    ends = np.array([[2.45, 6.55], [61.65, 6.55]])
    waypoints = ends[np.arange(passes + 1) % 2]
    count = 500 * passes
    sweeps = (np.arange(count) + 0.5) / 500 * float(ends[1, 0] - ends[0, 0])
    return drive_sweeps(world, waypoints, sweeps, sonars, noise, seed, person)


def building_drive(
    seed: int = 0,
    laps: int = 5,
    noise: NoiseModel = NOISY,
    person: bool = False,
    sonars: SonarArray | None = None,
) -> Recording:
    """Drive `laps` times through every room of `building_world`, on varying paths: 1750 sweeps each.

    By default 16 sonars with cones of 30 degrees, which gives 28 000 readings a lap.
    """
    world, tour = building_world(), building_tour()
    rng = np.random.default_rng([seed, laps])
    tours = [tour[:-1] + rng.uniform(-0.05, 0.05, tour[:-1].shape) for _ in range(laps)]
    waypoints = np.concatenate([*tours, tour[-1:]])
    length, count = Trajectory.through(waypoints).length, 1750 * laps
    sweeps = (np.arange(count) + 0.5) / count * length
    sonars = sonars or sonar_ring(16, field_of_view=math.radians(30.0))
    return drive_sweeps(world, waypoints, sweeps, sonars, noise, seed, person)


def _people(world: World, robot: Floats, rng: np.random.Generator) -> Floats:
    """Return the person's position at each sweep, shape (T, 2), NaN if there is no space behind the robot."""
    distance = np.clip(rng.normal(_PERSON_DISTANCE, 0.1, len(robot)), 0.7, 1.3)
    behind = robot[:, 2] + np.pi + rng.normal(0.0, 0.1, len(robot))
    free, _ = cast(robot[:, :2], behind[:, None], world.segments, 3.0)
    distance = np.where(distance + PERSON_RADIUS < free[:, 0], distance, np.nan)
    people: Floats = robot[:, :2] + distance[:, None] * np.stack([np.cos(behind), np.sin(behind)], axis=1)
    return people


def _odometry(trajectory: Trajectory, sweeps: NDArray[np.int64], start: int, rate: float) -> list[OdometryMessage]:
    regular = np.arange(0.0, trajectory.time[-1], 1.0 / rate)
    # motion is linear between corners: with messages at corners, interpolation is exact
    seconds = np.concatenate([regular, trajectory.time])
    ticks = np.union1d(np.round(seconds * NANOSECONDS).astype(np.int64), sweeps)
    poses = trajectory.pose_at(ticks / NANOSECONDS)
    stamps = (start + ticks).tolist()
    return [
        OdometryMessage(stamp, ODOM_FRAME, BASE_FRAME, Pose2(*pose))
        for stamp, pose in zip(stamps, poses.tolist(), strict=True)
    ]


def _range_messages(sonars: SonarArray, stamps: NDArray[np.int64], ranges: Floats) -> list[RangeMessage]:
    limits = (sonars.min_range, sonars.max_range, sonars.field_of_view)
    return [
        RangeMessage(stamp, name, value, *limits)
        for stamp, sweep in zip(stamps.tolist(), ranges.tolist(), strict=True)
        for name, value in zip(sonars.names, sweep, strict=True)
    ]


def _readings(sonars: SonarArray, stamps: NDArray[np.int64], robot: Floats, ranges: Floats) -> Readings:
    count = len(sonars.yaws)
    x, y, yaw = sonars.poses(robot).reshape(-1, 3).T
    return Readings.from_columns(
        sonars.names,
        x=x,
        y=y,
        yaw=yaw,
        z=np.minimum(ranges.ravel(), sonars.max_range),
        z_max=sonars.max_range,
        half_angle=sonars.field_of_view / 2,
        stamp=np.repeat(stamps, count),
        sensor=np.tile(np.arange(count), len(stamps)),
    )
