"""Faults around the node: processes that die or stop, lack of memory, and full disks."""

from __future__ import annotations

import contextlib
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from fault_samples import OPTIONS, circle, journal_of
from patience import PATIENCE, line_of
from robot import NodeProcess, Robot, environment

from forward_grid_mapper.simulation.drive import corridor_drive

BYSTANDER = Path(__file__).parent / 'bystander.py'


@contextlib.contextmanager
def bystander(domain: int, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, str(BYSTANDER), *arguments], stdout=subprocess.PIPE, text=True, env=environment(domain)
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE)


def accepted(robot: Robot) -> int:
    return int(robot.diagnostics.get('readings', {}).get('readings accepted', -1))


def em_state(robot: Robot) -> str:
    return str(robot.diagnostics.get('EM', {}).get('state', 'unknown'))


def memory(process: NodeProcess, key: str) -> int:
    text = Path(f'/proc/{process.process.pid}/status').read_text()
    return int(next(line for line in text.splitlines() if line.startswith(key)).split()[1]) * 1024


@pytest.mark.slow
def test_callers_that_die_or_call_all_at_once(start: Any, robot: Robot, domain: int, tmp_path: Path) -> None:
    folder = journal_of(tmp_path / 'journal', corridor_drive(0).readings)
    start(*OPTIONS, '-p', f'journal:={folder}', '-p', 'resolution:=0.04')
    robot.meet()
    calls = [robot.ask('run_em') for _ in range(20)]
    for call in calls:
        robot.until(call.done, 60.0, 'an answer')
    answers = [call.result() for call in calls]
    assert sum(answer.success for answer in answers) == 1
    assert all('already running' in answer.message for answer in answers if not answer.success)
    robot.until(lambda: em_state(robot) == 'idle', what='the last run has ended')
    with bystander(domain, 'call', '/forward_grid_mapper/run_em') as caller:
        assert line_of(caller) == 'called\n'
        robot.until(lambda: em_state(robot) not in ('idle', 'unknown'), what='EM runs')
        caller.kill()
        caller.wait(PATIENCE)
    robot.play(circle(0, 100))
    robot.until(lambda: em_state(robot) == 'idle', 60.0, 'EM ends')
    assert 'log-likelihood' in robot.diagnostics['EM']['last run']
    assert robot.call('run_em').success


