"""Poses of the robot and of its sensors from changing transforms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.bags import reader
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError, InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.recordings.drive import Drive, Part
from forward_grid_mapper.recordings.read_drive import read_drive

SECOND = 1_000_000_000
SENSOR = Pose2(0.1, 0.2, 0.5)
Links = list[tuple[str, str, Pose2]]


class TransformWriter(BagWriter):
    """Writes transforms to /tf."""

    def write_transforms(self, links: Links, stamp: int) -> None:
        """Write (parent, child, pose of child in parent) to /tf in one message."""
        items: list[Any] = []
        for parent, child, pose in links:
            posed = self._pose(pose)
            offset = self._make('geometry_msgs/msg/Vector3', x=pose.x, y=pose.y, z=0.1)
            transform = self._make('geometry_msgs/msg/Transform', translation=offset, rotation=posed.orientation)
            header = self._header('/tf', stamp, parent)
            kind = 'geometry_msgs/msg/TransformStamped'
            items.append(self._make(kind, header=header, child_frame_id=child, transform=transform))
        self._write('/tf', 'tf2_msgs/msg/TFMessage', self._make('tf2_msgs/msg/TFMessage', transforms=items), stamp)


def at(i: int) -> Pose2:
    return Pose2(i / 64, -i / 32, i / 16)


def recorded(
    path: Path, links: list[Any] | None, kind: str = 'mcap', fixed: tuple[str, str] = ('base_link', 'sonar')
) -> Path:
    """A bag with poses as Odometry, or as transforms: `links` has those of each message, as functions of the step."""
    with TransformWriter(path, kind) as writer:
        writer.write_static_transforms([(*fixed, SENSOR)], 0)
        for i in range(60):
            stamp = (i + 1) * SECOND // 10
            if links is None:
                writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', at(i)))
            for message in links or ():
                writer.write_transforms([(parent, child, pose(i)) for parent, child, pose in message], stamp)
            writer.write_range('/sonar', RangeMessage(stamp + 1000, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
    return path


def read(path: Path, topic: str | None = 'tf') -> Drive:
    return read_drive(path, Parameters(), {}, None, topic)


MOVING = ('odom', 'base_footprint', at)
BACK = ('base_footprint', 'base_link', lambda i: Pose2(0.0, 0.0, 0.0))
ELSEWHERE = ('map', 'odom', lambda i: Pose2(3.0, 1.0, math.pi / 2))


@pytest.mark.parametrize('kind', ['mcap', 'ros1'])
@pytest.mark.parametrize(
    'messages',
    [[[MOVING, BACK]], [[BACK, MOVING]], [[MOVING], [BACK]], [[BACK], [MOVING]], [[ELSEWHERE, MOVING], [BACK]]],
)
def test_constant_transforms_below_a_changing_one_are_composed(tmp_path: Path, messages: list[Any], kind: str) -> None:
    suffix = '.bag' if kind == 'ros1' else ''
    expected = read(recorded(tmp_path / f'odometry{suffix}', None, kind), None).associator
    found = read(recorded(tmp_path / f'tf{suffix}', messages, kind)).associator
    assert (found.map_frame, found.base_frame) == ('odom', 'base_link')
    assert len(found.readings) == 59
    for name in ('x', 'y', 'yaw', 'z', 'stamp'):
        np.testing.assert_allclose(getattr(found.readings, name), getattr(expected.readings, name), atol=1e-9)


def test_map_frame_is_the_parent_of_the_topmost_changing_transform(tmp_path: Path) -> None:
    drifting = ('map', 'odom', lambda i: Pose2(3.0, 1.0 + (i > 30), math.pi / 2))
    path = recorded(tmp_path / 'bag', [[drifting], [('odom', 'base_link', at)]])
    assert read(path).associator.map_frame == 'map'
    with Bag(path) as bag:
        topics = bag.choose_topics(odom_topic='/tf', any_poses=True)
        poses = [m.pose for m in bag.messages(topics) if isinstance(m, OdometryMessage)]
    for i, pose in enumerate(poses):
        assert pose is not None
        there = at(i)
        assert pose[:2] == pytest.approx((3.0 - there.y, 1.0 + (i > 30) + there.x))
        assert math.remainder(pose.yaw - there.yaw - math.pi / 2, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert len(poses) == 60


def test_robot_at_standstill_is_mapped_in_its_parent_frame(tmp_path: Path) -> None:
    still = ('odom', 'base_link', lambda i: Pose2(1.0, 2.0, 0.0))
    associator = read(recorded(tmp_path / 'bag', [[still]])).associator
    assert (associator.map_frame, len(associator.readings)) == ('odom', 59)


@pytest.mark.parametrize('other', [('map', 'base_link', at), ('base_link', 'odom', at)])
def test_unclear_frames_use_the_parent_of_the_base(tmp_path: Path, other: Any) -> None:
    associator = read(recorded(tmp_path / 'bag', [[('odom', 'base_link', at)], [other]])).associator
    assert associator.map_frame == 'odom'
    assert len(associator.readings) == 59


def test_frames_with_a_prefix_are_rejected_by_name(tmp_path: Path) -> None:
    path = recorded(tmp_path / 'bag', [[('r1/odom', 'r1/base_link', at)]], fixed=('r1/base_link', 'sonar'))
    with pytest.raises(BagError, match=r'neither base_link nor base_footprint, but r1/base_link in r1/odom; .*--poses'):
        read(path)


@pytest.mark.parametrize('kind', ['mcap', 'ros1'])
@pytest.mark.parametrize('frame', ['servo', 'sonar'])
def test_sensor_on_a_moving_joint_is_placed_at_each_stamp(tmp_path: Path, frame: str, kind: str) -> None:
    def turned(i: float) -> Pose2:
        return Pose2(0.1 + i / 100, 0.02 * i, 3.0 + i / 10)

    servo = ('base_link', frame, turned)
    fixed = ('servo', 'sonar') if frame == 'servo' else ('base_link', 'laser')
    path = recorded(
        tmp_path / ('bag' if kind == 'mcap' else 'a.bag'), [[('odom', 'base_link', at), servo]], kind, fixed
    )
    drive = read(path)
    readings = drive.associator.readings
    assert len(readings) == 59 and not drive.source['warnings']
    assert drive.source['mounts_from'] == 'moving transforms on /tf'
    assert drive.source['extrinsics'] == {}
    for i in range(59):
        # the reading is a ten thousandth of the way to the next transforms
        robot, joint = at(i + 1e-5), turned(i + 1e-5)
        sensor = robot.compose(joint).compose(SENSOR if frame == 'servo' else Pose2(0.0, 0.0, 0.0))
        assert (readings.x[i], readings.y[i]) == pytest.approx(sensor[:2], abs=1e-6)
        assert math.remainder(readings.yaw[i] - sensor.yaw, math.tau) == pytest.approx(0.0, abs=1e-6)


def test_readings_outside_the_time_of_a_joint_are_rejected(tmp_path: Path) -> None:
    with TransformWriter(tmp_path / 'bag') as writer:
        writer.write_static_transforms([('servo', 'sonar', SENSOR)], 0)
        for i in range(60):
            stamp = (i + 1) * SECOND // 10
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', at(i)))
            if 10 <= i < 40 and i % 5 == 0:
                writer.write_transforms([('base_link', 'servo', Pose2(0.1, 0.0, i / 40))], stamp)
            writer.write_range('/sonar', RangeMessage(stamp, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
    drive = read(tmp_path / 'bag', None)
    assert drive.associator.rejected == {'late_transform': 34}
    readings = drive.associator.readings
    for k, i in enumerate(range(10, 36)):
        expected = at(i).compose(Pose2(0.1, 0.0, i / 40)).compose(SENSOR)
        assert (readings.x[k], readings.y[k]) == pytest.approx(expected[:2])
        assert math.remainder(readings.yaw[k] - expected.yaw, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_given_pose_takes_precedence_over_a_joint(tmp_path: Path) -> None:
    servo = ('base_link', 'servo', lambda i: Pose2(0.1, 0.0, i / 10))
    path = recorded(tmp_path / 'bag', [[('odom', 'base_link', at), servo]], fixed=('servo', 'sonar'))
    given = Pose2(0.3, 0.0, 1.0)
    drive = read_drive(path, Parameters(), {'sonar': given}, None, 'tf')
    assert drive.source['mounts_from'] == 'parameters' and drive.source['extrinsics'] == {'sonar': given}
    assert drive.associator.readings.yaw[30] == pytest.approx(at(30 + 1e-5).yaw + 1.0, abs=1e-6)


@pytest.mark.parametrize('offset', [-2.0, 2.0])
def test_part_of_a_drive_has_the_odometry_for_its_shifted_stamps(tmp_path: Path, offset: float) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for i in range(100):
            stamp = (i + 1) * SECOND // 10
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', at(i)))
            writer.write_range('/sonar', RangeMessage(stamp, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
    parameters = Parameters.from_flat({'range_time_offset': offset, 'max_pose_gap': 0.2})
    drive = read_drive(tmp_path / 'bag', parameters, {'sonar': SENSOR}, part=Part(4.0, 2.0))
    assert len(drive.associator.readings) == 20 and not drive.associator.rejected


def test_base_that_is_itself_on_the_frame_of_a_joint(tmp_path: Path) -> None:
    """The robot's base may be a child of the frame that carries the servo, even a moving one."""

    def lifted(i: float) -> Pose2:
        return Pose2(0.2 - i / 200, 0.1, 0.3 + i / 100)

    with TransformWriter(tmp_path / 'bag') as writer:
        writer.write_static_transforms([('servo', 'sonar', SENSOR)], 0)
        for i in range(60):
            stamp = (i + 1) * SECOND // 10
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_footprint', at(i)))
            servo = ('base_link', 'servo', Pose2(0.1, 0.0, i / 40))
            writer.write_transforms([('base_link', 'base_footprint', lifted(i)), servo], stamp)
            writer.write_range('/sonar', RangeMessage(stamp, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
    readings = read(tmp_path / 'bag', None).associator.readings
    assert len(readings) == 60
    for i in range(60):
        base = lifted(i)
        c, s = math.cos(base.yaw), math.sin(base.yaw)
        inverse = Pose2(-c * base.x - s * base.y, s * base.x - c * base.y, -base.yaw)
        expected = at(i).compose(inverse).compose(Pose2(0.1, 0.0, i / 40)).compose(SENSOR)
        assert (readings.x[i], readings.y[i]) == pytest.approx(expected[:2])
        assert math.remainder(readings.yaw[i] - expected.yaw, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_readings_in_a_gap_of_a_joint_are_rejected(tmp_path: Path) -> None:
    with TransformWriter(tmp_path / 'bag') as writer:
        for i in range(100):
            stamp = (i + 1) * SECOND // 10
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', at(i)))
            # the gaps are 2 s and 2.1 s
            if i in (0, 20) or i >= 41:
                writer.write_transforms([('base_link', 'sonar', Pose2(0.1, 0.0, i / 40))], stamp)
            writer.write_range('/sonar', RangeMessage(stamp, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
    drive = read(tmp_path / 'bag', None)
    assert drive.associator.rejected == {'late_transform': 20}
    # the node waits as long
    patient = read_drive(tmp_path / 'bag', Parameters.from_flat({'pose_timeout': 2.1}), {})
    assert not patient.associator.rejected


def test_sensor_whose_joint_is_not_joined_to_the_robot_is_named(tmp_path: Path) -> None:
    servo = ('arm', 'servo', lambda i: Pose2(0.1, 0.0, i / 10))
    path = recorded(tmp_path / 'bag', [[('odom', 'base_link', at)], [servo]], fixed=('servo', 'sonar'))
    with pytest.raises(
        InputError, match=r'no pose on the robot \(frame base_link\) is known for sonar: .*--sensor sonar='
    ):
        read(path)


def test_transforms_are_searched_once_for_all_sensors_without_a_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with TransformWriter(tmp_path / 'bag') as writer:
        for i in range(50):
            stamp = (i + 1) * SECOND // 10
            writer.write_transforms([('odom', 'base_link', at(i)), ('arm', 'servo', at(i))], stamp)
            for k in range(8):
                writer.write_range(f'/sonar{k}', RangeMessage(stamp, f'sonar{k}', 1.0, 0.125, 5.0, 0.25))
    decoded = []
    original = Bag._decoded

    def counting(self: Bag, *args: Any) -> Any:
        for channel, message in original(self, *args):
            decoded.append(channel.topic)
            yield channel, message

    monkeypatch.setattr(Bag, '_decoded', counting)
    with pytest.raises(InputError, match='is known for sonar0, sonar1, sonar2'):
        read(tmp_path / 'bag', '/tf')
    # for the chain of the robot's pose, the constant transforms and the parents
    assert decoded.count('/tf') == 3 * 50


def test_frame_with_two_parents_is_no_joint(tmp_path: Path) -> None:
    servo = ('base_link', 'servo', lambda i: Pose2(0.1, 0.0, i / 10))
    for name in ('odom', 'mast'):
        other = (name, 'servo', lambda i: Pose2(0.1, 0.0, i / 10))
        path = recorded(tmp_path / name, [[('odom', 'base_link', at)], [servo], [other]], fixed=('servo', 'sonar'))
        named = f'/tf has servo in two frames, base_link and {name}: a frame has one parent'
        with pytest.raises(InputError, match=f'no pose on the robot.* {named}'):
            read(path)


def test_robot_with_two_parents_has_no_joint(tmp_path: Path) -> None:
    links = [[('odom', 'base_link', at)], [('base_footprint', 'base_link', at)], [('odom', 'base_footprint', at)]]
    servo = ('odom', 'servo', lambda i: Pose2(0.1, 0.0, i / 10))
    path = recorded(tmp_path / 'bag', [*links, [servo]], fixed=('servo', 'sonar'))
    with Bag(path) as bag:
        topics = bag.choose_topics(None, 'tf', any_poses=True)
        moving = bag.moving_transforms(topics, bag.moving_frames(), 'base_link', 'sonar', 2.0)
    assert not moving.connects('base_link', 'sonar')


@pytest.mark.parametrize('kind', ['mcap', 'ros1'])
@pytest.mark.parametrize('slash', ['', '/'])
def test_repeated_constant_transforms_give_the_mounts(tmp_path: Path, kind: str, slash: str) -> None:
    """As by the static_transform_publisher of tf in ROS 1, and by simulators."""
    suffix = '.bag' if kind == 'ros1' else ''
    fixed = [
        (f'{slash}base_link', f'{slash}mast', lambda i: Pose2(0.3, -0.1, 0.7)),
        ('mast', 'sonar', lambda i: SENSOR),
    ]
    path = recorded(tmp_path / f'bag{suffix}', [[('odom', 'base_link', at)], fixed], kind, ('base_link', 'laser'))
    drive = read(path)
    expected = Pose2(0.3, -0.1, 0.7).compose(SENSOR)
    assert drive.source['extrinsics']['sonar'] == pytest.approx(expected)
    assert drive.source['mounts_from'] == 'constant transforms on /tf'
    assert drive.source['warnings'] == []


def test_transforms_in_millimetres_give_a_warning(tmp_path: Path) -> None:
    fixed = [('base_link', 'mast', lambda i: Pose2(300.0, 0.0, 0.0))]
    path = recorded(tmp_path / 'bag', [[('odom', 'base_link', at)], fixed], fixed=('mast', 'sonar'))
    (warning,) = read(path).source['warnings']
    assert warning.startswith('transforms put sonar up to 300 m away') and 'in millimetres?' in warning


def test_static_transforms_have_priority_over_repeated_ones(tmp_path: Path) -> None:
    fixed = [('base_link', 'mast', lambda i: Pose2(0.3, 0.0, 0.0)), ('mast', 'sonar', lambda i: Pose2(9.0, 9.0, 0.0))]
    path = recorded(tmp_path / 'bag', [[('odom', 'base_link', at)], fixed], fixed=('mast', 'sonar'))
    drive = read(path)
    assert drive.source['extrinsics']['sonar'] == pytest.approx(Pose2(0.3, 0.0, 0.0).compose(SENSOR))
    assert ['/tf and /tf_static contain different poses' in warning for warning in drive.source['warnings']] == [True]


def test_frames_of_long_recordings_are_found_in_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recorded(tmp_path / 'bag', [[MOVING], [BACK]])
    monkeypatch.setattr(reader, 'MOST_SEARCHED', 20)
    with Bag(path) as bag:
        assert 10 <= sum(1 for _ in bag._searched({'/tf'})) < 40
        assert bag.moving_frames() == {'base_footprint': 'odom', 'base_link': 'base_footprint'}
    assert read(path).associator.map_frame == 'odom'
