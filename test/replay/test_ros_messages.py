"""Published messages have all fields of the recorded ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.replay.ros_messages import MISFITS, filled, message_class, static_transforms

pytest.importorskip('rclpy', reason='rclpy is not installed (the extra ros, or a sourced ROS 2)')
STORES = {'jazzy': Stores.ROS2_JAZZY, 'humble': Stores.ROS2_HUMBLE, 'ros1': Stores.ROS1_NOETIC}


class Maker:
    """Makes messages of rosbags for one distribution."""

    def __init__(self, distribution: str) -> None:
        self.name = distribution
        self._types = get_typestore(STORES[distribution]).types

    def make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def header(self, frame: str = 'sonar_3') -> Any:
        extra = {'seq': 7} if self.name == 'ros1' else {}
        stamp = self.make('builtin_interfaces/msg/Time', sec=12, nanosec=34)
        return self.make('std_msgs/msg/Header', stamp=stamp, frame_id=frame, **extra)

    def vector(self, kind: str, **values: float) -> Any:
        return self.make(f'geometry_msgs/msg/{kind}', **values)


@pytest.fixture(params=sorted(STORES))
def maker(request: pytest.FixtureRequest) -> Maker:
    return Maker(request.param)


def test_range_keeps_all_fields(maker: Maker) -> None:
    extra = {'variance': np.float32(0.25)} if maker.name == 'jazzy' else {}
    source = maker.make(
        'sensor_msgs/msg/Range',
        header=maker.header(),
        radiation_type=1,
        field_of_view=0.5,
        min_range=0.125,
        max_range=4.0,
        range=np.float32('inf'),
        **extra,
    )
    made = filled(message_class('sensor_msgs/msg/Range')(), source)
    assert (made.header.stamp.sec, made.header.stamp.nanosec, made.header.frame_id) == (12, 34, 'sonar_3')
    assert (made.radiation_type, made.field_of_view, made.min_range, made.max_range) == (1, 0.5, 0.125, 4.0)
    assert made.range == float('inf')
    assert made.variance == (0.25 if extra else 0.0)


def test_odometry_keeps_height_covariance_and_twist(maker: Maker) -> None:
    covariance = np.arange(36, dtype=np.float64)
    pose = maker.make(
        'geometry_msgs/msg/Pose',
        position=maker.vector('Point', x=1.0, y=2.0, z=3.0),
        orientation=maker.vector('Quaternion', x=0.0, y=float('nan'), z=0.0, w=1.0),
    )
    twist = maker.make(
        'geometry_msgs/msg/Twist',
        linear=maker.vector('Vector3', x=4.0, y=5.0, z=6.0),
        angular=maker.vector('Vector3', x=7.0, y=8.0, z=9.0),
    )
    source = maker.make(
        'nav_msgs/msg/Odometry',
        header=maker.header('odom'),
        child_frame_id='base_link',
        pose=maker.make('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=covariance),
        twist=maker.make('geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=-covariance),
    )
    made = filled(message_class('nav_msgs/msg/Odometry')(), source)
    assert made.child_frame_id == 'base_link'
    assert made.pose.pose.position.z == 3.0
    assert np.isnan(made.pose.pose.orientation.y)
    assert made.twist.twist.angular.y == 8.0
    np.testing.assert_array_equal(made.pose.covariance, covariance)
    np.testing.assert_array_equal(made.twist.covariance, -covariance)


def test_last_transform_of_a_frame_is_used(maker: Maker) -> None:
    def transform(child: str, x: float) -> Any:
        placed = maker.make(
            'geometry_msgs/msg/Transform',
            translation=maker.vector('Vector3', x=x, y=0.0, z=0.5),
            rotation=maker.vector('Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
        )
        kind = 'geometry_msgs/msg/TransformStamped'
        return maker.make(kind, header=maker.header('base_link'), child_frame_id=child, transform=placed)

    class Message:
        def __init__(self, *transforms: Any) -> None:
            self.transforms = transforms

    made = static_transforms(
        [Message(transform('left', 1.0), transform('right', 2.0)), Message(transform('/left', 3.0))]
    )
    assert [(item.child_frame_id, item.transform.translation.x) for item in made] == [('/left', 3.0), ('right', 2.0)]
    assert all(item.header.frame_id == 'base_link' and item.transform.translation.z == 0.5 for item in made)


def test_lists_of_messages_are_copied(maker: Maker) -> None:
    def pose(x: float) -> Any:
        turn = maker.vector('Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
        placed = maker.make(
            'geometry_msgs/msg/Pose', position=maker.vector('Point', x=x, y=0.0, z=0.0), orientation=turn
        )
        return maker.make('geometry_msgs/msg/PoseStamped', header=maker.header('map'), pose=placed)

    path = maker.make('nav_msgs/msg/Path', header=maker.header('map'), poses=[pose(1.0), pose(2.5)])
    made = filled(message_class('nav_msgs/msg/Path')(), path)
    assert [pose.pose.position.x for pose in made.poses] == [1.0, 2.5]
    assert all(type(pose) is message_class('geometry_msgs/msg/PoseStamped') for pose in made.poses)


def test_other_message_definition_is_rejected() -> None:
    class Other:
        range = 'far'

    with pytest.raises(MISFITS):
        filled(message_class('sensor_msgs/msg/Range')(), Other())


def test_missing_package_is_named() -> None:
    with pytest.raises(MapperError, match='install ros-jazzy-no-such-msgs'):
        message_class('no_such_msgs/msg/Nothing')
