"""Poses of the robot over time: interpolation, outliers, and the poses that are forgotten."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, Pose2
from forward_grid_mapper.core.messages.pose_history import (
    FASTEST,
    FEWEST,
    HISTORY,
    MOST_POSES,
    STRIDE,
    PoseHistory,
    interpolate,
)

SECOND = NANOSECONDS


def history(*poses: tuple[float, Pose2]) -> PoseHistory:
    made = PoseHistory()
    for seconds, pose in poses:
        made.add(round(seconds * SECOND), pose)
    return made


def test_last_two_poses_are_not_forgotten() -> None:
    made = history(*((float(second), Pose2(second, 0, 0)) for second in range(5)))
    made.forget_before(2 * SECOND)
    assert (len(made), made.at(SECOND, 1.0), made.at(2 * SECOND, 1.0)) == (3, 'before_odometry', Pose2(2, 0, 0))
    made.forget_before(9 * SECOND)
    assert (made.before, made.newest, len(made.record)) == (3 * SECOND, 4 * SECOND, 5)
    PoseHistory().forget_before(SECOND)


def test_yaw_is_interpolated_the_shorter_way() -> None:
    pose = interpolate(Pose2(0.0, 2.0, 3.1), Pose2(1.0, 4.0, -3.1), 0.25)
    assert pose == pytest.approx((0.25, 2.5, 3.1 + 0.25 * (2 * math.pi - 6.2)))


def test_poses_in_any_order_are_sorted_and_equal_stamps_replaced() -> None:
    made = history((2.0, Pose2(2, 0, 0)), (1.0, Pose2(1, 0, 0)), (1.5, Pose2(9, 0, 0)), (1.5, Pose2(1.5, 0, 0)))
    assert (len(made), made.newest) == (3, 2 * SECOND)
    assert made.at(round(1.25 * SECOND), 1.0) == pytest.approx((1.25, 0, 0))
    assert made.at(round(1.5 * SECOND), 0.001) == Pose2(1.5, 0, 0), 'an exact stamp bridges no gap'
    made.clear()
    assert (len(made), made.newest) == (0, None)


def test_stamp_without_pose_gives_a_reason() -> None:
    made = history((1.0, Pose2(0, 0, 0)), (3.0, Pose2(0, 0, 0)), (3.1, Pose2(11.5, 0, 0)), (3.2, Pose2(0.6, 0, 0)))
    assert made.at(SECOND - 1, 9.0) == 'before_odometry'
    assert made.at(0, 9.0) == 'zero_stamp'
    assert made.at(2 * SECOND, 1.9) == 'pose_gap'
    assert made.at(2 * SECOND, 2.0) == Pose2(0, 0, 0)
    assert made.at(round(3.05 * SECOND), 9.0) == 'pose_jump'
    assert isinstance(made.at(round(3.15 * SECOND), 9.0), Pose2), '10.9 m in 0.1 s: a drive and one correction'


def test_outlier_places_no_reading_even_at_its_own_stamp() -> None:
    made = history((1.0, Pose2(0, 0, 0)), (1.1, Pose2(600, 400, 0)), (1.2, Pose2(0.1, 0, 0)), (1.3, Pose2(0.2, 0, 0)))
    assert made.at(round(1.1 * SECOND), 1.0) == 'pose_jump'
    assert made.at(round(1.15 * SECOND), 1.0) == 'pose_jump'
    assert made.at(round(1.2 * SECOND), 1.0) == Pose2(0.1, 0, 0), 'back where it was before'
    assert made.at(round(1.3 * SECOND), 1.0) == Pose2(0.2, 0, 0)


def test_correction_of_odometry_rejects_readings_of_one_stamp() -> None:
    made = history(*((0.1 * k, Pose2(0.1 * k + (50.0 if k >= 5 else 0.0), 0, 0)) for k in range(10)))
    found = [made.at(round(0.1 * k * SECOND), 1.0) for k in range(10)]
    assert [k for k, pose in enumerate(found) if pose == 'pose_jump'] == [5]


def test_first_pose_is_always_accepted() -> None:
    made = history((1.0, Pose2(600, 0, 0)), (1.1, Pose2(0, 0, 0)), (1.2, Pose2(0.1, 0, 0)))
    assert made.at(SECOND, 1.0) == Pose2(600, 0, 0)
    assert made.at(round(1.1 * SECOND), 1.0) == 'pose_jump'
    assert made.at(round(1.2 * SECOND), 1.0) == Pose2(0.1, 0, 0)


def test_yaw_of_a_large_turn_is_interpolated_the_shorter_way() -> None:
    assert interpolate(Pose2(0, 0, 0.0), Pose2(0, 0, 3.0), 0.5).yaw == pytest.approx(1.5)
    assert interpolate(Pose2(0, 0, 0.0), Pose2(0, 0, -3.0), 0.5).yaw == pytest.approx(-1.5)


def test_old_poses_are_forgotten() -> None:
    """Half of the poses are forgotten at a time, `HISTORY` is kept, and each stamp keeps its pose."""
    made = PoseHistory()
    longest = 0
    for k in range(MOST_POSES + 1):
        made.add(k, Pose2(k, 0, 0))
        made.trim()
        longest = max(longest, len(made))
    assert longest == MOST_POSES - 1
    first = MOST_POSES // 2 - 1
    assert len(made) == MOST_POSES + 1 - first
    assert made.at(first, 1.0) == Pose2(first, 0, 0)
    assert made.at(first - 1, 1.0) == 'before_odometry'

    made = PoseHistory()
    for k in range(200):
        made.add(10 * k * SECOND, Pose2(k, 0, 0))
        made.trim()
        oldest = 10 * k * SECOND - HISTORY
        if oldest > 0:
            assert made.at(oldest, 10.0) == Pose2(k - 60, 0, 0)
        assert len(made) <= 2 * FEWEST + 2
    assert made.newest == 1990 * SECOND
    assert made.at(100 * SECOND, 10.0) == 'before_odometry'


def test_few_poses_are_kept_at_any_age() -> None:
    made = history(*((100.0 * k, Pose2(k, 0, 0)) for k in range(FEWEST + 1)))
    made.trim()
    assert len(made) == FEWEST + 1
    made.add(100 * (FEWEST + 20) * SECOND, Pose2(0, 0, 0))
    made.trim()
    assert len(made) == FEWEST + 2, 'the newest stamp alone may be wrong'
    made.add(100 * (FEWEST + 21) * SECOND, Pose2(0, 0, 0))
    made.trim()
    assert len(made) == 3


def test_step_at_the_limit_of_speed_is_accepted_and_above_is_not() -> None:
    farthest = STRIDE + 2 * FASTEST
    made = history((1.0, Pose2(0, 0, 0)), (3.0, Pose2(farthest, 0, 0)), (5.0, Pose2(2 * farthest + 0.1, 0, 0)))
    assert made.at(2 * SECOND, 2.0) == Pose2(farthest / 2, 0, 0)
    assert made.at(4 * SECOND, 2.0) == 'pose_jump'
    assert (FASTEST, STRIDE, HISTORY) == (100.0, 1.0, 600 * SECOND)


def test_outlier_is_replaced_by_the_next_pose_of_its_stamp() -> None:
    made = history((1.0, Pose2(0, 0, 0)), (1.1, Pose2(900, 0, 0)), (1.1, Pose2(0.1, 0, 0)))
    assert (len(made), made.at(round(1.1 * SECOND), 1.0)) == (2, Pose2(0.1, 0, 0))
    # three poses that agree, after a correction
    made = history(*((1.0 + 0.1 * k, Pose2(50.0 * (k > 2), 0, 0)) for k in range(6)))
    assert made.at(round(1.3 * SECOND), 1.0) == 'pose_jump'
    assert made.at(round(1.4 * SECOND), 1.0) == Pose2(50, 0, 0)
    # two outliers, then back: the poses before them are too old
    made = history(*((1.0 + 0.1 * k, Pose2(50.0 * (k in (1, 2)) * k, 0, 0)) for k in range(5)))
    assert made.at(round(1.3 * SECOND), 1.0) == 'pose_jump'
    assert made.at(round(1.4 * SECOND), 1.0) == Pose2(0, 0, 0)


@pytest.mark.parametrize('again', [False, True])
def test_newest_pose_can_be_dropped(again: bool) -> None:
    made = history((1.0, Pose2(1, 0, 0)), (1.1, Pose2(2, 0, 0)), (9.0, Pose2(3, 0, 0)))
    if again:
        made.add(9 * SECOND, Pose2(4, 0, 0))
    before = made.record.snapshot()
    made.drop_newest()
    made.add(round(1.2 * SECOND), Pose2(5, 0, 0))
    assert (made.before, made.newest) == (round(1.1 * SECOND), round(1.2 * SECOND))
    assert made.record.snapshot()[1][:, 0].tolist() == [1, 2, 5]
    assert before[0][-1] == 9 * SECOND, 'a snapshot never changes'


def test_dropped_pose_after_a_new_drive_is_not_counted() -> None:
    made = history((1.0, Pose2(1, 0, 0)), (9.0, Pose2(3, 0, 0)))
    made.record.begin_anew()
    made.drop_newest()
    made.add(2 * SECOND, Pose2(5, 0, 0))
    assert made.record.since_anew == 1


def test_a_stamp_far_before_the_others_does_not_look_at_all_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a driver whose stamps are zero, or late by an hour."""
    made, start = PoseHistory(patient=True), 1000
    stamps = [(start + k) * SECOND for k in range(7200)]
    made.extend(stamps, [Pose2(k / 2, -k / 3, k / 7) for k in range(7200)])
    asked = np.array([8000.5, 0, 4400.25, 8000, 999, 1000, 8100.75, 0, 4400]) * SECOND
    looked, jumped = [], PoseHistory._jumped

    def counted(self: PoseHistory, before: int, after: int) -> bool:
        looked.append(after)
        return jumped(self, before, after)

    monkeypatch.setattr(PoseHistory, '_jumped', counted)
    found = made.at_all(asked.astype(np.int64), 2.0)
    assert len(looked) < 50
    for stamp, reason, *pose in zip(asked.astype(np.int64).tolist(), *found, strict=True):
        expected = made.at(stamp, 2.0)
        assert reason == expected if isinstance(expected, str) else Pose2(*pose) == expected
    assert not len(made.at_all(np.zeros(0, np.int64), 2.0).reason)


def test_second_pose_that_jumped_places_no_reading_of_a_batch() -> None:
    """There is no pose two before it."""
    made = history((1.0, Pose2(0, 0, 0)), (1.1, Pose2(600, 400, 0)))
    stamps = np.array([SECOND, round(1.1 * SECOND)])
    assert made.at_all(stamps, 1.0).reason.tolist() == ['', 'pose_jump']
    assert made.at(int(stamps[1]), 1.0) == 'pose_jump'
