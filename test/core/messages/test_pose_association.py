"""Pose association of readings: REP 117, interpolation, waiting, and the count of each message."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.extrinsics import LATER, Later
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.pose_history import HISTORY
from forward_grid_mapper.core.messages.rep117 import REASONS, measure
from forward_grid_mapper.core.messages.sensor_records import MOST_FRAMES

INF, NAN = math.inf, math.nan
SENSOR = Pose2(0.2, 0.1, math.pi / 2)


def sonar(seconds: float = 0.0, **changes: object) -> RangeMessage:
    made = RangeMessage(round(seconds * NANOSECONDS), 'sonar', 1.0, 0.1, 4.0, 0.3)
    return made._replace(**changes)


def odometry(seconds: float, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> OdometryMessage:
    return OdometryMessage(round(seconds * NANOSECONDS), 'odom', 'base_link', Pose2(x, y, yaw))


class Clock:
    """A clock set by the test."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def associator(patient: bool = False, clock: Clock | None = None, **values: object) -> PoseAssociator:
    return PoseAssociator(
        lambda base, frame, stamp: SENSOR if frame.startswith('sonar') else None,
        Parameters.from_flat(values),
        patient,
        clock or Clock(),
    )


def accounted(p: PoseAssociator) -> bool:
    return p.received == len(p.buffer) + p.waiting + sum(p.rejected.values())


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'range': NAN}, 'nan_range'),
        ({'range': -INF}, 'too_near'),
        ({'range': 0.0, 'min_range': 0.0}, 'too_near'),
        ({'range': 1e-30, 'min_range': 0.0}, 'too_near'),
        ({'range': 0.0, 'min_range': 4.0}, 'too_near'),
        ({'range': 0.05}, 'below_min_range'),
        ({'range': -1.0}, 'below_min_range'),
        ({'field_of_view': 0.0}, 'bad_field_of_view'),
        ({'field_of_view': -0.3}, 'bad_field_of_view'),
        ({'field_of_view': NAN}, 'bad_field_of_view'),
        ({'field_of_view': 3.2}, 'bad_field_of_view'),
        ({'max_range': 0.05}, 'bad_limits'),
        ({'max_range': NAN}, 'bad_limits'),
        ({'max_range': INF}, 'bad_limits'),
        ({'max_range': 0.0, 'min_range': 0.0}, 'bad_limits'),
        ({'min_range': NAN}, 'bad_limits'),
        ({'min_range': -0.1}, 'bad_limits'),
        ({'frame_id': ''}, 'empty_frame_id'),
        ({'frame_id': 'x' * 300}, 'long_frame_id'),
        ({'frame_id': 'a\n\x1b[31mX'}, 'unprintable_frame_id'),
    ],
)
def test_bad_range_is_rejected_with_reason(changes: dict[str, object], reason: str) -> None:
    assert measure(sonar(**changes), Parameters().association) == reason
    p = associator()
    p.add_range(sonar(**changes))
    assert p.rejected == {reason: 1}
    assert accounted(p)


@pytest.mark.parametrize('value', [4.0, 4.5, INF])
def test_range_above_the_largest_is_no_echo_or_discarded(value: float) -> None:
    measured = measure(sonar(range=value), Parameters().association)
    assert not isinstance(measured, str)
    assert measured.z == measured.z_max == 4.0
    discard = Parameters.from_flat({'over_range': 'discard'}).association
    assert measure(sonar(range=value), discard) == 'over_range'


def test_variance_and_parameters_that_override_the_message() -> None:
    p = Parameters.from_flat({'field_of_view': 0.5, 'max_range': 2.0}).association
    measured = measure(sonar(variance=0.04, field_of_view=0.0, range=3.0), p)
    assert not isinstance(measured, str)
    assert (measured.sigma, measured.half_angle, measured.z, measured.z_max) == (0.2, 0.25, 2.0, 2.0)


