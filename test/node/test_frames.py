"""Sensor poses and the map frame from TF, with a stand-in for the buffer of tf2_ros."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='stamps are asked for with rclpy')

from forward_grid_mapper.core.messages.extrinsics import LATE, LATER, STEEP
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.stamp_order import JUMP
from forward_grid_mapper.node import frames
from forward_grid_mapper.node.frames import MapFrame, TfExtrinsics, Transforms


class TransformError(Exception):
    """The base of tf2's exceptions."""


class LookupFailed(TransformError):
    """A frame is unknown."""


class ExtrapolationFailed(TransformError):
    """The frame is known, but not at this time."""


ExtrapolationFailed.__name__ = 'ExtrapolationException'


def transform(x: float, y: float, yaw: float = 0.0, pitch: float = 0.0) -> Any:
    """A `geometry_msgs/Transform`: a rotation by yaw, and then by pitch."""
    a, b = yaw / 2, pitch / 2
    rotation = SimpleNamespace(
        x=-math.sin(a) * math.sin(b),
        y=math.cos(a) * math.sin(b),
        z=math.sin(a) * math.cos(b),
        w=math.cos(a) * math.cos(b),
    )
    return SimpleNamespace(rotation=rotation, translation=SimpleNamespace(x=x, y=y, z=0.3))


