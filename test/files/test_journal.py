"""The journal: readings are read back after faults of the process, the disk and the file."""

from __future__ import annotations

import contextlib
import errno
import functools
import math
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
from forward_grid_mapper.files import journal_database, journal_reader, syncing
from forward_grid_mapper.files.journal import Journal, drive_file, drives
from forward_grid_mapper.files.journal_database import DriveWriter
from forward_grid_mapper.files.journal_format import ROW, Contents
from forward_grid_mapper.files.journal_opening import log_of
from forward_grid_mapper.files.journal_reader import read

KILLS = 10


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_readings_of_a_journal_are_read_back(tmp_path: Path) -> None:
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
    # a frame is a name, never a path
    assert sorted(p.name for p in tmp_path.rglob('*')) == ['a b %41?#', 'drive_0001.journal', 'lock', 'журнал']


def test_parameters_of_the_node_are_read_back(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    journal.parameters = {'resolution': 0.05, 'max_readings': 7, 'over_range': 'discard', 'unheard_of': 1, 'p_hit': 9.0}
    written(journal, made(0, 10))
    mounts = {'left': [0.1, 0.2, 1.5], 'right': [0.1, 'a', 0], 'far': [math.inf, 0, 0], 'none': None, 'more': [1] * 4}
    journal.parameters = {**journal.parameters, 'max_readings': 8, 'sensors': mounts}
    written(journal, made(10, 10))
    journal.close()
    _, contents = numbers(journal.path)
    # unknown or invalid parameters are ignored
    assert contents.parameters == {'resolution': 0.05, 'max_readings': 8, 'over_range': 'discard'}
    assert contents.mounts == {'left': (0.1, 0.2, 1.5)}
    assert contents.harm == ''


def test_folder_has_one_writer_at_a_time(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    with pytest.raises(OutputError, match='another node'):
        Journal(tmp_path, print)
    journal.close()
    opened(tmp_path)[0].close()


def test_journal_open_in_another_program_is_rejected(tmp_path: Path) -> None:
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
    # another program cannot block the node either
    other = sqlite3.connect(journal.path, timeout=0.0)
    with pytest.raises(sqlite3.OperationalError, match='locked'):
        other.execute('SELECT * FROM sensors')
    journal.close()


def test_new_drive_begins_a_new_file(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    journal.begin_drive()
    assert journal.path.name == 'drive_0001.journal'
    written(journal, made(0, 10))
    journal.begin_drive()
    until(lambda: len(drives(tmp_path)) == 2)
    # also if the node dies before it receives readings
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


def test_put_does_not_wait_for_commits(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    begin = time.monotonic()
    journal.put(made(10, 2000), FRAMES)
    assert time.monotonic() - begin < 0.1
    until(lambda: len(numbers(journal.path)[0]) == 2010)
    journal.close()


# a file that was deleted or replaced


@pytest.mark.parametrize(
    'what', ['file', 'log', 'both', 'folder', 'moved', 'replaced', 'file cut', 'log cut', 'a byte cut']
)
def test_deleted_journal_is_detected_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    folder, warnings = tmp_path / 'j', []
    journal, _ = opened(folder, warnings)
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
    if what == 'a byte cut':
        os.truncate(log_of(path), log_of(path).stat().st_size - 1)
    # also if no readings are put
    until(lambda: journal.gone)
    assert 'the readings in memory are written to a new file' in warnings[0]
    assert journal.notice == warnings[0]
    # the warning before it was given
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
    # the folder still belongs to this node
    with pytest.raises(OutputError, match='another node'):
        Journal(folder, print)
    journal.close()
    assert len(warnings) == 1


def test_waiting_readings_of_an_earlier_drive_whose_file_was_deleted_get_a_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if a user resets a node whose disk is full, and deletes the file of the drive to make room."""
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    journal, _ = opened(tmp_path)
    journal.parameters = {'resolution': 0.05}
    written(journal, made(0, 10))
    with no_room(journal):
        journal.put(made(10, 2000), FRAMES)
        until(lambda: journal.trouble)
        journal.begin_drive()
        journal.put(made(3000, 10), FRAMES)
        (tmp_path / 'drive_0001.journal').unlink()
        until(lambda: not journal.unwritten)
    journal.close()
    assert [path.name for path in drives(tmp_path)] == ['drive_0002.journal', 'drive_0003.journal']
    found, contents = numbers(drives(tmp_path)[0])
    assert found == list(range(10, 2010)) and contents.harm == ''
    assert (contents.map_frame, contents.base_frame) == FRAMES and contents.parameters == {'resolution': 0.05}
    assert numbers(drives(tmp_path)[1])[0] == list(range(3000, 3010))


def test_log_of_another_file_is_not_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a user restores a backup in place of the files; SQLite deletes a log by its name."""
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    journal, _ = opened(tmp_path / 'j')
    written(journal, made(0, 10))
    backup = tmp_path / 'backup'
    shutil.copytree(tmp_path / 'j', backup)
    shutil.rmtree(tmp_path / 'j')
    backup.rename(tmp_path / 'j')
    until(lambda: journal.gone)
    journal.lost = 5
    journal.renew(made(0, 20), FRAMES, [])
    assert journal.lost == 0, 'the readings in memory are all written'
    until(lambda: not journal.unwritten)
    journal.close()
    assert numbers(tmp_path / 'j' / 'drive_0001.journal')[0] == list(range(10))
    assert numbers(tmp_path / 'j' / 'drive_0002.journal')[0] == list(range(20))


# full, slow and faulty disks


@contextlib.contextmanager
def no_room(journal: Journal) -> Iterator[None]:
    """Make SQLite find the disk full, by a limit on the pages of the file."""
    database = journal._writer._database
    assert database is not None
    pages = database.execute('PRAGMA page_count').fetchone()[0]
    database.execute(f'PRAGMA max_page_count={pages}')
    yield
    # closed if its file was deleted meanwhile
    with contextlib.suppress(sqlite3.ProgrammingError):
        database.execute('PRAGMA max_page_count=1073741823')


def test_full_disk_gives_one_warning_and_readings_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(journal_module, 'STEADY', 1e9)
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    written(journal, made(0, 10))
    with no_room(journal):
        for k in range(1, 6):
            journal.put(made(100 * k, 100), FRAMES)
        until(lambda: journal.trouble)
        time.sleep(0.1)
        assert len(warnings) == 1
        assert os.strerror(errno.ENOSPC) in warnings[0]
        assert journal.unwritten >= 400
    until(lambda: not journal.unwritten)
    checked, check = list[None](), journal._writer.check_file
    monkeypatch.setattr(journal._writer, 'check_file', lambda: (checked.append(None), check()))
    until(lambda: len(checked) > 2)
    assert journal.trouble, 'the next attempt may fail'
    monkeypatch.setattr(journal_module, 'STEADY', 0.0)
    until(lambda: not journal.trouble)
    assert len(warnings) == 2 and 'writing works again' in warnings[1]
    journal.close()
    assert numbers(journal.path)[0] == [*range(10), *range(100, 600)]
    assert journal.lost == 0


def test_nearly_full_disk_takes_what_fits_with_one_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    written(journal, made(0, 10))
    database = journal._writer._database
    assert database is not None
    with no_room(journal):
        for k in range(1, 101):
            journal.put(made(100 * k, 100), FRAMES)
        until(lambda: journal.trouble)
        for pages in (60, 100, 120):
            # another program frees some space, again and again; the readings need 200 pages
            before = journal.unwritten
            database.execute(f'PRAGMA max_page_count={pages}')
            until(lambda before=before: journal.unwritten < before - 500)
            time.sleep(0.1)
            assert journal.unwritten and journal.trouble
    assert len(warnings) == 1
    until(lambda: not journal.unwritten)
    journal.close()
    assert numbers(journal.path)[0] == [*range(10), *range(100, 10100)]


def test_readings_that_wait_for_a_disk_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(journal_module, 'MOST_PENDING', 100 * 10 * ROW.itemsize)
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    written(journal, made(0, 10, ('sonar 0',)))
    with no_room(journal):
        for k in range(1, 500):
            journal.put(made(10 * k, 10, (f'sonar {k}',)), FRAMES)
        assert journal.unwritten <= 1010
        assert journal.lost >= 4990 - 1010 - 100
        assert any('lost from now on' in text for text in warnings)
    until(lambda: not journal.unwritten)
    written(journal, made(5000, 10, ('sonar 499',)))
    contents, lost = Contents(), journal.lost
    # the next drive has lost nothing
    path = journal.path
    journal.begin_drive()
    assert journal.lost == 0
    journal.close()
    (back,) = read(path, contents)
    assert back.sensor_names[back.sensor[-1]] == 'sonar 499'
    assert len(back) == 5010 - lost
    assert contents.harm == ''


def test_without_a_free_descriptor_readings_are_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(syncing, 'PERIOD', 0.01)
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    written(journal, made(0, 10))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(map(int, os.listdir('/proc/self/fd')))  # noqa: PTH208 (numbers, not paths)
    taken = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, hard))
    try:
        for k in range(1, 50):
            # also the descriptors that the syncing thread had open a moment ago
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.dup(0))
            journal.put(made(10 * k, 10), FRAMES)
            time.sleep(0.005)
        # writing needs no new descriptor
        until(lambda: not journal.unwritten)
        journal.begin_drive()
        journal.put(made(500, 10), FRAMES)
        # a new file needs no more than the last one had
        until(lambda: not journal.unwritten)
    finally:
        for file in taken:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: not journal.unwritten)
    journal.close()
    assert any('does not sync written data' in text for text in warnings)
    assert numbers(drives(tmp_path)[0])[0] == list(range(500))
    assert numbers(drives(tmp_path)[1])[0] == list(range(500, 510))


