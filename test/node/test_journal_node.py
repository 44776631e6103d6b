"""The node with a journal: killed, restarted, and mapped offline from the journal."""

from __future__ import annotations

import json
import random
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from robot import Robot

from forward_grid_mapper.commands.process_bag import main as process_bag
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.files.map_archive import read_npz

OPTIONS = (
    *('-p', 'range_reliability:=reliable', '-p', 'odom_reliability:=reliable', '-p', 'publish_rate:=10.0'),
    *('-p', 'sensors.sonar/left.pose:=[0.1, 0.0, 0.4]'),
)


def drive(first: int, count: int) -> list[Any]:
    """Readings of a robot in a round room, each with an odometry message."""
    out: list[Any] = []
    for k in range(first, first + count):
        stamp = k * NANOSECONDS // 20
        out.append(OdometryMessage(stamp, 'odom', 'base_link', Pose2(0.001 * k, 0.0, 0.05 * k)))
        out.append(RangeMessage(stamp, 'sonar/left', 2.0 + 0.3 * (k % 7 == 0), 0.1, 5.0, 0.3))
    return out


def accepted(robot: Robot) -> int:
    return int(robot.diagnostics.get('readings', {}).get('readings accepted', -1))


def until_accepted(robot: Robot, count: int) -> None:
    robot.until(lambda: accepted(robot) == count, what=f'{count} are accepted')
    robot.until(lambda: robot.diagnostics['journal']['readings to be written'] == '0')


