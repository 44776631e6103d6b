"""Drift of simulated odometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, Drift, drifted, with_drift
from forward_grid_mapper.simulation.drive import door_drive

NONE = Drift(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def straight(metres: float) -> np.ndarray:
    x = np.arange(0.0, metres, 0.02)
    return np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])


def test_odometry_without_drift_is_unchanged() -> None:
    poses = np.cumsum(np.random.default_rng(0).normal(0, 0.05, (200, 3)), axis=0)
    assert drifted(poses, NONE, 0) == pytest.approx(poses)


def test_drift_does_not_depend_on_whole_turns_of_the_yaw() -> None:
    angle = np.linspace(0.0, 4 * np.pi, 400)
    poses = np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2])
    wrapped = poses.copy()
    wrapped[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    expected, found = (drifted(each, LEVELS['high'], 1) for each in (poses, wrapped))
    assert found == pytest.approx(expected)


def test_yaw_error_grows_with_the_square_root_of_the_distance() -> None:
    level = Drift(math.radians(2.0), 0.0, 0.0, 0.0, 0.0)
    ends = [drifted(straight(way), level, seed)[-1, 2] for way in (4.0, 36.0) for seed in range(150)]
    short, long = np.std(ends[:150]), np.std(ends[150:])
    assert short == pytest.approx(math.radians(4.0), rel=0.2)
    assert long == pytest.approx(math.radians(12.0), rel=0.2)


def test_noise_of_turns_grows_with_the_square_root_of_the_angle() -> None:
    level = Drift(0.0, 0.0, 0.0, 0.0, 0.0, turn_noise=math.radians(4.0))
    assert drifted(straight(20.0), level, 0) == pytest.approx(straight(20.0))
    for radians, sigma in ((1.0, 4.0), (9.0, 12.0)):
        # there and back: both directions count
        yaw = np.concatenate([np.linspace(0.0, radians / 2, 50), np.linspace(radians / 2, 0.0, 50)[1:]])
        poses = np.column_stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw])
        ends = [drifted(poses, level, seed)[-1, 2] for seed in range(150)]
        assert np.std(ends) == pytest.approx(math.radians(sigma), rel=0.2)


def test_noise_aside_is_at_right_angles_to_the_drive() -> None:
    level = Drift(0.0, 0.0, 0.0, 0.0, 0.0, side_noise=0.03)
    ends = np.array([drifted(straight(16.0), level, seed)[-1] for seed in range(150)])
    assert ends[:, 1].std() == pytest.approx(0.12, rel=0.2)
    assert ends[:, 0] == pytest.approx(straight(16.0)[-1, 0])


def test_bias_and_scale_are_constant_over_a_drive() -> None:
    level = Drift(0.0, 0.0, 0.02, 0.05, 0.0)
    poses = drifted(straight(10.0), level, 3)
    turns = np.diff(poses[:, 2])
    assert turns.std() < 1e-9 < abs(turns.mean())
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps.std() < 1e-9
    assert steps.mean() != pytest.approx(0.02, rel=1e-3)


def test_readings_of_a_drifted_drive_keep_their_pose_on_the_robot() -> None:
    exact = door_drive()
    bent = with_drift(exact, LEVELS['high'], 1)
    assert [m.stamp for m in bent.odometry] == [m.stamp for m in exact.odometry]
    mounts = []
    for recording in (exact, bent):
        stamps = np.array([m.stamp for m in recording.odometry])
        odometry = Odometry.of(stamps, np.array([m.pose for m in recording.odometry]))
        r = recording.readings
        mounts.append(relative(odometry.at(r.stamp), np.stack([r.x, r.y, r.yaw], 1)))
    assert mounts[1][:, :2] == pytest.approx(mounts[0][:, :2], abs=1e-9)
    assert np.abs(compose(np.zeros(3), mounts[1]) - mounts[0])[:, 2].max() < 1e-9
    assert np.array_equal(bent.readings.z, exact.readings.z)
