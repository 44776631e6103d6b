"""The command line as a process: exit codes, pipes, terminals, and the progress line."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from drive_samples import FILES, tape, write_tape
from numba.core import event

from forward_grid_mapper import __version__
from forward_grid_mapper.__main__ import COMMANDS, _with_output
from forward_grid_mapper.commands import console, process_bag
from forward_grid_mapper.commands.console import Ticker
from forward_grid_mapper.core.search.search import Progress
from forward_grid_mapper.files.output_folder import readable

MODULE = [sys.executable, '-m', 'forward_grid_mapper']


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct bag of the first part of the drive."""
    return write_tape(tmp_path_factory.mktemp('plain') / 'bag', tape()._replace(ranges=tape().ranges[:200]))


def shell(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the module in a separate process, with stdout buffered as for users."""
    inherited = {k: v for k, v in os.environ.items() if k != 'PYTHONUNBUFFERED'}
    command = [*MODULE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**inherited, **environment})


# ---- as a process


def test_usage_and_unknown_commands() -> None:
    helped = shell('--help')
    assert (helped.returncode, helped.stderr) == (0, '')
    assert all(re.search(rf'^  {name} ', helped.stdout, re.MULTILINE) for name in COMMANDS)
    refused = shell()
    assert (refused.returncode, refused.stdout, refused.stderr) == (2, '', helped.stdout)
    refused = shell('procces_bag')
    assert (refused.returncode, refused.stdout) == (2, '')
    assert "no command 'procces_bag'; did you mean process_bag?" in refused.stderr
    assert refused.stderr.endswith(helped.stdout)
    assert shell('--version').stdout == f'{__version__}\n'


@pytest.mark.parametrize('unbuffered', ['', '1'])
@pytest.mark.parametrize('arguments', [('--help',), ('--version',), ('mapper', '--help'), ('process_bag', '--help')])
def test_closed_output_pipe_gives_no_traceback(arguments: tuple[str, ...], unbuffered: str) -> None:
    """As with `head`."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [*MODULE, *arguments]
    with os.fdopen(writer, 'w') as output:
        done = subprocess.run(
            command,
            stdout=output,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env={**os.environ, 'PYTHONUNBUFFERED': unbuffered},
        )
    assert done.stderr == ''
    # without buffering, argparse ignores the error
    assert done.returncode in (0, 1)


def test_broken_pipe_elsewhere_is_an_error() -> None:
    def fail() -> int:
        raise BrokenPipeError('somewhere else')

    with pytest.raises(BrokenPipeError, match='somewhere else'):
        _with_output(fail)
    assert _with_output(lambda: 3) == 3


WITHOUT_ROSBAGS = """
import os
import sys
import numba
import numpy
from forward_grid_mapper.__main__ import main
for words in sys.stdin.read().splitlines():
    child = os.fork()
    if not child:
        os.dup2(os.open(words, os.O_WRONLY | os.O_CREAT, 0o600), 2)
        sys.argv[1:] = words.split()
        sys.exit(main())
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
"""Each of the command lines in stdin in a process of its own, with its errors in the file of that name."""


@pytest.mark.parametrize('arguments', ['--help', ''])
def test_missing_package_is_reported_with_the_extra(tmp_path: Path, arguments: str) -> None:
    # found before the real package
    (tmp_path / 'rosbags.py').write_text('raise ModuleNotFoundError("no", name="rosbags.rosbag1")\n')
    commands = ['process_bag', 'learn', 'replay_bag', 'simulate', 'demo']
    lines = [f'{command} {arguments}'.strip() for command in commands]
    paths = os.pathsep.join([str(tmp_path), *filter(None, map(os.path.abspath, sys.path))])
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROSBAGS],
        input='\n'.join(lines),
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': paths},
    )
    assert done.stdout.split() == ['1'] * len(commands)
    for command, line in zip(commands, lines, strict=True):
        error = (tmp_path / line).read_text()
        assert error.startswith(f'{command}: error: rosbags is not installed: pip install')
        assert '[offline]' in error and 'Traceback' not in error


def test_missing_module_of_no_extra_raises(tmp_path: Path) -> None:
    (tmp_path / 'rosbags.py').write_text('import absent_from_everywhere\n')
    assert 'Traceback' in shell('process_bag', '--help', PYTHONPATH=str(tmp_path)).stderr


def test_simulated_drive_is_mapped_by_the_printed_command(tmp_path: Path) -> None:
    simulated = shell('simulate', 'door', '--seen', 1, '-o', tmp_path / 'drive', '--sonars', 'front')
    assert simulated.returncode == 0, simulated.stderr
    command = simulated.stdout.splitlines()[-1].split()
    assert command[1:3] == ['-m', 'forward_grid_mapper']
    done = shell(*command[3:], '-o', tmp_path / 'maps', '-q')
    assert (done.returncode, done.stdout) == (0, f'maps are in {tmp_path / "maps"}\n')
    # where this test is the first one
    assert done.stderr in ('', console.COMPILES.strip('()') + '\n')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES


def test_errors_are_one_line(tmp_path: Path) -> None:
    done = shell('process_bag', tmp_path / 'absent')
    assert (done.returncode, done.stdout) == (1, '')
    assert re.fullmatch(r'process_bag: error: .*absent does not exist.*\n', done.stderr)


@pytest.mark.slow
def test_reader_that_closes_the_pipe_does_not_stop_the_maps(tmp_path: Path, bag: Path) -> None:
    """As with `process_bag … | head` and `| true`."""
    for arguments in (['--list-parameters'], [str(bag), '-o', str(tmp_path / 'maps')]):
        for unbuffered in ('', '1') if len(arguments) == 1 else ('',):
            reader, writer = os.pipe()
            os.close(reader)
            environment = {**os.environ, 'PYTHONUNBUFFERED': unbuffered}
            command = [*MODULE, 'process_bag', *arguments]
            done = subprocess.run(
                command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, env=environment
            )
            os.close(writer)
            assert done.returncode == 1
            assert not re.search('Traceback|Exception|error', done.stderr)
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='there is no /dev/full')
@pytest.mark.parametrize('unbuffered', ['', '1'])
def test_full_standard_output_is_reported(tmp_path: Path, bag: Path, unbuffered: str) -> None:
    environment = {**os.environ, 'PYTHONUNBUFFERED': unbuffered}
    for arguments in (['--list-parameters'], [str(bag), '-q', '-o', str(tmp_path / 'maps')]):
        with Path('/dev/full').open('w') as full:
            command = [*MODULE, 'process_bag', *arguments]
            done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=environment)
        assert done.returncode == 1
        assert done.stderr == 'process_bag: error: standard output: No space left on device\n'


@pytest.mark.slow
def test_name_that_the_terminal_cannot_show_is_escaped(tmp_path: Path, bag: Path) -> None:
    done = shell('process_bag', bag, '-q', '-o', tmp_path / 'maps–日本', PYTHONIOENCODING='latin-1')
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith('maps\\u2013\\u65e5\\u672c\n')


def test_deleted_working_directory_is_reported(tmp_path: Path, bag: Path) -> None:
    folder = tmp_path / 'gone'
    folder.mkdir()
    script = f'rmdir "{folder}" && exec "$@"'
    command = ['sh', '-c', script, 'sh', *MODULE, 'process_bag', str(bag)]
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    expected = 'process_bag: error: the working directory does not exist any more; change to one that does'
    assert done.stderr.splitlines()[-1] == expected and 'Traceback' not in done.stderr


def test_name_is_kept_in_an_ascii_locale(tmp_path: Path, bag: Path) -> None:
    (tmp_path / 'größe').symlink_to(bag)
    ascii_only = {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
    done = shell('process_bag', tmp_path / 'größe', '-q', '-o', tmp_path / 'maps', **ascii_only)
    assert (done.returncode, done.stderr) == (0, '')
    assert 'größe' in (tmp_path / 'maps' / 'report.txt').read_text('utf-8')


# ---- errors


@pytest.mark.parametrize(
    ('error', 'code', 'expected'),
    [
        (MemoryError(), 1, 'raise resolution'),
        (FileNotFoundError(2, 'No such file or directory', 'there'), 1, 'error: there: No such file or directory'),
        (KeyboardInterrupt(), 130, 'nothing was written'),
    ],
)
def test_unexpected_errors_give_one_line_and_an_exit_code(
    capsys: pytest.CaptureFixture[str], error: BaseException, code: int, expected: str
) -> None:
    def body(options: object) -> int:
        raise error

    assert console.run(process_bag.parser(), body, ['bag']) == code
    out, err = capsys.readouterr()
    assert out == '' and err.startswith('process_bag: ') and expected in err
    print('still printing')
    assert capsys.readouterr().out == 'still printing\n'


def test_command_whose_reader_has_ended_fails_without_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    """As that of `head`: what was not printed is unknown, so scripts must not believe that all is well."""

    def body(options: object) -> int:
        raise BrokenPipeError

    assert console.run(process_bag.parser(), body, ['bag']) == 1
    assert capsys.readouterr() == ('', '')


def test_programming_error_is_raised() -> None:
    def body(options: object) -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        console.run(process_bag.parser(), body, ['bag'])


def test_readable_text_of_a_path(monkeypatch: pytest.MonkeyPatch) -> None:
    assert readable(Path('Büro 日本')) == readable(readable(Path('Büro 日本'))) == 'Büro 日本'
    assert readable(os.fsdecode(b'n\xfft')) == r'n\xfft'
    # as if names of files were ASCII
    monkeypatch.setattr(os, 'fsencode', lambda path: str(path).encode('ascii', 'surrogateescape'))
    name = 'Büro'.encode().decode('ascii', 'surrogateescape')
    assert readable(name) == readable(readable(name)) == 'Büro'


# ---- progress


class Screen(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def test_work_below_a_second_shows_no_progress() -> None:
    for stream in (io.StringIO(), Screen()):
        with Ticker(stream=stream) as ticker:
            ticker.say('working')
            time.sleep(0.4)
        assert stream.getvalue() == ''


def test_longer_work_shows_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('PATIENCE', 'ON_SCREEN', 'IN_LOG'):
        monkeypatch.setattr(console, name, 0.05)
    streams = {'log': io.StringIO(), 'screen': Screen(), 'quiet': Screen(), 'idle': Screen()}
    with (
        Ticker(stream=streams['log']) as log,
        Ticker(stream=streams['screen']) as screen,
        Ticker(quiet=True, stream=streams['quiet']) as quiet,
        Ticker(stream=streams['idle']),
    ):
        for ticker in (log, screen, quiet):
            ticker.reading(1000, 12345)
        wait_until_shown(streams['log'], 'messages')
        wait_until_shown(streams['screen'], 'messages')
        for ticker in (log, screen, quiet):
            ticker.mapping('search', Progress(3, 1234, 5, 678.9))
        wait_until_shown(streams['log'], 'gained')
        wait_until_shown(streams['screen'], 'gained')
    shown = {name: stream.getvalue() for name, stream in streams.items()}
    assert shown['quiet'] == shown['idle'] == ''
    reading, searching = 'reading: 1,000 of 12,345 messages', 'search: iteration 3, 1,234 flips, 679 nats gained'
    assert re.fullmatch(rf' +\d s  {reading}\n +\d s  {searching}\n', shown['log'])
    parts = shown['screen'].split('\r\033[K')
    assert parts[0] == '' and parts[-1] == '', 'the line is cleared at the end'
    assert [text for text in dict.fromkeys(part.partition(' s  ')[2] for part in parts) if text] == [reading, searching]
    assert '\n' not in shown['screen']


def test_warnings_are_printed_during_long_work(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('PATIENCE', 'LONG', 'ON_SCREEN', 'IN_LOG'):
        monkeypatch.setattr(console, name, 0.05)
    log, screen, quiet = io.StringIO(), Screen(), io.StringIO()
    with Ticker(stream=log) as one, Ticker(stream=screen) as two, Ticker(quiet=True, stream=quiet) as three:
        for ticker in (one, two, three):
            ticker.warn(['max_range is 400 m', 'no echo'])
            ticker.say('index')
        for stream in (log, screen):
            wait_until_shown(stream, 'index')
        for ticker, stream in ((one, log), (two, screen)):
            begin = len(stream.getvalue())
            ticker.say('search')
            wait_until_shown(stream, 'search', begin)
    assert log.getvalue().startswith('warning: max_range is 400 m\nwarning: no echo\n')
    assert screen.getvalue().startswith('\r\033[Kwarning: max_range is 400 m\n\r\033[Kwarning: no echo\n')
    assert log.getvalue().count('warning') == screen.getvalue().count('warning') == 2
    assert quiet.getvalue() == ''


def test_warnings_are_not_printed_during_short_work() -> None:
    stream = io.StringIO()
    with Ticker(stream=stream) as ticker:
        ticker.warn(['max_range is 400 m'])
        ticker.say('index')
        wait_until_shown(stream, 'index')
    assert 'warning' not in stream.getvalue()


def wait_until_shown(stream: io.StringIO, text: str, begin: int = 0) -> None:
    end = time.monotonic() + 30.0
    while text not in stream.getvalue()[begin:]:
        assert time.monotonic() < end, stream.getvalue()
        time.sleep(0.01)


def test_compilation_is_shown_only_while_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 0.0)
    stream = Screen()
    with Ticker(stream=stream) as ticker:
        ticker.mapping('live map', None)
        wait_until_shown(stream, 'live map')
        assert 'compil' not in stream.getvalue(), 'nothing is compiled'
        ticker.mapping('search', None)
        with compiling_begun():
            wait_until_shown(stream, 'search (compiling kernels')
        ticker.mapping('uncertainty', None)
        wait_until_shown(stream, 'uncertainty')
        assert 'uncertainty (compil' not in stream.getvalue()


def test_quiet_mentions_compilation_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 0.0)
    stream = io.StringIO()
    with Ticker(quiet=True, stream=stream) as ticker:
        ticker.say('one')
        with compiling_begun():
            wait_until_shown(stream, 'compiling kernels; this takes one to three minutes and is done once\n')
            ticker.say('two')
        with compiling_begun():
            ticker.say('three')
    assert stream.getvalue().count('\n') == 1


def compiling_begun() -> AbstractContextManager[None]:
    """The event that numba triggers around a compilation, but not when a kernel comes from the cache."""
    return event.trigger_event('numba:compile')


def test_compilation_is_detected_and_loading_from_the_cache_is_not(tmp_path: Path) -> None:
    program = """
import sys, numba
from numba.core import event
from forward_grid_mapper.core.runtime import compiling
before = compiling.count()
numba.config.CACHE_DIR = sys.argv[1]
@numba.njit(cache=True)
def add(a, b):
    return a + b
add(1, 2)
assert not compiling.compiling()
print(compiling.count() - before)
"""
    file = tmp_path / 'program.py'
    file.write_text(program)
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))}
    for expected in ('1\n', '0\n'):
        done = subprocess.run(
            [sys.executable, str(file), str(tmp_path)], capture_output=True, text=True, check=False, env=environment
        )
        assert (done.stdout, done.returncode) == (expected, 0), done.stderr


@pytest.mark.parametrize('columns', [20, 40, 80])
def test_progress_line_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 0.0)
    monkeypatch.setenv('COLUMNS', str(columns))
    stream = Screen()
    with Ticker(stream=stream) as ticker:
        ticker.mapping('x' * 100, None)
        wait_until_shown(stream, '...')
    lines = stream.getvalue().split('\r\033[K')
    assert max(map(len, lines)) == columns - 1


def test_shortened_text() -> None:
    assert console.shortened('as it is', 8) == 'as it is'
    assert console.shortened('too long for it', 8) == 'too l...'
    assert [len(console.shortened('too long', width)) for width in range(-1, 9)] == [0, 0, 1, 2, 3, 4, 5, 6, 7, 8]


def test_progress_in_a_pipe_is_one_line_a_second_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    assert console.IN_LOG == 1.0
    monkeypatch.setattr(console, 'PATIENCE', 0.0)
    monkeypatch.setattr(console, 'IN_LOG', 0.2)
    stream = io.StringIO()
    begin = time.monotonic()
    with Ticker(stream=stream) as ticker:
        while not stream.getvalue() or time.monotonic() < begin + 0.7:
            ticker.say(f'step {time.monotonic()}')
            time.sleep(0.01)
        passed = time.monotonic() - begin
    assert 1 <= len(stream.getvalue().splitlines()) <= passed / 0.2


def test_progress_ends_at_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, 'PATIENCE', 0.0)
    stream = Screen()
    with pytest.raises(KeyboardInterrupt), Ticker(stream=stream) as ticker:
        ticker.say('working')
        time.sleep(0.5)
        raise KeyboardInterrupt
    length = len(stream.getvalue())
    time.sleep(0.5)
    assert len(stream.getvalue()) == length
    assert stream.getvalue().endswith('\r\033[K')
