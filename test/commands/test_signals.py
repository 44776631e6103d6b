"""Ctrl-C, SIGTERM and SIGHUP at any time: one line, exit code 128 plus the signal, and no files or processes left."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from drive_samples import everything_in, tape, write_tape

import forward_grid_mapper
from forward_grid_mapper.commands import console, process_bag, signals
from forward_grid_mapper.commands.live_node import start_child

ROOT = str(Path(forward_grid_mapper.__file__).parents[1])
AT_IMPORT = """
import os, sys

module, number, command = sys.argv[1:4]

class Interrupting:
    # sends the signal when the module is about to be imported
    def find_spec(self, name, path=None, target=None):
        if name == module:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), int(number))
        return None

sys.meta_path.insert(0, Interrupting())
import forward_grid_mapper.__main__ as entry
sys.argv = [command, *sys.argv[4:]]
sys.exit(getattr(entry, command)())
"""
"""Starts a command like its installed script and interrupts it at the import of a module."""

COMMANDS = {
    'process_bag': ('bag',),
    'learn': ('bag',),
    'replay_bag': ('bag',),
    'simulate': ('door', '-o', 'out'),
    'experiment': ('door',),
    'demo': ('--offline',),
    'mapper': (),
}


def environment(**more: str) -> dict[str, str]:
    path = os.pathsep.join(filter(None, (ROOT, os.environ.get('PYTHONPATH'))))
    return {**os.environ, 'PYTHONPATH': path, **more}


def interrupted(
    folder: Path, module: str, number: signal.Signals, command: str, *arguments: object
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, '-c', AT_IMPORT, module, str(int(number)), command, *map(str, arguments)],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize('command', sorted(COMMANDS))
def test_signal_during_the_import_ends_the_command(tmp_path: Path, command: str, number: signal.Signals) -> None:
    module = {'mapper': 'forward_grid_mapper.node.main'}.get(command, 'numpy')
    done = interrupted(tmp_path, module, number, command, *COMMANDS[command])
    assert (done.returncode, done.stdout) == (128 + number, '')
    assert done.stderr == f'{command}: cancelled; nothing was written\n'
    assert everything_in(tmp_path) == []


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize('module', ['numba', 'yaml', 'rosbags', 'argparse'])
def test_signal_during_other_imports_ends_the_command(tmp_path: Path, module: str, number: signal.Signals) -> None:
    done = interrupted(tmp_path, module, number, 'process_bag', 'bag')
    assert (done.returncode, done.stderr) == (128 + number, 'process_bag: cancelled; nothing was written\n')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_during_the_work_leaves_no_files(tmp_path: Path, number: signal.Signals) -> None:
    """Matplotlib is imported after the maps were written to the temporary folder."""
    bag = write_tape(tmp_path / 'bag', tape())
    before = everything_in(tmp_path)
    done = interrupted(tmp_path, 'matplotlib', number, 'process_bag', bag, '-q', '-o', tmp_path / 'new' / 'maps')
    assert (done.returncode, done.stdout) == (128 + number, '')
    # if this test runs alone, kernels must be compiled
    message = done.stderr.removeprefix('compiling kernels; this takes one to three minutes and is done once\n')
    assert message == 'process_bag: cancelled; nothing was written\n'
    assert everything_in(tmp_path) == before


def test_second_signal_does_not_interrupt_the_clean_up(capsys: pytest.CaptureFixture[str]) -> None:
    cleaned = []

    def body(options: object) -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            cleaned.append(True)
        return 0

    before = [signal.getsignal(number) for number in signals.SIGNALS]
    assert console.run(process_bag.parser(), body, ['bag']) == 130
    assert cleaned == [True]
    assert capsys.readouterr().err == 'process_bag: cancelled; nothing was written\n'
    assert [signal.getsignal(number) for number in signals.SIGNALS] == before


@pytest.mark.parametrize('fails', [False, True])
def test_signal_in_a_callback_of_c_code_ends_the_command(capsys: pytest.CaptureFixture[str], fails: bool) -> None:
    """As in the compiler of kernels: an exception there is printed as ignored, and the compiler may fail."""
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))

    def body(options: object) -> int:
        callback()
        if fails:
            raise RuntimeError('missing object')
        end = time.monotonic() + 60.0
        while time.monotonic() < end:
            pass
        return 0

    before = sys.unraisablehook
    assert console.run(process_bag.parser(), body, ['bag']) == 128 + signal.SIGTERM
    assert capsys.readouterr().err == 'process_bag: cancelled; nothing was written\n'
    assert sys.unraisablehook is before


def test_ignored_signals_stay_ignored(capsys: pytest.CaptureFixture[str]) -> None:
    """As with `nohup`, and in shells without job control for background commands."""

    def body(options: object) -> int:
        signal.raise_signal(signal.SIGINT)
        return 7

    before = {number: signal.signal(number, signal.SIG_IGN) for number in signals.SIGNALS}
    hook = sys.unraisablehook
    try:
        assert console.run(process_bag.parser(), body, ['bag']) == 7
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert capsys.readouterr().err == ''
    assert sys.unraisablehook is hook


# ---- children


def wait_for(what: Callable[[], object], seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, 'it did not happen'
        time.sleep(0.02)


def running(command: str, folder: Path) -> list[int]:
    """Processes of one of our commands with a folder in their command line."""
    found = []
    for process in Path('/proc').glob('[0-9]*'):
        try:
            words = (process / 'cmdline').read_bytes().decode(errors='replace').split('\0')
        except OSError:
            continue
        if command in words and any(str(folder) in word for word in words):
            found.append(int(process.name))
    return found


@pytest.mark.skipif(not Path('/proc/self/cmdline').exists(), reason='there is no /proc')
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_interrupted_demo_leaves_no_node_running(tmp_path: Path, number: signal.Signals) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed (the extra ros, or a sourced ROS 2)')
    folder = tmp_path / 'out'
    command = [sys.executable, '-m', 'forward_grid_mapper', 'demo', '-o', str(folder)]
    demo = subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: running('mapper', tmp_path))
        demo.send_signal(number)
        _, err = demo.communicate(timeout=60)
        wait_for(lambda: not running('mapper', tmp_path), 20)
    finally:
        demo.kill()
    if number == signal.SIGKILL:
        return
    assert demo.returncode == 128 + number
    assert err.splitlines()[-1] == 'demo: cancelled; nothing was written'
    assert 'Traceback' not in err
    assert everything_in(tmp_path) == []


@pytest.mark.skipif(not Path('/proc/self/task').exists(), reason='there is no /proc')
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_simulation_ends_its_child_processes(tmp_path: Path, number: signal.Signals) -> None:
    """A terminal sends Ctrl-C to all processes; the drives would take minutes."""
    options = ('campus', '--drives', '2', '--jobs', '2', '--readings', '1000000', '-q', '-o', str(tmp_path / 'out'))
    command = [sys.executable, '-m', 'forward_grid_mapper', 'simulate', *options]
    made = subprocess.Popen(
        command, env=environment(), stderr=subprocess.PIPE, text=True, start_new_session=True, cwd=tmp_path
    )

    def children() -> list[str]:
        return Path(f'/proc/{made.pid}/task/{made.pid}/children').read_text('ascii').split()

    try:
        # those that make drives, and the resource tracker of multiprocessing
        wait_for(lambda: len(children()) == 3)
        os.killpg(made.pid, number) if number == signal.SIGINT else made.send_signal(number)
        _, err = made.communicate(timeout=120)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(made.pid, signal.SIGKILL)
    assert (made.returncode, err) == (128 + number, 'simulate: cancelled; nothing was written\n')
    assert everything_in(tmp_path) == []


def test_child_ends_with_its_parent() -> None:
    child = start_child(['mapper', '--help'], environment(), stdout=subprocess.DEVNULL)
    assert child.wait(60) == 0, 'a command that is done does not wait for its parent'
    assert child.stdin is not None
    child.stdin.close()