def test_pose_of_a_reading_is_interpolated_odometry_and_mount() -> None:
    p = associator()
    p.add_odometry(odometry(10.0, 1.0, 2.0, 3.0))
    p.add_range(sonar(10.25))
    assert p.waiting == 1
    p.add_odometry(odometry(10.5, 2.0, 0.0, -3.0))
    r = p.readings
    yaw = 3.0 + 0.5 * (2 * math.pi - 6.0)
    assert r.x[0] == pytest.approx(1.5 + math.cos(yaw) * 0.2 - math.sin(yaw) * 0.1)
    assert r.y[0] == pytest.approx(1.0 + math.sin(yaw) * 0.2 + math.cos(yaw) * 0.1)
    assert math.remainder(r.yaw[0] - yaw - math.pi / 2, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    assert r.sensor_names == ('sonar',)
    assert (p.map_frame, p.base_frame) == ('odom', 'base_link')


def test_time_offset_is_added_to_the_stamps_of_ranges() -> None:
    late, right = associator(range_time_offset=-0.15), associator()
    for made, seconds in ((late, 10.4), (right, 10.25)):
        made.add_odometry(odometry(10.0))
        made.add_odometry(odometry(10.5, 2.0, 0.0, 1.0))
        made.add_range(sonar(seconds))
        made.add_range(RangeMessage(0, 'sonar', 1.0, 0.1, 4.0, 0.3))
    assert late.readings.stamp.tolist() == right.readings.stamp.tolist() == [10_250_000_000]
    assert late.readings.x.tolist() == right.readings.x.tolist()
    assert late.rejected == right.rejected == {'zero_stamp': 1}


def test_reading_with_a_time_offset_waits_for_odometry() -> None:
    p = associator(range_time_offset=0.2)
    p.add_odometry(odometry(10.0))
    p.add_range(sonar(9.9))
    assert p.waiting == 1
    p.add_odometry(odometry(10.1))
    assert p.waiting == 0 and len(p.readings) == 1


def test_time_offset_is_not_part_of_the_timeout() -> None:
    clock = Clock()
    p = associator(clock=clock, range_time_offset=2.0)
    for i in range(200):
        clock.now = i / 10
        p.add_range(sonar(10.0 + clock.now))
        # odometry arrives late
        p.add_odometry(odometry(9.7 + clock.now, clock.now))
    assert not p.rejected and p.waiting + len(p.readings) == 200 and p.waiting < 30


def test_readings_without_pose_are_rejected_with_reason() -> None:
    clock = Clock()
    p = associator(clock=clock, max_pose_gap=0.5, pose_timeout=1.0)
    p.add_range(sonar(0.5))
    p.add_odometry(odometry(1.0))
    assert p.rejected['before_odometry'] == 1
    p.add_range(sonar(1.3))
    p.add_odometry(odometry(1.7))
    assert p.rejected['pose_gap'] == 1
    p.add_range(sonar(1.8))
    clock.now = 1.5
    p.add_range(sonar(3.0))
    assert p.rejected['no_odometry'] == 1
    p.finish()
    assert p.rejected['after_odometry'] == 1
    assert len(p.buffer) == 0
    assert accounted(p)
    assert set(p.rejected) <= set(REASONS)


def test_reading_times_out_by_stamps_and_by_the_clock() -> None:
    clock = Clock()
    fast, still = associator(clock=clock), associator(clock=clock)
    for p in (fast, still):
        p.add_odometry(odometry(0.0))
        p.add_range(sonar(0.1))
    # a bag replayed fast: stamps advance quickly, the clock hardly
    fast.add_range(sonar(60.0))
    assert fast.waiting == 2
    # a simulation at standstill: the clock advances, stamps do not
    clock.now = 100.0
    still.add_range(sonar(0.1))
    assert still.waiting == 2
    for p in (fast, still):
        p.add_odometry(odometry(0.2))
        assert len(p.buffer) >= 1
        assert not p.rejected


def test_reading_waits_for_a_mount_that_becomes_known_later() -> None:
    clock, known = Clock(), {'sonar'}
    p = PoseAssociator(lambda base, frame, stamp: SENSOR if frame in known else LATER, clock=clock)
    p.add_odometry(odometry(0.0))
    p.add_range(sonar(0.0, frame_id='late'))
    p.add_range(sonar(0.0, frame_id='never'))
    assert (p.waiting, len(p.buffer)) == (2, 0)
    known.add('late')
    p.add_odometry(odometry(0.5))
    assert (p.waiting, len(p.buffer)) == (1, 1)
    clock.now = 10.0
    p.add_odometry(odometry(10.0))
    assert p.rejected == {'unknown_extrinsics': 1}
    assert p.unknown_frames == {'never'}
    assert accounted(p)


def test_reading_with_the_stamp_of_a_pose_is_placed_at_once() -> None:
    p = associator()
    p.add_odometry(odometry(5.0, 1.0))
    p.add_range(sonar(5.0))
    assert len(p.buffer) == 1


def test_readings_of_unknown_frames_are_counted_and_named() -> None:
    p = associator()
    p.add_odometry(odometry(0.0))
    p.add_range(sonar(0.0, frame_id='mystery'))
    assert p.rejected == {'unknown_extrinsics': 1}
    assert p.unknown_frames == {'mystery'}
    assert p.rejected_by_frame['mystery']['unknown_extrinsics'] == 1


def test_jump_back_of_time_rejects_waiting_readings_and_keeps_others() -> None:
    p = associator()
    for second in (100.0, 100.5, 101.0):
        p.add_odometry(odometry(second))
        p.add_range(sonar(second + 0.2))
    kept = len(p.buffer)
    assert (kept, p.waiting) == (2, 1)
    p.add_odometry(odometry(2.0, 7.0))
    assert p.rejected == {'time_jump': 1}
    p.add_range(sonar(2.1))
    p.add_odometry(odometry(2.2, 7.0))
    assert len(p.buffer) == kept + 1
    assert p.time_jumps == 1
    assert accounted(p)


def test_jump_back_of_time_rejects_readings_that_wait_for_a_mount() -> None:
    """With stamps of the new time, they would be placed by poses of the old one, or be counted twice."""
    known: set[str] = set()
    p = PoseAssociator(lambda base, frame, stamp: SENSOR if frame in known else LATER, clock=Clock())
    p.add_odometry(odometry(100.0))
    p.add_range(sonar(100.0))
    p.add_odometry(odometry(2.0, 7.0))
    assert (p.rejected, p.waiting) == ({'time_jump': 1}, 0)
    assert accounted(p)
    known.add('sonar')
    p.add_odometry(odometry(3.0, 7.0))
    assert len(p.buffer) == 0 and accounted(p)


def test_odometry_out_of_order_is_sorted() -> None:
    p = associator()
    for second, x in ((0.0, 0.0), (0.4, 4.0), (0.2, 1.0)):
        p.add_odometry(odometry(second, x))
    p.add_range(sonar(0.1))
    assert p.readings.x[0] == pytest.approx(0.5 + SENSOR.x)


def test_bad_odometry_is_rejected_with_reason() -> None:
    p = associator()
    p.add_odometry(odometry(0.0)._replace(pose=None))
    p.add_odometry(odometry(0.0))
    p.add_odometry(odometry(0.1)._replace(frame_id='other'))
    assert p.odometry_rejected == {'bad_pose': 1, 'other_frame': 1}


def test_slash_before_a_frame_does_not_change_the_frame() -> None:
    p = associator()
    p.add_odometry(odometry(0.0))
    first = odometry(0.2)
    p.add_odometry(first._replace(frame_id=f'/{first.frame_id}', child_frame_id=f'/{first.child_frame_id}'))
    p.add_range(sonar(0.1))
    assert not p.odometry_rejected and len(p.buffer) == 1


def test_pose_at_a_million_metres_is_rejected() -> None:
    p = associator()
    for second, x in ((0.0, 0.0), (0.1, 1e6), (0.2, 1e9), (0.3, 0.0)):
        p.add_odometry(odometry(second, x))
        p.add_range(sonar(second))
    # the robot was never at 1e6 m or half way there
    assert p.rejected == {'pose_jump': 2}
    assert p.odometry_rejected == {'bad_pose': 1}
    assert len(p.buffer) == 2


def test_large_max_range_with_a_near_echo_is_accepted() -> None:
    p = associator(max_cells=10_000)
    p.add_odometry(odometry(0.0))
    p.add_range(sonar(0.0, max_range=3e38))
    assert len(p.buffer) == 1


def test_history_of_odometry_is_bounded_unless_patient() -> None:
    p, q = associator(), associator(patient=True)
    for k in range(50_000):
        p.add_odometry(odometry(0.05 * k))
        q.add_odometry(odometry(0.05 * k))
    assert len(p._history) < 2.2 * HISTORY / (0.05 * NANOSECONDS)
    assert len(q._history) == 50_000


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_patient_result_does_not_depend_on_the_order_of_topics(seed: int) -> None:
    rng = random.Random(seed)
    poses = [odometry(0.1 * k + 0.01 * rng.random(), k, -k, 0.1 * k) for k in range(30) if rng.random() < 0.8]
    ranges = [sonar(3.2 * rng.random() - 0.1, range=rng.choice([1.0, 2.0, INF, NAN])) for _ in range(60)]

    def run(messages: list[RangeMessage | OdometryMessage]) -> PoseAssociator:
        p = associator(patient=True, max_pose_gap=0.25)
        for message in messages:
            (p.add_range if isinstance(message, RangeMessage) else p.add_odometry)(message)
            assert accounted(p)
        p.finish()
        assert accounted(p)
        return p

    merged = [*poses, *ranges]
    merged.sort(key=lambda m: m.stamp)
    # each topic in order, the two interleaved at random
    mixed, a, b = [], list(poses), sorted(ranges, key=lambda m: m.stamp)
    while a or b:
        mixed.append((a if a and (not b or rng.random() < 0.5) else b).pop(0))
    first = run(merged)
    for other in (run(mixed), run([*ranges, *poses]), run([*poses, *ranges])):
        assert sum(other.rejected.values()) == sum(first.rejected.values())
        order, base = np.argsort(other.readings.stamp), np.argsort(first.readings.stamp)
        for name in ('x', 'y', 'yaw', 'z', 'stamp'):
            assert np.array_equal(getattr(other.readings, name)[order], getattr(first.readings, name)[base])


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.builds(
                RangeMessage,
                st.integers(-(2**62), 2**62),
                st.sampled_from(['sonar', 'sonar_2', '', 'mystery']),
                st.floats(),
                st.floats(),
                st.floats(),
                st.floats(),
                st.floats(),
            ),
            st.builds(
                lambda stamp, x, y, yaw: OdometryMessage(stamp, 'odom', 'base', Pose2(x, y, yaw)),
                st.integers(-(2**62), 2**62),
                st.floats(-1e12, 1e12),
                st.floats(-1e12, 1e12),
                st.floats(-4, 4),
            ),
        ),
        max_size=40,
    )
)
def test_all_messages_are_accounted_for(messages: list[RangeMessage | OdometryMessage]) -> None:
    p = associator()
    for message in messages:
        (p.add_range if isinstance(message, RangeMessage) else p.add_odometry)(message)
        assert accounted(p)
    p.finish()
    assert p.waiting == 0
    assert accounted(p)
    for column in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma'):
        assert np.isfinite(getattr(p.readings, column)).all()


