"""A journal file that continues an earlier one: no reading is lost or doubled, whenever the node is stopped."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from journal_samples import FRAMES, Previous, database, made, numbers, opened, rows, until, written
from patience import PATIENCE

from forward_grid_mapper.files import journal as journal_module
from forward_grid_mapper.files import journal_backlog, journal_format, journal_reader
from forward_grid_mapper.files.journal import Journal, drive_file
from forward_grid_mapper.files.journal_backlog import Copied
from forward_grid_mapper.files.journal_format import OWN, Contents, Insert

MOMENTS = 12
"""Moments of each kind of journal at which a node is killed."""

STOPPER = Path(__file__).parent / 'journal_stopper.py'


def cut_journal(folder: Path) -> list[int]:
    """Make a journal whose file was cut by a power failure; return the readings that remain."""
    folder.mkdir()
    path = folder / 'drive_0001.journal'
    forged = database(path, [rows(made(10 * k, 10)).tobytes() for k in range(100)])
    forged.execute('UPDATE drive SET map_frame = ?, base_frame = ?', [name.encode() for name in FRAMES])
    forged.close()
    os.truncate(path, path.stat().st_size // 2)
    found, contents = numbers(path)
    assert 100 < len(found) < 1000 and contents.harm
    return found


def previous_journal(folder: Path) -> list[int]:
    folder.mkdir()
    (folder / 'drive_0001.journal').write_bytes(Previous.file(500))
    return list(range(500))


def restored(folder: Path, warnings: list[str] | None = None) -> tuple[Journal, list[int]]:
    journal, chunks = opened(folder, warnings)
    return journal, [int(x) for readings in chunks for x in readings.x]


def newest(folder: Path) -> tuple[list[int], Contents]:
    path = drive_file(folder)
    assert path is not None
    return numbers(path)


def whole(folder: Path) -> bool:
    """Return whether the newest file has all readings itself."""
    return newest(folder)[1].continues == ''


@pytest.mark.parametrize('make', [cut_journal, previous_journal])
@pytest.mark.parametrize('part', [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 8))])
def test_node_killed_at_any_moment_loses_and_doubles_nothing(
    tmp_path: Path, make: Callable[[Path], list[int]], part: int
) -> None:
    rng = random.Random(part)
    old = make(tmp_path / 'first')
    with subprocess.Popen(
        [sys.executable, str(STOPPER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdin is not None and program.stdout is not None

        def run(folder: Path, last: int = 0) -> int:
            print(folder, last, file=program.stdin, flush=True)
            code, count = program.stdout.readline().split()
            assert code == '0'
            return int(count)

        shutil.copytree(tmp_path / 'first', tmp_path / 'unkilled')
        lines = run(tmp_path / 'unkilled')
        assert newest(tmp_path / 'unkilled')[0] == list(range(len(old) + 20)) and whole(tmp_path / 'unkilled')
        for k in range(MOMENTS):
            folder = tmp_path / f'{k}'
            shutil.copytree(tmp_path / 'first', folder)
            accepted = tmp_path / f'{k}.accepted'
            moment = (k + rng.random()) * lines / MOMENTS
            # the second time at any moment, then not at all
            for last in (int(moment) + 1, rng.randrange(1, lines), 0):
                run(folder, last)
                found, contents = newest(folder)
                assert found == list(range(len(found))), f'killed at line {moment}'
                assert len(found) >= max(len(old), int(accepted.read_text()) if accepted.exists() else 0)
                assert (contents.map_frame, contents.base_frame) == FRAMES
                # until the new file is there, the newest one is the old one
                assert contents.harm == '' or [*folder.glob('drive_*.journal')] == [folder / 'drive_0001.journal']
            assert whole(folder) and len(found) >= len(old) + 20
            # a node that starts once more has the same
            journal, again = restored(folder)
            journal.close()
            assert again == found
        program.stdin.close()
        assert program.wait(PATIENCE) == 0


def test_node_stopped_before_the_copy_leaves_it_to_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with Ctrl-C at the start; new readings are written all the same."""
    monkeypatch.setattr(journal_format, 'CHUNK', 100)
    old = previous_journal(tmp_path / 'j')
    begin = Copied.__iter__
    journal, warnings = Journal(tmp_path / 'j', print), list[str]()

    def stopped_first(copied: Copied) -> Iterator[Insert]:
        until(copied.stopped)
        yield from begin(copied)

    with monkeypatch.context() as patched:
        patched.setattr(Copied, '__iter__', stopped_first)
        assert sum(map(len, journal.restore())) == len(old)
        journal.put(made(len(old), 10), FRAMES, [(7.0, 8.0)])
        journal.close(PATIENCE)
    found, contents = newest(tmp_path / 'j')
    assert found == list(range(len(old) + 10)) and contents.continues == 'drive_0001.journal'
    assert contents.path == [*((10.0 * k, 0.0) for k in range(50)), (7.0, 8.0)]
    journal, again = restored(tmp_path / 'j', warnings)
    assert again == found and 'drive_0001.journal: it has the format of the previous version' in warnings[0]
    assert journal.path.name == 'drive_0002.journal'
    written(journal, made(len(found), 10))
    journal.close()
    found, contents = newest(tmp_path / 'j')
    assert found == list(range(len(old) + 20)) and contents.continues == ''
    assert contents.path[50:] == [(7.0, 8.0), (float(len(old) + 10), 0.0)]