def test_block_written_again_is_stored_once(tmp_path: Path) -> None:
    """As after a commit that reached the disk but reported a failure; the file is then opened again."""
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    written(journal, made(0, 10))
    writer = journal._writer
    write = writer.write

    def fails(*arguments: object) -> Path:
        write(*arguments)  # type: ignore[arg-type]
        writer.write = write  # type: ignore[method-assign]
        writer.close()
        raise OSError(errno.EIO, 'Input/output error')

    writer.write = fails  # type: ignore[method-assign,assignment]
    journal.put(made(10, 10), FRAMES, [(1.0, 1.0)])
    until(lambda: not journal.unwritten)
    written(journal, made(20, 10))
    journal.close()
    found, contents = numbers(journal.path)
    assert found == list(range(30))
    assert len(contents.path) == 3
    # the file has all that was written to it, so there is no new one
    assert len(warnings) == 1 and names_in(tmp_path) == ['drive_0001.journal', 'lock']


def test_slow_sync_does_not_delay_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    # later data is synced by a new call
    until(lambda: len(synced) >= 2)
    journal.close()
    assert numbers(drives(tmp_path)[1])[0] == list(range(20, 30))


def test_folder_is_released_after_the_last_write_of_a_closed_journal(
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


def test_journal_closed_while_it_is_restored_writes_nothing(tmp_path: Path) -> None:
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


@pytest.mark.parametrize('step', ['_connect', 'readings'])
def test_journal_closed_while_its_file_is_opened_releases_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    warnings: list[str] = []
    journal = Journal(tmp_path, warnings.append)
    begin, begun, go_on = getattr(DriveWriter, step), threading.Event(), threading.Event()

    def slow(*arguments: object) -> object:
        begun.set()
        assert go_on.wait(20.0)
        return begin(*arguments)

    with ThreadPoolExecutor() as pool, monkeypatch.context() as patched:
        patched.setattr(DriveWriter, step, slow)
        found = pool.submit(lambda: list(journal.restore()))
        assert begun.wait(20.0)
        journal.close()
        go_on.set()
        assert found.result(20.0) == []
    assert warnings == []
    another, chunks = opened(tmp_path)
    assert [len(chunk) for chunk in chunks] == [10]
    another.close()


def test_file_size_limit_is_handled_as_a_full_disk(tmp_path: Path) -> None:
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


def test_journal_folder_that_is_a_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match=r'/file is a file, but a journal is a folder$'):
        Journal(tmp_path / 'file', print)
    with pytest.raises(OutputError, match='a part of this path is a file'):
        Journal(tmp_path / 'file' / 'journal', print)
    (tmp_path / 'drive_0001.journal').write_text('')
    with pytest.raises(OutputError, match=rf'drive_0001\.journal is a file, .*: give {tmp_path}$'):
        Journal(tmp_path / 'drive_0001.journal', print)
    (tmp_path / 'broken').symlink_to('nowhere')
    with pytest.raises(OutputError, match='is a folder'):
        Journal(tmp_path / 'broken', print)
    assert not (tmp_path / 'lock').exists()


