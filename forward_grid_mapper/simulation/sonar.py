"""Simulated sonars on a robot.

A cone is a fan of rays, and the reading is the shortest ray that returns. Rough walls and people reflect every ray. A
smooth wall reflects only rays within 20° of its normal and absorbs the others; neighbouring rays of the same cone that
miss it may still return. If the *axis* of the cone hits a smooth wall at a larger angle, sound that is reflected
specularly returns on the same path in 30 % of the readings, if an object within range reflects it: a ghost, at the
length of this path. The first echo counts. So of the readings without a direct echo, 70 % have none, and also those
without an object on the specular path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.common.readings import Floats
from ..core.messages.message_types import Pose2
from .rays import NOTHING, cast, cast_discs
from .world import World

RAYS = 31  # half a degree apart in a cone of 15°: the nearest point of a wall is met to 1e-5 of its distance
SMOOTH_ECHO = math.radians(20.0)
GHOST_SHARE = 0.3
PERSON_RADIUS = 0.25


@dataclass(frozen=True)
class SonarArray:
    """Sonars on a circle around the robot's centre, each pointing outwards.

    Attributes
    ----------
    yaws : tuple of float
        Directions in base_link, radians.
    radius : float
        Distance of the sonars from the centre, metres.
    field_of_view : float
        Full opening angle, radians.
    max_range, min_range : float
        Metres; an echo from farther than `max_range` is not reported.
    """

    yaws: tuple[float, ...]
    radius: float
    field_of_view: float
    max_range: float
    min_range: float

    @property
    def names(self) -> tuple[str, ...]:
        """Frames of the sonars, `sonar_00` and so on."""
        return tuple(f'sonar_{k:02d}' for k in range(len(self.yaws)))

    @property
    def extrinsics(self) -> tuple[tuple[str, Pose2], ...]:
        """Frame and pose in base_link of each sonar."""
        poses = (Pose2(self.radius * math.cos(yaw), self.radius * math.sin(yaw), yaw) for yaw in self.yaws)
        return tuple(zip(self.names, poses, strict=True))

    def poses(self, robot: Floats) -> Floats:
        """Return the sonars' poses in the map frame for the robot's, both x, y, yaw.

        Parameters
        ----------
        robot : float64, shape (T, 3)
            Metres, radians.

        Returns
        -------
        float64, shape (T, n, 3)
        """
        extrinsic = np.array([pose for _, pose in self.extrinsics])
        cos, sin = np.cos(robot[:, 2:]), np.sin(robot[:, 2:])
        x = robot[:, :1] + cos * extrinsic[:, 0] - sin * extrinsic[:, 1]
        y = robot[:, 1:2] + sin * extrinsic[:, 0] + cos * extrinsic[:, 1]
        return np.stack([x, y, robot[:, 2:] + extrinsic[:, 2]], axis=2)


def sonar_ring(
    count: int = 24,
    radius: float = 0.25,
    field_of_view: float = math.radians(15.0),
    max_range: float = 6.0,
    min_range: float = 0.1,
) -> SonarArray:
    """Return `count` evenly spaced sonars, the first pointing ahead; units as in `SonarArray`."""
    yaws = (math.remainder(math.tau * k / count, math.tau) for k in range(count))
    return SonarArray(tuple(yaws), radius, field_of_view, max_range, min_range)


def front_array(
    radius: float = 0.2,
    field_of_view: float = math.radians(15.0),
    max_range: float = 5.0,
    min_range: float = 0.1,
) -> SonarArray:
    """Return the eight sonars of a small research robot, from its left side over its front to its right side."""
    yaws = tuple(math.radians(angle) for angle in (90, 50, 30, 10, -10, -30, -50, -90))
    return SonarArray(yaws, radius, field_of_view, max_range, min_range)


@dataclass(frozen=True)
class NoiseModel:
    """Errors of a reading that do not depend on the world.

    Attributes
    ----------
    sigma : float
        Standard deviation of the range of an echo, metres.
    p_random : float
        Probability of a range drawn evenly from min_range to max_range.
    p_lost : float
        Probability that an echo is lost.
    """

    sigma: float = 0.0
    p_random: float = 0.0
    p_lost: float = 0.0


NOISE_FREE = NoiseModel()
#: The causes of the paper's sensor model: Gaussian noise and 5 % random readings.
NOISY = NoiseModel(sigma=0.05, p_random=0.05)


def measure(
    world: World,
    sonars: SonarArray,
    robot: Floats,
    noise: NoiseModel,
    rng: np.random.Generator,
    people: Floats | None = None,
) -> Floats:
    """Return one sweep of all sonars per robot pose.

    Parameters
    ----------
    robot : float64, shape (T, 3)
        Poses in the map frame, metres and radians.
    people : float64, shape (T, 2), optional
        Position of a person during each sweep, metres in the map frame; NaN for none.

    Returns
    -------
    float64, shape (T, n)
        Ranges in metres, +inf where there was no echo. Echoes from nearer than min_range are reported at min_range.
    """
    poses = sonars.poses(robot).reshape(-1, 3)
    draws = rng.random((3, len(poses)))
    error = noise.sigma * rng.standard_normal(len(poses))
    discs = None if people is None else np.repeat(people, len(sonars.yaws), axis=0)
    ranges = _true_ranges(world, sonars, poses, discs, draws[0] < GHOST_SHARE) + error
    random = sonars.min_range + draws[1] * (sonars.max_range - sonars.min_range)
    ranges = np.where(draws[2] < noise.p_random, random, np.maximum(ranges, sonars.min_range))
    lost = (ranges >= sonars.max_range) | (draws[2] >= 1.0 - noise.p_lost)
    return np.where(lost, np.inf, ranges).reshape(len(robot), -1)


def _true_ranges(
    world: World, sonars: SonarArray, poses: Floats, discs: Floats | None, may_ghost: NDArray[np.bool_]
) -> Floats:
    """Return the range of the first echo of each cone, direct or by reflection, +inf if there is none; shape (N,)."""
    half = sonars.field_of_view / 2
    angles = poses[:, 2:] + np.linspace(-half, half, RAYS)
    distance, hit, echo = _echoes(world, poses[:, :2], angles, discs, sonars.max_range)
    ranges: Floats = np.where(echo, distance, np.inf).min(axis=1)

    axis = RAYS // 2
    ghost = np.flatnonzero(may_ghost & ~echo[:, axis] & (hit[:, axis] != NOTHING))
    if len(ghost):
        heading, leg = angles[ghost, axis], distance[ghost, axis]
        x0, y0, x1, y1 = world.segments[hit[ghost, axis]].T
        mirrored = (2.0 * np.arctan2(y1 - y0, x1 - x0) - heading)[:, None]
        # slightly before the wall, so that the reflected ray does not hit the same wall again
        along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        start = poses[ghost, :2] + (leg - 1e-6)[:, None] * along
        rest, _, back = _echoes(world, start, mirrored, None if discs is None else discs[ghost], sonars.max_range)
        whole = np.where(back, rest, np.inf)[:, 0] + leg
        ranges[ghost] = np.minimum(ranges[ghost], whole)
    return ranges


def _echoes(
    world: World, origins: Floats, angles: Floats, discs: Floats | None, reach: float
) -> tuple[Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Return each ray's length, the wall it hits (`NOTHING` for a person or none), and whether it returns."""
    distance, hit = cast(origins, angles, world.segments, reach)
    x0, y0, x1, y1 = world.segments.T
    wall = np.arctan2(y1 - y0, x1 - x0)
    oblique = np.abs(np.sin(angles - wall[hit])) < math.cos(SMOOTH_ECHO)
    echo = (hit != NOTHING) & ~(world.smooth[hit] & oblique)
    if discs is not None:
        person = cast_discs(origins, angles, discs, PERSON_RADIUS)
        closer = (person < distance) & (person <= reach)
        distance = np.where(closer, person, distance)
        hit = np.where(closer, NOTHING, hit)
        echo |= closer
    return distance, hit, echo
