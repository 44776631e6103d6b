"""Output folders that appear complete or not at all."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

import pytest

from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.files.output_folder import distinguished, free_name, output_errors, output_folder, unwritable


def test_paths_are_shortened_to_distinct_ends() -> None:
    assert distinguished(['/a/monday/bag', '/a/tuesday/bag', 'other']) == ['monday/bag', 'tuesday/bag', 'other']
    assert distinguished(['/a/x/bag', '/b/x/bag']) == ['a/x/bag', 'b/x/bag']
    assert distinguished(['bag', '/b/bag', 'bag', '', '/']) == ['bag', 'b/bag', 'bag', '.', '/']


def names_in(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def fill(path: Path) -> None:
    with output_folder(path) as folder:
        assert folder != path
        assert not (path / 'a.txt').exists()
        (folder / 'a.txt').write_text('a')
        (folder / 'sub').mkdir()


@pytest.mark.parametrize('name', ['maps', 'maps.v2', 'runs/today/maps'])
def test_folder_appears_when_complete(tmp_path: Path, name: str) -> None:
    fill(tmp_path / name)
    assert names_in(tmp_path / name) == ['a.txt', 'sub']
    assert len(list(tmp_path.iterdir())) == 1


def test_folder_has_default_permissions(tmp_path: Path) -> None:
    (tmp_path / 'plain').mkdir()
    fill(tmp_path / 'maps')
    assert (tmp_path / 'maps').stat().st_mode == (tmp_path / 'plain').stat().st_mode


def test_existing_empty_folder_is_filled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inode = tmp_path.stat().st_ino
    monkeypatch.chdir(tmp_path)
    fill(Path())
    assert names_in(tmp_path) == ['a.txt', 'sub']
    assert tmp_path.stat().st_ino == inode


@pytest.mark.parametrize('exists', [False, True])
def test_second_run_is_refused_at_once(tmp_path: Path, exists: bool) -> None:
    maps = tmp_path / 'maps'
    if exists:
        maps.mkdir()
    with output_folder(maps) as folder:
        (folder / 'a.txt').write_text('a')
        with pytest.raises(OutputError, match=r'another run writes .*maps now; wait until .* another folder'):
            fill(maps)
        fill(tmp_path / 'others')
    assert names_in(maps) == ['a.txt'] and names_in(tmp_path) == ['maps', 'others']


@pytest.mark.parametrize('exists', [False, True])
def test_rest_of_a_killed_run_is_removed(tmp_path: Path, exists: bool) -> None:
    maps = tmp_path / 'maps'
    if exists:
        maps.mkdir()
    killed = (maps if exists else tmp_path) / '.maps.0123abcd.partial'
    killed.mkdir()
    (killed / 'live_map.pgm').write_text('half of')
    other = tmp_path / '.other.0123abcd.partial'
    other.mkdir()
    fill(maps)
    assert names_in(maps) == ['a.txt', 'sub'] and names_in(tmp_path) == [other.name, 'maps']


def test_file_system_without_locks_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(fcntl, 'flock', flock)
    kept = tmp_path / '.maps.0123abcd.partial'
    kept.mkdir()
    fill(tmp_path / 'maps')
    assert names_in(tmp_path) == [kept.name, 'maps']


def test_folder_that_is_not_empty_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'mine.txt').write_text('mine')
    with pytest.raises(OutputError, match='choose another folder'):
        fill(tmp_path)
    assert names_in(tmp_path) == ['mine.txt']


def test_file_in_place_of_the_folder_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'maps').write_text('mine')
    with pytest.raises(OutputError, match='is a file'):
        fill(tmp_path / 'maps')
    with pytest.raises(OutputError, match='is a file, not a folder'):
        fill(tmp_path / 'maps' / 'inner')


def test_folder_created_meanwhile_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match='has been created meanwhile'), output_folder(tmp_path / 'maps') as folder:
        (folder / 'a.txt').write_text('a')
        (tmp_path / 'maps').mkdir()
        (tmp_path / 'maps' / 'mine.txt').write_text('mine')
    assert names_in(tmp_path) == ['maps']
    assert names_in(tmp_path / 'maps') == ['mine.txt']


@pytest.mark.parametrize('failure', [RuntimeError, KeyboardInterrupt, FileNotFoundError])
@pytest.mark.parametrize('exists', [False, True])
def test_failure_leaves_no_files(tmp_path: Path, failure: type[BaseException], exists: bool) -> None:
    target = tmp_path / 'maps' if exists else tmp_path / 'new' / 'maps'
    if exists:
        target.mkdir()
    with pytest.raises(failure), output_folder(target) as folder:
        (folder / 'a.txt').write_text('a')
        raise failure
    assert list(tmp_path.iterdir()) == ([target] if exists else [])
    assert not exists or not names_in(target)


def test_full_disk_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match='disk is full'), output_folder(tmp_path / 'maps'):
        raise OSError(errno.ENOSPC, 'No space left on device')
    assert not list(tmp_path.iterdir())


def test_parent_without_permission_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(errno.EACCES, 'Permission denied')

    monkeypatch.setattr(Path, 'mkdir', refuse)
    with pytest.raises(OutputError, match='no permission'):
        fill(tmp_path / 'maps')


@pytest.mark.skipif(os.geteuid() == 0, reason='permissions do not bind root')
def test_parent_without_write_mode_is_reported(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match='no permission'):
        fill(tmp_path / 'maps')
    tmp_path.chmod(0o700)


def test_unwritable_folder_is_detected_in_advance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'file').touch()
    assert unwritable(tmp_path) == unwritable(tmp_path / 'new' / 'newer') == ''
    assert 'there is no user' in unwritable('~nobody_of_this_name/maps')
    assert unwritable(tmp_path / 'file' / 'new') == f'{tmp_path / "file"} is not a folder'
    there = os.access
    monkeypatch.setattr(
        os, 'access', lambda path, mode: there(path, mode) and (path, mode) != (tmp_path, os.W_OK | os.X_OK)
    )
    assert unwritable(tmp_path / 'new') == f'{tmp_path} is not writable'


def test_output_errors_name_the_file() -> None:
    with pytest.raises(OutputError, match=r'maps\.npz cannot be written: odd'), output_errors(Path('maps.npz')):
        raise OSError(errno.EINVAL, 'odd')


def test_free_name_never_overwrites(tmp_path: Path) -> None:
    assert free_name(tmp_path / 'absent', 'maps') == tmp_path / 'absent' / 'maps'
    for expected in ('maps', 'maps_2', 'maps_3'):
        path = free_name(tmp_path, 'maps')
        assert path == tmp_path / expected
        path.mkdir()
    (tmp_path / 'maps_4').symlink_to('nowhere')
    assert free_name(tmp_path, 'maps').name == 'maps_5'
    with output_folder(tmp_path / 'maps_5'):
        assert free_name(tmp_path, 'maps').name == 'maps_6'
    assert free_name(tmp_path, 'maps').name == 'maps_6', 'that run has ended'


def test_free_name_below_a_file(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='is a file'):
        free_name(tmp_path / 'file', 'maps')
