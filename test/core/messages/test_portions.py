"""Placing, moving and thinning of readings is done in portions or in the background, so that no message waits long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages import reading_buffer
from forward_grid_mapper.core.messages.extrinsics import LATER
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.reading_buffer import STEP, ReadingBuffer

AT_ONCE = 50


def sonar(seconds: float, frame: str = 'sonar') -> RangeMessage:
    return RangeMessage(round(seconds * NANOSECONDS), frame, 1.0, 0.1, 4.0, 0.3)


def odometry(seconds: float) -> OdometryMessage:
    return OdometryMessage(round(seconds * NANOSECONDS), 'odom', 'base_link', Pose2(0.0, 0.0, 0.0))


def settled(p: PoseAssociator) -> int:
    return len(p.buffer) + sum(p.rejected.values())


def portions(p: PoseAssociator, most: int = AT_ONCE) -> int:
    """Continue until nothing is left; no call may settle more than `most` readings."""
    count = 0
    while p.behind:
        before = settled(p)
        p.settle()
        assert settled(p) - before <= most
        count += 1
        assert count < 10_000
    return count


def test_odometry_after_a_long_gap_places_readings_in_portions() -> None:
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), at_once=AT_ONCE, clock=lambda: 0.0)
    p.add_odometry(odometry(0.0))
    for k in range(5000):
        p.add_range(sonar(0.001 + k * 1e-4))
    p.add_odometry(odometry(0.6))
    assert p.behind and settled(p) == AT_ONCE
    assert portions(p) >= 5000 // AT_ONCE - 1
    assert len(p.buffer) == 5000
    assert np.all(np.diff(p.readings.stamp) > 0)


def test_readings_that_time_out_together_are_rejected_in_portions() -> None:
    now = [0.0]
    p = PoseAssociator(lambda base, frame, stamp: None, at_once=AT_ONCE, clock=lambda: now[0])
    for k in range(1000):
        p.add_range(sonar(0.0 + k * 1e-4))
    now[0] = 100.0
    p.add_range(sonar(100.0))
    assert p.behind and p.rejected['no_odometry'] == AT_ONCE
    portions(p)
    assert p.rejected['no_odometry'] == 1000


@pytest.mark.parametrize('known', [True, False])
def test_poses_of_waiting_readings_are_looked_up_in_portions(known: bool) -> None:
    now, lookups = [0.0], [0]
    answer: list[Any] = [LATER]

    def pose(base: str, frame: str, stamp: int) -> Any:
        lookups[0] += 1
        return answer[0]

    p = PoseAssociator(pose, at_once=AT_ONCE, clock=lambda: now[0])
    p.add_odometry(odometry(0.0))
    p.add_odometry(odometry(0.9))
    for k in range(800):
        p.add_range(sonar(0.1 + k * 1e-4))
        portions(p)
    assert p.waiting == 800
    if known:
        answer[0] = Pose2(0.0, 0.0, 0.0)
    now[0] = 50.0
    lookups[0] = 0
    p.add_odometry(odometry(1.5 if known else 50.0))
    assert p.behind and lookups[0] <= AT_ONCE
    portions(p)
    assert p.waiting == 0
    assert (len(p.buffer), p.rejected['unknown_extrinsics']) == ((800, 0) if known else (0, 800))


def test_jump_back_of_time_rejects_waiting_readings_by_frame() -> None:
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), at_once=AT_ONCE, clock=lambda: 0.0)
    p.add_odometry(odometry(100.0))
    for k in range(300):
        p.add_range(sonar(100.1, f'sonar_{k % 3}'))
    p.add_odometry(odometry(10.0))
    assert p.rejected == {'time_jump': 300}
    assert {frame: dict(counts) for frame, counts in p.rejected_by_frame.items()} == {
        f'sonar_{k}': {'time_jump': 100} for k in range(3)
    }


def append(buffer: ReadingBuffer, first: int, count: int) -> None:
    for k in range(first, first + count):
        buffer.append('s', x=k, y=0.0, yaw=0.0, z=1.0 + k % 2, z_max=2.0, half_angle=0.1, sigma=0.0, stamp=k)


@pytest.mark.parametrize('restored', [0, 16_000, 12_300, 16_384])
def test_columns_grow_in_small_copies(monkeypatch: pytest.MonkeyPatch, restored: int) -> None:
    monkeypatch.setattr(reading_buffer, 'LARGE', 4096)
    moved: list[int] = []
    copy = ReadingBuffer._copy_up_to

    def counted(self: ReadingBuffer, end: int) -> None:
        before = self._copied
        copy(self, end)
        if len(self._columns['z']) >= 4096:
            moved.append(end - before)

    monkeypatch.setattr(ReadingBuffer, '_copy_up_to', counted)
    buffer, earlier = ReadingBuffer(), ReadingBuffer()
    append(earlier, 0, restored)
    buffer.extend(earlier.snapshot())
    moved.clear()
    append(buffer, restored, 100_000 - restored)
    assert max(moved) <= 5 * STEP
    assert np.array_equal(buffer.snapshot().x, np.arange(100_000))
    assert buffer.counts() == {'s': (100_000, 50_000)}


def test_thinning_in_the_background_loses_no_readings() -> None:
    """The kept readings are the same whether appending waits for thinning or not."""
    bound = 200
    aside: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []
    ours, waiting = ReadingBuffer(bound), ReadingBuffer(bound)
    ours.run_in_background = lambda thin, done: aside.append((thin, done))
    looked: list[int] = []
    ours.before_thinning.append(lambda: looked.append(len(ours)))
    for first in range(0, 3000, 100):
        append(ours, first, 100)
        append(waiting, first, 100)
        if first % 300 == 0 and aside:
            thin, done = aside.pop()
            thinned = thin()
            append(ours, 10_000 + first, 7)
            append(waiting, 10_000 + first, 7)
            done(thinned)
            assert looked[-1] == len(ours)
            assert ours.stored < 10 * bound
    assert not aside or len(aside) == 1
    assert len(ours) == len(waiting)
    assert np.array_equal(ours.bounded().x, waiting.bounded().x)


def test_thinning_that_fails_or_ends_after_a_reset_changes_nothing() -> None:
    aside: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []
    buffer = ReadingBuffer(100)
    buffer.run_in_background = lambda thin, done: aside.append((thin, done))
    append(buffer, 0, 113)
    _, done = aside.pop()
    done(None)
    assert buffer.stored == 113
    append(buffer, 113, 12)
    assert not aside
    append(buffer, 125, 1)
    thin, done = aside.pop()
    thinned = thin()
    buffer.clear()
    append(buffer, 0, 5)
    done(thinned)
    assert np.array_equal(buffer.snapshot().x, np.arange(5))


class Clock:
    """A clock set by the test."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize('every', [1, 2])
