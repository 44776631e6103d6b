"""Bags of several robots, each in a namespace: ranges and static transforms of one robot are used."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from bag_samples import START

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.namespaces import Assigned, by_precedence, ranges_of
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.recordings.read_drive import read_drive

MOUNTS = {'/r1': Pose2(0.1, 0.0, 0.0), '/r2': Pose2(0.3, 0.2, math.pi / 2)}


class RobotWriter(BagWriter):
    """Writes the messages of a robot in a namespace."""

    def write_mount(self, topic: str, mount: Pose2, parent: str = 'base_link', child: str = 'sonar') -> None:
        """Write the pose of its sonar, or of another frame."""
        posed = self._pose(mount)
        offset = self._make('geometry_msgs/msg/Vector3', x=mount.x, y=mount.y, z=0.0)
        transform = self._make('geometry_msgs/msg/Transform', translation=offset, rotation=posed.orientation)
        stamped: Any = self._make(
            'geometry_msgs/msg/TransformStamped',
            header=self._header(topic, START, parent),
            child_frame_id=child,
            transform=transform,
        )
        content = self._make('tf2_msgs/msg/TFMessage', transforms=[stamped])
        self._write(topic, 'tf2_msgs/msg/TFMessage', content, START)


def two_robots(path: Path, mounts: dict[str, Pose2] = MOUNTS) -> Path:
    with RobotWriter(path) as writer:
        for namespace in ('/r1', '/r2'):
            writer.write_odometry(
                f'{namespace}/odometry/filtered', OdometryMessage(START, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0))
            )
            writer.write_range(f'{namespace}/sonar', RangeMessage(START, 'sonar', 1.0, 0.125, 5.0, 0.25))
        for namespace, mount in mounts.items():
            writer.write_mount(f'{namespace}/tf_static', mount)
    return path


@pytest.mark.parametrize('robot', ['/r1', '/r2'])
def test_robot_is_mapped_with_its_own_sensors(tmp_path: Path, robot: str) -> None:
    odometry = f'{robot}/odometry/filtered'
    with Bag(two_robots(tmp_path / 'bag')) as bag:
        topics = bag.choose_topics(odom_topic=odometry)
        transforms = bag.static_transforms(topics)
        assert bag.choose_topics(['/r1/sonar', '/r2/sonar'], odometry).left_out == ()
        with pytest.raises(BagError, match=f'`--odom-topic {odometry} --range-topics {robot}/sonar`'):
            bag.choose_topics()
    assert topics.range_topics == (f'{robot}/sonar',)
    (note,) = topics.notes()
    assert '--range-topics' in note and '/r1/sonar' in note and '/r2/sonar' in note
    assert transforms.lookup('base_link', 'sonar') == pytest.approx(MOUNTS[robot])
    assert transforms.doubts('base_link', 'sonar') == []


@pytest.mark.parametrize(
    ('mounts', 'taken', 'other'),
    [
        ({'/r1': MOUNTS['/r1'], '': MOUNTS['/r2']}, '/r1', '/tf_static'),
        ({'/r2': MOUNTS['/r2'], '': MOUNTS['/r1']}, '', '/r2/tf_static'),
    ],
)
def test_different_static_transforms_give_a_warning(
    tmp_path: Path, mounts: dict[str, Pose2], taken: str, other: str
) -> None:
    with Bag(two_robots(tmp_path / 'bag', mounts)) as bag:
        transforms = bag.static_transforms(Topics(('/r1/sonar',), '/r1/odometry/filtered'))
    assert transforms.lookup('base_link', 'sonar') == pytest.approx(mounts[taken])
    (doubt,) = transforms.doubts('base_link', 'sonar')
    assert doubt.startswith(f'{other} and {taken}/tf_static contain different poses')
    assert transforms.doubts('base_link', 'base_link') == []


def test_equal_static_transforms_give_no_warning(tmp_path: Path) -> None:
    with Bag(two_robots(tmp_path / 'bag', {'/r1': MOUNTS['/r1'], '': MOUNTS['/r1']})) as bag:
        transforms = bag.static_transforms(Topics(('/r1/sonar',), '/r1/odometry/filtered'))
    assert transforms.doubts('base_link', 'sonar') == []


@pytest.mark.parametrize('robot', ['/r1', '/r2'])
def test_constant_transforms_continue_the_static_ones_of_the_robot(tmp_path: Path, robot: str) -> None:
    with RobotWriter(tmp_path / 'bag') as writer:
        for namespace, mount in MOUNTS.items():
            writer.write_mount(f'{namespace}/tf_static', mount, child='mast')
            writer.write_mount(f'{namespace}/tf', Pose2(0.0, 0.0, 0.0), parent='mast')
    with Bag(tmp_path / 'bag') as bag:
        transforms = bag.constant_transforms_on_tf(Topics((f'{robot}/sonar',), f'{robot}/odom'))
    assert transforms.lookup('base_link', 'sonar') == pytest.approx(MOUNTS[robot])
    assert transforms.doubts('base_link', 'sonar') == []


def test_topics_of_different_poses_are_named_after_all_were_joined() -> None:
    parts = []
    for k, topic in enumerate(('/tf_static', '/r1/tf_static', '/tf')):
        parts.append(StaticTransforms(topic))
        parts[k].add('base_link', 'sonar', (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    static, constant = StaticTransforms(), parts[2]
    static.take(parts[0])
    static.take(parts[1])
    everything = StaticTransforms()
    everything.take(static)
    (doubt,) = everything.doubts('base_link', 'sonar')
    assert doubt.startswith('/tf_static and /r1/tf_static contain different poses')
    constant.take(static)
    (doubt,) = constant.doubts('base_link', 'sonar')
    assert doubt.startswith('/tf and /r1/tf_static contain different poses')


def test_range_topics_of_a_robot_are_chosen_by_namespace() -> None:
    both = ('/r1/sonar/left', '/r2/sonar')
    assert ranges_of('/r1/odom', ['/r1/odom', '/r2/odom'], both) == Assigned(both[:1], both[1:])
    # a single robot may have its odometry or its ranges in any namespace
    for odometry, others, ranges in (
        ('/odom', ['/odom', '/odometry/filtered'], ('/sonar', '/front/sonar')),
        ('/odometry/filtered', ['/odom', '/odometry/filtered'], ('/sonar', '/front/sonar')),
        ('/ekf/odom', ['/base/odom', '/ekf/odom'], ('/base/sonar',)),
        ('/r1/odom', ['/r1/odom'], ('/r1/sonar', '/r2/sonar')),
        ('/r1/odom', ['/r1/odom', '/r1/wheel/odom'], ('/r1/sonar',)),
    ):
        assert ranges_of(odometry, others, ranges) == Assigned(ranges, ()), odometry
    assert ranges_of('/odom', ['/odom', '/r2/odom'], ('/sonar', '/r2/sonar')) == Assigned(('/sonar',), ('/r2/sonar',))


def test_namespace_that_begins_with_that_of_another_robot_is_not_inside_it() -> None:
    odometry, ranges = ['/r1/odom', '/r10/odom'], ['/r1/sonar', '/r10/sonar', '/r100/sonar']
    assert ranges_of('/r1/odom', odometry, ranges) == Assigned(('/r1/sonar',), ('/r10/sonar', '/r100/sonar'))
    assert by_precedence(['/r1/tf_static', '/tf_static'], ['/r10/odom']) == ['/r1/tf_static', '/tf_static']


def test_precedence_of_static_transforms() -> None:
    topics = ['/r1/tf_static', '/r2/tf_static', '/tf_static']
    assert by_precedence(topics, ['/r1/odom', '/r1/sonar']) == ['/tf_static', '/r1/tf_static']
    assert by_precedence(topics, ['/r1/odom', '/r2/sonar']) == ['/tf_static', '/r2/tf_static', '/r1/tf_static']
    assert by_precedence(topics, ['/odom', '/sonar']) == ['/r2/tf_static', '/r1/tf_static', '/tf_static']
    assert by_precedence(topics, []) == by_precedence(topics, ['', '/sonar'])


def test_report_names_left_out_topics_and_different_transforms(tmp_path: Path) -> None:
    mounts = {**MOUNTS, '': Pose2(0.0, 0.0, 0.0)}
    for robot in ('/r1', '/r2'):
        path = two_robots(tmp_path / robot[1:], mounts)
        source = read_drive(path, Parameters(), {}, None, f'{robot}/odometry/filtered').source
        assert source['range_topics'] == [f'{robot}/sonar']
        assert source['extrinsics']['sonar'] == pytest.approx(MOUNTS[robot])
        warnings = ' '.join(source['warnings'])
        assert 'are left out' in warnings and f'/tf_static and {robot}/tf_static contain different poses' in warnings
