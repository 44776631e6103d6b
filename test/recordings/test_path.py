"""The length of the driven path, for odometry in any order."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.recordings.drive import alternation_note, jumps_note, length_between, length_of, path_of


def drive(order: np.ndarray, stamps: np.ndarray) -> PoseAssociator:
    """An associator that received the poses of a drive of ten metres in some order."""
    associator = PoseAssociator(lambda base, frame, stamp: None, patient=True)
    for k in order.tolist():
        pose = Pose2(0.1 * k, 0.5 * math.sin(0.02 * k), 0.0)
        associator.add_odometry(OdometryMessage(int(stamps[k]), 'odom', 'base_link', pose))
    return associator


def shuffled(seed: int, count: int) -> np.ndarray:
    """Indices of poses, up to eight messages out of order."""
    return np.argsort(np.arange(count) + np.random.default_rng(seed).uniform(0.0, 8.0, count))


@pytest.mark.parametrize('seed', range(5))
def test_length_with_poses_out_of_order_is_that_of_sorted_poses(seed: int) -> None:
    stamps = np.arange(1, 102) * 50_000_000
    straight, mixed = drive(np.arange(101), stamps), drive(shuffled(seed, 101), stamps)
    assert length_of(straight) == pytest.approx(10.0, abs=0.1)
    assert np.array_equal(path_of(mixed), path_of(straight))
    arrived = np.hypot(*np.diff(np.array(mixed.path), axis=0).T).sum()
    assert arrived > 1.5 * length_of(mixed), 'the sample is out of order'


def test_length_between_two_stamps_is_that_of_the_poses_between_them() -> None:
    stamps = np.arange(1, 102) * 50_000_000
    straight = drive(np.arange(101), stamps)
    assert length_between(straight, int(stamps[20]), int(stamps[50])) == pytest.approx(3.0, abs=0.1)
    assert length_between(straight, 0, int(stamps[-1])) == length_of(straight)


def test_path_of_poses_in_order_is_unchanged() -> None:
    associator = drive(np.arange(101), np.arange(1, 102) * 50_000_000)
    assert not associator.record.late
    assert np.array_equal(path_of(associator), np.array(associator.path))


def test_repeated_poses_do_not_change_the_path() -> None:
    stamps = np.arange(1, 102) * 50_000_000
    again = drive(np.repeat(np.arange(101), 2), stamps)
    assert again.record.late == 101
    assert np.array_equal(path_of(again), path_of(drive(np.arange(101), stamps)))


def test_length_after_a_jump_back_of_time_is_that_of_the_whole_drive() -> None:
    stamps = np.arange(1, 102) * 50_000_000
    stamps[60:] -= 3_000_000_000
    order = np.arange(101)
    order[[90, 91]] = 91, 90
    associator = drive(order, stamps)
    assert associator.time_jumps == 1 and associator.record.late
    assert length_of(associator) == pytest.approx(10.2, abs=0.1)


def test_length_of_no_pose_or_one_pose_is_zero() -> None:
    for count in (0, 1):
        associator = drive(np.arange(count), np.arange(1, 102) * 50_000_000)
        assert length_of(associator) == 0.0


def test_jump_is_not_part_of_the_length() -> None:
    associator = PoseAssociator(lambda base, frame, stamp: None, patient=True)
    for k in range(101):
        x = 0.1 * k + (30.0 if k > 40 else 0.0)
        associator.add_odometry(OdometryMessage((k + 1) * 50_000_000, 'odom', 'base_link', Pose2(x, 0.0, 0.0)))
    assert length_of(associator) == pytest.approx(9.9, abs=0.1)
    (note,) = jumps_note(associator)
    assert 'jumps once, by 30.1 m after 4 m' in note and '--refine-poses' in note
    # the distance over missing messages counts
    associator.add_odometry(OdometryMessage(20 * 10**9, 'odom', 'base_link', Pose2(44.0, 0.0, 0.0)))
    assert length_of(associator) == pytest.approx(13.9, abs=0.1)


def test_driving_and_poses_in_other_units_are_no_jumps() -> None:
    for metres, messages in ((0.1, 100), (2.5, 100), (100.0, 100), (0.0, 1)):
        associator = PoseAssociator(lambda base, frame, stamp: None, patient=True)
        for k in range(messages):
            # one second each: fast, and much too fast
            associator.add_odometry(OdometryMessage((k + 1) * 10**9, 'odom', 'base_link', Pose2(metres * k, 0.0, 0.0)))
        assert jumps_note(associator) == []


def poses_of(points: list[tuple[float, float]], period: float = 0.05) -> PoseAssociator:
    associator = PoseAssociator(lambda base, frame, stamp: None, patient=True)
    for k, (x, y) in enumerate(points):
        stamp = int((k + 1) * period * 1e9)
        associator.add_odometry(OdometryMessage(stamp, 'odom', 'base_link', Pose2(x, y, 0.0)))
    return associator


@pytest.mark.parametrize(('every', 'steps'), [(2, 99), (5, 40), (15, 14)])
def test_two_sources_of_poses_on_one_topic_give_a_warning(every: int, steps: int) -> None:
    points = [(0.02 * k, 0.5 * (k % every == every // 2)) for k in range(100)]
    (note,) = alternation_note(poses_of(points))
    assert f'by 0.50 m in {steps} of 99 steps; do two nodes publish' in note


def test_other_patterns_of_poses_give_no_warning_of_two_sources() -> None:
    generator = np.random.default_rng(0)
    fast = [(2.9 * 0.05 * (k if k < 50 else 100 - k), 0.0) for k in range(100)]
    noisy = [(0.02 * k + e, 0.0) for k, e in enumerate(generator.normal(0.0, 0.03, 100).tolist())]
    in_millimetres = [(50.0 * k, 0.0) for k in range(100)]
    one_outlier = [(0.02 * k + 2.0 * (k == 3), 0.0) for k in range(10)]
    jumped_once = [(0.02 * k + 2.0 * (k > 40), 0.0) for k in range(100)]
    for points in (fast, noisy, in_millimetres, one_outlier, jumped_once, [(0.0, 0.0)], []):
        assert alternation_note(poses_of(points)) == []
