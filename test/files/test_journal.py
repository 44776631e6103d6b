"""The journal: what was put comes back, whatever happens to the process, the disk and the file."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import random
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from journal_samples import FRAMES, Previous, database, made, numbers, opened, rows, until, written
from patience import PATIENCE, line_of

from forward_grid_mapper.core.common.errors import BagError, OutputError
from forward_grid_mapper.files import journal as journal_module
from forward_grid_mapper.files import syncing
from forward_grid_mapper.files.journal import Journal, drive_file, drives
from forward_grid_mapper.files.journal_database import DriveWriter
from forward_grid_mapper.files.journal_format import ROW, Contents
from forward_grid_mapper.files.journal_reader import log_of, read

KILLS = 10


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_is_put_comes_back(tmp_path: Path) -> None:
    names = ('ultra sonic/../left', '超音波', '', 'new\nline', '\udcff')
    journal, before = opened(tmp_path / 'a b %41?#' / 'журнал')
    assert before == []
    for k in range(3):
        written(journal, made(100 * k, 100, names[: k + 3]))
    journal.close()
    again, chunks = opened(tmp_path / 'a b %41?#' / 'журнал')
    back = chunks[0]
    expected = made(0, 300)
    for column in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp'):
        assert np.array_equal(getattr(back, column), getattr(expected, column))
    sensors = [back.sensor_names[k] for k in back.sensor]
    assert sensors == [names[k % (k // 100 + 3)] for k in range(300)]
    assert (again.contents.map_frame, again.contents.base_frame) == FRAMES
    assert again.contents.path == [(0.0, 0.0), (100.0, 0.0), (200.0, 0.0)]
    assert again.contents.harm == ''
    again.close()
    # a frame is a name and never a path
    assert sorted(p.name for p in tmp_path.rglob('*')) == ['a b %41?#', 'drive_0001.journal', 'lock', 'журнал']


def test_the_parameters_of_the_node_come_back(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    journal.parameters = {'resolution': 0.05, 'max_readings': 7, 'over_range': 'discard', 'unheard_of': 1, 'p_hit': 9.0}
    written(journal, made(0, 10))
    journal.parameters = {**journal.parameters, 'max_readings': 8}
    written(journal, made(10, 10))
    journal.close()
    _, contents = numbers(journal.path)
    # what this version does not know or admit is passed over
    assert contents.parameters == {'resolution': 0.05, 'max_readings': 8, 'over_range': 'discard'}
    assert contents.harm == ''


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    with pytest.raises(OutputError, match='another node'):
        Journal(tmp_path, print)
    journal.close()
    opened(tmp_path)[0].close()


def test_a_file_that_another_program_has_open(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    other = sqlite3.connect(journal.path)
    other.execute('SELECT * FROM sensors').fetchone()
    journal = Journal(tmp_path, print)
    with pytest.raises(OutputError, match='open in another program'):
        list(journal.restore())
    journal.close()
    other.close()
    journal, chunks = opened(tmp_path)
    assert sum(map(len, chunks)) == 10
    # nor can another program hold up the node
    other = sqlite3.connect(journal.path, timeout=0.0)
    with pytest.raises(sqlite3.OperationalError, match='locked'):
        other.execute('SELECT * FROM sensors')
    journal.close()


def test_a_new_drive_begins_a_new_file(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    journal.begin_drive()
    assert journal.path.name == 'drive_0001.journal'
    written(journal, made(0, 10))
    journal.begin_drive()
    until(lambda: len(drives(tmp_path)) == 2)
    # also where nothing comes before the node dies
    assert numbers(drives(tmp_path)[1])[0] == []
    written(journal, made(10, 10))
    assert names_in(tmp_path) == ['drive_0001.journal', 'drive_0002.journal', 'drive_0002.journal-wal', 'lock']
    journal.close()
    assert names_in(tmp_path) == ['drive_0001.journal', 'drive_0002.journal', 'lock']
    assert numbers(drives(tmp_path)[0])[0] == list(range(10))
    assert numbers(drives(tmp_path)[1])[0] == list(range(10, 20))
    assert drive_file(tmp_path) == drives(tmp_path)[1]
    assert drive_file(drives(tmp_path)[0]) == drives(tmp_path)[0]
    assert drive_file(tmp_path / 'lock') is None
    assert drive_file(tmp_path / 'nothing') is None
    again, chunks = opened(tmp_path)
    assert sum(map(len, chunks)) == 10
    again.close()


def test_commits_come_soon_and_put_never_waits(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    begin = time.monotonic()
    journal.put(made(10, 2000), FRAMES)
    assert time.monotonic() - begin < 0.1
    until(lambda: len(numbers(journal.path)[0]) == 2010)
    journal.close()


# a file that is not there any more


@pytest.mark.parametrize('what', ['file', 'log', 'both', 'folder', 'moved', 'replaced', 'file cut', 'log cut'])
def test_a_file_that_goes_is_noticed_and_begun_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    folder, said = tmp_path / 'j', []
    journal, _ = opened(folder, said)
    for k in range(3):
        written(journal, made(10 * k, 10))
    path = journal.path
    if what in ('file', 'both'):
        path.unlink()
    if what in ('log', 'both'):
        log_of(path).unlink()
    if what == 'folder':
        shutil.rmtree(folder)
    if what == 'moved':
        path.rename(tmp_path / 'elsewhere')
    if what == 'replaced':
        copy = shutil.copy(path, tmp_path / 'copy')
        Path(copy).rename(path)
    if what == 'file cut':
        os.truncate(path, 5000)
    if what == 'log cut':
        os.truncate(log_of(path), 5000)
    # also while nothing is put
    until(lambda: journal.gone)
    assert 'the readings in memory are written to a new file' in said[0]
    assert journal.notice == said[0]
    # what came before it was told
    journal.put(made(30, 10), FRAMES)
    journal.renew(made(0, 40), FRAMES, [(0.0, 0.0), (1.0, 0.0)])
    journal.put(made(40, 10), FRAMES, [(2.0, 0.0)])
    until(lambda: not journal.unwritten)
    assert not journal.gone
    assert journal.path.name == 'drive_0002.journal'
    found, contents = numbers(journal.path)
    assert found == list(range(50))
    assert contents.path == [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    assert (contents.map_frame, contents.base_frame) == FRAMES
    assert contents.harm == ''
    # the folder is still this node's alone
    with pytest.raises(OutputError, match='another node'):
        Journal(folder, print)
    journal.close()
    assert len(said) == 1


def test_a_log_of_another_is_not_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where somebody puts a backup in the place of the files; SQLite deletes a log by its name."""
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    journal, _ = opened(tmp_path / 'j')
    written(journal, made(0, 10))
    backup = tmp_path / 'backup'
    shutil.copytree(tmp_path / 'j', backup)
    shutil.rmtree(tmp_path / 'j')
    backup.rename(tmp_path / 'j')
    until(lambda: journal.gone)
    journal.renew(made(0, 20), FRAMES, [])
    until(lambda: not journal.unwritten)
    journal.close()
    assert numbers(tmp_path / 'j' / 'drive_0001.journal')[0] == list(range(10))
    assert numbers(tmp_path / 'j' / 'drive_0002.journal')[0] == list(range(20))


