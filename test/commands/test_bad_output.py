"""Results appear complete or not at all, and never replace other files."""

from __future__ import annotations

import errno
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_samples import FILES, code_of, error_of, everything_in, mapped, tape, write_tape
from rosbags import rosbag2

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.console import Ticker
from forward_grid_mapper.core.search.search import Progress


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct bag of the drive."""
    return write_tape(tmp_path_factory.mktemp('plain') / 'bag', tape())


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if the bag is read: errors of the output must be detected before."""

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError('the bag was read first')

    monkeypatch.setattr(process_bag, 'read_drives', refuse)


@pytest.mark.usefixtures('no_work')
def test_existing_output_is_rejected_and_unchanged(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'mine.txt').write_text('mine')
    (tmp_path / 'link').symlink_to('nowhere')
    for path, expected in (
        (tmp_path, 'exists and is not empty'),
        (tmp_path / 'mine.txt', 'is a file'),
        (tmp_path / 'link', 'is a file'),
        (tmp_path / 'mine.txt' / 'maps', 'a part of this path is a file'),
        (tmp_path / 'mine.txt' / 'deep' / 'maps', 'a part of this path is a file'),
        (bag, 'exists and is not empty'),
    ):
        error = error_of(capsys, tmp_path, bag, '-o', path)
        assert str(path) in error and expected in error and '-o' in error
    assert (tmp_path / 'mine.txt').read_text() == 'mine'


@pytest.mark.usefixtures('no_work')
def test_output_without_permission_is_rejected(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, *arguments: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, 'Permission denied')

    monkeypatch.setattr(Path, 'mkdir', refuse)
    error = error_of(capsys, tmp_path, bag, '-o', tmp_path / 'new' / 'maps')
    assert str(tmp_path / 'new' / 'maps') in error and 'no permission' in error and '-o' in error


@pytest.mark.skipif(os.geteuid() == 0, reason='permissions do not bind root')
def test_output_in_a_read_only_folder_is_rejected(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'locked').mkdir(mode=0o500)
    assert 'no permission' in error_of(capsys, tmp_path, bag, '-o', tmp_path / 'locked' / 'maps')


def full(*arguments: object, **options: object) -> None:
    """Fail like a write to a full disk."""
    raise OSError(errno.ENOSPC, 'No space left on device')


@pytest.mark.parametrize('exists', [False, True])
@pytest.mark.parametrize(
    ('owner', 'name'),
    [(np, 'savez_compressed'), (Path, 'write_text'), (rosbag2.Writer, 'write'), (BagWriter, '__exit__')],
)
def test_full_disk_leaves_no_incomplete_results(
    tmp_path: Path,
    bag: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    exists: bool,
) -> None:
    output = tmp_path / 'maps' if exists else tmp_path / 'new' / 'maps'
    if exists:
        output.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, full)
        error = error_of(capsys, tmp_path, bag, '-o', output, '--bag')
    assert str(tmp_path) in error
    assert 'disk is full' in error or 'No space left' in error
    mapped(bag, output, '--bag')
    assert {path.name for path in output.iterdir()} == FILES | {'maps.mcap_bag'}


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """Limit the size of files, so that real writes fail."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # the hard limit stays, otherwise the soft limit could not be raised again
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(('limit', 'name'), [(6_000, 'live_map.pgm'), (20_000, 'maps.npz')])
def test_file_size_limit_leaves_no_incomplete_results(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], limit: int, name: str
) -> None:
    with no_file_larger_than(limit):
        error = error_of(capsys, tmp_path, bag, '-q', '-o', tmp_path / 'maps')
    assert f'{name} cannot be written: File too large' in error
    assert everything_in(tmp_path) == []


def test_picture_that_cannot_be_written_is_left_out(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with no_file_larger_than(60_000):
        assert code_of(process_bag.main, bag, '-q', '-o', tmp_path / 'maps') == 0
    error = capsys.readouterr().err
    assert 'warning: no picture was drawn: ' in error and 'File too large' in error
    assert 'warning: report.html was not written: ' in error
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES - {'maps.png', 'report.html'}


def interrupt(*arguments: object, **options: object) -> None:
    """Do what Ctrl-C does."""
    signal.raise_signal(signal.SIGINT)


def during_the_search(self: Ticker, stage: str, progress: Progress | None) -> None:
    """Interrupt after the first sweep of the search."""
    if progress is not None:
        interrupt()


@pytest.mark.parametrize('exists', [False, True])
@pytest.mark.parametrize(
    ('owner', 'name', 'action'),
    [
        (Ticker, 'mapping', during_the_search),
        (Ticker, 'reading', interrupt),
        (np, 'savez_compressed', interrupt),
        (BagWriter, 'write_grid', interrupt),
    ],
)
def test_ctrl_c_leaves_no_files(
    tmp_path: Path,
    bag: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    action: Callable[..., None],
    exists: bool,
) -> None:
    output = tmp_path / 'maps' if exists else tmp_path / 'new' / 'maps'
    if exists:
        output.mkdir()
    before = everything_in(tmp_path)
    monkeypatch.setattr(owner, name, action)
    assert code_of(process_bag.main, bag, '-q', '-o', output, '--bag') == 130
    assert capsys.readouterr() == ('', 'process_bag: cancelled; nothing was written\n')
    assert everything_in(tmp_path) == before


def test_output_folder_created_meanwhile_is_kept(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def meanwhile(*arguments: object, **options: object) -> Any:
        (tmp_path / 'maps').mkdir()
        (tmp_path / 'maps' / 'mine.txt').write_text('mine')
        return write(*arguments, **options)

    write = process_bag.write_results
    monkeypatch.setattr(process_bag, 'write_results', meanwhile)
    assert code_of(process_bag.main, bag, '-o', tmp_path / 'maps') == 1
    assert 'has been created meanwhile' in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob('*')] == ['maps', 'mine.txt']
