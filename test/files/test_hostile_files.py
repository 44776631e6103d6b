"""Files with arbitrary bytes are read or rejected with a message, in limited time and without a traceback."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_maps import made_maps

from forward_grid_mapper.core.common.errors import MapperError, ParameterError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.files.map_archive import read_npz, write_npz
from forward_grid_mapper.files.map_files import read_map, write_trinary
from forward_grid_mapper.files.parameter_file import load_parameters

CONFIG = Path(__file__).resolve().parents[2] / 'config'
SHREDS = (
    *(b'!!python/object/apply:os.system ', b'!!int ', b'!!binary ', b'!!timestamp ', b'&a ', b'*a', b'{', b'[', b'? '),
    *(b': ', b'\n', b'\t', b'|', b'---', b'"', b'1e999', b'.inf', b'null', b'9' * 12, b'-1', b'\x00', b'\xff', b'../'),
)


def bomb(levels: int) -> str:
    lines = ['a0: &a0 {x: 1, y: 2}']
    for k in range(1, levels):
        names = ', '.join(f'k{n}: *a{k - 1}' for n in range(9))
        lines.append(f'a{k}: &a{k} {{{names}}}')
    return '\n'.join(lines)


def garbled(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.randrange(1, 8)):
        at, kind = rng.randrange(len(data)), rng.random()
        if kind < 0.5:
            data[at] = rng.randrange(256)
        elif kind < 0.8:
            data[at : at + 1] = rng.choice(SHREDS)
        else:
            del data[at : at + rng.randrange(20)]
        data = data or bytearray(b'x')
    return bytes(data)


def survives(read: Callable[[Path], object], path: Path) -> bool:
    """Whether the file is read; if not, it must be rejected with a message."""
    begin = time.process_time()
    try:
        read(path)
        return True
    except MapperError as error:
        assert str(path.parent) in str(error) or str(path) in str(error)
        return False
    finally:
        assert time.process_time() - begin < 10.0


@pytest.mark.parametrize(
    'text',
    [
        'a: &a {x: *a}',
        '&a [*a]',
        bomb(12),
        '{' * 5000,
        '[' * 5000,
        '- ' * 3000,
        '? [a, b]\n: 1',
        '? {a: 1}\n: 1',
        'p_hit: 2001-99-99',
        'p_hit: 2001-01-01',
        'p_hit: !!int abc',
        'p_hit: !!timestamp abc',
        'p_hit: !!python/object/apply:os.getcwd []',
        '1: 2',
        'null: 3',
        'p_hit: .nan',
        'p_hit: 1e999',
        'max_iterations: 1' + '0' * 5000,
        'sensors.a.pose: [1' + '0' * 400 + ', 0, 0]',
        'sensors: {a: {pose: [1e400, 0, 0]}}',
        'sensors: {a: {pose: [true, 0, 0]}}',
        '<<: [1]',
        '!!set {p_hit}',
        'p_hit: 12:30:45',
        'range_topics: [1]',
        'journal: [a]',
        '\x00',
    ],
)
def test_malicious_parameter_file_is_rejected_in_time(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'p.yaml'
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(ParameterError, match=r'p\.yaml'):
        load_parameters(path)
    assert time.process_time() - begin < 10.0


def test_garbled_parameter_file_is_read_or_rejected(tmp_path: Path) -> None:
    rng = random.Random(1)
    content = (CONFIG / 'ring_24.yaml').read_bytes()[:800]
    path = tmp_path / 'p.yaml'
    for _ in range(400):
        path.write_bytes(garbled(content, rng))
        survives(load_parameters, path)


def test_garbled_map_is_read_or_rejected(tmp_path: Path) -> None:
    rng = random.Random(2)
    grid = Grid(0.1, 0, 0, 7, 5)
    path = write_trinary(tmp_path / 'map', grid, np.zeros(grid.shape, np.int8))
    image = tmp_path / 'map.pgm'
    meta, pixels = path.read_bytes(), image.read_bytes()
    for k in range(600):
        path.write_bytes(garbled(meta, rng) if k % 2 else meta)
        image.write_bytes(pixels if k % 2 else garbled(pixels, rng))
        survives(read_map, path)


def test_garbled_archive_is_read_or_rejected(tmp_path: Path) -> None:
    rng = random.Random(3)
    path = tmp_path / 'maps.npz'
    write_npz(path, made_maps())
    content = path.read_bytes()
    read = 0
    for _ in range(300):
        damaged = bytearray(content)
        for _ in range(rng.randrange(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(damaged[: rng.randrange(len(damaged))] if rng.random() < 0.2 else damaged)
        read += survives(read_npz, path)
    assert read < 300
