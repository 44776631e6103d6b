"""Recordings found in a folder, and the message about entries that are left out."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from forward_grid_mapper.recordings import finding
from forward_grid_mapper.recordings.finding import find_recordings


def made(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def names_of(folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in find_recordings([folder]).paths]


def test_bags_without_metadata_are_found(tmp_path: Path) -> None:
    folder = made(tmp_path, 'a/metadata.yaml', 'b/b_0.mcap', 'c/c_0.db3', 'c/c_1.db3', 'd/d_0.mcap.zstd', 'e.bag')
    assert names_of(folder) == ['a', 'b', 'c', 'd', 'e.bag']
    assert find_recordings([folder]).skipped == []


def test_entries_left_out_are_named(tmp_path: Path) -> None:
    folder = made(
        tmp_path,
        'a/metadata.yaml',
        'journal/drive_000001.journal',
        'robots/one.mcap',
        'robots/other.mcap',
        'week/monday/metadata.yaml',
        'night.bag.active',
        'maps/report.json',
        'maps/maps.mcap_bag/metadata.yaml',
        'notes/read.txt',
        '.hidden/b_0.mcap',
    )
    assert names_of(folder) == ['a']
    (message,) = find_recordings([folder]).skipped
    assert ': journal, robots, week, night.bag.active; if they are recordings' in message


def test_folder_without_permission_is_among_the_bags_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made(tmp_path, 'a/metadata.yaml', 'b/b_0.mcap')
    whole = finding.storage_files

    def refused(inside: Path) -> list[Path]:
        if inside.name == 'b':
            raise PermissionError(13, 'Permission denied', str(inside))
        return whole(inside)

    monkeypatch.setattr(finding, 'storage_files', refused)
    assert names_of(folder) == ['a', 'b']


def test_single_bag_is_no_folder_of_bags(tmp_path: Path) -> None:
    for number, names in enumerate((['a_0.mcap', 'a_1.mcap.zstd'], ['a.mcap'], ['a.mcap', 'a.mcap.zstd'])):
        folder = made(tmp_path / str(number), *names)
        assert find_recordings([folder]) == ([folder], [])
    # files of a split bag are not several drives, even with other bags beside them
    folder = made(tmp_path / 'split', 'a_0.mcap', 'a_1.mcap', 'b/metadata.yaml')
    assert names_of(folder) == ['.']


def test_files_of_ros_1_are_bags_of_their_own(tmp_path: Path) -> None:
    # `rosbag record --split`, and `simulate campus --format ros1`, number their files
    folder = made(tmp_path, 'drive_0000.bag', 'drive_0001.bag')
    assert names_of(folder) == ['drive_0000.bag', 'drive_0001.bag']


def test_folder_without_permission_is_left_to_the_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Path) -> bool:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, 'is_file', refused)
    assert find_recordings([tmp_path]) == ([tmp_path], [])


def test_names_with_superscript_digits_are_sorted(tmp_path: Path) -> None:
    folder = made(tmp_path, '1²2/metadata.yaml', '10/metadata.yaml', '9/metadata.yaml', 'a1²2.mcap', 'b.mcap')
    assert names_of(folder) == ['1²2', '9', '10', 'a1²2.mcap', 'b.mcap']
