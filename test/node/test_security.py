"""The SROS 2 policy names exactly the topics and services of the node, and the node writes only to its folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from fault_samples import OPTIONS, circle
from robot import Robot
from test_mapper_node import RELIABLE

POLICY = Path(__file__).resolve().parents[2] / 'config' / 'sros2_policy.xml'
NAME = 'forward_grid_mapper'
WITH_TF = {'/tf', '/tf_static'}
WITH_MAP_MSGS = {f'/{NAME}/live_map_updates'}


def allowed(tag: str, access: str) -> set[str]:
    """The full names that the policy allows."""
    names = set()
    for group in ElementTree.parse(POLICY).getroot().iter(tag):
        if group.get(access) == 'ALLOW':
            names |= {(item.text or '').replace('~', NAME) for item in group}
    return {f'/{name}' for name in names}


def test_policy_names_the_topics_and_services_of_the_node(start: Any, robot: Robot) -> None:
    start(*RELIABLE, '-p', 'use_sim_time:=true', '-p', 'refine_poses:=true')
    robot.meet()
    robot.until(lambda: 'readings' in robot.diagnostics)
    node = robot.node

    def names(found: list[tuple[str, list[str]]]) -> set[str]:
        return {name for name, _ in found}

    robot.until(lambda: '/clock' in names(node.get_subscriber_names_and_types_by_node(NAME, '/')))
    received = names(node.get_subscriber_names_and_types_by_node(NAME, '/'))
    # tf2_ros and map_msgs may not be installed
    assert received | WITH_TF == allowed('topics', 'subscribe')
    published = names(node.get_publisher_names_and_types_by_node(NAME, '/'))
    assert published | WITH_MAP_MSGS | {'/tf'} == allowed('topics', 'publish')
    assert names(node.get_service_names_and_types_by_node(NAME, '/')) == allowed('services', 'reply')


def test_frame_ids_are_not_used_as_paths(start: Any, robot: Robot, tmp_path: Path) -> None:
    inside = tmp_path / 'inside'
    inside.mkdir()
    wild = '../../outside/sonar'
    poses = tmp_path / 'poses.yaml'
    poses.write_text(f"/**:\n  ros__parameters:\n    'sensors.{wild}.pose': [0.1, 0.0, 0.4]\n")
    start(
        *OPTIONS,
        *('-p', f'journal:={inside}/journal', '-p', f'save_directory:={inside}/maps'),
        *('--params-file', str(poses)),
    )
    robot.meet()
    frames = ['sonar', wild, '/etc/passwd', 'a\x01b', '..', '超音波']
    messages = [
        message._replace(frame_id=frames[k // 2 % len(frames)]) if hasattr(message, 'range') else message
        for k, message in enumerate(circle(0, 60))
    ]
    robot.play(messages)
    robot.until(lambda: robot.diagnostics['readings'].get('readings accepted') == '20')
    saved = robot.call('save_maps')
    assert saved.success
    folder = Path(saved.message.split(', ')[0]).parent
    assert folder.parent == inside / 'maps'
    assert {path.name for path in inside.iterdir()} == {'journal', 'maps'}
    assert {path.name for path in tmp_path.iterdir()} == {'inside', 'poses.yaml', 'node_0.log'}
    assert wild in (folder / 'report.json').read_text()
