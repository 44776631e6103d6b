"""The journal: what was put comes back, whatever happens to the process, the disk and the file."""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import BagError, OutputError
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.files import journal as journal_module
from forward_grid_mapper.files import syncing
from forward_grid_mapper.files.journal import Journal, drive_file, drives
from forward_grid_mapper.files.journal_format import MAGIC, ROW, Contents, read

FRAMES = ('odom', 'base_link')
KILLS = 50


def made(first: int, count: int, names: tuple[str, ...] = ('left', 'right')) -> Readings:
    numbers = np.arange(first, first + count)
    return Readings.from_columns(
        names=names,
        x=numbers,
        y=-0.5 * numbers,
        yaw=0.1 * numbers,
        z=1.0 + 0.001 * numbers,
        z_max=9.0,
        half_angle=0.2,
        sigma=0.01,
        stamp=numbers * 10**8,
        sensor=numbers % len(names),
    )


def opened(folder: Path, reported: list[str] | None = None) -> tuple[Journal, list[Readings]]:
    journal = Journal(folder, (reported if reported is not None else []).append)
    return journal, list(journal.restore())


def written(journal: Journal, readings: Readings) -> None:
    journal.put(readings, FRAMES, [(float(readings.x[0]), 0.0)])
    until(lambda: not journal.unwritten)


def until(condition: object, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.005)


def numbers(path: Path) -> tuple[list[int], Contents]:
    contents = Contents()
    return [int(x) for readings in read(path, contents) for x in readings.x], contents