@pytest.mark.parametrize('when', ['before', 'during'])
def test_full_disk_keeps_new_readings_and_the_next_start_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    old = cut_journal(tmp_path / 'j')
    warnings: list[str] = []
    begin = Copied.__iter__

    def full(copied: Copied) -> Iterator[Insert]:
        yield from list(begin(copied))[:5]
        raise sqlite3.OperationalError('database or disk is full')

    with monkeypatch.context() as patched:
        if when == 'before':
            usage = shutil.disk_usage(tmp_path)
            patched.setattr(journal_backlog.shutil, 'disk_usage', lambda path: usage._replace(free=1000))
        else:
            patched.setattr(Copied, '__iter__', full)
        journal, back = restored(tmp_path / 'j', warnings)
        assert back == old
        written(journal, made(len(old), 10))
        assert not journal.trouble and journal.lost == 0
        # also by a reader while the node runs
        assert newest(tmp_path / 'j')[0] == list(range(len(old) + 10))
        journal.close()
    assert 'cannot be copied: No space left on device; the next start tries it again' in warnings[-1]
    assert newest(tmp_path / 'j')[1].continues == 'drive_0001.journal'
    journal, back = restored(tmp_path / 'j')
    assert back == list(range(len(old) + 10))
    until(lambda: not journal.unwritten)
    journal.close()
    assert newest(tmp_path / 'j')[0] == back and whole(tmp_path / 'j')


def test_path_of_a_file_that_was_not_copied_comes_before_the_own_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = previous_journal(tmp_path / 'j')
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(journal_backlog.shutil, 'disk_usage', lambda path: usage._replace(free=1000))
        # the first run receives nothing
        restored(tmp_path / 'j')[0].close()
        journal, _ = restored(tmp_path / 'j')
        written(journal, made(len(old), 10))
        journal.close()
    journal, _ = restored(tmp_path / 'j')
    until(lambda: not journal.unwritten)
    journal.close()
    found, contents = newest(tmp_path / 'j')
    assert found == list(range(len(old) + 10)) and contents.continues == ''
    assert contents.path == [*((10.0 * k, 0.0) for k in range(50)), (float(len(old)), 0.0)]