def test_zero_ranges_of_a_dead_sensor_are_rejected() -> None:
    p = associator()
    for second in range(5):
        p.add_odometry(odometry(second))
        p.add_range(sonar(second, range=0.0, min_range=0.0))
    assert p.rejected == {'too_near': 5}


@pytest.mark.parametrize('patient', [False, True])
def test_outlier_of_odometry_does_not_extend_the_map(patient: bool) -> None:
    """Poses and readings have equal stamps, as of a driver that stamps both with the time of its cycle."""
    p = associator(patient)
    for k in range(40):
        wild = k == 20
        p.add_odometry(odometry(0.1 * k, 700.0 if wild else 0.02 * k, 600.0 if wild else 0.0))
        p.add_range(sonar(0.1 * k))
    p.finish()
    assert p.rejected == {'pose_jump': 1}
    assert len(p.buffer) == 39
    assert float(np.abs(p.readings.x).max()) < 2.0
    assert accounted(p)


def test_readings_after_a_jump_of_ten_kilometres_are_rejected() -> None:
    p = associator()
    for second in range(20):
        p.add_odometry(odometry(second, 0.1 * second + (10_000.0 if second >= 10 else 0.0)))
        p.add_range(sonar(second + 0.5))
    p.finish()
    assert p.rejected == {'pose_jump': 1, 'far_from_map': 9, 'after_odometry': 1}
    assert len(p.buffer) == 9
    assert accounted(p)
    p.clear()
    p.add_odometry(odometry(20.0, 10_002.0))
    p.add_range(sonar(20.0))
    assert len(p.buffer) == 1


