"""Drives, their maps by one process, and jobs to continue: made once for all tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from unittest.mock import patch

import pytest
from scaled_jobs import TILE, Here, code_of, made_here

from forward_grid_mapper.commands.simulate import write_bag
from forward_grid_mapper.files import drawing
from forward_grid_mapper.simulation.campus import campus_drive
from forward_grid_mapper.simulation.sonar import front_array


def without_pictures() -> AbstractContextManager[object]:
    """Return a block in which no pictures are drawn; afterwards they are, for tests of other folders."""
    return patch.object(drawing, 'draw', lambda path, picture: path.write_bytes(b''))


@pytest.fixture(autouse=True)
def quick_picture() -> Iterator[None]:
    with without_pictures():
        yield


@pytest.fixture(scope='session')
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short drives in one building."""
    folder = tmp_path_factory.mktemp('drives')
    for number in range(3):
        write_bag(folder / f'drive_{number}', campus_drive(number, 1, 900, sonars=front_array()), 'mcap', False)
    return folder


@pytest.fixture(scope='session')
def one_process(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The maps of one process, in tiles."""
    folder = tmp_path_factory.mktemp('one') / 'maps'
    with without_pictures():
        assert code_of(drives, '-o', folder, '--tiles', TILE, '-q') == 0
    return folder


@pytest.fixture(scope='session')
def finished(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the maps of a job in this process and, in `work`, all its tasks."""
    folder = tmp_path_factory.mktemp('finished')
    with without_pictures():
        made_here(drives, folder, Here())
    return folder


@pytest.fixture(scope='session')
def placed(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work folder of a command that was cancelled when it had placed the drives, which takes most of its time."""
    from forward_grid_mapper.scale import cluster

    folder = tmp_path_factory.mktemp('placed')
    with patch.object(cluster, 'Cluster', lambda *_: Here(3)):
        assert code_of(drives, '-o', folder / 'maps', '--tiles', TILE, '--workers', 1, '--work', folder / 'work') == 130
    assert len([*(folder / 'work' / 'drives').iterdir()]) == 3
    assert not (folder / 'work' / 'tiles').exists()
    return folder / 'work'