@pytest.mark.slow
def test_killed_node_continues_after_a_restart(
    start: Any, domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / 'the journal'
    options = (*OPTIONS, '-p', f'journal:={folder}', '-p', f'save_directory:={tmp_path}/maps')
    sent = 0
    rng = random.Random(4)
    for run in range(2):
        node = start(*options)
        assert f'restored {sent} readings of an earlier run' in node.output
        robot = Robot(domain)
        try:
            robot.meet()
            robot.sent = sent
            count = rng.randrange(100, 400)
            robot.play(drive(sent, count))
            sent += count
            until_accepted(robot, sent)
            live = np.array(robot.get_map('live_map').data)
            robot.spin(0.3)
            if run == 0:
                other = start(*OPTIONS, '-p', f'journal:={folder}', '-r', '__node:=other', ready=False)
                assert other.process.wait(60) == 1
                assert 'another node' in other.output
                assert 'Traceback' not in other.output
        finally:
            robot.close()
        if run == 0:
            node.stop(signal.SIGKILL)
    robot = Robot(domain)
    try:
        robot.meet()
        assert np.array_equal(np.array(robot.get_map('live_map').data), live)
        assert robot.call('run_em').message.startswith(f'{sent} readings')
        saved = Path(robot.call('save_maps').message.split(', ')[0]).parent
        assert process_bag([str(folder), '-o', str(tmp_path / 'offline'), '-q']) == 0
        ours, offline = read_npz(saved / 'maps.npz'), read_npz(tmp_path / 'offline' / 'maps.npz')
        assert ours.grid == offline.grid
        for name in ('live', 'ml', 'uncertainty'):
            assert np.array_equal(getattr(ours, name), getattr(offline, name), equal_nan=True)
        report = json.loads((tmp_path / 'offline' / 'report.json').read_text())
        assert report['sensors']['sonar/left']['accepted'] == sent
        assert report['input']['map_frame'] == 'odom'
        # a reset begins a new drive and keeps the old one
        answer = robot.call('reset').message
        assert 'the journal keeps them in drive_0001.journal' in answer
        robot.until(lambda: accepted(robot) == 0)
        robot.sent = 0
        robot.play(drive(5000, 50))
        robot.until(lambda: accepted(robot) == 50)
    finally:
        robot.close()
    assert node.stop() == 0
    node = start(*options)
    assert 'restored 50 readings of an earlier run' in node.output
    # a node that ended normally leaves no log, a running one has a log
    files = {path.name for path in folder.iterdir()}
    assert files - {'drive_0002.journal-wal'} == {'drive_0001.journal', 'drive_0002.journal', 'lock'}
    first = folder / 'drive_0001.journal'
    assert process_bag([str(first), '-o', str(tmp_path / 'old'), '-q']) == 0
    first.write_bytes(first.read_bytes()[: first.stat().st_size * 2 // 3])
    # the missing pages depend on when the node wrote: either some readings are left, or the error is reported
    capsys.readouterr()
    left = process_bag([str(first), '-o', str(tmp_path / 'torn'), '-q']) == 0
    assert left or 'cannot be read to its end' in capsys.readouterr().err


def test_node_and_offline_keep_the_same_readings(start: Any, robot: Robot, tmp_path: Path) -> None:
    folder = tmp_path / 'journal'
    start(*OPTIONS, '-p', f'journal:={folder}', '-p', f'save_directory:={tmp_path}/maps', '-p', 'max_readings:=300')
    robot.meet()
    robot.play(drive(0, 1500))
    robot.until(lambda: accepted(robot) == 1500)
    assert robot.diagnostics['readings']['readings kept to map from'] == '300 of at most 300'
    assert robot.call('run_em').message.startswith('300 readings')
    saved = Path(robot.call('save_maps').message.split(', ')[0]).parent
    warnings = json.loads((saved / 'report.json').read_text())['warnings']
    assert any('EM used 300 of 1500 readings' in text for text in warnings)
    assert not any('arrived after EM' in text for text in warnings)
    out = tmp_path / 'offline'
    assert process_bag([str(folder), '-o', str(out), '-q', '--set', 'max_readings=300']) == 0
    # a journal has no poses of the sensors, so they cannot be compared with the readings; these readings fit no room
    warnings = [text for text in warnings if 'with this corrected' not in text]
    assert warnings == json.loads((out / 'report.json').read_text())['warnings']
    ours, offline = read_npz(saved / 'maps.npz'), read_npz(out / 'maps.npz')
    assert ours.grid == offline.grid
    for name in ('live', 'ml', 'uncertainty'):
        assert np.array_equal(getattr(ours, name), getattr(offline, name), equal_nan=True)


def test_journal_path_below_a_file_is_rejected(start: Any, tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    node = start('-p', f'journal:={tmp_path}/file/journal', ready=False)
    assert node.process.wait(60) == 1
    assert 'is a file' in node.output
    assert 'Traceback' not in node.output


def journal_status(robot: Robot) -> dict[str, Any]:
    return dict(robot.diagnostics.get('journal', {}))


def test_deleted_or_hostile_journal_is_replaced(start: Any, domain: int, robot: Robot, tmp_path: Path) -> None:
    folder = tmp_path / 'journal'
    options = (*OPTIONS, '-p', f'journal:={folder}')
    node = start(*options)
    robot.meet()
    robot.play(drive(0, 300))
    until_accepted(robot, 300)
    # also without new messages
    (folder / 'drive_0001.journal').unlink()
    robot.until(lambda: journal_status(robot).get('file') == 'drive_0002.journal', what='a new file')
    assert journal_status(robot)['level'] != b'\x00'
    assert 'was deleted or moved' in journal_status(robot)['message']
    assert 'was deleted or moved' in node.output
    robot.play(drive(300, 100))
    until_accepted(robot, 400)
    # while the node writes
    assert process_bag([str(folder), '-o', str(tmp_path / 'offline'), '-q']) == 0
    report = json.loads((tmp_path / 'offline' / 'report.json').read_text())
    assert report['sensors']['sonar/left']['accepted'] == 400
    node.stop(signal.SIGKILL)
    path = folder / 'drive_0002.journal'
    Path(f'{path}-wal').unlink(missing_ok=True)
    path.write_bytes(b'SQLite format 3\0' + bytes(range(256)) * 100)
    node = start(*options)
    assert 'the journal continues in drive_0003.journal' in node.output
    assert 'restored 0 readings of an earlier run' in node.output
    # a new client, since the first one still counts the killed node among its subscribers
    other = Robot(domain)
    try:
        other.meet()
        other.play(drive(400, 100))
        until_accepted(other, 100)
    finally:
        other.close()
    assert 'Traceback' not in node.output
    assert node.stop() == 0
