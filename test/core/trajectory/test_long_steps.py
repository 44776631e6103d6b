"""Steps of odometry that are jumps or doubtful, judged only by their length and time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.trajectory.jumps import doubtful_steps, jumps, since_jump
from forward_grid_mapper.core.trajectory.windows import Odometry


def moves_around(odometry: Odometry, k: int) -> bool:
    """Whether the robot moves by 0.05 in the second before the step to pose k, and in that after it."""
    stamp, pose = odometry.stamp, odometry.pose
    if k < 2 or k == len(stamp) - 1:
        return False
    first = min([j for j in range(k) if stamp[j] >= stamp[k - 1] - 1e9] + [k - 2])
    last = max([j for j in range(k, len(stamp)) if stamp[j] <= stamp[k] + 1e9] + [k + 1])
    ends = (pose[first], pose[k - 1]), (pose[k], pose[last])
    return all(math.dist(a[:2], b[:2]) >= 0.05 or abs(b[2] - a[2]) >= 0.05 for a, b in ends)


@pytest.mark.parametrize('seed', range(10))
def test_step_faster_than_any_robot_is_a_jump(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seconds = rng.choice([0.01, 0.1, 1.0, 10.0], 200)
    size = np.where(rng.random(200) < 0.07, 2.0, 0.1)
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
        driven = far[k] <= longest or far[k] <= 3.0 * seconds[k]
        if far[k] > longest and driven and seconds[k] > gap and moves_around(odometry, k):
            continue
        if far[k] > longest or (turn > 0.5 and turn / seconds[k] > 2 * math.pi):
            (doubtful if driven else expected).append(k)
    assert expected and doubtful
    assert jumps(odometry).tolist() == expected
    assert doubtful_steps(odometry).tolist() == doubtful
    assert since_jump(odometry).stamp[0] == odometry.stamp[expected[-1]]


@pytest.mark.parametrize(
    ('far', 'seconds', 'jump'),
    [(1.1, 1.2, False), (1.1, 1.0, True), (1.9, 1.95, False), (2.2, 1.9, True), (0.9, 0.01, False)],
)
def test_long_step_is_a_jump_for_a_slow_robot(far: float, seconds: float, jump: bool) -> None:
    # 0.5 m/s, ten poses a second, and one long step
    x = np.r_[np.arange(50) * 0.05, 49 * 0.05 + far + np.arange(50) * 0.05]
    since = np.r_[np.arange(50) * 0.1, 4.9 + seconds + np.arange(50) * 0.1]
    odometry = Odometry.of(np.round(since * 1e9).astype(np.int64), np.stack([x, 0 * x, 0 * x], 1))
    assert jumps(odometry).tolist() == ([50] if jump else [])
    assert doubtful_steps(odometry).tolist() == ([50] if not jump and far > 1.0 else [])


def with_gap(far: float, seconds: float, rate: float, before: float, after: float) -> Odometry:
    """Odometry of a robot that drives 0.5 m/s, except in this many seconds before and after a step of `far` metres."""
    count, stand, moves = round(60 * rate), [round(lasts * rate) for lasts in (before, after)], 0.5 / rate
    x = [np.r_[np.arange(count) * moves, np.full(stand[0], (count - 1) * moves)]]
    x.append(x[0][-1] + far + np.r_[np.zeros(stand[1]), np.arange(count) * moves])
    since = [np.arange(len(x[0])) / rate]
    since.append(since[0][-1] + seconds + np.arange(len(x[1])) / rate)
    along = np.concatenate(x)
    return Odometry.of(
        np.round(np.concatenate(since) * 1e9).astype(np.int64), np.stack([along, 0 * along, 0 * along], 1)
    )


@pytest.mark.parametrize('rate', [0.7, 1.0, 10.0, 50.0])
@pytest.mark.parametrize(
    ('far', 'seconds', 'before', 'after', 'found'),
    [
        (1.4, 3.5, 0.0, 0.0, 'driven'),
        (2.4, 10.0, 0.0, 0.0, 'driven'),
        (12.0, 60.0, 0.0, 0.0, 'driven'),
        (9.9, 10.0, 0.0, 0.0, 'driven'),
        (10.3, 10.0, 0.0, 0.0, 'jump'),
        (2.4, 10.0, 20.0, 0.0, 'doubtful'),
        (2.4, 10.0, 0.0, 20.0, 'doubtful'),
        (2.4, 10.0, 20.0, 20.0, 'doubtful'),
        (0.1, 10.0, 20.0, 20.0, 'driven'),
    ],
)
def test_robot_may_have_driven_while_messages_are_missing(
    far: float, seconds: float, before: float, after: float, found: str, rate: float
) -> None:
    odometry = with_gap(far, seconds, rate, before, after)
    at = int(np.argmax(np.diff(odometry.stamp))) + 1
    if seconds < 4.0 / rate:
        # odometry is rare, and no messages are missing
        assert not len(jumps(odometry))
        return
    assert jumps(odometry).tolist() == ([at] if found == 'jump' else [])
    assert doubtful_steps(odometry).tolist() == ([at] if found == 'doubtful' else [])
    # nothing follows the step, as in the node just after it
    assert jumps(Odometry(odometry.stamp[: at + 1], odometry.pose[: at + 1])).tolist() == (
        [at] if found == 'jump' else []
    )


@pytest.mark.parametrize('stood', [0.0, 20.0])
def test_odometry_at_zero_after_missing_messages_is_a_jump(stood: float) -> None:
    odometry = with_gap(0.0, 10.0, 10.0, stood, stood)
    at = int(np.argmax(np.diff(odometry.stamp))) + 1
    pose = odometry.pose.copy()
    pose[at:] -= pose[at]
    pose[:at, 0] -= 20.0
    # by its length, the robot may have driven the step
    assert 1.0 < abs(pose[at - 1, 0]) < 10.0
    restarted = Odometry.of(odometry.stamp, pose)
    assert jumps(restarted).tolist() == [at] and not len(doubtful_steps(restarted))


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