# a disk that is full, slow, or out of order


@contextlib.contextmanager
def no_room(journal: Journal) -> Iterator[None]:
    """Let SQLite find the disk full, by a bound on the pages of the file."""
    database = journal._writer._database
    assert database is not None
    pages = database.execute('PRAGMA page_count').fetchone()[0]
    database.execute(f'PRAGMA max_page_count={pages}')
    yield
    database.execute('PRAGMA max_page_count=1073741823')


def test_a_full_disk_is_warned_of_once_and_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    said: list[str] = []
    journal, _ = opened(tmp_path, said)
    written(journal, made(0, 10))
    with no_room(journal):
        for k in range(1, 6):
            journal.put(made(100 * k, 100), FRAMES)
        until(lambda: journal.trouble)
        time.sleep(0.1)
        assert len(said) == 1
        assert os.strerror(errno.ENOSPC) in said[0]
        assert journal.unwritten >= 400
    until(lambda: not journal.unwritten)
    assert journal.trouble == ''
    journal.close()
    assert numbers(journal.path)[0] == [*range(10), *range(100, 600)]
    assert journal.lost == 0


def test_what_waits_for_a_disk_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(journal_module, 'MOST_PENDING', 100 * 10 * ROW.itemsize)
    said: list[str] = []
    journal, _ = opened(tmp_path, said)
    written(journal, made(0, 10, ('sonar 0',)))
    with no_room(journal):
        for k in range(1, 500):
            journal.put(made(10 * k, 10, (f'sonar {k}',)), FRAMES)
        assert journal.unwritten <= 1010
        assert journal.lost >= 4990 - 1010 - 100
        assert any('lost from now on' in text for text in said)
    until(lambda: not journal.unwritten)
    written(journal, made(5000, 10, ('sonar 499',)))
    journal.close()
    contents = Contents()
    (back,) = read(journal.path, contents)
    assert back.sensor_names[back.sensor[-1]] == 'sonar 499'
    assert len(back) == 5010 - journal.lost
    assert contents.harm == ''


