"""Sensor poses and the map frame from TF, with a buffer that stands in for tf2_ros'."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='stamps are asked for with rclpy')

from forward_grid_mapper.core.messages.extrinsics import LATE, LATER, STEEP
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.node import frames
from forward_grid_mapper.node.frames import Extrinsics, MapFrame, Transforms


class TransformError(Exception):
    """The base of tf2's exceptions."""


class LookupFailed(TransformError):
    """A frame is not known."""


class ExtrapolationFailed(TransformError):
    """The frame is known, but not at this time."""


ExtrapolationFailed.__name__ = 'ExtrapolationException'


def transform(x: float, y: float, yaw: float = 0.0, pitch: float = 0.0) -> Any:
    """A `geometry_msgs/Transform`: first turned by yaw, then by pitch."""
    a, b = yaw / 2, pitch / 2
    rotation = SimpleNamespace(
        x=-math.sin(a) * math.sin(b),
        y=math.cos(a) * math.sin(b),
        z=math.sin(a) * math.cos(b),
        w=math.cos(a) * math.cos(b),
    )
    return SimpleNamespace(rotation=rotation, translation=SimpleNamespace(x=x, y=y, z=0.3))


class Buffer:
    """Answers as `tf2_ros.Buffer` does, without waiting."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, str], Any] = {}
        self.until = 1 << 62
        self.asked = 0

    def clear(self) -> None:
        """Forget what is not static; here nothing is."""
        self.known.clear()

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        self.asked += 1
        if (target, source) not in self.known:
            raise LookupFailed(source)
        if time.nanoseconds > self.until:
            raise ExtrapolationFailed(source)
        found = self.known[target, source]
        return SimpleNamespace(transform=found(time.nanoseconds) if callable(found) else found)


@pytest.fixture
def buffer() -> Buffer:
    return Buffer()


@pytest.fixture
def transforms(buffer: Buffer) -> Transforms:
    return Transforms(buffer, TransformError)


def test_parameters_win_over_tf(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'sonar'] = transform(1.0, 2.0)
    assert Extrinsics({}, transforms)('base', 'sonar', 0) == Pose2(1.0, 2.0, 0.0)
    assert Extrinsics({'sonar': Pose2(3, 4, 5)}, transforms)('base', '/sonar', 0) == Pose2(3, 4, 5)
    assert Extrinsics({}, transforms)('/base', '/sonar', 0) == Pose2(1.0, 2.0, 0.0)


def test_without_tf_an_unknown_frame_is_unknown_at_once() -> None:
    assert Extrinsics({}, Transforms())('base', 'sonar', 0) is None


def test_poses_are_projected_and_steep_sensors_refused(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'ahead'] = transform(1.0, 2.0, yaw=2.5, pitch=0.5)
    buffer.known['base', 'down'] = transform(0.0, 0.0, pitch=1.5)
    extrinsics = Extrinsics({}, transforms)
    assert extrinsics('base', 'ahead', 0) == pytest.approx((1.0, 2.0, 2.5))
    assert extrinsics('base', 'down', 0) == STEEP
    assert extrinsics.unusable == set()


def test_a_frame_that_is_not_there_is_asked_for_only_now_and_then(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    extrinsics = Extrinsics({}, transforms)
    assert all(extrinsics('base', 'ghost', k) is LATER for k in range(50))
    assert buffer.asked == 1
    now += 1.0
    buffer.known['base', 'ghost'] = transform(1.0, 0.0)
    assert extrinsics('base', 'ghost', 99) == Pose2(1.0, 0.0, 0.0)


def test_a_moving_sensor_is_taken_at_the_readings_stamp_even_if_tf_is_late(
    buffer: Buffer, transforms: Transforms
) -> None:
    buffer.known['base', 'servo'] = lambda stamp: transform(0.0, 0.0, yaw=stamp / NANOSECONDS)
    buffer.until = 0
    associator = PoseAssociator(Extrinsics({}, transforms))
    for tenth in range(5):
        stamp = tenth * NANOSECONDS // 10
        associator.add_odometry(OdometryMessage(stamp, 'odom', 'base', Pose2(0, 0, 0)))
        associator.add_range(RangeMessage(stamp, 'servo', 1.0, 0.1, 3.0, 0.3))
    assert associator.waiting == 4
    buffer.until = 1 << 62
    associator.add_odometry(OdometryMessage(NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
    assert associator.waiting == 0
    assert sorted(associator.readings.yaw) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


def test_odometry_is_given_in_the_map_frame_once_tf_knows_it(buffer: Buffer, transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, timeout=1.0)
    first, second = (OdometryMessage(k * NANOSECONDS // 2, 'odom', 'base', Pose2(1.0, 0.0, 0.0)) for k in (0, 1))
    buffer.known['map', 'odom'] = transform(10.0, 5.0, yaw=math.pi / 2)
    buffer.until = -1
    assert frame.convert(first) == []
    buffer.until = 1 << 62
    ready = frame.convert(second)
    assert [message.stamp for message in ready] == [first.stamp, second.stamp]
    assert all(message.frame_id == 'map' for message in ready)
    assert ready[0].pose == pytest.approx((10.0, 6.0, math.pi / 2))


def test_odometry_without_a_transform_is_dropped_after_the_timeout(buffer: Buffer, transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, timeout=1.0)
    for k in range(10):
        assert frame.convert(OdometryMessage(k * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0))) == []
    assert frame.dropped == 8
    # the clock jumps back
    assert frame.convert(OdometryMessage(0, 'odom', 'base', Pose2(0, 0, 0))) == []
    assert frame.dropped == 10


@pytest.mark.parametrize('name', ['', 'odom', '/odom'])
def test_without_another_map_frame_odometry_passes(transforms: Transforms, name: str) -> None:
    message = OdometryMessage(0, 'odom', 'base', Pose2(0, 0, 0))
    assert MapFrame(name, transforms, 1.0).convert(message) == [message]


def test_a_stamp_before_1970_is_no_error(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base_link', 'sonar'] = transform(0.1, 0.2)
    assert transforms.lookup('base_link', 'sonar', 5) is buffer.known['base_link', 'sonar']
    assert transforms.lookup('base_link', 'sonar', -5) is LATER


def test_names_that_nobody_knows_are_not_remembered_for_ever(transforms: Transforms) -> None:
    for k in range(2 * frames.MOST_MISSING):
        assert transforms.lookup('base_link', f'frame {k}', 5) is LATER
    assert len(transforms._missing) <= frames.MOST_MISSING + 1


def test_odometry_that_overtakes_by_a_nanosecond_loses_nothing(buffer: Buffer, transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, 2.0)

    def at(stamp: int) -> OdometryMessage:
        return OdometryMessage(stamp, 'odom', 'base_link', Pose2(1.0, 0.0, 0.0))

    assert frame.convert(at(NANOSECONDS)) == []
    assert frame.convert(at(NANOSECONDS - 1)) == []
    buffer.known['map', 'odom'] = transform(5.0, 0.0)
    transforms._missing.clear()
    assert [m.stamp for m in frame.convert(at(NANOSECONDS + 1))] == [NANOSECONDS, NANOSECONDS - 1, NANOSECONDS + 1]
    assert frame.dropped == 0


def test_odometry_whose_clock_stands_still_does_not_pile_up(transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, 2.0)
    for _ in range(frames.MOST_HELD + 500):
        frame.convert(OdometryMessage(5, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0)))
    assert frame.dropped == 500


def test_transforms_of_before_a_jump_of_the_clock_are_forgotten(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'PATIENCE', 0.0)
    frame = MapFrame('map', transforms, 2.0)
    buffer.known['map', 'odom'] = transform(1.0, 0.0)

    def at(seconds: float) -> OdometryMessage:
        return OdometryMessage(round(seconds * NANOSECONDS), 'odom', 'base', Pose2(0.0, 0.0, 0.0))

    assert frame.convert(at(100.0))[0].pose == Pose2(1.0, 0.0, 0.0)
    # late by less than a jump, as messages may be
    assert frame.convert(at(99.5))[0].pose == Pose2(1.0, 0.0, 0.0)
    # the recording begins anew, and its transforms are not there yet
    assert frame.convert(at(10.0)) == []
    buffer.known['map', 'odom'] = transform(5.0, 0.0)
    assert [m.pose for m in frame.convert(at(10.1))] == [Pose2(5.0, 0.0, 0.0)] * 2


def test_the_extrinsics_are_asked_for_anew_after_a_jump_where_odometry_is_the_map_frame(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'PATIENCE', 0.0)
    frame, extrinsics = MapFrame('', transforms, 2.0), Extrinsics({}, transforms)
    buffer.known['base', 'sonar'] = transform(0.1, 0.0)
    frame.convert(OdometryMessage(100 * NANOSECONDS, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    assert extrinsics('base', 'sonar', 100 * NANOSECONDS) == Pose2(0.1, 0.0, 0.0)
    frame.convert(OdometryMessage(1 * NANOSECONDS, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    assert extrinsics('base', 'sonar', 1 * NANOSECONDS) is LATER
    buffer.known['base', 'sonar'] = transform(0.2, 0.0)
    assert extrinsics('base', 'sonar', 1 * NANOSECONDS) == Pose2(0.2, 0.0, 0.0)


def test_a_sensor_that_looks_back_is_fixed(buffer: Buffer, transforms: Transforms) -> None:
    """Rounding decides whether its yaw is 180 or -180 degrees."""
    yaws = iter((math.pi - 1e-12, -math.pi + 1e-12))
    buffer.known['base', 'rear'] = lambda stamp: transform(-0.1, 0.0, yaw=next(yaws))
    extrinsics = Extrinsics({}, transforms)
    first, second = extrinsics('base', 'rear', 0), extrinsics('base', 'rear', NANOSECONDS)
    assert isinstance(first, Pose2) and isinstance(second, Pose2) and first.yaw > 3.0 and second.yaw < -3.0
    assert set(extrinsics.fixed) == {'rear'}


def test_sensors_that_turn_on_the_robot_are_not_fixed(buffer: Buffer, transforms: Transforms) -> None:
    extrinsics = Extrinsics({'given': Pose2(1.0, 2.0, 3.0)}, transforms)
    buffer.known['base', 'fixed'] = transform(0.1, 0.0)
    buffer.known['base', 'servo'] = lambda stamp: transform(0.1, 0.0, stamp / NANOSECONDS)
    for seconds in (0.0, 0.1, 0.2):
        for frame in ('given', 'fixed', 'servo', 'absent'):
            extrinsics('base', frame, round(seconds * NANOSECONDS))
    assert extrinsics.fixed == {'given': Pose2(1.0, 2.0, 3.0), 'fixed': Pose2(0.1, 0.0, 0.0)}


def test_a_transform_that_is_late_is_no_unknown_frame(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'servo'] = transform(0.1, 0.0)
    buffer.until = 0
    now = [0.0]
    associator = PoseAssociator(Extrinsics({}, transforms), clock=lambda: now[0])

    def second(stamp: int, frame: str) -> None:
        associator.add_odometry(OdometryMessage(stamp * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
        associator.add_range(RangeMessage(stamp * NANOSECONDS, frame, 1.0, 0.1, 3.0, 0.3))
        now[0] += 1.0

    for stamp in range(10):
        second(stamp, 'servo')
        second(stamp, 'ghost')
    assert set(associator.rejected) == {'late_transform', 'unknown_extrinsics'}
    assert set(associator.rejected_by_frame['servo']) == {'late_transform'}
    assert set(associator.rejected_by_frame['ghost']) == {'unknown_extrinsics'}
    assert associator.unknown_frames == {'ghost'}


def test_a_frame_whose_transform_came_after_all_is_not_unknown_any_more(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'PATIENCE', 0.0)
    now = [0.0]
    associator = PoseAssociator(Extrinsics({}, transforms), clock=lambda: now[0])
    for stamp in range(10):
        associator.add_odometry(OdometryMessage(stamp * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
        associator.add_range(RangeMessage(stamp * NANOSECONDS, 'sonar', 1.0, 0.1, 3.0, 0.3))
        now[0] += 1.0
        if stamp == 5:
            assert associator.unknown_frames == {'sonar'}
            buffer.known['base', 'sonar'] = transform(0.1, 0.0)
            buffer.until = 0
        if stamp == 7:
            # it is known, though not at these stamps
            assert associator.unknown_frames == set()
            buffer.until = 1 << 62
    assert associator.unknown_frames == set()
    assert len(associator.buffer) >= 3


def test_a_map_frame_without_its_transform_is_named(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    frame = MapFrame('map', transforms, timeout=1.0)

    def drive(seconds: int) -> None:
        nonlocal now
        for _ in range(10 * seconds):
            now += 0.1
            frame.convert(OdometryMessage(round(now * NANOSECONDS), 'odom', 'base', Pose2(0, 0, 0)))

    drive(2)
    assert frame.fault() == ''
    drive(2)
    assert 'TF has no transform from map (map_frame) to odom' in frame.fault()
    assert f'{frame.dropped} were dropped' in frame.fault() and frame.dropped
    # nobody drives: no odometry is what is wrong now
    now += 10.0
    assert frame.fault() == ''
    drive(1)
    assert frame.fault() and not frame.found
    buffer.known['map', 'odom'] = transform(1.0, 0.0)
    drive(1)
    assert frame.fault() == '' and frame.found
    buffer.until = round(now * NANOSECONDS)
    drive(4)
    assert "TF's transform from map (map_frame) to odom arrives later than pose_timeout" in frame.fault()
    # late as TF is, by a tenth of a second
    for _ in range(50):
        buffer.until = round(now * NANOSECONDS)
        now += 0.1
        frame.convert(OdometryMessage(round(now * NANOSECONDS), 'odom', 'base', Pose2(0, 0, 0)))
    assert frame.fault() == ''


def test_a_map_frame_that_is_tilted_is_told_of_and_waited_for_by_nobody(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    frame = MapFrame('map', transforms, timeout=1.0)
    buffer.known['map', 'odom'] = transform(1.0, 0.0, pitch=1.5)
    for _ in range(40):
        now += 0.1
        assert frame.convert(OdometryMessage(round(now * NANOSECONDS), 'odom', 'base', Pose2(0, 0, 0))) == []
    assert frame.dropped == 40 and not frame.found
    assert "TF's transform from map (map_frame) to odom is tilted" in frame.fault()
    buffer.known['map', 'odom'] = transform(1.0, 0.0)
    (placed,) = frame.convert(OdometryMessage(round(now * NANOSECONDS) + 1, 'odom', 'base', Pose2(0, 0, 0)))
    assert placed.pose == Pose2(1.0, 0.0, 0.0) and frame.found and not frame.fault()


def test_the_lookup_says_whether_a_frame_or_a_time_is_missing(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'servo'] = transform(0.1, 0.0)
    buffer.until = 4
    assert transforms.lookup('base', 'ghost', 5) is LATER
    assert transforms.lookup('base', 'servo', 5) is LATE


@pytest.mark.parametrize('timeout', [0.25, 3.0])
def test_the_timeout_is_that_of_the_parameter(transforms: Transforms, timeout: float) -> None:
    frame = MapFrame('map', transforms, timeout)
    for k in range(50):
        frame.convert(OdometryMessage(k * NANOSECONDS // 10, 'odom', 'base', Pose2(0, 0, 0)))
    # what is as old as that waits
    assert len(frame._held) == 10 * timeout // 1 + 1
    assert frame.dropped + len(frame._held) == 50


@pytest.mark.parametrize('begin', [0, 1_700_000_000 * NANOSECONDS])
def test_what_waits_is_dropped_by_a_jump_and_by_no_less(transforms: Transforms, begin: int) -> None:
    for back, dropped in ((frames.JUMP, 0), (frames.JUMP + 1, 2)):
        frame = MapFrame('map', transforms, 1000.0)
        for stamp in (begin + 8 * NANOSECONDS, begin + 9 * NANOSECONDS, begin + 9 * NANOSECONDS - back):
            assert frame.convert(OdometryMessage(stamp, 'odom', 'base', Pose2(0, 0, 0))) == []
        assert frame.dropped == dropped


def test_one_stamp_from_the_future_keeps_the_transforms_and_nobody_waiting(
    buffer: Buffer, transforms: Transforms
) -> None:
    buffer.known['map', 'odom'] = transform(1.0, 0.0)
    frame = MapFrame('map', transforms, 1.0)
    taken: list[int] = []
    for stamp in (1, 2, 3600, 3, 4):
        # TF has no transform of times to come
        buffer.until = 10 * NANOSECONDS
        made = frame.convert(OdometryMessage(stamp * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
        taken += [each.stamp // NANOSECONDS for each in made]
    assert taken == [1, 2, 3, 4]
    assert frame.dropped == 1 and frame.found
    assert buffer.known, 'nothing was forgotten'


@pytest.mark.parametrize('name', ['earth', 'zone', '/zone'])
def test_odometry_of_any_other_frame_is_converted(buffer: Buffer, transforms: Transforms, name: str) -> None:
    buffer.known[name.lstrip('/'), 'odom'] = transform(1.0, 2.0)
    (made,) = MapFrame(name, transforms, 1.0).convert(OdometryMessage(5, 'odom', 'base', Pose2(0, 0, 0)))
    assert (made.frame_id, made.pose) == (name, Pose2(1.0, 2.0, 0.0))


def test_a_frame_that_is_missing_is_asked_for_now_and_then(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    for _ in range(5):
        for name in ('sonar', 'another'):
            assert transforms.lookup('base', name, 5) is LATER
    assert buffer.asked == 2
    now += frames.PATIENCE
    assert transforms.lookup('base', 'sonar', 5) is LATER
    assert buffer.asked == 3
    buffer.known['base', 'sonar'] = transform(0.1, 0.0)
    now += frames.PATIENCE
    for _ in range(3):
        assert transforms.lookup('base', 'sonar', 5) is buffer.known['base', 'sonar']


def test_poses_of_so_many_sensors_are_remembered(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'MOST_MISSING', 2)
    extrinsics = Extrinsics({}, transforms)
    for k in range(4):
        buffer.known['base', f'sonar {k}'] = transform(0.1 * k, 0.0)
        assert extrinsics('base', f'sonar {k}', 5) == Pose2(0.1 * k, 0.0, 0.0)
    assert set(extrinsics.fixed) == {'sonar 0', 'sonar 1'}