# at the start of a node


def test_incomplete_new_journal_is_replaced(tmp_path: Path) -> None:
    for name in ('.new.journal', '.new.journal-journal', '.new.journal-wal'):
        (tmp_path / name).write_bytes(b'SQLite format 3\0' + bytes(1000))
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    assert names_in(tmp_path) == ['drive_0001.journal', 'lock']
    assert numbers(journal.path)[0] == list(range(10))


def test_new_file_is_not_used_before_it_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if SQLite could not move its log into the file, so that the file alone lacks its tables."""
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    left = [tmp_path / '.new.journal-wal', tmp_path / '.new.journal-journal']

    @contextlib.contextmanager
    def closing(database: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
        with contextlib.closing(database):
            yield database
        if left:
            left.pop().write_bytes(b'')

    monkeypatch.setattr(journal_database, 'closing', closing)
    warnings: list[str] = []
    journal, _ = opened(tmp_path, warnings)
    until(lambda: not left)
    written(journal, made(0, 10))
    journal.close()
    assert 'a new file could not be completed' in warnings[0]
    assert names_in(tmp_path) == ['drive_0001.journal', 'lock']
    assert numbers(journal.path)[0] == list(range(10))


def test_file_that_cannot_be_read_again_at_the_start_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, _ = opened(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    read_rows, tables = journal_reader._Table.rows, list[str]()

    def failing(table: journal_reader._Table, name: str, *columns: str) -> Iterator[tuple[object, ...]]:
        tables.append(name)
        if tables.count('readings') == 2:
            raise sqlite3.OperationalError('disk I/O error')
        yield from read_rows(table, name, *columns)

    with monkeypatch.context() as patched:
        patched.setattr(journal_reader._Table, 'rows', failing)
        journal, chunks = opened(tmp_path)
    assert chunks == [] and journal.gone, 'new readings must not follow those that are not in memory'
    journal.renew(made(10, 10), FRAMES, [])
    journal.close()
    assert [numbers(path)[0] for path in drives(tmp_path)] == [list(range(10)), list(range(10, 20))]


@pytest.mark.parametrize('content', ['bytes', 'directory', 'nan', 'cut', 'newer', 'rollback', 'empty'])
def test_damaged_journal_stays_and_its_readings_are_copied(tmp_path: Path, content: str) -> None:
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
    warnings: list[str] = []
    journal, chunks = opened(tmp_path, warnings)
    back = [int(x) for readings in chunks for x in readings.x]
    if content == 'cut':
        assert back == expected[: len(back)]
        assert 100 < len(back) < 1000
    else:
        assert back == expected
    if content == 'rollback':
        assert not warnings
    else:
        assert 'drive_0007.journal' in warnings[0]
        assert 'the journal continues in drive_0008.journal' in warnings[0]
        assert journal.notice == warnings[-1]
    written(journal, made(1000, 10))
    journal.close()
    assert journal.path.name == 'drive_0008.journal'
    found, contents = numbers(journal.path)
    assert found == [*back, *range(1000, 1010)]
    assert contents.harm == ''
    assert (path.read_bytes() if path.is_file() else b'') == before
    journal, chunks = opened(tmp_path, warnings)
    assert [int(x) for readings in chunks for x in readings.x] == found
    journal.close()


def test_journal_of_the_previous_format_continues_in_a_new_file(tmp_path: Path) -> None:
    old = tmp_path / 'drive_0003.journal'
    old.write_bytes(Previous.file(120_000, 1000))
    before = old.read_bytes()
    warnings: list[str] = []
    journal, chunks = opened(tmp_path, warnings)
    assert sum(map(len, chunks)) == 120_000
    assert 'the previous version, which the next version will not read' in warnings[0]
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


def killed_repeatedly(folder: Path, times: int, seed: int) -> float:
    """Kill the writer of a journal at random moments; return the most seconds of readings that were lost."""
    rng = random.Random(seed)
    program = Path(__file__).parent / 'journal_writer.py'
    worst = 0.0
    log = Path(f'{folder}.accepted')
    for _ in range(times):
        began = time.time_ns()
        process = subprocess.Popen(
            [sys.executable, str(program), str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        # while it writes, or while it starts
        if rng.random() < 0.8:
            until(functools.partial(written_since, log, began), 60.0)
        time.sleep(rng.uniform(0.0, 2.0))
        died = time.time_ns()
        process.send_signal(signal.SIGKILL)
        _, warnings = process.communicate(timeout=PATIENCE)
        assert warnings == ''
        newest = drive_file(folder)
        if newest is None:
            continue
        contents = Contents()
        found = list(read(newest, contents))
        x = np.concatenate([readings.x for readings in found] or [np.zeros(0)])
        # none is missing or duplicated: each run continues where the journal of the last one ended
        assert np.array_equal(x, np.arange(len(x)))
        assert contents.harm == ''
        for readings in found:
            names = np.array(readings.sensor_names)[readings.sensor]
            expected = np.array(('front', 'hinten links', '超音波'))[readings.x.astype(int) % 3]
            assert (names == expected).all()
        counts, moments = np.fromfile(log, '<i8').reshape(-1, 2).T if log.exists() else np.zeros((2, 0), np.int64)
        # only readings of this run, since the next run accepts the lost ones again
        lost = moments[(counts > len(x)) & (moments > began)]
        if len(lost):
            worst = max(worst, (died - int(lost[0])) / 1e9)
    assert len(x) > 0
    return worst


@pytest.mark.slow
def test_kill_at_any_moment_loses_less_than_a_second(tmp_path: Path) -> None:
    writers = 2
    with ThreadPoolExecutor(writers) as pool:
        runs = [pool.submit(killed_repeatedly, tmp_path / f'{k}', KILLS // writers, k) for k in range(writers)]
    # a quarter of a second is due to the writer, as in the node
    assert 0.0 < max(run.result() for run in runs) < 1.0


def test_pipe_in_place_of_a_journal_is_rejected_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'drive_0001.journal')
    with pytest.raises(BagError, match='not a regular file'):
        numbers(tmp_path / 'drive_0001.journal')
    journal, _ = opened(tmp_path)
    assert journal.path.name == 'drive_0002.journal'
    journal.close()
