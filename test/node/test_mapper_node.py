"""The node in a second process, over DDS."""

from __future__ import annotations

import json
import math
import re
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import ParameterType
from robot import MAPS, Robot
from rosgraph_msgs.msg import Clock

from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.commands.process_bag import main as process_bag
from forward_grid_mapper.commands.simulate import write_recording
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.map_files import read_map
from forward_grid_mapper.simulation.drive import Recording, corridor_drive, door_drive
from forward_grid_mapper.simulation.sonar import NOISY

RELIABLE = ('-p', 'range_reliability:=reliable', '-p', 'odom_reliability:=reliable')


def extrinsics(recording: Recording) -> list[str]:
    arguments = []
    for frame, pose in recording.extrinsics:
        arguments += ['-p', f'sensors.{frame}.pose:=[{pose.x!r}, {pose.y!r}, {pose.yaw!r}]']
    return arguments


def merged(recording: Recording) -> list[Any]:
    return sorted([*recording.odometry, *recording.ranges], key=lambda message: message.stamp)


@pytest.fixture(scope='module')
def door() -> Recording:
    return door_drive(3, NOISY, seed=2)


def values(message: OccupancyGrid) -> np.ndarray:
    return np.array(message.data, np.int8).reshape(message.info.height, message.info.width)


def test_drive_gives_three_maps_to_late_subscribers(start: Any, robot: Robot, door: Recording, tmp_path: Path) -> None:
    start(*RELIABLE, *extrinsics(door), '-p', f'save_directory:={tmp_path}/maps here', '-p', 'publish_rate:=5.0')
    robot.meet()
    assert robot.get_map('ml_map').info.width == 0
    robot.play(merged(door))
    answer = robot.call('run_em')
    assert answer.success, answer.message
    for word in ('iterations', 'log-likelihood', 'flips', 'seconds'):
        assert word in answer.message
    sensors = robot.until(
        lambda: 'judged' not in robot.diagnostics['sensors']['message'] and robot.diagnostics['sensors']
    )
    assert {frame for frame, _ in door.extrinsics} <= set(sensors) and ' short: ' in sensors[door.extrinsics[0][0]]
    robot.listen()
    for name in MAPS:
        message = robot.until(lambda name=name: robot.maps[name] and robot.maps[name][-1], what=name)
        assert message.header.frame_id == 'odom'
        assert message.header.stamp == message.info.map_load_time
        assert message.info.resolution == pytest.approx(0.1)
        assert message.info.origin.orientation.w == 1.0
        assert set(np.unique(values(message))) <= set(range(-1, 101))
        assert values(robot.get_map(name)).shape == values(message).shape
    assert set(np.unique(values(robot.maps['ml_map'][-1]))) == {-1, 0, 100}
    first, second = (robot.call('save_maps') for _ in range(2))
    assert first.success and second.success, first.message
    folder, other = (Path(answer.message.split(' for Nav2, ')[0]).parent for answer in (first, second))
    names = {path.name for path in folder.iterdir()}
    assert names >= {'live_map.pgm', 'ml_map.yaml', 'maps.npz', 'report.json', 'report.txt', 'report.html'}
    assert f', and {len(names) - 3} files more' in first.message
    assert folder != other and {path.name for path in other.iterdir()} == names
    # published maps equal saved maps
    for name in MAPS:
        message = robot.maps[name][-1]
        grid, saved = read_map(folder / f'{name}.yaml')
        shown = values(robot.get_map(name))
        assert grid.shape == shown.shape
        assert grid.origin == pytest.approx((message.info.origin.position.x, message.info.origin.position.y))
        assert np.array_equal(np.where(np.isnan(saved), -1, np.round(saved * 100)), shown)


def compare(robot: Robot, bag: Path, out: Path, *options: str) -> None:
    """Save the maps of the node, and compare them with those of process_bag."""
    assert robot.call('run_em').success
    saved = robot.call('save_maps')
    assert saved.success, saved.message
    folder = Path(saved.message.split(' for Nav2, ')[0]).parent
    assert process_bag([str(bag), '-o', str(out), '-q', *options]) == 0
    ours, theirs = read_npz(folder / 'maps.npz'), read_npz(out / 'maps.npz')
    counts = [json.loads((f / 'report.json').read_text())['counts'] for f in (folder, out)]
    assert counts[0]['accepted'] == counts[1]['accepted']
    assert counts[0]['received'] == counts[1]['received']
    assert ours.grid == theirs.grid
    for name in ('live', 'ml', 'uncertainty'):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name), equal_nan=True), name
    assert ours.log_likelihood == theirs.log_likelihood


