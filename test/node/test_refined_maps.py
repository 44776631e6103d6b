"""The node with `refine_poses` and `online` over DDS: refinement gives the result of the offline tool."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from drift_samples import bent_drive, in_turn, write_parameters
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from robot import LATCHED

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.simulate import write_recording
from forward_grid_mapper.files.map_archive import read_npz

OK, WARN = b'\x00', b'\x01'


def same_maps(one: Path, other: Path) -> None:
    a, b = (read_npz(folder / 'maps.npz') for folder in (one, other))
    assert a.grid == b.grid
    for name in ('live', 'ml', 'uncertainty'):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name


def folder_of(answer: Any) -> Path:
    return Path(answer.message.split(', ')[0]).parent


@pytest.mark.slow
def test_maps_of_a_drive_with_drift_equal_those_of_the_offline_tool(
    start: Callable[..., Any], robot: Any, tmp_path: Path
) -> None:
    recording = bent_drive()
    bag = write_recording(tmp_path, recording)
    file = write_parameters(
        tmp_path / 'parameters.yaml', recording, refine_poses=True, online=True, save_directory=str(tmp_path / 'saved')
    )
    start('--params-file', str(file))
    robot.listen()
    robot.meet()
    messages = in_turn(recording)
    first = int(0.6 * len(messages))
    robot.play(messages[:first], 1000.0)
    status = robot.until(lambda: robot.diagnostics.get('trajectory'))
    assert 'until run_em is called' in status['message']
    # following after an earlier run has no effect on the next run
    answer = robot.call('run_em', seconds=300.0)
    assert 'trajectory refined' in answer.message, answer.message
    robot.play(messages[first:], 1000.0)
    for key, sent in (('readings accepted', recording.ranges), ('odometry received', recording.odometry)):
        robot.until(lambda key=key, sent=sent: int(robot.diagnostics['readings'][key]) == len(sent), what=key)
    robot.until(lambda: not robot.diagnostics['trajectory']['followed since the latest run'].startswith('0 '))
    answer = robot.call('run_em', seconds=300.0)
    assert answer.success, answer.message
    assert re.search(r'trajectory refined \(.*\): odometry was off by 0\.\d\d m', answer.message), answer.message
    assert (
        process_bag.main([str(bag), '-o', str(tmp_path / 'maps'), '--params', str(file), '--refine-poses', '-q']) == 0
    )
    saved = folder_of(robot.call('save_maps', seconds=120.0))
    same_maps(saved, tmp_path / 'maps')
    for name in ('trajectory.tum', 'odometry.tum'):
        assert (saved / name).read_bytes() == (tmp_path / 'maps' / name).read_bytes()
    reports = [json.loads((folder / 'report.json').read_text()) for folder in (saved, tmp_path / 'maps')]
    node, offline = (report['input']['trajectory'] for report in reports)
    # only process_bag estimates the errors of the wheels with their uncertainty
    estimated = {'calibration_estimates', 'odometry', 'calibrated'}
    assert offline.keys() - node.keys() == {'calibration_estimates', 'calibrated'}
    common = [{k: v for k, v in each.items() if k not in estimated} for each in (node, offline)]
    assert common[0] == common[1]
    assert reports[0]['input']['trajectory']['refined']
    assert (reports[0]['input']['odom_frame'], reports[0]['input']['map_frame']) == ('odom', 'map')
    assert {name: robot.maps[name][-1].header.frame_id for name in robot.maps} == dict.fromkeys(robot.maps, 'map')
    # late subscribers get the path, and the pose if there is no TF
    paths: list[PathMessage] = []
    poses: list[PoseWithCovarianceStamped] = []
    robot.node.create_subscription(PathMessage, f'{robot.name}/path', paths.append, LATCHED)
    robot.node.create_subscription(PoseWithCovarianceStamped, f'{robot.name}/pose', poses.append, 10)
    robot.until(lambda: paths and paths[-1].poses)
    way = np.loadtxt(saved / 'trajectory.tum')
    assert paths[-1].header.frame_id == 'map'
    last = paths[-1].poses[-1].pose.position
    assert (last.x, last.y) == pytest.approx(tuple(way[-1, 1:3]), abs=1e-5)
    robot.send(recording.odometry[-1]._replace(stamp=recording.odometry[-1].stamp + 10**8))
    robot.until(lambda: poses)
    there = poses[-1].pose.pose.position
    assert (there.x, there.y) == pytest.approx(tuple(way[-1, 1:3]), abs=1e-5)
    status = robot.until(
        lambda: 'places recognised' in robot.diagnostics['trajectory'] and robot.diagnostics['trajectory']
    )
    assert status['level'] == OK
    assert 'trajectory refined' in status['message']
