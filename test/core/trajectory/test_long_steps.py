"""Steps of odometry that are jumps or doubtful, judged only by their length and time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.trajectory.jumps import doubtful_steps, jumps, since_jump
from forward_grid_mapper.core.trajectory.windows import Odometry


@pytest.mark.parametrize('seed', range(10))
def test_step_faster_than_any_robot_is_a_jump(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seconds = rng.choice([0.01, 0.1, 1.0, 10.0], 200)
    size = np.where(rng.random(200) < 0.07, 1.0, 0.1)
    pose = np.cumsum(rng.normal(0.0, 1.0, (200, 3)) * np.stack([size, size, 0 * size + 1.5], 1), 0)
    odometry = Odometry.of(np.cumsum(np.round(seconds * 1e9)).astype(np.int64), pose)
    far = [0.0] + [math.dist(pose[k - 1, :2], pose[k, :2]) for k in range(1, 200)]
    longest = max(2 * float(np.quantile(far[1:], 0.9)), 1.0)
    # the speeds of these steps are too large for a robot, so 3 m/s is the limit for driving
    assert 2 * np.quantile([far[k] / seconds[k] for k in range(1, 200)], 0.9) > 3.0
    gap = max(2.0, 4 * float(np.median(seconds[1:])))
    expected, doubtful = [], []
    for k in range(1, 200):
        turn = abs(math.remainder(pose[k, 2] - pose[k - 1, 2], 2 * math.pi))
        driven = far[k] <= longest or (far[k] <= 3.0 * seconds[k] and seconds[k] <= gap)
        if far[k] > longest or (turn > 0.5 and turn / seconds[k] > 2 * math.pi):
            (doubtful if driven else expected).append(k)
    assert expected and doubtful
    assert jumps(odometry).tolist() == expected
    assert doubtful_steps(odometry).tolist() == doubtful
    assert since_jump(odometry).stamp[0] == odometry.stamp[expected[-1]]


@pytest.mark.parametrize(
    ('far', 'seconds', 'jump'),
    [(1.1, 1.2, False), (1.1, 1.0, True), (1.9, 1.95, False), (2.2, 1.9, True), (1.9, 2.1, True), (0.9, 0.01, False)],
)
def test_long_step_is_a_jump_for_a_slow_robot_or_after_a_gap(far: float, seconds: float, jump: bool) -> None:
    # 0.5 m/s, ten poses a second, and one long step
    x = np.r_[np.arange(50) * 0.05, 49 * 0.05 + far + np.arange(50) * 0.05]
    since = np.r_[np.arange(50) * 0.1, 4.9 + seconds + np.arange(50) * 0.1]
    odometry = Odometry.of(np.round(since * 1e9).astype(np.int64), np.stack([x, 0 * x, 0 * x], 1))
    assert jumps(odometry).tolist() == ([50] if jump else [])
    assert doubtful_steps(odometry).tolist() == ([50] if not jump and far > 1.0 else [])


@pytest.mark.parametrize(('seconds', 'jump'), [(0.1, True), (0.3, True), (0.4, False), (1.0, False)])
def test_long_step_of_two_poses_is_driving_only_if_messages_are_rare(seconds: float, jump: bool) -> None:
    stamp = np.array([0, round(seconds * 1e9)], np.int64)
    odometry = Odometry.of(stamp, np.array([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]]))
    assert jumps(odometry).tolist() == ([1] if jump else [])
    assert doubtful_steps(odometry).tolist() == ([] if jump else [1])


@pytest.mark.parametrize('count', [2, 5, 6, 12, 19, 30])
def test_short_drive_with_one_message_a_second_has_no_false_jumps(count: int) -> None:
    stamp, x = np.arange(count + 1) * 1_000_000_000, 1.2 * np.arange(count + 1)
    assert not len(jumps(Odometry.of(stamp, np.stack([x, 0 * x, 0 * x], 1))))
    # except a real jump
    x[count // 2 + 1 :] += 5.0
    assert jumps(Odometry.of(stamp, np.stack([x, 0 * x, 0 * x], 1))).tolist() == [count // 2 + 1]


@pytest.mark.parametrize('moves', [0, 1, 4, 10])
def test_jump_of_a_robot_that_hardly_moved_is_found(moves: int) -> None:
    # fifty messages a second of a robot at standstill, except some small steps
    x = np.zeros(3000)
    x[100 : 100 + moves] = 0.01
    x = np.cumsum(x)
    x[2000:] += 1.5
    odometry = Odometry.of(np.arange(3000) * 20_000_000, np.stack([x, 0 * x, 0 * x], 1))
    assert jumps(odometry).tolist() == [2000]


@pytest.mark.parametrize('tremble', [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize('driven', [1, 4, 60])
def test_robot_that_stood_long_drives_with_one_message_a_second(driven: int, tremble: float) -> None:
    x = np.r_[np.zeros(600), 1.2 * np.arange(1, driven + 1)]
    pose = np.stack([x, 0 * x, 0 * x], 1)
    pose[:, :2] += np.random.default_rng(0).normal(0.0, tremble, (len(x), 2))
    odometry = Odometry.of(np.arange(len(x)) * 1_000_000_000, pose)
    assert not len(jumps(odometry))
    # a few steps show how fast the robot may drive, many steps that they are usual
    assert driven < 60 or not len(doubtful_steps(odometry))
    # but its odometry may jump
    pose[600:, 0] += 5.0
    assert jumps(Odometry.of(np.arange(len(x)) * 1_000_000_000, pose)).tolist() == [600]


def test_step_after_a_gap_at_standstill_is_a_jump() -> None:
    # fifty messages a second, and none for one and a half seconds
    pose = np.zeros((200, 3))
    pose[100:, 0] = 1.5
    stamp = np.arange(200) * 20_000_000
    stamp[100:] += 1_500_000_000
    assert jumps(Odometry.of(stamp, pose)).tolist() == [100]