def replay(start: Any, robot: Robot, path: Path, tmp_path: Path, odom_topic: str | None = None) -> None:
    """Replay a bag to a node with the sensor poses of the bag, and compare its maps with the offline ones."""
    with Bag(path) as bag:
        transforms = bag.static_transforms()
        messages = list(bag.messages(bag.choose_topics(None, odom_topic)))
    arguments = []
    for frame in sorted({message.frame_id for message in messages if isinstance(message, RangeMessage)}):
        pose = transforms.lookup('base_link', frame)
        assert pose is not None
        arguments += ['-p', f'sensors.{frame}.pose:=[{pose.x!r}, {pose.y!r}, {pose.yaw!r}]']
    start(*RELIABLE, *arguments, '-p', f'save_directory:={tmp_path}')
    robot.meet()
    robot.play(messages)
    compare(robot, path, tmp_path / 'offline', *(['--odom-topic', odom_topic] if odom_topic else []))


@pytest.mark.slow
@pytest.mark.parametrize('name', ['office_a', 'office_b'])
def test_node_and_offline_agree_on_real_recordings(
    start: Any, robot: Robot, shared: Path, tmp_path: Path, name: str
) -> None:
    replay(start, robot, shared / 'data' / name / 'bag', tmp_path, '/odom_corrected')


def test_node_and_offline_agree_on_a_simulated_drive(start: Any, robot: Robot, door: Recording, tmp_path: Path) -> None:
    (tmp_path / 'sim').mkdir()
    replay(start, robot, write_recording(tmp_path / 'sim', door), tmp_path)


def test_grid_is_at_the_place_of_the_world(start: Any, robot: Robot, tmp_path: Path) -> None:
    # Two walls, seen from a place off the origin. Their surfaces are a little in front of the centres of their cells,
    # which are 1 m to the left and 2 m ahead.
    start(*RELIABLE, '-p', 'sensors.left.pose:=[0.0, 0.0, 1.5707963]', '-p', 'sensors.front.pose:=[0.0, 0.0, 0.0]')
    robot.meet()
    messages: list[Any] = []
    for k in range(60):
        stamp = 10 * NANOSECONDS + k * NANOSECONDS // 20
        pose = Pose2(5.05, -3.05 + 0.01 * (k % 5), 0.0)
        messages.append(OdometryMessage(stamp, 'world', 'base', pose))
        messages.append(RangeMessage(stamp, 'left', 0.97 - 0.01 * (k % 5), 0.1, 3.0, 0.2))
        messages.append(RangeMessage(stamp, 'front', 1.97, 0.1, 3.0, 0.2))
    robot.play(messages)
    assert robot.call('run_em').success
    message = robot.get_map('ml_map')
    assert message.header.frame_id == 'world'
    cells, origin, size = values(message), message.info.origin.position, message.info.resolution

    def cell(x: float, y: float) -> int:
        return int(cells[math.floor((y - origin.y) / size), math.floor((x - origin.x) / size)])

    assert cell(5.05, -2.05) == 100, 'the wall on the left'
    assert cell(7.05, -3.05) == 100, 'the wall ahead'
    assert cell(5.05, -2.55) == cell(6.05, -3.05) == 0
    rows, columns = np.nonzero(cells == 100)
    x, y = origin.x + (columns + 0.5) * size, origin.y + (rows + 0.5) * size
    assert (((x > 6.8) & (np.abs(y + 3.05) < 0.4)) | ((y > -2.3) & (np.abs(x - 5.05) < 0.3))).all()