def test_file_that_changed_since_it_was_read_is_not_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The node has other readings in memory than the file has."""
    previous_journal(tmp_path / 'j')
    begin, warnings = Copied.__iter__, list[str]()

    def changed(copied: Copied) -> Iterator[Insert]:
        (tmp_path / 'j' / 'drive_0001.journal').write_bytes(Previous.file(400))
        yield from begin(copied)

    with monkeypatch.context() as patched:
        patched.setattr(Copied, '__iter__', changed)
        journal, back = restored(tmp_path / 'j', warnings)
        written(journal, made(500, 10))
        journal.close()
    assert back == list(range(500)) and 'drive_0001.journal has changed; the next start tries it' in warnings[-1]
    assert newest(tmp_path / 'j')[1].continues == 'drive_0001.journal'


@pytest.mark.parametrize('why', ['no room for a copy', 'another version', 'an error of the disk'])
def test_file_that_cannot_be_read_at_one_start_is_read_at_a_later_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    old = cut_journal(tmp_path / 'j')
    path, warnings = tmp_path / 'j' / 'drive_0001.journal', list[str]()

    def set_version(number: int) -> None:
        with path.open('r+b') as file:
            file.seek(60)
            file.write(number.to_bytes(4, 'big'))

    with monkeypatch.context() as patched:
        if why == 'no room for a copy':
            patched.setattr(tempfile, 'tempdir', str(tmp_path / 'absent'))
        elif why == 'another version':
            set_version(2)
        else:

            def failing(*arguments: object) -> Iterator[object]:
                raise sqlite3.OperationalError('disk I/O error')
                yield

            patched.setattr(journal_reader._Table, 'rows', failing)
        journal, back = restored(tmp_path / 'j', warnings)
        assert back == []
        assert 'the journal continues in drive_0002.journal, and each start tries again' in warnings[-1]
        written(journal, made(len(old), 10))
        journal.close()
    if why == 'another version':
        set_version(1)
    assert newest(tmp_path / 'j')[0] == list(range(len(old) + 10))
    journal, back = restored(tmp_path / 'j')
    assert back == list(range(len(old) + 10))
    written(journal, made(len(back), 10))
    journal.close()
    assert newest(tmp_path / 'j')[0] == list(range(len(old) + 20)) and whole(tmp_path / 'j')


def test_file_cut_before_it_was_whole_is_continued_as_well(tmp_path: Path) -> None:
    folder = tmp_path / 'j'
    old = cut_journal(folder)
    data = (folder / 'drive_0001.journal').read_bytes()
    (folder / 'drive_0001.journal').write_bytes(b'')
    journal, _ = opened(folder)
    for first in range(len(old), len(old) + 1000, 100):
        written(journal, made(first, 100))
    journal.close()
    os.truncate(folder / 'drive_0002.journal', (folder / 'drive_0002.journal').stat().st_size - 10_000)
    (folder / 'drive_0001.journal').write_bytes(data)
    warnings: list[str] = []
    journal, back = restored(folder, warnings)
    assert back == list(range(len(back))) and len(old) + 500 < len(back) < len(old) + 1000
    assert journal.path.name == 'drive_0003.journal'
    written(journal, made(len(back), 10))
    journal.close()
    assert ['drive_0002.journal: ' in warnings[0], 'drive_0001.journal: ' in warnings[1]] == [True, True]
    assert newest(folder)[0] == list(range(len(back) + 10)) and whole(folder)


def after_an_unreadable_file(tmp_path: Path) -> tuple[Path, Journal]:
    """Return a journal, and its folder, that continues an empty file in `drive_0002.journal`."""
    folder = tmp_path / 'j'
    folder.mkdir()
    (folder / 'drive_0001.journal').write_bytes(b'')
    return folder, opened(folder)[0]


def test_file_removed_before_it_was_copied_is_reported_once(tmp_path: Path) -> None:
    folder, journal = after_an_unreadable_file(tmp_path)
    written(journal, made(0, 10))
    journal.close()
    (folder / 'drive_0001.journal').unlink()
    warnings: list[str] = []
    journal, back = restored(folder, warnings)
    assert back == list(range(10)) and len(warnings) == 1
    assert 'drive_0001.journal: it was removed, so drive_0002.journal lacks its readings' in warnings[0]
    written(journal, made(10, 10))
    journal.close()
    warnings.clear()
    journal, back = restored(folder, warnings)
    journal.close()
    assert back == list(range(20)) and warnings == []


def test_file_removed_while_its_readings_are_only_in_memory_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if a user makes room on a full disk."""
    monkeypatch.setattr(journal_module, 'CHECK_PERIOD', 0.01)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(journal_backlog.shutil, 'disk_usage', lambda path: usage._replace(free=1000))
    old, warnings = previous_journal(tmp_path / 'j'), list[str]()
    journal, _ = restored(tmp_path / 'j', warnings)
    written(journal, made(len(old), 10))
    (tmp_path / 'j' / 'drive_0001.journal').unlink()
    until(lambda: journal.gone)
    assert 'drive_0001.journal, which it continues, was removed; the readings in memory are written' in warnings[-1]
    journal.renew(made(0, len(old) + 20), FRAMES, [])
    until(lambda: not journal.unwritten)
    assert not journal.gone
    journal.close()
    assert newest(tmp_path / 'j')[0] == list(range(len(old) + 20)) and whole(tmp_path / 'j')


