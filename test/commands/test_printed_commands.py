"""Printed commands run as they are, for any file names."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from drive_samples import Tape, code_of, report_in, tape, write_tape

from forward_grid_mapper.commands import learn, process_bag, replay_bag, simulate
from forward_grid_mapper.core.common import shell
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.files import drawing

PARSERS = {'process_bag': process_bag.parser, 'learn': learn.parser, 'replay_bag': replay_bag.parser}
NAMES = ['plain', 'with space', 'a, b', 'it\'s $HOME `x` "y"', 'a;b&c|d>e', '-dash', 'Büro 日本', '*?[a]', '#1', '~']


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run and is not needed here."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: None)


def words_of(line: str) -> list[str]:
    """The words of a line as split by bash."""
    bash = shutil.which('bash')
    if bash is None:
        return shlex.split(line)
    done = subprocess.run([bash, '-c', f'printf "%s\\0" {line}'], capture_output=True, check=True)
    return [os.fsdecode(word) for word in done.stdout.split(b'\0')[:-1]]


def commands_in(text: str) -> list[list[str]]:
    """The commands among the lines of an output, without the interpreter and the package."""
    # the shell's name of the interpreter depends on the folder
    lead = f'{shell.module_line("forward_grid_mapper")} '
    return [words_of(line.strip())[3:] for line in text.splitlines() if line.strip().startswith(lead)]


def two_odometries() -> Tape:
    """The drive with a second odometry topic, so that one must be chosen."""
    other = [m._replace(frame_id='map', pose=Pose2(m.pose.y, m.pose.x, 1.0)) for m in tape().odometry]
    return tape()._replace(odometry=[*tape().odometry, *other])


@pytest.mark.parametrize('name', NAMES)
def test_simulate_prints_a_command_that_finds_the_bag(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # a leading ~ is the home folder
    output = f'./{name}' if name == '~' else name
    assert code_of(simulate.main, 'door', '--seen', 1, '--sonars', 'front', f'--output={output}') == 0
    ((command, *words),) = commands_in(capsys.readouterr().out)
    options = PARSERS[command]().parse_args(words)
    (bag,) = options.bags
    assert Path(bag).samefile(tmp_path / name / 'bag')


@pytest.mark.parametrize('name', ['with space', "-it's, $HOME"])
def test_learn_prints_a_command_that_maps_the_same_readings(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    frames = [frame for frame, _ in tape().extrinsics][2:4]
    bag = write_tape(
        Path(name),
        two_odometries(),
        odometry_topic=lambda m: '/odom' if m.frame_id == 'odom' else '/laser/odom',
        sonar_topic=lambda m: f'/sonars/{m.frame_id}',
    )
    topics = [f'/sonars/{frame}' for frame in frames]
    written = '--keep-going', f'--output={name}.yaml'
    arguments = ('--rounds', 1, *written, '--odom-topic', '/odom', '--range-topics', *topics)
    assert code_of(learn.main, f'./{bag}', *arguments) == 0
    out = capsys.readouterr().out
    ((command, *words),) = commands_in(out)
    assert command == 'process_bag'
    assert code_of(process_bag.main, *words, '-q', '-o', 'maps') == 0, capsys.readouterr().err
    report = report_in(Path('maps'))
    assert (report['input']['odom_topic'], report['input']['range_topics']) == ('/odom', topics)
    learned = re.search(r'^  p_hit +[\d.]+ +([\d.]+)', out, re.MULTILINE)
    assert learned and report['parameters']['p_hit'] == pytest.approx(float(learned[1]), abs=1e-4)


@pytest.mark.parametrize('name', [*NAMES, os.fsdecode(b'n\xfft'), 'line\nbreak', "tab\tand 'quote' \\"])
def test_quoted_words_are_unchanged_by_bash(name: str) -> None:
    if shutil.which('bash') is None:
        pytest.skip('there is no bash')
    assert words_of(shell.quoted(name)) == [name]
    assert '\n' not in shell.quoted(name)
    (path,) = words_of(shell.quoted(Path(name)))
    assert Path(path) == Path(name) and not path.startswith('-')


def test_printed_interpreter_is_the_one_the_shell_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for python in (tmp_path / 'my venv' / 'bin' / 'python', tmp_path / 'bin' / 'python3'):
        python.parent.mkdir(parents=True)
        python.touch(0o755)
    monkeypatch.setenv('PATH', str(tmp_path / 'bin'))
    monkeypatch.setattr(shell.sys, 'executable', str(tmp_path / 'bin' / 'python3'))
    assert shell.command_line('learn') == 'python3 -m forward_grid_mapper learn'
    # without an activated environment
    monkeypatch.setattr(shell.sys, 'executable', str(tmp_path / 'my venv' / 'bin' / 'python'))
    monkeypatch.chdir(tmp_path / 'bin')
    assert words_of(shell.command_line('learn'))[0] == str(tmp_path / 'my venv' / 'bin' / 'python')
    monkeypatch.chdir(tmp_path)
    assert shell.command_line('learn', 'a b') == "'my venv/bin/python' -m forward_grid_mapper learn 'a b'"