def test_without_a_free_descriptor_nothing_is_written_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(syncing, 'PERIOD', 0.01)
    said: list[str] = []
    journal, _ = opened(tmp_path, said)
    written(journal, made(0, 10))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(map(int, os.listdir('/proc/self/fd')))  # noqa: PTH208 (numbers, not paths)
    taken = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, hard))
    try:
        for k in range(1, 50):
            # also what the thread that syncs had open a moment ago
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.dup(0))
            journal.put(made(10 * k, 10), FRAMES)
            time.sleep(0.005)
        # it needs none to write
        until(lambda: not journal.unwritten)
        journal.begin_drive()
        journal.put(made(500, 10), FRAMES)
        # nor to begin a file more than the last one had
        until(lambda: not journal.unwritten)
    finally:
        for file in taken:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: not journal.unwritten)
    journal.close()
    assert any('does not sync written data' in text for text in said)
    assert numbers(drives(tmp_path)[0])[0] == list(range(500))
    assert numbers(drives(tmp_path)[1])[0] == list(range(500, 510))


def test_a_block_that_is_written_again_is_there_once(tmp_path: Path) -> None:
    """As after a commit that reached the disk although it reported a failure."""
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    writer = journal._writer
    write = writer.write

    def fails(*arguments: object) -> Path:
        write(*arguments)  # type: ignore[arg-type]
        writer.write = write  # type: ignore[method-assign]
        raise OSError(errno.EIO, 'Input/output error')

    writer.write = fails  # type: ignore[method-assign,assignment]
    journal.put(made(10, 10), FRAMES, [(1.0, 1.0)])
    until(lambda: not journal.unwritten)
    written(journal, made(20, 10))
    journal.close()
    found, contents = numbers(journal.path)
    assert found == list(range(30))
    assert len(contents.path) == 3


def test_a_disk_that_is_slow_to_sync_holds_up_no_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(syncing, 'PERIOD', 0.01)
    began, go_on = threading.Event(), threading.Event()
    sync = os.fdatasync
    synced: list[int] = []

    def fdatasync(file: int) -> None:
        began.set()
        assert go_on.wait(20.0)
        synced.append(os.fstat(file).st_size)
        sync(file)

    monkeypatch.setattr(os, 'fdatasync', fdatasync)
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    assert began.wait(5.0)
    written(journal, made(10, 10))
    journal.begin_drive()
    written(journal, made(20, 10))
    assert numbers(drives(tmp_path)[0])[0] == list(range(20))
    assert not synced
    go_on.set()
    # what came after it is asked for anew
    until(lambda: len(synced) >= 2)
    journal.close()
    assert numbers(drives(tmp_path)[1])[0] == list(range(20, 30))