def test_reset_does_not_bring_back_the_continued_file(tmp_path: Path) -> None:
    folder, journal = after_an_unreadable_file(tmp_path)
    journal.begin_drive()
    written(journal, made(0, 10))
    journal.close()
    (folder / 'drive_0001.journal').write_bytes(Previous.file(500))
    journal, back = restored(folder)
    journal.close()
    assert back == list(range(10)) and journal.path.name == 'drive_0003.journal'


def test_deleted_file_is_replaced_by_one_that_continues_what_was_not_read(tmp_path: Path) -> None:
    folder, journal = after_an_unreadable_file(tmp_path)
    written(journal, made(500, 10))
    for path in folder.glob('drive_0002*'):
        path.unlink()
    until(lambda: journal.gone)
    journal.renew(made(500, 20), FRAMES, [(1.0, 2.0)])
    written(journal, made(520, 10))
    journal.close()
    (folder / 'drive_0001.journal').write_bytes(Previous.file(500))
    journal, back = restored(folder)
    until(lambda: not journal.unwritten)
    journal.close()
    assert back == list(range(530)) == newest(folder)[0] and whole(folder)


# files that were not written by a node


def continuing(path: Path, name: bytes, first: int = OWN) -> None:
    forged = database(path)
    forged.execute('INSERT INTO drive VALUES (1, NULL, NULL, ?)', (name,))
    forged.execute('INSERT INTO readings VALUES (?, ?)', (first, rows(made(10, 10)).tobytes()))
    forged.close()


def test_files_that_continue_each_other_are_read_once(tmp_path: Path) -> None:
    for number, other in ((1, 2), (2, 1), (3, 3)):
        continuing(tmp_path / f'drive_000{number}.journal', b'drive_000%d.journal' % other)
    for number, count in ((1, 20), (2, 20), (3, 10)):
        found, contents = numbers(tmp_path / f'drive_000{number}.journal')
        assert len(found) == count and 'continue each other' in contents.unread


def test_long_chain_of_files_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_reader, 'MOST_FILES', 5)
    for number in range(1, 9):
        continuing(tmp_path / f'drive_{number:04d}.journal', b'drive_%04d.journal' % (number - 1))
    found, contents = numbers(tmp_path / 'drive_0008.journal')
    assert len(found) == 60 and 'continue each other' in contents.unread


@pytest.mark.parametrize(
    'name', [b'/etc/passwd', b'../drive_0001.journal', b'drive_0001.journal-wal', b'', b'\xff', b'lock']
)
def test_only_files_of_the_folder_are_continued(tmp_path: Path, name: bytes) -> None:
    continuing(tmp_path / 'drive_0002.journal', name)
    found, contents = numbers(tmp_path / 'drive_0002.journal')
    assert found == list(range(10, 20)) and contents.earlier is None
    assert contents.harm == 'the name of the file that it continues is damaged'


def test_pipe_in_place_of_the_continued_file_is_not_waited_for(tmp_path: Path) -> None:
    continuing(tmp_path / 'drive_0002.journal', b'drive_0001.journal')
    os.mkfifo(tmp_path / 'drive_0001.journal')
    found, contents = numbers(tmp_path / 'drive_0002.journal')
    assert found == list(range(10, 20)) and 'not a regular file' in contents.unread
