"""The record of a drive's odometry: sorted, bounded, and with snapshots that never change."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.odometry_record import OVERLAP, PART, OdometryRecord
from forward_grid_mapper.core.messages.pose_association import PoseAssociator


def test_poses_in_any_order_are_sorted_by_stamp() -> None:
    rng = random.Random(1)
    for _ in range(50):
        record, known = OdometryRecord(0), {}
        snapshots = []
        for _ in range(rng.randrange(1, 3000)):
            newest = max(known, default=0)
            stamp = newest + 10 if rng.random() < 0.97 else rng.randrange(newest + 10)
            known[stamp] = Pose2(rng.random(), rng.random(), rng.random())
            record.add(stamp, known[stamp])
            if rng.random() < 0.01:
                held = record.snapshot()
                snapshots.append((*held, *(column.copy() for column in held)))
        stamp, pose = record.snapshot()
        assert stamp.tolist() == sorted(known)
        assert pose.tolist() == [list(known[s]) for s in sorted(known)]
        assert len(record) == len(known), 'those that came late are in their places'
        assert record.newest == (max(known), known[max(known)])
        first = rng.randrange(max(known) + 20)
        late, late_pose = record.since(first)
        assert late.tolist() == [s for s in sorted(known) if s >= first]
        assert late_pose.tolist() == [list(known[s]) for s in sorted(known) if s >= first]
        for now_stamp, now_pose, then_stamp, then_pose in snapshots:
            assert np.array_equal(now_stamp, then_stamp)
            assert np.array_equal(now_pose, then_pose)


def hours_of_odometry(count: int = 200_000) -> OdometryRecord:
    record = OdometryRecord(0)
    record.extend([20 * k for k in range(count)], [Pose2(0.01 * k, 0.0, 0.0) for k in range(count)])
    return record


def test_message_that_is_sent_again_changes_nothing() -> None:
    """As by a driver that publishes at a higher rate than it measures."""
    record = hours_of_odometry()
    stamp, pose = record.snapshot()
    newest = record.newest
    assert newest is not None
    record.add(*newest)
    assert record.late == 1
    again, _ = record.snapshot()
    assert np.shares_memory(again, stamp), 'nothing was sorted'
    # unless another pose came in between
    other = Pose2(1.0, 2.0, 3.0)
    record.add(newest[0], other)
    record.add(*newest)
    assert np.array_equal(record.snapshot()[1], pose)
    record.add(newest[0], other)
    assert record.snapshot()[1][-1].tolist() == list(other)


def test_removing_the_newest_pose_copies_nothing_unless_a_snapshot_shows_it() -> None:
    """As if two nodes publish odometry by clocks that differ: each second pose is ahead, and is removed."""
    record = hours_of_odometry()
    stamp, before = record.snapshot()
    held = before.copy()
    record.drop(int(stamp[-1]))
    record.add(int(stamp[-1]) + 5, Pose2(-1.0, 0.0, 0.0))
    assert np.array_equal(before, held)
    columns = record._pose
    for k in range(10):
        record.add(10**9, Pose2(-2.0, 0.0, 0.0))
        record.drop(10**9)
        record.add(int(stamp[-1]) + 10 + k, Pose2(-3.0, 0.0, k))
    assert record._pose is columns, 'a copy each time would take minutes for an hour of such odometry'
    now, poses = record.snapshot()
    assert now[-12:].tolist() == [stamp[-2], *(stamp[-1] + k for k in (5, *range(10, 20)))]
    assert poses[-11:, 0].tolist() == [-1.0, *10 * [-3.0]]
    assert np.array_equal(before, held)


def test_sorting_in_late_poses_looks_at_the_last_poses_only(monkeypatch: pytest.MonkeyPatch) -> None:
    record = hours_of_odometry()
    sizes: list[int] = []
    sort = np.argsort

    def counting(values: np.ndarray, **options: Any) -> Any:
        sizes.append(len(values))
        return sort(values, **options)

    monkeypatch.setattr(np, 'argsort', counting)
    record.add(20 * 199_990 + 10, Pose2(0.0, 1.0, 0.0))
    stamp, pose = record.snapshot()
    assert len(stamp) == 200_001
    assert (np.diff(stamp) > 0).all()
    assert pose[199_991].tolist() == [0.0, 1.0, 0.0]
    assert sizes
    assert max(sizes) < 20


def test_memory_is_bounded_and_the_path_stays_accurate() -> None:
    record, most = OdometryRecord(2000), 2000
    turns = np.cumsum(np.random.default_rng(0).normal(0.0, 0.004, 50_000))
    true = np.cumsum(np.stack([0.01 * np.cos(turns), 0.01 * np.sin(turns)], 1), 0)
    for k, (x, y) in enumerate(true.tolist()):
        record.add(k * NANOSECONDS // 50, Pose2(x, y, math.remainder(turns[k], 2 * math.pi)))
        assert len(record) <= most
    stamp, pose = record.snapshot()
    assert len(stamp) > 0.3 * most
    assert (np.diff(stamp) > 0).all()
    again = np.stack([np.interp(np.arange(50_000) * NANOSECONDS // 50, stamp, pose[:, axis]) for axis in (0, 1)], 1)
    assert np.hypot(*(again - true).T).max() < 0.05, 'half a cell, over 500 m'
    # arrays of the size before thinning are not kept
    assert record._stamp.nbytes + record._pose.nbytes <= 2 * 32 * (most + 1024)


def test_overlap_before_a_new_drive_is_not_counted() -> None:
    record = OdometryRecord()
    assert record.since_anew == 0
    for k in range(100):
        record.add(k * NANOSECONDS // 10, Pose2(0.0, 0.0, 0.0))
    assert record.since_anew == len(record) == 100
    record.begin_anew()
    assert len(record) > 0 == record.since_anew
    for k in (103, 101, 102, 101):
        record.add(k * NANOSECONDS // 10, Pose2(0.0, 0.0, 0.0))
    assert record.since_anew == 3
    record.snapshot()
    assert record.since_anew == 3
    record.clear()
    assert record.since_anew == 0


def test_standstill_removes_no_poses_of_the_path() -> None:
    record = OdometryRecord(1000)
    for k in range(400):
        record.add(k, Pose2(0.01 * k, 0.0, 3.1 if k % 2 else -3.1))
    path = record.snapshot()[1][50:350]
    for k in range(400, 20_000):
        record.add(k, Pose2(4.0, 0.0, 3.1))
    kept = {tuple(pose) for pose in record.snapshot()[1].tolist()}
    assert {tuple(pose) for pose in path.tolist()} <= kept
    assert len(record) <= 1000


def test_thinning_removes_at_least_a_quarter() -> None:
    record = OdometryRecord(100)
    rng = random.Random(3)
    for k in range(101):
        record.add(k, Pose2(rng.random(), rng.random(), rng.random()))
    assert len(record) <= 0.76 * 101
    assert record.snapshot()[0][[0, -1]].tolist() == [0, 100]


def test_thinning_is_spread_evenly_over_the_drive() -> None:
    most = 4 * PART
    record, rng = OdometryRecord(most), random.Random(4)
    for k in range(most + 3 * PART):
        record.add(k, Pose2(rng.random(), rng.random(), rng.random()))
    assert len(record) <= most
    stamp = record.snapshot()[0]
    assert stamp[0] == 0
    parts = np.histogram(stamp, np.arange(0, most, PART))[0]
    assert parts.min() > 0.4 * PART
    assert parts.max() < 0.8 * PART


def test_new_drive_begins_shortly_before_its_first_reading() -> None:
    record = OdometryRecord(0)
    for k in range(2000):
        record.add(k * NANOSECONDS, Pose2(k, 0.0, 0.0))
    first = 1990 * NANOSECONDS + 5
    assert len(record.snapshot(first)[0]) == 2000
    record.begin_anew()
    assert record.snapshot()[0][0] == 1999 * NANOSECONDS - OVERLAP
    assert record.snapshot(first)[0][0] == 1990 * NANOSECONDS
    assert record.snapshot(0)[0][0] == 1999 * NANOSECONDS - OVERLAP
    record.add(2000 * NANOSECONDS, Pose2(2000, 0.0, 0.0))
    assert record.snapshot(first)[0][-1] == 2000 * NANOSECONDS
    record.clear()
    record.begin_anew()
    assert len(record.snapshot(5)[0]) == 0
    record.add(7, Pose2(0.0, 0.0, 0.0))
    record.add(8, Pose2(0.0, 0.0, 0.0))
    assert record.snapshot(8)[0].tolist() == [8]


@pytest.mark.parametrize('patient', [False, True])
def test_associator_keeps_all_odometry_of_a_long_drive(patient: bool) -> None:
    associator = PoseAssociator(lambda base, frame, stamp: Pose2(0, 0, 0), patient=patient)
    for k in range(2000):
        associator.add_odometry(OdometryMessage(k * NANOSECONDS, 'odom', 'base', Pose2(0.1 * k, 0.0, 0.0)))
    stamp, pose = associator.odometry
    assert stamp.tolist() == [k * NANOSECONDS for k in range(2000)]
    assert pose[-1].tolist() == [0.1 * 1999, 0.0, 0.0]
    associator.clear()
    associator.add_range(RangeMessage(1998 * NANOSECONDS, 'sonar', 1.0, 0.1, 3.0, 0.3))
    assert associator.odometry[0].tolist() == [1998 * NANOSECONDS, 1999 * NANOSECONDS]
    associator.add_odometry(OdometryMessage(NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
    assert associator.odometry[0].tolist() == [NANOSECONDS], 'the clock jumped back'
