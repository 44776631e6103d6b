"""JSON output, viewers, examples in the help, and tab completion."""

from __future__ import annotations

import argparse
import importlib
import io
import json
import os
import re
import shlex
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from drive_samples import code_of, report_in, tape, write_tape

from forward_grid_mapper.__main__ import COMMANDS
from forward_grid_mapper.commands import completion, demo, desktop, experiment, process_bag
from forward_grid_mapper.commands.options import print_json
from forward_grid_mapper.files import drawing
from forward_grid_mapper.node.main import USAGE

PARSED = [name for name in COMMANDS if name != 'mapper']


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run and is not needed here."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: None)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct bag of the drive."""
    return write_tape(tmp_path_factory.mktemp('plain') / 'bag', tape())


def parser_of(command: str) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = importlib.import_module(f'forward_grid_mapper.{COMMANDS[command][0]}').parser()
    return made


@pytest.mark.parametrize('encoding', ['utf-8', 'ascii', 'latin-1'])
def test_json_is_utf_8_in_any_locale(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = {'bag': 'Büro – 中文 𝄞'}
    written = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(written, encoding, errors='backslashreplace'))
    print_json(data)
    sys.stdout.flush()
    assert json.loads(written.getvalue().decode('utf-8')) == data


@pytest.mark.parametrize('command', PARSED)
def test_help_has_an_example_that_is_parsed(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'MY_BAG').mkdir()
    example = re.search(rf'^example: {command}\b([^.]*(?:\.\w[^.]*)*)', parser_of(command).epilog or '')
    assert example, 'the help has no example'
    parser_of(command).parse_args(shlex.split(example[1]))


def test_help_of_the_node_has_an_example() -> None:
    assert 'example: mapper --ros-args' in USAGE


def test_json_prints_only_the_report(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(process_bag.main, bag, '-o', tmp_path / 'maps', '--json') == 0
    report = json.loads(capsys.readouterr().out)
    assert report.pop('folder') == str(tmp_path / 'maps')
    assert report == report_in(tmp_path / 'maps')


def test_json_prints_nothing_after_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(process_bag.main, tmp_path / 'absent', '-o', tmp_path / 'maps', '--json') == 1
    out, err = capsys.readouterr()
    assert out == '' and err.startswith('process_bag: error: ')


def viewer(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A desktop whose viewer writes its argument to a file; return that file."""
    notes, program = folder / 'notes', folder / 'xdg-open'
    os.mkfifo(notes)
    program.write_text(f'#!/bin/sh\necho "$1" > {shlex.quote(str(notes))}\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv('PATH', f'{folder}{os.pathsep}{os.environ["PATH"]}')
    monkeypatch.setenv('DISPLAY', ':7')
    monkeypatch.setattr(sys, 'platform', 'linux')
    return notes


def test_show_opens_the_report(
    tmp_path: Path, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = viewer(tmp_path, monkeypatch)
    assert code_of(process_bag.main, bag, '-q', '-o', tmp_path / 'maps', '--show') == 0
    # the named pipe waits for the viewer to write
    assert notes.read_text() == f'{tmp_path / "maps" / "report.html"}\n'
    assert 'no desktop' not in capsys.readouterr().err


@pytest.mark.parametrize(
    ('main', 'words', 'picture'),
    [
        (experiment.main, ['density', '--show'], 'figure.png'),
        (demo.main, ['--offline', '--seen', 1, '--show'], 'demo.png'),
    ],
)
def test_show_opens_the_picture(
    tmp_path: Path, main: Any, words: list[str], picture: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = []
    for module in (experiment, demo):
        monkeypatch.setattr(module, 'show', shown.append)
    assert code_of(main, *words, '-o', tmp_path / 'out') == 0
    assert shown == [tmp_path / 'out' / picture] and shown[0].exists()


def test_show_opens_one_figure_of_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(folder: Path, *rest: Any) -> str:
        for name in ('rooms', 'corridor'):
            (folder / f'figure_{name}.png').touch()
        return 'a table'

    shown: list[Path] = []
    monkeypatch.setattr(experiment, 'drifting', draw)
    monkeypatch.setattr(experiment, 'show', shown.append)
    assert code_of(experiment.main, 'drift', '--show', '-o', tmp_path / 'out') == 0
    assert shown == [tmp_path / 'out' / 'figure_corridor.png']


def test_show_without_a_desktop_prints_the_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('DISPLAY', 'WAYLAND_DISPLAY'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, 'platform', 'linux')
    page = tmp_path / 'a page.html'
    desktop.show(page)
    assert page.as_uri() in capsys.readouterr().err


def test_rerun_writes_the_drive_and_prints_the_viewer_command(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('rerun', reason='the extra rerun is not installed')
    assert code_of(process_bag.main, bag, '-o', tmp_path / 'my maps', '--rerun') == 0
    line = capsys.readouterr().out.splitlines()[-1]
    words = shlex.split(line)
    assert words[1:] == ['-m', 'rerun', str(tmp_path / 'my maps' / 'drive.rrd')]
    # the viewer needs a screen, the check of a file does not
    done = subprocess.run([*words[:3], 'rrd', 'verify', words[3]], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


def test_missing_rerun_is_reported_before_the_work(
    tmp_path: Path, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)
    assert code_of(process_bag.main, bag, '-o', tmp_path / 'maps', '--rerun') == 1
    assert 'forward_grid_mapper[rerun]' in capsys.readouterr().err
    assert not (tmp_path / 'maps').exists()


def test_commands_and_options_are_completed() -> None:
    made = completion.parser_of_all(COMMANDS, 'forward_grid_mapper', ['forward_grid_mapper', 'learn', '--ro'])
    (below,) = [action for action in made._actions if isinstance(action, argparse._SubParsersAction)]
    assert set(below.choices) == set(COMMANDS)
    assert '--rounds' in below.choices['learn'].format_help()
    assert '--seeds' not in below.choices['experiment'].format_help(), 'only the command in question is imported'


@pytest.mark.parametrize(
    ('line', 'expected'),
    [('forward_grid_mapper pro', ['process_bag']), ('forward_grid_mapper learn --roun', ['--rounds'])],
)
def test_completions_are_returned_to_the_shell(tmp_path: Path, line: str, expected: list[str]) -> None:
    pytest.importorskip('argcomplete')
    answer = tmp_path / 'answer'
    environment = {
        **os.environ,
        '_ARGCOMPLETE': '1',
        '_ARGCOMPLETE_STDOUT_FILENAME': str(answer),
        'COMP_LINE': line,
        'COMP_POINT': str(len(line)),
        'IFS': '\013',
    }
    program = 'import sys; from forward_grid_mapper.__main__ import main; sys.exit(main())'
    done = subprocess.run([sys.executable, '-c', program], env=environment, capture_output=True, check=False)
    assert done.stdout == b''
    assert [word.strip() for word in answer.read_text().split('\013')] == expected
