"""Drift of wheel odometry: adds errors to the exact odometry of a simulated drive.

Each small motion is measured in the robot's frame, travel, aside and turn, and summed up with errors:

    travel' = travel · (1 + scale) + travel_noise · √progress
    aside'  = aside + side_noise · √progress
    turn'   = turn · (1 + turn_scale) + bias · travel + yaw_noise · √progress + turn_noise · √|turn|

where progress = travel + |turn| / 3, in metres and radians.

`scale`, `turn_scale`, `bias` and `heading` (the direction of driving in the frame of odometry) are drawn once for a
drive, since they depend on wheels and mounts. Noise is drawn for every 5 cm of progress, and that of turns for every
0.15 rad. Noise of the yaw has the heavy tails of wheel slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..core.common.readings import Floats
from ..core.messages.message_types import Pose2
from ..core.trajectory.windows import Odometry
from .drive import Recording

STEP = 0.05
"""Metres of progress for each draw of noise."""

TURN_STEP = 0.15
"""Radians for each draw of the noise of turns; they are as much progress as `STEP`."""

TAIL = 5.0
"""Degrees of freedom of Student's t for the noise of yaw; it has the stated variance."""


@dataclass(frozen=True)
class Drift:
    """Standard deviations of the errors of odometry: of noise, and of the values that are drawn once for a drive.

    Attributes
    ----------
    yaw_noise : float
        Radians a √metre.
    travel_noise : float
        Metres a √metre.
    bias : float
        Radians a metre.
    scale, turn_scale : float
        Of travel, and of turning.
    heading : float
        Radians.
    turn_noise : float
        Radians a √radian.
    side_noise : float
        At right angles to the direction of driving, metres a √metre.
    """

    yaw_noise: float
    travel_noise: float
    bias: float
    scale: float
    turn_scale: float = 0.01
    heading: float = 0.0
    turn_noise: float = 0.0
    side_noise: float = 0.0


LEVELS = {
    'low': Drift(math.radians(1.0), 0.01, math.radians(0.3), 0.01),
    'middle': Drift(math.radians(2.0), 0.015, math.radians(0.6), 0.015),
    'high': Drift(math.radians(3.0), 0.02, math.radians(1.0), 0.02),
    'wheels': Drift(math.radians(4.5), 0.02, math.radians(0.7), 0.03, 0.03, math.radians(1.3)),
    'turns': Drift(
        math.radians(1.0), 0.045, math.radians(0.3), 0.025, 0.03, math.radians(1.3), math.radians(8.0), 0.035
    ),
}
"""Levels by name. `wheels` has about as much noise of the yaw a metre as an old research robot beside a laser, and
`turns` has most of it in turns, as that robot does."""


def drifted(poses: Floats, drift: Drift, seed: int) -> Floats:
    """Return the drifting odometry for exact poses.

    Parameters
    ----------
    poses : float64, shape (M, 3)
        In order of time; metres, radians.
    drift : Drift
    seed : int

    Returns
    -------
    float64, shape (M, 3)
        It begins with the same pose.
    """
    rng = np.random.default_rng([seed, 77])
    bias, scale, turn_scale, heading = rng.standard_normal(4) * (
        drift.bias,
        drift.scale,
        drift.turn_scale,
        drift.heading,
    )
    yaw = np.unwrap(poses[:, 2])
    steps, turns = np.diff(poses[:, :2], axis=0), np.diff(yaw)
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    ahead, aside = c * steps[:, 0] + s * steps[:, 1], -s * steps[:, 0] + c * steps[:, 1]
    travel = np.hypot(ahead, aside)
    progress = np.concatenate([[0.0], np.cumsum(travel + np.abs(turns) * STEP / TURN_STEP)])
    count = int(progress[-1] / STEP) + 2
    noise_along = _random_walk(rng.standard_normal(count), drift.travel_noise, STEP, progress)
    noise_yaw = _random_walk(_heavy_tailed(rng, count), drift.yaw_noise, STEP, progress)
    # a generator of their own: the draws of the others do not depend on them
    rng, turned = np.random.default_rng([seed, 78]), np.concatenate([[0.0], np.cumsum(np.abs(turns))])
    noise_of_turns = _random_walk(
        _heavy_tailed(rng, int(turned[-1] / TURN_STEP) + 2), drift.turn_noise, TURN_STEP, turned
    )
    noise_aside = _random_walk(rng.standard_normal(count), drift.side_noise, STEP, progress)
    ahead, aside = ahead * (1.0 + scale) + noise_along, aside + noise_aside
    turns = turns * (1.0 + turn_scale) + bias * travel + noise_yaw + noise_of_turns
    measured = poses[0, 2] + np.concatenate([[0.0], np.cumsum(turns)])
    direction = measured[:-1] + turns / 2 - np.diff(yaw) / 2 + heading
    c, s = np.cos(direction), np.sin(direction)
    moved = np.stack([c * ahead - s * aside, s * ahead + c * aside], axis=1)
    return np.column_stack([np.concatenate([poses[:1, :2], poses[0, :2] + np.cumsum(moved, axis=0)]), measured])


def _heavy_tailed(rng: np.random.Generator, count: int) -> Floats:
    """Return draws from Student's t with a variance of 1, shape (count,)."""
    out: Floats = rng.standard_t(TAIL, count) / math.sqrt(TAIL / (TAIL - 2.0))
    return out


def _random_walk(draws: Floats, sigma: float, step: float, ends: Floats) -> Floats:
    """Return what a random walk adds between the places `ends`, shape (M,); it makes one draw for each `step`."""
    walk = np.concatenate([[0.0], np.cumsum(draws)]) * sigma * math.sqrt(step)
    out: Floats = np.diff(np.interp(ends, np.arange(len(walk)) * step, walk))
    return out


def with_drift(recording: Recording, drift: Drift, seed: int) -> Recording:
    """Return a recording with drifting odometry, and readings placed by it; `robot` keeps the true poses."""
    true = np.array([message.pose for message in recording.odometry], np.float64)
    true[:, 2] = np.unwrap(true[:, 2])
    measured = drifted(true, drift, seed)
    odometry = [
        message._replace(pose=Pose2(*pose)) for message, pose in zip(recording.odometry, measured.tolist(), strict=True)
    ]
    stamps = np.array([message.stamp for message in recording.odometry])
    readings = recording.readings
    seconds, knots = (readings.stamp - stamps[0]) * 1e-9, (stamps - stamps[0]) * 1e-9
    was, now = (np.stack([np.interp(seconds, knots, column) for column in poses.T]) for poses in (true, measured))
    turn = now[2] - was[2]
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = readings.x - was[0], readings.y - was[1]
    placed = replace(readings, x=now[0] + c * dx - s * dy, y=now[1] + s * dx + c * dy, yaw=readings.yaw + turn)
    return replace(recording, odometry=odometry, readings=placed)


def odometry_of(recording: Recording) -> Odometry:
    """Return the odometry of a recording."""
    poses = np.array([message.pose for message in recording.odometry], np.float64)
    return Odometry.of(np.array([message.stamp for message in recording.odometry], np.int64), poses)