class Buffer:
    """Responds like `tf2_ros.Buffer`, without waiting."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, str], Any] = {}
        self.until = 1 << 62
        self.lookups = 0

    def clear(self) -> None:
        """Delete transforms that are not static, here all."""
        self.known.clear()

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        self.lookups += 1
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


def test_pose_in_parameters_overrides_tf(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'sonar'] = transform(1.0, 2.0)
    assert TfExtrinsics({}, transforms)('base', 'sonar', 0) == Pose2(1.0, 2.0, 0.0)
    assert TfExtrinsics({'sonar': Pose2(3, 4, 5)}, transforms)('base', '/sonar', 0) == Pose2(3, 4, 5)
    assert TfExtrinsics({}, transforms)('/base', '/sonar', 0) == Pose2(1.0, 2.0, 0.0)


def test_unknown_frame_without_tf_is_unknown_at_once() -> None:
    assert TfExtrinsics({}, Transforms())('base', 'sonar', 0) is None


def test_poses_are_projected_and_steep_sensors_rejected(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'ahead'] = transform(1.0, 2.0, yaw=2.5, pitch=0.5)
    buffer.known['base', 'down'] = transform(0.0, 0.0, pitch=1.5)
    extrinsics = TfExtrinsics({}, transforms)
    assert extrinsics('base', 'ahead', 0) == pytest.approx((1.0, 2.0, 2.5))
    assert extrinsics('base', 'down', 0) == STEEP
    assert extrinsics.unusable == set()


def test_unknown_frame_is_looked_up_rarely(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    extrinsics = TfExtrinsics({}, transforms)
    assert all(extrinsics('base', 'ghost', k) is LATER for k in range(50))
    assert buffer.lookups == 1
    now += 1.0
    buffer.known['base', 'ghost'] = transform(1.0, 0.0)
    assert extrinsics('base', 'ghost', 99) == Pose2(1.0, 0.0, 0.0)


def test_moving_sensor_has_its_pose_at_the_stamp_with_late_tf(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'servo'] = lambda stamp: transform(0.0, 0.0, yaw=stamp / NANOSECONDS)
    buffer.until = 0
    associator = PoseAssociator(TfExtrinsics({}, transforms))
    for tenth in range(5):
        stamp = tenth * NANOSECONDS // 10
        associator.add_odometry(OdometryMessage(stamp, 'odom', 'base', Pose2(0, 0, 0)))
        associator.add_range(RangeMessage(stamp, 'servo', 1.0, 0.1, 3.0, 0.3))
    assert associator.waiting == 4
    buffer.until = 1 << 62
    associator.add_odometry(OdometryMessage(NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
    assert associator.waiting == 0
    assert sorted(associator.readings.yaw) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


def test_odometry_is_converted_once_tf_has_the_map_frame(buffer: Buffer, transforms: Transforms) -> None:
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


def test_odometry_without_transform_is_dropped_after_the_timeout(buffer: Buffer, transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, timeout=1.0)
    for k in range(10):
        assert frame.convert(OdometryMessage(k * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0))) == []
    assert frame.dropped == 8
    # the clock jumps back
    assert frame.convert(OdometryMessage(0, 'odom', 'base', Pose2(0, 0, 0))) == []
    assert frame.dropped == 10


@pytest.mark.parametrize('name', ['', 'odom', '/odom'])
def test_odometry_in_the_map_frame_is_unchanged(transforms: Transforms, name: str) -> None:
    message = OdometryMessage(0, 'odom', 'base', Pose2(0, 0, 0))
    assert MapFrame(name, transforms, 1.0).convert(message) == [message]


def test_negative_stamp_gives_no_error(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base_link', 'sonar'] = transform(0.1, 0.2)
    assert transforms.lookup('base_link', 'sonar', 5) is buffer.known['base_link', 'sonar']
    assert transforms.lookup('base_link', 'sonar', -5) is LATER


def test_number_of_remembered_unknown_frames_is_bounded(transforms: Transforms) -> None:
    for k in range(2 * frames.MOST_MISSING):
        assert transforms.lookup('base_link', f'frame {k}', 5) is LATER
    assert len(transforms._missing) <= frames.MOST_MISSING + 1


def test_odometry_out_of_order_by_a_nanosecond_is_kept(buffer: Buffer, transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, 2.0)

    def at(stamp: int) -> OdometryMessage:
        return OdometryMessage(stamp, 'odom', 'base_link', Pose2(1.0, 0.0, 0.0))

    assert frame.convert(at(NANOSECONDS)) == []
    assert frame.convert(at(NANOSECONDS - 1)) == []
    buffer.known['map', 'odom'] = transform(5.0, 0.0)
    transforms._missing.clear()
    assert [m.stamp for m in frame.convert(at(NANOSECONDS + 1))] == [NANOSECONDS, NANOSECONDS - 1, NANOSECONDS + 1]
    assert frame.dropped == 0


def test_odometry_with_constant_stamps_is_bounded(transforms: Transforms) -> None:
    frame = MapFrame('map', transforms, 2.0)
    for _ in range(frames.MOST_UNTRANSFORMED + 500):
        frame.convert(OdometryMessage(5, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0)))
    assert frame.dropped == 500


def test_jump_back_of_time_deletes_transforms(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'LOOK_UP_AGAIN_AFTER', 0.0)
    frame = MapFrame('map', transforms, 2.0)
    buffer.known['map', 'odom'] = transform(1.0, 0.0)

    def at(seconds: float) -> OdometryMessage:
        return OdometryMessage(round(seconds * NANOSECONDS), 'odom', 'base', Pose2(0.0, 0.0, 0.0))

    assert frame.convert(at(100.0))[0].pose == Pose2(1.0, 0.0, 0.0)
    # late by less than a jump, which is normal
    assert frame.convert(at(99.5))[0].pose == Pose2(1.0, 0.0, 0.0)
    # the recording restarts, and its transforms are not there yet
    assert frame.convert(at(10.0)) == []
    buffer.known['map', 'odom'] = transform(5.0, 0.0)
    assert [m.pose for m in frame.convert(at(10.1))] == [Pose2(5.0, 0.0, 0.0)] * 2


def test_jump_back_of_time_renews_sensor_poses_in_the_odometry_frame(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'LOOK_UP_AGAIN_AFTER', 0.0)
    frame, extrinsics = MapFrame('', transforms, 2.0), TfExtrinsics({}, transforms)
    buffer.known['base', 'sonar'] = transform(0.1, 0.0)
    frame.convert(OdometryMessage(100 * NANOSECONDS, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    assert extrinsics('base', 'sonar', 100 * NANOSECONDS) == Pose2(0.1, 0.0, 0.0)
    frame.convert(OdometryMessage(1 * NANOSECONDS, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
    assert extrinsics('base', 'sonar', 1 * NANOSECONDS) is LATER
    buffer.known['base', 'sonar'] = transform(0.2, 0.0)
    assert extrinsics('base', 'sonar', 1 * NANOSECONDS) == Pose2(0.2, 0.0, 0.0)


def test_sensor_that_looks_back_is_fixed(buffer: Buffer, transforms: Transforms) -> None:
    """Rounding decides whether its yaw is 180 or -180 degrees."""
    yaws = iter((math.pi - 1e-12, -math.pi + 1e-12))
    buffer.known['base', 'rear'] = lambda stamp: transform(-0.1, 0.0, yaw=next(yaws))
    extrinsics = TfExtrinsics({}, transforms)
    first, second = extrinsics('base', 'rear', 0), extrinsics('base', 'rear', NANOSECONDS)
    assert isinstance(first, Pose2) and isinstance(second, Pose2) and first.yaw > 3.0 and second.yaw < -3.0
    assert set(extrinsics.fixed) == {'rear'}


def test_turning_sensors_are_not_fixed(buffer: Buffer, transforms: Transforms) -> None:
    extrinsics = TfExtrinsics({'given': Pose2(1.0, 2.0, 3.0)}, transforms)
    buffer.known['base', 'fixed'] = transform(0.1, 0.0)
    buffer.known['base', 'servo'] = lambda stamp: transform(0.1, 0.0, stamp / NANOSECONDS)
    for seconds in (0.0, 0.1, 0.2):
        for frame in ('given', 'fixed', 'servo', 'absent'):
            extrinsics('base', frame, round(seconds * NANOSECONDS))
    assert extrinsics.fixed == {'given': Pose2(1.0, 2.0, 3.0), 'fixed': Pose2(0.1, 0.0, 0.0)}


def test_late_transform_has_another_reason_than_an_unknown_frame(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'servo'] = transform(0.1, 0.0)
    buffer.until = 0
    now = [0.0]
    associator = PoseAssociator(TfExtrinsics({}, transforms), clock=lambda: now[0])

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


def test_frame_with_a_transform_is_removed_from_unknown_frames(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'LOOK_UP_AGAIN_AFTER', 0.0)
    now = [0.0]
    associator = PoseAssociator(TfExtrinsics({}, transforms), clock=lambda: now[0])
    for stamp in range(10):
        associator.add_odometry(OdometryMessage(stamp * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
        associator.add_range(RangeMessage(stamp * NANOSECONDS, 'sonar', 1.0, 0.1, 3.0, 0.3))
        now[0] += 1.0
        if stamp == 5:
            assert associator.unknown_frames == {'sonar'}
            buffer.known['base', 'sonar'] = transform(0.1, 0.0)
            buffer.until = 0
        if stamp == 7:
            # the frame is known, but not at these stamps
            assert associator.unknown_frames == set()
            buffer.until = 1 << 62
    assert associator.unknown_frames == set()
    assert len(associator.buffer) >= 3


def test_missing_transform_of_the_map_frame_is_reported(
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
    # without odometry messages, missing odometry is the fault
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
    # TF is late by a tenth of a second
    for _ in range(50):
        buffer.until = round(now * NANOSECONDS)
        now += 0.1
        frame.convert(OdometryMessage(round(now * NANOSECONDS), 'odom', 'base', Pose2(0, 0, 0)))
    assert frame.fault() == ''


def test_tilted_map_frame_is_reported_and_odometry_dropped(
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


def test_lookup_distinguishes_missing_frames_and_times(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['base', 'servo'] = transform(0.1, 0.0)
    buffer.until = 4
    assert transforms.lookup('base', 'ghost', 5) is LATER
    assert transforms.lookup('base', 'servo', 5) is LATE


@pytest.mark.parametrize('timeout', [0.25, 3.0])
def test_odometry_waits_as_long_as_the_timeout_parameter(transforms: Transforms, timeout: float) -> None:
    frame = MapFrame('map', transforms, timeout)
    for k in range(50):
        frame.convert(OdometryMessage(k * NANOSECONDS // 10, 'odom', 'base', Pose2(0, 0, 0)))
    # odometry exactly as old as the timeout still waits
    assert len(frame._untransformed) == 10 * timeout // 1 + 1
    assert frame.dropped + len(frame._untransformed) == 50


@pytest.mark.parametrize('begin', [0, 1_700_000_000 * NANOSECONDS])
def test_only_a_jump_back_of_time_drops_waiting_odometry(transforms: Transforms, begin: int) -> None:
    for back, dropped in ((JUMP, 0), (JUMP + 1, 2)):
        frame = MapFrame('map', transforms, 1000.0)
        for stamp in (begin + 8 * NANOSECONDS, begin + 9 * NANOSECONDS, begin + 9 * NANOSECONDS - back):
            assert frame.convert(OdometryMessage(stamp, 'odom', 'base', Pose2(0, 0, 0))) == []
        assert frame.dropped == dropped


def test_one_stamp_from_the_future_deletes_no_transforms(buffer: Buffer, transforms: Transforms) -> None:
    buffer.known['map', 'odom'] = transform(1.0, 0.0)
    frame = MapFrame('map', transforms, 1.0)
    taken: list[int] = []
    for stamp in (1, 2, 3600, 3, 4):
        # TF has no transforms of the future
        buffer.until = 10 * NANOSECONDS
        made = frame.convert(OdometryMessage(stamp * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)))
        taken += [each.stamp // NANOSECONDS for each in made]
    assert taken == [1, 2, 3, 4]
    assert frame.dropped == 1 and frame.found
    assert buffer.known, 'nothing was forgotten'


@pytest.mark.parametrize('name', ['earth', 'zone', '/zone'])
def test_odometry_of_another_frame_is_converted(buffer: Buffer, transforms: Transforms, name: str) -> None:
    buffer.known[name.lstrip('/'), 'odom'] = transform(1.0, 2.0)
    (made,) = MapFrame(name, transforms, 1.0).convert(OdometryMessage(5, 'odom', 'base', Pose2(0, 0, 0)))
    assert (made.frame_id, made.pose) == (name, Pose2(1.0, 2.0, 0.0))


def test_missing_frame_is_looked_up_again_later(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(frames.time, 'monotonic', lambda: now)
    for _ in range(5):
        for name in ('sonar', 'another'):
            assert transforms.lookup('base', name, 5) is LATER
    assert buffer.lookups == 2
    now += frames.LOOK_UP_AGAIN_AFTER
    assert transforms.lookup('base', 'sonar', 5) is LATER
    assert buffer.lookups == 3
    buffer.known['base', 'sonar'] = transform(0.1, 0.0)
    now += frames.LOOK_UP_AGAIN_AFTER
    for _ in range(3):
        assert transforms.lookup('base', 'sonar', 5) is buffer.known['base', 'sonar']


def test_number_of_remembered_sensor_poses_is_bounded(
    buffer: Buffer, transforms: Transforms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, 'MOST_MISSING', 2)
    extrinsics = TfExtrinsics({}, transforms)
    for k in range(4):
        buffer.known['base', f'sonar {k}'] = transform(0.1 * k, 0.0)
        assert extrinsics('base', f'sonar {k}', 5) == Pose2(0.1 * k, 0.0, 0.0)
    assert set(extrinsics.fixed) == {'sonar 0', 'sonar 1'}
