"""Files that contain code: the code never runs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_maps import made_maps

from forward_grid_mapper.core.common.errors import InputError, ParameterError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.files.map_archive import read_npz, write_npz
from forward_grid_mapper.files.map_files import read_map, write_trinary
from forward_grid_mapper.files.parameter_file import load_parameters

TAGS = [
    "!!python/object/apply:os.mkdir ['{marker}']",
    "!!python/object/new:os.mkdir ['{marker}']",
    '!!python/name:os.mkdir',
    '!!python/module:os',
    '!!python/tuple [0.0, 0.0, 0.0]',
    '!!python/complex 1.0',
]
"""Tags that PyYAML's unsafe and full loaders accept, and its safe loader does not."""


@pytest.mark.parametrize('tag', TAGS)
def test_code_in_the_yaml_of_a_map_is_rejected(tmp_path: Path, tag: str) -> None:
    path = write_trinary(tmp_path / 'map', Grid(0.1, 0, 0, 3, 2), np.zeros((2, 3), np.int8))
    read_map(path)
    marker = tmp_path / 'marker'
    path.write_text(path.read_text() + f'extra: {tag.format(marker=marker)}\n')
    with pytest.raises(InputError, match='not the YAML of a map'):
        read_map(path)
    assert not marker.exists()


def test_python_tuple_as_origin_of_a_map_is_rejected(tmp_path: Path) -> None:
    path = write_trinary(tmp_path / 'map', Grid(0.1, 0, 0, 3, 2), np.zeros((2, 3), np.int8))
    lines = [line for line in path.read_text().splitlines() if not line.startswith(('origin', '-', '  -'))]
    path.write_text('\n'.join([*lines, 'origin: !!python/tuple [0.0, 0.0, 0.0]']))
    with pytest.raises(InputError, match='python/tuple'):
        read_map(path)


@pytest.mark.parametrize('tag', TAGS)
def test_code_in_a_parameter_file_is_rejected(tmp_path: Path, tag: str) -> None:
    path, marker = tmp_path / 'p.yaml', tmp_path / 'marker'
    path.write_text(f'p_hit: {tag.format(marker=marker)}')
    with pytest.raises(ParameterError, match='not valid YAML'):
        load_parameters(path)
    assert not marker.exists()


class Trap:
    """Makes a folder when unpickled."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._marker),)


@pytest.mark.parametrize(
    'name',
    ['live_map', 'ml_map', 'uncertainty_map', 'origin', 'resolution', 'log_likelihood', 'objective', 'parameters'],
)
def test_pickle_in_an_archive_is_rejected(tmp_path: Path, name: str) -> None:
    path, marker = tmp_path / 'maps.npz', tmp_path / 'marker'
    write_npz(path, made_maps())
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    trap = np.empty(1, object)
    trap[0] = Trap(marker)
    np.savez(path, **{**arrays, name: trap}, allow_pickle=True)
    with pytest.raises(InputError, match='damaged'):
        read_npz(path)
    assert not marker.exists()


@pytest.mark.parametrize('filling', ['\n', ' \n', '# x\n', '-\n', 'a: 1\n', '['])
def test_very_long_file_is_rejected(tmp_path: Path, filling: str) -> None:
    path = tmp_path / 'p.yaml'
    path.write_text(filling * (3_000_000 // len(filling)))
    with pytest.raises(ParameterError, match=r'p\.yaml.* more than 1,000,000 bytes'):
        load_parameters(path)
    with pytest.raises(InputError, match=r'p\.yaml.* more than 1,000,000 bytes'):
        read_map(path)


def test_file_with_80_kb_of_blank_lines_is_read(tmp_path: Path) -> None:
    path = tmp_path / 'p.yaml'
    path.write_text('\n' * 40_000 + 'p_hit: 0.6' + '\n' * 40_000)
    assert load_parameters(path).values == {'p_hit': 0.6}


def test_endless_device_is_rejected(tmp_path: Path) -> None:
    if not Path('/dev/zero').exists():
        pytest.skip('there is no /dev/zero')
    (tmp_path / 'p.yaml').symlink_to('/dev/zero')
    with pytest.raises(ParameterError, match='more than'):
        load_parameters(tmp_path / 'p.yaml')
    with pytest.raises(InputError, match='more than'):
        read_map(tmp_path / 'p.yaml')