def test_cone_of_millions_of_cells_is_rejected() -> None:
    p = associator()
    p.add_odometry(odometry(0.0))
    p.add_range(sonar(0.0, range=300.0, max_range=1000.0, field_of_view=2.0))
    p.add_range(sonar(0.0, range=6.0, max_range=1000.0, field_of_view=2.0))
    assert (p.rejected, len(p.buffer)) == ({'large_cone': 1}, 1)


def test_readings_of_a_sensor_with_clock_ahead_do_not_accumulate() -> None:
    clock = Clock()
    p = associator(clock=clock)
    for tenth in range(200):
        clock.now = tenth / 10
        p.add_odometry(odometry(tenth / 10))
        p.add_range(sonar(tenth / 10 + 3600.0))
        p.add_range(sonar(tenth / 10))
    assert p.waiting < 60
    assert set(p.rejected) <= {'from_the_future', 'no_odometry'}
    assert len(p.buffer) == 200
    assert accounted(p)


@pytest.mark.parametrize('seed', range(3))
def test_readings_are_placed_by_stamp_after_others_from_the_future_are_rejected(seed: int) -> None:
    clock, stamps = Clock(), random.Random(seed).sample(range(500, 600), 60)
    p = associator(clock=clock)
    p.add_odometry(odometry(0.0))
    for stamp in stamps[:30]:
        p.add_range(sonar(stamp / 100))
    p.add_odometry(odometry(1.9))
    clock.now = 10.0
    for stamp in stamps[30:]:
        p.add_range(sonar(stamp / 100))
    for tenth in range(20, 61):
        p.add_odometry(odometry(tenth / 10))
    assert p.rejected == {'from_the_future': 30}
    assert p.readings.stamp.tolist() == [stamp * NANOSECONDS // 100 for stamp in sorted(stamps[30:])]


def test_readings_wait_while_odometry_has_constant_stamps() -> None:
    clock = Clock()
    p = associator(clock=clock)
    p.add_odometry(odometry(1.0))
    p.add_range(sonar(1.1))
    clock.now = 1000.0
    p.add_odometry(odometry(1.0))
    p.add_range(sonar(1.2))
    p.add_odometry(odometry(1.2))
    assert (len(p.buffer), p.waiting) == (2, 0)


@pytest.mark.parametrize('rate', [1, 1000])
def test_readings_are_placed_at_any_rate_of_odometry(rate: int) -> None:
    p = associator()
    for k in range(5 * rate + 1):
        p.add_odometry(odometry(k / rate, k / rate))
        for tenth in range(10 // min(rate, 10)):
            p.add_range(sonar(k / rate + tenth / 10))
    p.finish()
    assert set(p.rejected) <= {'after_odometry'}
    assert p.readings.x == pytest.approx(p.readings.stamp / NANOSECONDS + 0.2)


def test_readings_in_a_gap_of_an_hour_are_rejected() -> None:
    p = associator()
    for second in (0.0, 0.5, 3600.0, 3600.5):
        p.add_odometry(odometry(second))
    for second in (0.25, 1.0, 1800.0, 3599.0, 3600.25):
        p.add_range(sonar(second))
    # odometry at 0.25 s is forgotten by then, unless few poses came
    assert p.rejected == {'pose_gap': 3}
    assert len(p.buffer) == 2


def test_one_stamp_from_the_future_rejects_only_waiting_readings() -> None:
    p = associator()
    for second in range(10):
        p.add_odometry(odometry(1e9 if second == 5 else second))
        p.add_range(sonar(second - 0.5))
    assert (p.time_jumps, len(p.buffer)) == (0, 7)
    assert p.rejected == {'before_odometry': 1, 'pose_gap': 2}
    assert p.odometry_rejected == {'ahead_of_others': 1}
    assert accounted(p)


@pytest.mark.parametrize('patient', [False, True])
@pytest.mark.parametrize('ahead', [1.5, 5.0, 1e9])
def test_one_stamp_from_the_future_keeps_the_odometry(patient: bool, ahead: float) -> None:
    p = associator(patient)
    for k in range(200):
        second = 0.1 * k
        p.add_odometry(odometry(second + (ahead if k in (100, 150) else 0.0), second))
        p.add_range(sonar(second))
    # a reading that comes a minute late still gets a pose
    p.add_range(sonar(5.05))
    p.finish()
    stamps = [round(0.1 * k * NANOSECONDS) for k in range(200) if k not in (100, 150)]
    assert p.odometry[0].tolist() == stamps
    assert (p.time_jumps, p.odometry_rejected) == (0, {'ahead_of_others': 2})
    assert len(p.buffer) > 190 and 5_050_000_000 in p.readings.stamp
    assert p.readings.x == pytest.approx(p.readings.stamp / NANOSECONDS + SENSOR.x)
    assert accounted(p)


@pytest.mark.parametrize('back', [1.5, 5.0, 19.0])
def test_clock_that_jumps_back_is_detected_at_once(back: float) -> None:
    p = associator()
    for k in range(200):
        p.add_odometry(odometry(20.0 + 0.1 * k))
    p.add_odometry(odometry(40.0 - back))
    assert (p.time_jumps, p.odometry_rejected, len(p.record)) == (1, {}, 1)


@pytest.mark.parametrize(('first', 'jumps'), [(19.5, 0), (30.0, 0), (5.0, 1)])
def test_clock_behind_restored_readings_jumped_back_once(first: float, jumps: int) -> None:
    before = associator()
    for k in range(100):
        before.add_odometry(odometry(10.0 + 0.1 * k))
        before.add_range(sonar(10.0 + 0.1 * k))
    p = associator()
    assert p.restore(before.buffer.snapshot()) == 0
    # what waits is of the new time
    p.add_range(sonar(first + 0.05))
    p.add_odometry(odometry(first))
    p.add_odometry(odometry(first + 0.1))
    assert (p.time_jumps, len(p.buffer)) == (jumps, 101)
    assert accounted(p)
    p.clear()
    p.add_odometry(odometry(1.0))
    p.clear()
    assert p.time_jumps == 0


def test_clock_behind_restored_readings_is_no_jump_after_a_reset() -> None:
    """The restored readings are forgotten, and so is their time."""
    before = associator()
    before.add_odometry(odometry(10.0))
    before.add_range(sonar(10.0))
    p = associator()
    p.restore(before.buffer.snapshot())
    p.clear()
    p.add_odometry(odometry(1.0))
    assert p.time_jumps == 0


@pytest.mark.parametrize('reset', [True, False])
def test_jump_back_with_which_a_drive_begins_loses_nothing_of_it(reset: bool) -> None:
    p = associator()
    p.add_odometry(odometry(10.0))
    p.add_range(sonar(10.0))
    if reset:
        p.clear()
    for second in (1.0, 1.1):
        p.add_odometry(odometry(second))
    p.add_range(sonar(1.0))
    assert (p.time_jumps, p.jumps_before_begin, len(p.buffer)) == (1, int(reset), 2 - reset)
    p.add_odometry(odometry(0.0))
    assert (p.time_jumps, p.jumps_before_begin) == (2, int(reset))


def test_clock_set_ahead_and_back_is_one_jump() -> None:
    p = associator()
    for second in (10.0, 10.1, 70.2, 70.3, 10.4, 10.5):
        p.add_odometry(odometry(second))
    assert p.time_jumps == 1
    assert p.odometry[0].tolist() == [10_400_000_000, 10_500_000_000]


def test_one_of_two_clocks_on_one_topic_is_used() -> None:
    p = associator()
    for k in range(100):
        p.add_odometry(odometry(20.0 + 0.1 * k))
        p.add_odometry(odometry(10.05 + 0.1 * k))
    assert p.time_jumps == 1
    assert p.odometry_rejected['ahead_of_others'] == 99
    assert len(p.record) == 100


def test_stamp_zero_is_rejected_with_its_own_reason() -> None:
    p = associator()
    p.add_odometry(odometry(100.0))
    p.add_range(sonar(0.0))
    p.add_range(sonar(99.0))
    assert p.rejected == {'zero_stamp': 1, 'before_odometry': 1}
    assert 'set it in the driver' in REASONS['zero_stamp']
    # if time begins with 0, it is a normal stamp
    p = associator()
    p.add_odometry(odometry(0.0))
    p.add_range(sonar(0.0))
    assert len(p.buffer) == 1


def test_drive_after_a_reset_begins_with_odometry_that_is_accepted() -> None:
    """Drivers may send a message without an orientation first."""
    p = associator()
    p.add_odometry(odometry(10.0))
    p.clear()
    p.add_odometry(odometry(1.0)._replace(pose=None))
    p.add_odometry(odometry(1.1))
    assert (p.odometry_rejected, p.time_jumps, p.jumps_before_begin) == ({'bad_pose': 1}, 1, 1)


def test_reading_after_a_reset_has_no_pose_of_the_drive_before() -> None:
    """The clock of a simulation begins anew, and a reading comes before odometry."""
    p = associator()
    for tenth in range(100):
        p.add_odometry(odometry(0.1 * tenth, 0.05 * tenth))
    p.clear()
    p.add_range(sonar(5.0))
    for tenth in range(100):
        p.add_odometry(odometry(0.1 * tenth, 50.0 + 0.05 * tenth))
    assert (len(p.buffer), p.rejected, p.jumps_before_begin) == (0, {'before_odometry': 1}, 1)


@pytest.mark.parametrize('reset', [False, True])
def test_reading_from_the_future_does_not_delay_others(reset: bool) -> None:
    clock = Clock()

    def extrinsics(base: str, frame: str, stamp: int) -> Pose2 | Later:
        # TF knows the frame a tenth of a second later
        return SENSOR if clock.now > stamp / NANOSECONDS + 0.1 else LATER

    p = PoseAssociator(extrinsics, Parameters(), clock=clock)
    for k in range(200):
        clock.now = 0.1 * k
        p.add_odometry(odometry(clock.now))
        p.add_range(sonar(3e7 if k == 20 else clock.now))
        if reset and k == 100:
            p.clear()
    assert p.rejected == ({} if reset else {'from_the_future': 1})
    assert p.waiting <= 3
    assert len(p.buffer) == p.received - p.waiting - sum(p.rejected.values()) > 90


def test_readings_time_out_if_odometry_has_constant_stamps() -> None:
    clock = Clock()
    p = associator(clock=clock)
    for k in range(200):
        clock.now = 0.1 * k
        p.add_odometry(odometry(0.0))
        p.add_range(sonar(1000.0 + clock.now))
    assert p.odometry_stamp == 0
    assert p.waiting < 30
    assert p.rejected['no_odometry'] == p.received - p.waiting


def test_counts_by_frame_are_bounded() -> None:
    p = associator()
    for k in range(2 * MOST_FRAMES):
        p.reject(sonar(0.0, frame_id=f'frame {k}'), 'paused')
        p.add_odometry(odometry(k))
        p.add_range(sonar(k, frame_id=f'unknown {k}'))
    assert len(p.rejected_by_frame) <= MOST_FRAMES + 1
    assert len(p.unknown_frames) <= MOST_FRAMES
    assert sum(sum(counts.values()) for counts in p.rejected_by_frame.values()) == sum(p.rejected.values())


def test_reset_with_another_odometry_frame_starts_again() -> None:
    p = associator()
    p.add_odometry(odometry(0.0)._replace(frame_id='garbage'))
    for second in (1.0, 1.5):
        p.add_odometry(odometry(second))
    p.add_range(sonar(1.2))
    assert p.odometry_rejected == {'other_frame': 2}
    p.clear()
    for second in (2.0, 2.5):
        p.add_odometry(odometry(second))
    p.add_range(sonar(2.2))
    assert (p.map_frame, len(p.buffer), p.odometry_rejected) == ('odom', 1, {})
    # otherwise odometry is kept, so that the next reading can be placed
    p.clear()
    p.add_range(sonar(2.3))
    assert (p.map_frame, len(p.buffer)) == ('odom', 1)


@pytest.mark.parametrize(
    ('frame', 'child', 'wrong'),
    [
        ('odom', 'base_link', False),
        ('map', 'base_footprint', False),
        ('odom_combined', '', False),
        ('', '', False),
        ('base_link', 'odom', True),
        ('/robot1/base_footprint', 'robot1/odom', True),
        ('base_link', '', True),
        ('odom', 'odom', True),
        ('base_link', 'base_link', True),
    ],
)
def test_swapped_frames_of_odometry_are_named(frame: str, child: str, wrong: bool) -> None:
    p = associator()
    p.add_odometry(odometry(1.0)._replace(frame_id=frame, child_frame_id=child))
    warnings = p.message_warnings()
    assert len(warnings) == wrong
    if wrong:
        assert f'odometry has frame_id {frame} and child_frame_id {child or "(none)"}' in warnings[0]


def test_odometry_in_another_frame_may_begin_after_a_reset() -> None:
    p = associator()
    for second in (1.0, 1.5):
        p.add_odometry(odometry(second)._replace(frame_id='base_link', child_frame_id='odom'))
    p.add_range(sonar(1.2))
    p.clear()
    # the driver is started again after the reset, corrected
    p.add_range(sonar(2.2))
    for second in (2.0, 2.5):
        p.add_odometry(odometry(second, x=30.0))
    assert (p.map_frame, p.base_frame, p.buffer.stored, p.odometry_rejected) == ('odom', 'base_link', 1, {})
    # the drive before is no part of it
    assert p.odometry[1][:, 0].tolist() == [30.0, 30.0]
    # a drive that has begun keeps its frames
    p.add_odometry(odometry(3.0)._replace(frame_id='other'))
    assert p.odometry_rejected == {'other_frame': 1}


def test_reset_with_another_odometry_frame_forgets_the_clock() -> None:
    clock = Clock()
    p = associator(clock=clock)
    p.add_odometry(odometry(1e6)._replace(frame_id='garbage'))
    p.add_range(sonar(1e6 + 1.0))
    p.add_odometry(odometry(1e6 + 0.5)._replace(frame_id='garbage'))
    p.add_odometry(odometry(0.0))
    p.clear()
    for tenth in range(200):
        clock.now = tenth / 10
        p.add_odometry(odometry(tenth / 10))
        p.add_range(sonar(tenth / 10 + 3600.0))
    assert p.odometry_stamp == odometry(19.9).stamp
    assert p.waiting < 60
    assert p.rejected['from_the_future'] > 140
