"""Faults around the node that it reports: incompatible publishers, and nodes with the same name."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from rclpy.qos import QoSProfile, ReliabilityPolicy
from robot import Robot
from sensor_msgs.msg import Range

from forward_grid_mapper.node.graph_check import GraphCheck
from forward_grid_mapper.node.trajectory import Trajectory


@pytest.mark.slow
def test_incompatible_publisher_and_a_second_node_of_the_name(start: Any, robot: Robot) -> None:
    options = ('-p', 'range_reliability:=reliable', '-p', 'odom_reliability:=reliable')
    node = start(*options)
    robot.meet()
    robot.until(lambda: 'readings' in robot.diagnostics)
    assert 'no message is received' not in node.output
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = robot.node.create_publisher(Range, 'sonar', best_effort)
    expected = 'robot publishes /sonar as best_effort, but this node requests reliable'
    robot.until(lambda: expected in robot.diagnostics['readings']['message'], what='a warning')
    assert robot.diagnostics['readings']['level'] == b'\x01'
    robot.node.destroy_publisher(publisher)
    robot.until(lambda: expected not in robot.diagnostics['readings']['message'], what='it passes')
    assert node.output.count(expected) == 1
    other = start(*options)
    node.wait_for('2 nodes have the name /forward_grid_mapper', 20.0)
    other.wait_for('2 nodes have the name /forward_grid_mapper', 20.0)
    assert 'start each with a different name, --ros-args -r __node:=NAME' in other.output


@pytest.mark.parametrize(
    ('published', 'expected'),
    [
        ({}, ': no node publishes /sonar'),
        ({'/sonar': 'sensor_msgs/msg/Range'}, ''),
        (
            {'/us': 'sensor_msgs/msg/Range', '/odom': 'nav_msgs/msg/Odometry', '/a': 'sensor_msgs/msg/Range'},
            ': no node publishes /sonar; Range is published on /a, /us: set range_topics, or remap sonar',
        ),
        (
            {'/sonar': 'sensor_msgs/msg/LaserScan'},
            ': /sonar carries sensor_msgs/msg/LaserScan, not sensor_msgs/msg/Range',
        ),
    ],
)
def test_reason_for_missing_messages(published: dict[str, str], expected: str) -> None:
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda topic: [
            SimpleNamespace(topic_type=kind) for name, kind in published.items() if name == topic
        ],
        # a topic with only subscribers exists as well
        get_topic_names_and_types=lambda: [
            *((name, [kind]) for name, kind in published.items()),
            ('/wanted', ['sensor_msgs/msg/Range']),
        ],
        count_publishers=published.__contains__,
    )
    assert GraphCheck(node, {}).absent('Range', ['/sonar']) == expected


@pytest.mark.parametrize(
    ('stamps', 'reported'),
    [
        # a static transform has no other stamp
        ((0, 0, 0), [False, True, True]),
        ((5, 6, 7), [False, True, True]),
        # the last transform of a node that has ended
        ((5, 5, 5), [False, False, False]),
        ((None, 0, None), [False, False, False]),
    ],
)
def test_other_publisher_of_the_correction_is_reported_while_it_publishes(
    stamps: tuple[int | None, ...], reported: list[bool]
) -> None:
    own = SimpleNamespace(sent_at=lambda stamp: False)
    trajectory: Any = SimpleNamespace(
        _foreign_stamp=None,
        _publishers=own,
        in_map_frame=True,
        obstacle='',
        listening=lambda: True,
        frame='map',
        _associator=SimpleNamespace(map_frame='odom'),
    )
    found = [
        Trajectory.other_publisher_fault(trajectory, lambda target, source, stamp=stamp: stamp) for stamp in stamps
    ]
    assert [text.startswith('another node publishes the transform from map to odom') for text in found] == reported
