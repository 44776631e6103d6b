"""Results appear whole or not at all, and never in place of something else."""

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
from drive_samples import FILES, code_of, everything_in, mapped, refusal, tape, write_tape
from rosbags import rosbag2

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.console import Ticker
from forward_grid_mapper.core.search.search import Progress


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound bag of the drive."""
    return write_tape(tmp_path_factory.mktemp('plain') / 'bag', tape())


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is read: what is wrong with the output must be known before."""

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError('the bag was read first')

    monkeypatch.setattr(process_bag, 'read_drives', refuse)


@pytest.mark.usefixtures('no_work')
def test_places_that_are_taken(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
        said = refusal(capsys, tmp_path, bag, '-o', path)
        assert str(path) in said and expected in said and '-o' in said
    assert (tmp_path / 'mine.txt').read_text() == 'mine'


@pytest.mark.usefixtures('no_work')
def test_a_place_without_permission(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, *arguments: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, 'Permission denied')

    monkeypatch.setattr(Path, 'mkdir', refuse)
    said = refusal(capsys, tmp_path, bag, '-o', tmp_path / 'new' / 'maps')
    assert str(tmp_path / 'new' / 'maps') in said and 'no permission' in said and '-o' in said


@pytest.mark.skipif(os.geteuid() == 0, reason='permissions do not bind root')
def test_a_place_without_permission_for_real(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'locked').mkdir(mode=0o500)
    assert 'no permission' in refusal(capsys, tmp_path, bag, '-o', tmp_path / 'locked' / 'maps')


def full(*arguments: object, **options: object) -> None:
    """Fail as every write to a full disk does."""
    raise OSError(errno.ENOSPC, 'No space left on device')


@pytest.mark.parametrize('exists', [False, True])
@pytest.mark.parametrize(
    ('owner', 'name'),
    [(np, 'savez_compressed'), (Path, 'write_text'), (rosbag2.Writer, 'write'), (BagWriter, '__exit__')],
)
def test_a_full_disk(
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
        said = refusal(capsys, tmp_path, bag, '-o', output, '--bag')
    assert str(tmp_path) in said
    assert 'disk is full' in said or 'No space left' in said
    mapped(bag, output, '--bag')
    assert {path.name for path in output.iterdir()} == FILES | {'maps.mcap_bag'}


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """Let no file grow beyond so many bytes: real failures of real writes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # the hard limit stays, without which the other could not be raised again
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(('limit', 'name'), [(6_000, 'live_map.pgm'), (20_000, 'maps.npz')])
def test_a_limit_on_the_size_of_files(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], limit: int, name: str
) -> None:
    with no_file_larger_than(limit):
        said = refusal(capsys, tmp_path, bag, '-q', '-o', tmp_path / 'maps')
    assert f'{name} cannot be written: File too large' in said
    assert everything_in(tmp_path) == []


def test_a_picture_that_cannot_be_written_costs_only_itself(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with no_file_larger_than(60_000):
        assert code_of(process_bag.main, bag, '-q', '-o', tmp_path / 'maps') == 0
    said = capsys.readouterr().err
    assert 'warning: no picture was drawn: ' in said and 'File too large' in said
    assert 'warning: report.html was not written: ' in said
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES - {'maps.png', 'report.html'}


def interrupt(*arguments: object, **options: object) -> None:
    """Do what Ctrl-C does."""
    signal.raise_signal(signal.SIGINT)


def during_the_search(self: Ticker, stage: str, progress: Progress | None) -> None:
    """Press Ctrl-C when the search has made its first sweep."""
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
def test_ctrl_c(
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


def test_a_folder_that_came_up_meanwhile(
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