def test_what_is_put_comes_back(tmp_path: Path) -> None:
    names = ('ultra sonic/../left', '超音波', '', 'new\nline', '\udcff')
    journal, before = opened(tmp_path / 'a b' / 'журнал')
    assert before == []
    for k in range(3):
        written(journal, made(100 * k, 100, names[: k + 3]))
    journal.close()
    again, chunks = opened(tmp_path / 'a b' / 'журнал')
    back = chunks[0]
    expected = made(0, 300)
    for column in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp'):
        assert np.array_equal(getattr(back, column), getattr(expected, column))
    found = [back.sensor_names[k] for k in back.sensor]
    assert found == [names[k % (k // 100 + 3)] for k in range(300)]
    assert (again.contents.map_frame, again.contents.base_frame) == FRAMES
    assert again.contents.path == [(0.0, 0.0), (100.0, 0.0), (200.0, 0.0)]
    assert again.contents.harm == ''
    # a frame is a name and never a path
    assert sorted(p.name for p in tmp_path.rglob('*')) == ['a b', 'drive_0001.journal', 'lock', 'журнал']
    again.close()


def test_an_end_that_is_torn_anywhere(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path / 'whole')
    for k in range(3):
        written(journal, made(10 * k, 10))
    journal.close()
    whole = (tmp_path / 'whole' / 'drive_0001.journal').read_bytes()
    path = tmp_path / 'torn' / 'drive_0001.journal'
    path.parent.mkdir()
    last = 0
    for length in (*range(0, len(whole), 9), *range(len(whole) - 30, len(whole) + 1)):
        path.write_bytes(whole[:length])
        found, contents = numbers(path)
        assert found == list(range(len(found)))
        assert len(found) % 10 == 0
        assert len(found) >= last
        assert contents.torn == length - contents.end
        last = len(found)
    assert last == 30
    for length in (0, 3, len(MAGIC), len(MAGIC) + 5, len(whole) - 100, len(whole) - 1):
        path.write_bytes(whole[:length])
        reported: list[str] = []
        journal, chunks = opened(path.parent, reported)
        kept = sum(map(len, chunks))
        assert bool(reported) == (length not in (0, len(MAGIC)))
        written(journal, made(kept, 7))
        journal.close()
        found, contents = numbers(path)
        assert found == list(range(kept + 7))
        assert contents.harm == ''


def test_a_flipped_bit_costs_one_block(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    for k in range(20):
        written(journal, made(10 * k, 10))
    journal.close()
    whole = journal.path.read_bytes()
    rng = random.Random(1)
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(MAGIC), len(damaged))] ^= 1 << rng.randrange(8)
        journal.path.write_bytes(damaged)
        found, contents = numbers(journal.path)
        assert len(found) >= 190
        assert set(found) <= set(range(200))
        assert contents.harm


def test_random_bytes_are_no_readings(tmp_path: Path) -> None:
    rng = random.Random(2)
    path = tmp_path / 'drive_0001.journal'
    for _ in range(300):
        path.write_bytes(MAGIC + rng.randbytes(rng.randrange(2000)))
        assert numbers(path)[0] == []
    path.write_bytes(b'#ROSBAG V2.0\n')
    with pytest.raises(BagError, match='is not a journal'):
        numbers(path)
    with pytest.raises(OutputError, match='move it away'):
        opened(tmp_path)


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    with pytest.raises(OutputError, match='another node'):
        Journal(tmp_path, print)
    journal.close()
    opened(tmp_path)[0].close()


def test_a_new_drive_begins_a_new_file(tmp_path: Path) -> None:
    journal, _ = opened(tmp_path)
    journal.begin_drive()
    assert journal.path.name == 'drive_0001.journal'
    written(journal, made(0, 10))
    journal.begin_drive()
    written(journal, made(10, 10))
    journal.close()
    assert [p.name for p in drives(tmp_path)] == ['drive_0001.journal', 'drive_0002.journal']
    assert numbers(drives(tmp_path)[0])[0] == list(range(10))
    assert numbers(drives(tmp_path)[1])[0] == list(range(10, 20))
    assert drive_file(tmp_path) == drives(tmp_path)[1]
    assert drive_file(drives(tmp_path)[0]) == drives(tmp_path)[0]
    assert drive_file(tmp_path / 'lock') is None
    assert drive_file(tmp_path / 'nothing') is None
    again, chunks = opened(tmp_path)
    assert sum(map(len, chunks)) == 10
    again.close()


@pytest.mark.parametrize('number', [errno.ENOSPC, errno.EIO])
def test_a_full_disk_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    reported: list[str] = []
    journal, _ = opened(tmp_path, reported)
    written(journal, made(0, 10))
    full = True
    write = os.pwrite

    def pwrite(file: int, data: bytes, at: int) -> int:
        if full and len(data) > 100:
            # as much as there is space for
            return write(file, data[:50], at)
        if full:
            raise OSError(number, os.strerror(number))
        return write(file, data, at)

    monkeypatch.setattr(os, 'pwrite', pwrite)
    for k in range(1, 6):
        journal.put(made(10 * k, 10), FRAMES)
    until(lambda: journal.trouble)
    time.sleep(0.1)
    assert len(reported) == 1
    assert os.strerror(number) in reported[0]
    assert journal.unwritten == 50
    assert numbers(journal.path)[0] == list(range(10))
    full = False
    until(lambda: not journal.unwritten)
    assert journal.trouble == ''
    journal.close()
    assert numbers(journal.path)[0] == list(range(60))
    assert journal.lost == 0


def test_what_waits_for_a_disk_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, 'RETRY', 0.01)
    monkeypatch.setattr(journal_module, 'MOST_PENDING', 10 * 10 * ROW.itemsize)
    reported: list[str] = []
    journal, _ = opened(tmp_path, reported)
    write = os.pwrite

    def pwrite(file: int, data: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(os, 'pwrite', pwrite)
    for k in range(50):
        journal.put(made(10 * k, 10, (f'sonar {k}',)), FRAMES)
    assert journal.unwritten <= 110
    assert journal.lost == 500 - journal.unwritten
    assert any('lost from here on' in text for text in reported)
    monkeypatch.setattr(os, 'pwrite', write)
    until(lambda: not journal.unwritten)
    written(journal, made(490, 10, ('sonar 49',)))
    journal.close()
    contents = Contents()
    (back,) = read(journal.path, contents)
    assert back.sensor_names[back.sensor[-1]] == 'sonar 49'
    assert len(back) == 510 - journal.lost


def test_a_slow_disk_holds_up_no_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(syncing, 'PERIOD', 0.01)
    began, go_on = threading.Event(), threading.Event()
    sync = os.fdatasync
    synced: list[int] = []

    def fdatasync(file: int) -> None:
        began.set()
        assert go_on.wait(10.0)
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
    journal.close()
    assert len(synced) == 3
    assert numbers(drives(tmp_path)[1])[0] == list(range(20, 30))


def test_a_limit_on_the_size_of_files_is_a_full_disk(tmp_path: Path) -> None:
    program = (
        'import resource, signal, sys, time; sys.path.insert(0, sys.argv[2])\n'
        'signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n'
        'resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n'
        'from journal_writer import main; main(sys.argv[1])'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', program, str(tmp_path / 'j'), str(Path(__file__).parent)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
    )
    assert process.stdout is not None
    assert 'cannot be written: File too large; mapping goes on' in process.stdout.readline()
    time.sleep(0.5)
    assert process.poll() is None
    process.kill()
    process.wait()
    found, contents = numbers(tmp_path / 'j' / 'drive_0001.journal')
    assert found == list(range(len(found)))
    assert len(found) > 100
    assert contents.harm == ''


def test_places_where_no_journal_can_be(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='file'):
        Journal(tmp_path / 'file', print)
    (tmp_path / 'j' / 'drive_0001.journal').mkdir(parents=True)
    with pytest.raises(OutputError):
        Journal(tmp_path / 'j', print)


def killed_again_and_again(folder: Path, times: int, seed: int) -> float:
    """Kill the writer of a journal at random moments; return the most seconds that were ever lost."""
    rng = random.Random(seed)
    program = Path(__file__).parent / 'journal_writer.py'
    worst = 0.0
    for _ in range(times):
        began = time.time_ns()
        process = subprocess.Popen([sys.executable, str(program), str(folder)], stdout=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.2, 2.0))
        died = time.time_ns()
        process.send_signal(signal.SIGKILL)
        process.wait()
        newest = drive_file(folder)
        if newest is None:
            continue
        contents = Contents()
        found = list(read(newest, contents))
        x = np.concatenate([readings.x for readings in found] or [np.zeros(0)])
        # none is missing and none is there twice: every run goes on where the last one's journal ended
        assert np.array_equal(x, np.arange(len(x)))
        assert contents.damaged == 0
        for readings in found:
            names = np.array(readings.sensor_names)[readings.sensor]
            expected = np.array(('front', 'hinten links', '超音波'))[readings.x.astype(int) % 3]
            assert (names == expected).all()
        log = Path(f'{folder}.accepted')
        counts, moments = np.fromfile(log, '<i8').reshape(-1, 2).T if log.exists() else np.zeros((2, 0), np.int64)
        # of this run, since what a run loses the next one accepts anew
        lost = moments[(counts > len(x)) & (moments > began)]
        if len(lost):
            worst = max(worst, (died - int(lost[0])) / 1e9)
    assert len(x) > 0
    return worst


def test_kill_at_any_moment_loses_less_than_a_second(tmp_path: Path) -> None:
    writers = 5
    with ThreadPoolExecutor(writers) as pool:
        runs = [pool.submit(killed_again_and_again, tmp_path / f'{k}', KILLS // writers, k) for k in range(writers)]
    # the writer's part of it is a quarter of a second, as the node's
    assert 0.0 < max(run.result() for run in runs) < 1.0