def test_ranges_ahead_of_odometry_wait_while_odometry_keeps_coming(every: int) -> None:
    """Odometry that the middleware delivers 20 s late, without a gap; not all of it says when it was sent."""
    clock = Clock()
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), Parameters(), clock=clock)
    lag = 20.0
    for k in range(400):
        clock.now = now = 0.1 * k
        p.add_range(sonar(100.0 + now), sent=round((100.0 + now) * NANOSECONDS))
        published = 100.0 + now - lag
        p.add_odometry(odometry(published), sent=0 if (k + 1) % every else round(published * NANOSECONDS))
    assert sum(p.rejected.values()) == 0
    assert len(p.buffer) > 190
    assert p.waiting == 400 - len(p.buffer)


def test_ranges_of_a_clock_ahead_are_rejected_and_late_odometry_is_not() -> None:
    clock = Clock()
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), Parameters(), clock=clock)
    for k in range(200):
        clock.now = now = 0.1 * k
        sent = round((100.0 + now) * NANOSECONDS)
        p.add_range(sonar(120.0 + now), sent=sent)
        p.add_odometry(odometry(100.0 + now), sent=sent)
    assert p.rejected['from_the_future'] > 150
    assert p.waiting < 50


def test_readings_time_out_once_odometry_stops() -> None:
    clock = Clock()
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), Parameters(), clock=clock)
    p.add_odometry(odometry(100.0))
    for k in range(100):
        clock.now = 0.1 * k
        p.add_range(sonar(100.1 + clock.now))
    assert p.rejected['no_odometry'] > 60


def test_ranges_with_stamps_an_hour_ahead_do_not_accumulate() -> None:
    """A range whose publisher's clock, but not its stamps, is an hour ahead of odometry's."""
    clock = Clock()
    p = PoseAssociator(lambda base, frame, stamp: Pose2(0.0, 0.0, 0.0), Parameters(), clock=clock)
    for k in range(1000):
        clock.now = now = 0.1 * k
        p.add_range(sonar(3700.0 + now), sent=round((3700.0 + now) * NANOSECONDS))
        p.add_odometry(odometry(100.0 + now), sent=round((100.0 + now) * NANOSECONDS))
    assert p.rejected['from_the_future'] > 350
    assert p.waiting < 650