def test_services_during_em_and_after_reset(start: Any, robot: Robot) -> None:
    recording = corridor_drive(0)
    node = start(*RELIABLE, *extrinsics(recording), '-p', 'resolution:=0.02', '-p', 'publish_rate:=4.0')
    robot.meet()
    robot.listen()
    messages = merged(recording)
    most = len(messages) * 4 // 5
    robot.play(messages[:most])
    first = robot.ask('run_em')
    robot.until(lambda: robot.diagnostics.get('EM', {}).get('state', 'idle') != 'idle', what='EM runs')
    second = robot.call('run_em')
    assert not second.success
    assert 'already running' in second.message
    # live mapping continues, and the intermediate map is published
    before = len(robot.maps['live_map'])
    robot.play(messages[most : most + 200], rate=400.0)
    assert not first.done(), 'EM must last longer than this for the test to show anything'
    robot.until(lambda: len(robot.maps['live_map']) > before, what='live maps go on')
    robot.until(lambda: robot.maps['ml_map'], what='the map so far')
    assert not first.done()
    reset = robot.call('reset')
    assert reset.success
    answer = robot.until(first.result, what='run_em ends')
    assert not answer.success
    assert 'cancelled' in answer.message
    robot.until(lambda: robot.maps['ml_map'][-1].info.width == 1, what='an empty map')
    empty = robot.call('run_em')
    assert not empty.success
    assert 'no Range message has been received on /sonar' in empty.message
    save = robot.call('save_maps')
    assert not save.success
    # a running search does not prevent the node from ending
    robot.sent = 0
    robot.play(messages[: len(messages) // 5])
    robot.until(lambda: robot.diagnostics['EM']['state'] == 'idle', what='the cancelled run has ended')
    robot.ask('run_em')
    robot.until(lambda: robot.diagnostics['EM']['state'] != 'idle', what='EM runs again')
    assert node.stop(signal.SIGTERM) == 0


def test_parameters_are_checked_at_run_time(start: Any, robot: Robot, door: Recording) -> None:
    start(*RELIABLE, *extrinsics(door), '-p', 'prior:=0.5', '-p', 'p_hitt:=0.4', '-p', 'alpha:=1')
    robot.meet()
    assert robot.get_parameter('prior').double_value == 0.5
    for name, value, why in (
        ('p_hit', 1.5, 'range'),
        ('p_hit', 'often', 'number|type'),
        ('over_range', 'maybe', 'no_echo'),
        ('resolution', 0.05, 'read-only|read_only'),
        ('p_rand', 0.9, 'p_lost'),
        ('max_iterations', 0, 'range'),
        ('sensors.sonar_00.pose', 'x', 'restart|type'),
    ):
        result = robot.set_parameter(name, value)
        assert not result.successful, name
        assert re.search(why, result.reason), result.reason
    for name, value in (('p_hit', 0.9), ('max_iterations', 100), ('sigma', 1), ('publish_rate', 10.0)):
        result = robot.set_parameter(name, value)
        assert result.successful, result.reason
    # the declared type of a parameter stays, after wrong types and whole numbers
    for name, value in (('p_hit', 0.9), ('sigma', 1.0)):
        assert robot.get_parameter(name).type == ParameterType.PARAMETER_DOUBLE
        assert robot.get_parameter(name).double_value == value
    robot.play(merged(door)[:400])
    first = robot.call('run_em').message
    robot.set_parameter('sigma', 0.05)
    assert robot.call('run_em').message.split('objective')[1] != first.split('objective')[1]


def test_bad_value_at_start_is_an_error(start: Any) -> None:
    node = start('-p', 'p_hit:=2.0', ready=False)
    assert node.process.wait(60) == 1
    assert 'p_hit' in node.output
    assert 'Traceback' not in node.output


def test_one_topic_for_ranges_and_odometry_is_an_error(start: Any) -> None:
    node = start('-p', 'odom_topic:=/sonar', ready=False)
    assert node.process.wait(60) == 1
    assert '/sonar cannot be a topic of both Range and odometry' in node.output
    assert 'Traceback' not in node.output


def test_misspelt_parameter_is_named(start: Any) -> None:
    node = start('-p', 'p_hitt:=0.5', '-p', 'save_directory:=/proc/version/maps')
    assert 'did you mean p_hit' in node.output
    assert 'save_maps will fail: /proc/version is not a folder' in node.output


def test_faults_are_in_the_diagnostics_until_they_end(start: Any, robot: Robot) -> None:
    node = start(*RELIABLE, '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
    robot.meet()

    def second(stamp: float, odometry: bool = True, frame: str = 'sonar') -> list[Any]:
        out: list[Any] = []
        for k in range(10):
            tick = round((stamp + k / 10) * NANOSECONDS)
            if odometry:
                out.append(OdometryMessage(tick, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0)))
            out.append(RangeMessage(tick, frame, 1.0, 0.1, 3.0, 0.3))
        return out

    def readings() -> dict[str, Any]:
        return robot.diagnostics['readings']

    robot.play(second(100.0))
    assert int(readings()['readings accepted']) == 10
    robot.play(second(101.0, frame='mystery'))
    robot.until(lambda: 'mystery' in readings()['frames without a pose'], what='the frame is named')
    node.wait_for('sensor mystery', 5.0)
    assert node.output.count('sensor mystery') == 1
    robot.play(second(102.0, odometry=False))
    robot.until(lambda: 'no odometry' in readings()['message'], what='a warning')
    assert readings()['level'] != b'\x00'
    robot.play(second(120.0))
    robot.until(lambda: 'no odometry' not in readings()['message'], what='the warning passes')
    # the bag loops: waiting readings are dropped, the map is kept
    accepted = int(readings()['readings accepted'])
    robot.play(second(100.0))
    robot.until(lambda: int(readings()['clock jumps back']) == 1, what='the jump is counted')
    assert int(readings()['readings accepted']) == accepted + 10
    assert 'jumped back' in node.output
    total = sum(int(readings()[f'readings {k}']) for k in ('accepted', 'waiting for a pose', 'rejected'))
    assert total == int(readings()['readings received'])


def test_ranges_in_millimetres_give_a_warning_until_reset(start: Any, robot: Robot) -> None:
    start(*RELIABLE, '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
    robot.meet()
    messages: list[Any] = []
    for k in range(40):
        stamp = 100 * NANOSECONDS + k * NANOSECONDS // 10
        messages.append(OdometryMessage(stamp, 'odom', 'base_link', Pose2(0.01 * k, 0.0, 0.0)))
        messages.append(RangeMessage(stamp, 'sonar', 2900.0 - 10 * k, 0.1, 3.0, 0.3))
    robot.play(messages)
    robot.until(lambda: 'millimetres' in robot.diagnostics['readings']['message'], what='a warning')
    assert robot.diagnostics['readings']['level'] != b'\x00'
    assert robot.call('reset').success
    robot.until(lambda: 'millimetres' not in robot.diagnostics['readings']['message'], what='the warning passes')


def test_pause_rejects_readings(start: Any, robot: Robot) -> None:
    start(*RELIABLE, '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
    robot.meet()
    messages: list[Any] = []
    for stamp in range(NANOSECONDS, 11 * NANOSECONDS, NANOSECONDS):
        messages.append(OdometryMessage(stamp, 'odom', 'base', Pose2(0, 0, 0)))
        messages.append(RangeMessage(stamp, 'sonar', 1.0, 0.1, 3.0, 0.3))
    assert robot.pause(True).success
    robot.play(messages[:10])
    assert robot.pause(False).success
    robot.play(messages[10:])
    robot.until(lambda: robot.diagnostics['readings'].get('rejected: paused') == '5')
    assert robot.diagnostics['readings']['readings accepted'] == '5'


def test_two_nodes_in_two_namespaces_map_separately(start: Any, domain: int) -> None:
    for name in ('one', 'two'):
        start(*RELIABLE, '-r', f'__ns:=/{name}', '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
    robots = [Robot(domain, f'/{name}/forward_grid_mapper', f'/{name}/') for name in ('one', 'two')]
    try:
        for k, robot in enumerate(robots):
            robot.meet()
            robot.play(
                [
                    OdometryMessage(NANOSECONDS, 'odom', 'base', Pose2(10.0 * k, 0, 0)),
                    RangeMessage(NANOSECONDS, 'sonar', 1.0, 0.1, 3.0, 0.3),
                ]
            )
            assert robot.call('run_em').success
        origins = [robot.get_map('ml_map').info.origin.position.x for robot in robots]
        assert origins[1] - origins[0] == pytest.approx(10.0)
    finally:
        for robot in robots:
            robot.close()


def test_maps_have_stamps_of_simulated_time(start: Any, robot: Robot) -> None:
    start(*RELIABLE, '-p', 'use_sim_time:=true', '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
    robot.meet()
    clock = robot.node.create_publisher(Clock, '/clock', 10)
    now = Clock()
    now.clock.sec = 42
    # the node may discover the publisher after the first messages, and keeps only what it received
    robot.node.create_timer(0.05, lambda: clock.publish(now))
    robot.until(lambda: robot.time == 42, what='the node has the time')
    robot.play(
        [
            OdometryMessage(42 * NANOSECONDS, 'odom', 'base', Pose2(0, 0, 0)),
            RangeMessage(42 * NANOSECONDS, 'sonar', 1.0, 0.1, 3.0, 0.3),
        ]
    )
    assert robot.call('run_em').success
    assert robot.get_map('ml_map').header.stamp.sec == 42


@pytest.mark.parametrize(
    ('number', 'times'), [(signal.SIGINT, 1), (signal.SIGINT, 2), (signal.SIGTERM, 1), (signal.SIGHUP, 1)]
)
def test_signals_end_the_node_normally(start: Any, number: signal.Signals, times: int) -> None:
    node = start()
    assert node.stop(number, times) == 0
    assert 'Traceback' not in node.output


def test_node_under_nohup_survives_its_terminal(start: Any) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        node = start()
    finally:
        signal.signal(signal.SIGHUP, before)
    node.process.send_signal(signal.SIGHUP)
    time.sleep(0.5)
    assert node.process.poll() is None
    assert node.stop() == 0


def test_signal_during_compilation_ends_the_node(start: Any, tmp_path: Path) -> None:
    node = start(ready=False, NUMBA_CACHE_DIR=str(tmp_path / 'cache'))
    node.wait_for('preparing kernels')
    time.sleep(1.0)
    assert node.stop(signal.SIGINT, 2) == 0
    assert 'Traceback' not in node.output
