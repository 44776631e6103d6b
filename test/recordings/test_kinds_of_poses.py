"""Poses of the robot in other message types than Odometry give the same readings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.bags.poses import ODOMETRY, POSE, POSE_WITH_COVARIANCE
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.recordings.read_drive import Drive, read_drive

SECOND = 1_000_000_000
TF = 'tf2_msgs/msg/TFMessage'
SENSOR = Pose2(0.1, 0.2, 0.5)


class PoseWriter(BagWriter):
    """Writes poses as all message types."""

    def write_pose(self, kind: str, topic: str, message: OdometryMessage) -> None:
        """Write a pose as a message of this type, together with transforms of other frames."""
        if kind == ODOMETRY:
            self.write_odometry(topic, message)
            return
        header = self._header(topic, message.stamp, message.frame_id)
        pose: Any = self._pose(message.pose or Pose2(math.nan, math.nan, math.nan))
        if kind == POSE:
            content = self._make(kind, header=header, pose=pose)
        elif kind == POSE_WITH_COVARIANCE:
            inner = self._make('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=np.zeros(36))
            content = self._make(kind, header=header, pose=inner)
        else:
            offset = self._make('geometry_msgs/msg/Vector3', x=pose.position.x, y=pose.position.y, z=0.0)
            turn = self._make('geometry_msgs/msg/Transform', translation=offset, rotation=pose.orientation)
            stamped = 'geometry_msgs/msg/TransformStamped'
            items = [
                self._make(stamped, header=header, child_frame_id=child, transform=turn)
                for child in ('wheel', message.child_frame_id)
            ]
            content = self._make(TF, transforms=items)
        self._write(topic, kind, content, message.stamp)


def written(path: Path, kind: str, topics: tuple[str, ...] = ('/where',), base: str = 'base_link') -> Path:
    """A bag with ranges, and with poses of this type on each topic."""
    with PoseWriter(path, 'mcap') as writer:
        writer.write_static_transforms([(base, 'sonar', SENSOR)], 0)
        for i in range(60):
            stamp = i * SECOND // 10
            for k, topic in enumerate(topics):
                writer.write_pose(kind, topic, OdometryMessage(stamp, 'odom', base, Pose2(i / 64, -i / 32, i / 16 + k)))
            writer.write_range('/sonar', RangeMessage(stamp + 1000, 'sonar', 1.0 + i / 64, 0.125, 5.0, 0.25))
            if kind == TF:
                other = OdometryMessage(stamp, 'base_link', 'arm', Pose2(9.0, 9.0, 0.0))
                writer.write_pose(TF, topics[0], other)
    return path


def drive_of(path: Path, topic: str | None = None) -> Drive:
    return read_drive(path, Parameters.from_flat({}), {}, None, topic)


@pytest.mark.parametrize(
    ('kind', 'topic', 'base'),
    [
        (POSE, None, 'base_link'),
        (POSE, '/where', 'base_link'),
        (POSE_WITH_COVARIANCE, None, 'base_link'),
        (TF, 'where', 'base_link'),
        (TF, '/where', 'base_footprint'),
        (TF, '/where', '/base_link'),
    ],
)
def test_all_types_of_poses_give_the_same_readings(tmp_path: Path, kind: str, topic: str | None, base: str) -> None:
    expected = drive_of(written(tmp_path / 'odometry', ODOMETRY)).associator
    found = drive_of(written(tmp_path / 'other', kind, base=base), topic).associator
    assert len(expected.readings) == 59
    for name in ('x', 'y', 'yaw', 'z', 'stamp'):
        np.testing.assert_allclose(getattr(found.readings, name), getattr(expected.readings, name), atol=1e-12)
    assert (found.map_frame, found.base_frame) == ('odom', base)


def test_odometry_has_priority_over_stamped_poses(tmp_path: Path) -> None:
    path = tmp_path / 'bag'
    with PoseWriter(path, 'mcap') as writer:
        message = OdometryMessage(0, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0))
        for kind, topic in ((ODOMETRY, '/odom'), (POSE, '/goal')):
            writer.write_pose(kind, topic, message)
        writer.write_range('/sonar', RangeMessage(0, 'sonar', 1.0, 0.1, 5.0, 0.25))
    with Bag(path) as bag:
        assert bag.choose_topics(any_poses=True).odom_topic == '/odom'
        assert bag.choose_topics(None, 'goal', any_poses=True).odom_type == POSE
        with pytest.raises(BagError, match='has the type geometry_msgs/msg/PoseStamped, not nav_msgs/msg/Odometry'):
            bag.choose_topics(None, 'goal')


def test_several_topics_of_poses_require_a_choice(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r'(?s)several.*/a: 60 messages, odom → base_link.*/b: 60'):
        drive_of(written(tmp_path / 'bag', POSE, ('/a', '/b')))


@pytest.mark.parametrize('goal', ['/goal_pose', '/move_base_simple/goal', '/initialpose', '/r1/Goal'])
def test_goal_topics_are_used_only_by_name(tmp_path: Path, goal: str) -> None:
    for kind in (POSE, POSE_WITH_COVARIANCE):
        path = written(tmp_path / kind.rpartition('/')[2], kind, (goal,))
        with pytest.raises(BagError, match=r'no nav_msgs/Odometry'):
            drive_of(path)
        assert len(drive_of(path, goal).associator.readings) == 59
    assert drive_of(written(tmp_path / 'both', POSE, (goal, '/where'))).source['odom_topic'] == '/where'


def test_transforms_as_poses_require_the_option(tmp_path: Path) -> None:
    path = written(tmp_path / 'bag', TF, ('/tf',))
    with pytest.raises(BagError, match='--odom-topic /tf` uses the poses of base_link from the transforms of the bag'):
        drive_of(path)
    with Bag(path) as bag, pytest.raises(BagError, match=r'no nav_msgs/Odometry.*robot\. It has'):
        bag.choose_topics()