@pytest.mark.slow
def test_lack_of_memory_fails_only_the_call(start: Any, robot: Robot, tmp_path: Path) -> None:
    readings = corridor_drive(0).readings.select(slice(None, 4000))
    folder = journal_of(tmp_path / 'journal', readings)
    node = start(*OPTIONS, '-p', f'journal:={folder}', '-p', 'resolution:=0.02')
    robot.meet()
    robot.sent = 4000
    robot.play(circle(0, 50))
    # compilation needs more than the limit leaves
    robot.until(lambda: robot.diagnostics.get('background', {}).get('message') == 'no fault', what='all is compiled')
    free = memory(node, 'VmSize:')
    # enough for all work of the node, and less than the least that EM needs
    limit = memory(node, 'VmSize:') + (50 << 20)
    resource.prlimit(node.process.pid, resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    answer = robot.call('run_em')
    assert not answer.success
    assert ' MB are free' in answer.message
    robot.play(circle(robot.sent, 50))
    robot.until(lambda: accepted(robot) == robot.sent, what='mapping continues')
    resource.prlimit(node.process.pid, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    answer = robot.call('run_em')
    assert answer.success
    assert answer.message.startswith(f'{robot.sent} readings')
    assert memory(node, 'VmSize:') < free + (2 << 30)


def test_node_stopped_for_some_time_catches_up(start: Any, robot: Robot) -> None:
    node = start(*OPTIONS)
    robot.meet()
    robot.play(circle(0, 50))
    node.process.send_signal(signal.SIGSTOP)
    for message in circle(50, 400):
        robot.send(message)
        time.sleep(0.002)
    node.process.send_signal(signal.SIGCONT)
    robot.until(lambda: accepted(robot) == 450, what='all are taken')
    assert robot.call('run_em').success


@pytest.mark.slow
def test_subscriber_that_never_reads_blocks_nothing(start: Any, robot: Robot, domain: int) -> None:
    start(*OPTIONS)
    robot.meet()
    with bystander(domain, 'listen', '/forward_grid_mapper/live_map') as listener:
        robot.play(circle(0, 50))
        assert line_of(listener) == 'a map\n'
        listener.send_signal(signal.SIGSTOP)
        robot.listen()
        robot.until(lambda: robot.maps['live_map'], what='the latest map')
        begin = len(robot.maps['live_map'])
        for first in range(50, 250, 50):
            robot.play(circle(first, 50))
            robot.spin(0.2)
        robot.until(lambda: accepted(robot) == 250, what='mapping continues')
        assert len(robot.maps['live_map']) > begin + 3
        assert float(robot.diagnostics['readings']['longest delay of a reading (ms)']) < 1000
        listener.send_signal(signal.SIGCONT)
        assert line_of(listener) == 'a map\n'


@pytest.mark.slow
def test_restarted_publishers_are_received(start: Any, domain: int) -> None:
    start(*OPTIONS)
    watcher = Robot(domain)
    try:
        for k in range(3):
            with bystander(domain, 'publish', str(100 * k), '100') as publisher:
                assert line_of(publisher) == 'published\n'
                watcher.until(lambda total=100 * (k + 1): accepted(watcher) == total, what='all are taken')
        assert watcher.diagnostics['readings']['readings rejected'] == '0'
    finally:
        watcher.close()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 kB."""
    folder = tmp_path / 'a small disk'
    folder.mkdir()
    mounted = subprocess.run(['mount', '-t', 'tmpfs', '-o', 'size=400k', 'none', str(folder)], check=False)
    if mounted.returncode:
        pytest.skip('mounting needs root')
    yield folder
    subprocess.run(['umount', '-l', str(folder)], check=False)


def test_full_disk_gives_a_warning_and_no_incomplete_files(start: Any, robot: Robot, small_disk: Path) -> None:
    ballast = small_disk / 'ballast'
    options = ('-p', f'journal:={small_disk}/journal', '-p', f'save_directory:={small_disk}/maps')
    node = start(*OPTIONS, *options)
    robot.meet()
    robot.play(circle(0, 100))
    robot.until(lambda: robot.diagnostics['journal']['readings to be written'] == '0')
    with contextlib.suppress(OSError), ballast.open('wb', buffering=0) as file:
        while True:
            file.write(bytes(1000))
    robot.play(circle(100, 500))
    robot.until(lambda: robot.diagnostics['journal']['level'] != b'\x00', what='a warning')
    assert 'No space left' in robot.diagnostics['journal']['message']
    robot.until(lambda: accepted(robot) == 600, what='all readings are accepted')
    saved = robot.call('save_maps')
    assert not saved.success
    assert 'the disk is full' in saved.message
    assert sorted(path.name for path in small_disk.iterdir()) == ['ballast', 'journal']
    ballast.unlink()
    robot.until(lambda: robot.diagnostics['journal']['readings to be written'] == '0', what='the journal catches up')
    assert robot.call('reset').success
    node.stop(signal.SIGKILL)
    from forward_grid_mapper.files.journal_format import Contents
    from forward_grid_mapper.files.journal_reader import read

    contents = Contents()
    found = list(read(small_disk / 'journal' / 'drive_0001.journal', contents))
    assert sum(map(len, found)) == 600
    assert contents.harm == ''


@pytest.mark.parametrize('module', ['rclpy.signals', 'numpy', 'rclpy.node', 'forward_grid_mapper.node.em_service'])
def test_ctrl_c_during_imports_gives_no_traceback(domain: int, module: str) -> None:
    process = subprocess.Popen(
        [sys.executable, '-X', 'importtime', '-m', 'forward_grid_mapper', 'mapper'],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(domain),
    )
    assert process.stdout is not None
    assert any(line.rpartition('|')[2].strip() == module for line in process.stdout)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode in (0, -signal.SIGINT, 128 + signal.SIGINT)
    assert 'Traceback' not in output