def test_a_journal_that_was_closed_too_soon_for_the_disk_lets_go_of_the_folder_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others, write, go_on = {*threading.enumerate()}, DriveWriter.write, threading.Event()

    def slow(*arguments: object) -> Path:
        assert go_on.wait(20.0)
        return write(*arguments)

    journal, _ = opened(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(DriveWriter, 'write', slow)
        journal.put(made(0, 10), FRAMES)
        journal.close(0.05)
        with pytest.raises(OutputError, match='another node'):
            Journal(tmp_path, print)
        go_on.set()
        until(lambda: {*threading.enumerate()} <= others)
    again, chunks = opened(tmp_path)
    assert [len(chunk) for chunk in chunks] == [10]
    again.close()


def test_a_journal_that_is_closed_while_it_is_read_writes_nothing_any_more(tmp_path: Path) -> None:
    others = {*threading.enumerate()}
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    journal = Journal(tmp_path, print)
    found = journal.restore()
    assert len(next(found)) == 10
    journal.close()
    # another node has the folder by now
    another, _ = opened(tmp_path)
    assert list(found) == []
    journal.put(made(10, 10), FRAMES)
    another.close()
    assert {*threading.enumerate()} <= others
    assert numbers(journal.path)[0] == list(range(10))


def test_a_limit_on_the_size_of_files_is_a_full_disk(tmp_path: Path) -> None:
    program = (
        'import resource, signal, sys, time; sys.path.insert(0, sys.argv[2])\n'
        'signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n'
        'resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))\n'
        'from journal_writer import main; main(sys.argv[1])'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', program, str(tmp_path / 'j'), str(Path(__file__).parent)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    )
    assert 'cannot be written: disk I/O error; mapping continues' in line_of(process)
    time.sleep(0.5)
    assert process.poll() is None
    process.kill()
    assert 'Traceback' not in process.communicate(timeout=PATIENCE)[0]
    found, contents = numbers(tmp_path / 'j' / 'drive_0001.journal')
    assert found == list(range(len(found)))
    assert len(found) > 100
    assert contents.harm == ''


def test_places_where_no_journal_can_be(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='file'):
        Journal(tmp_path / 'file', print)


# what a node finds when it starts


def test_a_file_that_was_left_half_made_is_made_anew(tmp_path: Path) -> None:
    for name in ('.new.journal', '.new.journal-journal', '.new.journal-wal'):
        (tmp_path / name).write_bytes(b'SQLite format 3\0' + bytes(1000))
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    assert names_in(tmp_path) == ['drive_0001.journal', 'lock']
    assert numbers(journal.path)[0] == list(range(10))


@pytest.mark.parametrize('content', ['bytes', 'directory', 'nan', 'cut', 'newer', 'rollback', 'empty'])
def test_a_damaged_file_is_left_as_it_is_and_its_readings_carried_over(tmp_path: Path, content: str) -> None:
    path, expected = tmp_path / 'drive_0007.journal', list(range(1000))
    forged = database(path, [rows(made(10 * k, 10)).tobytes() for k in range(100)], ())
    forged.executemany('INSERT INTO sensors VALUES (?, ?)', [(0, b'left'), (1, b'right')])
    if content == 'nan':
        bad = rows(made(0, 10))
        bad['yaw'][7] = np.nan
        forged.execute('UPDATE readings SET rows = ? WHERE number = 0', (bad.tobytes(),))
        del expected[7]
    if content == 'newer':
        forged.execute('PRAGMA user_version = 2')
        expected = []
    forged.close()
    if content in ('bytes', 'empty'):
        path.write_bytes(random.Random(1).randbytes(5000) if content == 'bytes' else b'')
        expected = []
    if content == 'directory':
        path.unlink()
        path.mkdir()
        expected = []
    if content == 'cut':
        os.truncate(path, path.stat().st_size // 2)
    if content == 'rollback':
        path.with_name(path.name + '-journal').write_bytes(b'\xd9\xd5\x05\xf9\x20\xa1\x63\xd7' + bytes(600))
    before = path.read_bytes() if path.is_file() else b''
    said: list[str] = []
    journal, chunks = opened(tmp_path, said)
    back = [int(x) for readings in chunks for x in readings.x]
    if content == 'cut':
        assert back == expected[: len(back)]
        assert 100 < len(back) < 1000
    else:
        assert back == expected
    if content == 'rollback':
        assert not said
    else:
        assert 'drive_0007.journal' in said[0]
        assert 'the journal continues in drive_0008.journal' in said[0]
        assert journal.notice == said[-1]
    written(journal, made(1000, 10))
    journal.close()
    assert journal.path.name == 'drive_0008.journal'
    found, contents = numbers(journal.path)
    assert found == [*back, *range(1000, 1010)]
    assert contents.harm == ''
    assert (path.read_bytes() if path.is_file() else b'') == before
    journal, chunks = opened(tmp_path, said)
    assert [int(x) for readings in chunks for x in readings.x] == found
    journal.close()


def test_a_journal_of_the_previous_format_goes_on_in_a_new_file(tmp_path: Path) -> None:
    old = tmp_path / 'drive_0003.journal'
    old.write_bytes(Previous.file(120_000, 1000))
    before = old.read_bytes()
    said: list[str] = []
    journal, chunks = opened(tmp_path, said)
    assert sum(map(len, chunks)) == 120_000
    assert 'the previous version, which the next version will not read' in said[0]
    assert journal.contents.map_frame == 'odom'
    written(journal, made(120_000, 10))
    journal.close()
    assert old.read_bytes() == before
    assert names_in(tmp_path) == ['drive_0003.journal', 'drive_0004.journal', 'lock']
    (found, contents), (_, expected) = numbers(journal.path), numbers(old)
    assert found == list(range(120_010))
    assert (contents.map_frame, contents.base_frame) == FRAMES
    assert contents.path[:-1] == expected.path
    assert not contents.note


# kills


def written_since(path: Path, moment: int) -> bool:
    return path.exists() and path.stat().st_mtime_ns > moment


def killed_again_and_again(folder: Path, times: int, seed: int) -> float:
    """Kill the writer of a journal at random moments; return the most seconds that were ever lost."""
    rng = random.Random(seed)
    program = Path(__file__).parent / 'journal_writer.py'
    worst = 0.0
    log = Path(f'{folder}.accepted')
    for _ in range(times):
        began = time.time_ns()
        process = subprocess.Popen(
            [sys.executable, str(program), str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        # once it writes, or while it starts
        if rng.random() < 0.8:
            until(functools.partial(written_since, log, began), 60.0)
        time.sleep(rng.uniform(0.0, 2.0))
        died = time.time_ns()
        process.send_signal(signal.SIGKILL)
        _, said = process.communicate(timeout=PATIENCE)
        assert said == ''
        newest = drive_file(folder)
        if newest is None:
            continue
        contents = Contents()
        found = list(read(newest, contents))
        x = np.concatenate([readings.x for readings in found] or [np.zeros(0)])
        # none is missing and none is there twice: every run goes on where the last one's journal ended
        assert np.array_equal(x, np.arange(len(x)))
        assert contents.harm == ''
        for readings in found:
            names = np.array(readings.sensor_names)[readings.sensor]
            expected = np.array(('front', 'hinten links', '超音波'))[readings.x.astype(int) % 3]
            assert (names == expected).all()
        counts, moments = np.fromfile(log, '<i8').reshape(-1, 2).T if log.exists() else np.zeros((2, 0), np.int64)
        # of this run, since what a run loses the next one accepts anew
        lost = moments[(counts > len(x)) & (moments > began)]
        if len(lost):
            worst = max(worst, (died - int(lost[0])) / 1e9)
    assert len(x) > 0
    return worst


@pytest.mark.slow
def test_kill_at_any_moment_loses_less_than_a_second(tmp_path: Path) -> None:
    writers = 2
    with ThreadPoolExecutor(writers) as pool:
        runs = [pool.submit(killed_again_and_again, tmp_path / f'{k}', KILLS // writers, k) for k in range(writers)]
    # the writer's part of it is a quarter of a second, as the node's
    assert 0.0 < max(run.result() for run in runs) < 1.0


def test_a_pipe_in_the_place_of_a_journal_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'drive_0001.journal')
    with pytest.raises(BagError, match='not a regular file'):
        numbers(tmp_path / 'drive_0001.journal')
    journal, _ = opened(tmp_path)
    assert journal.path.name == 'drive_0002.journal'
    journal.close()
