"""Map files as map_server, the scoring tool and numpy read them."""

from __future__ import annotations

import errno
import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from made_maps import made_maps

from forward_grid_mapper.core.common.errors import InputError, OutputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files.map_archive import read_npz, write_npz
from forward_grid_mapper.files.map_files import occupancy_values, read_map, write_raw, write_trinary
from forward_grid_mapper.files.panels import UNKNOWN_COLOUR
from forward_grid_mapper.files.png import write_png

SCORE_MAP = Path(__file__).parents[2].parent / 'shared' / 'tools' / 'score_map.py'
# Row 0 has the smallest y: the only occupied cell is at the lower right.
CELLS = np.array([[0, 0, 1], [-1, 0, -1]], np.int8)
GRID = Grid(0.05, -142, 33, 3, 2)
SHARED = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)

cells = arrays(np.int8, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(-1, 1))
resolutions = st.floats(0.005, 2.0)
lattice = st.integers(-100_000, 100_000)


def as_probability(ml: np.ndarray) -> np.ndarray:
    return np.where(ml == -1, np.nan, ml).astype(np.float32)


def score_map() -> ModuleType:
    if not SCORE_MAP.exists():
        pytest.skip('the scoring tool is not beside this checkout')
    pytest.importorskip('scipy')
    pytest.importorskip('PIL')
    spec = importlib.util.spec_from_file_location('score_map', SCORE_MAP)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_top_row_of_the_image_has_the_largest_y(tmp_path: Path) -> None:
    assert write_trinary(tmp_path / 'map', GRID, CELLS) == tmp_path / 'map.yaml'
    assert (tmp_path / 'map.pgm').read_bytes() == b'P5\n3 2\n255\n' + bytes([205, 254, 205, 254, 254, 0])


def test_yaml_has_the_fields_of_map_server(tmp_path: Path) -> None:
    meta = yaml.safe_load(write_trinary(tmp_path / 'a.b', GRID, CELLS).read_text())
    assert meta == {
        'image': 'a.b.pgm',
        'mode': 'trinary',
        'resolution': 0.05,
        'origin': [-142 * 0.05, 33 * 0.05, 0.0],
        'negate': 0,
        'occupied_thresh': 0.65,
        'free_thresh': 0.196,
    }


def test_raw_pixels_are_percent(tmp_path: Path) -> None:
    probability = np.array([[0.0, 1.0, 0.496, np.nan]], np.float32)
    meta = yaml.safe_load(write_raw(tmp_path / 'map', Grid(0.1, 0, 0, 4, 1), probability).read_text())
    assert meta['mode'] == 'raw'
    assert (tmp_path / 'map.pgm').read_bytes()[-4:] == bytes([0, 100, 50, 255])


def test_thresholds_separate_occupied_unknown_and_free() -> None:
    occupied, unknown, free = ((255 - v) / 255 for v in (0, 205, 254))
    assert occupied > 0.65
    assert 0.196 <= unknown <= 0.65
    assert free < 0.196


@SHARED
@given(ml=cells, resolution=resolutions, column=lattice, row=lattice)
def test_trinary_round_trip(tmp_path: Path, ml: np.ndarray, resolution: float, column: int, row: int) -> None:
    grid = Grid(resolution, column, row, ml.shape[1], ml.shape[0])
    read_grid, probability = read_map(write_trinary(tmp_path / 'map', grid, ml))
    assert read_grid == grid
    np.testing.assert_array_equal(probability, as_probability(ml))


@SHARED
@given(
    arrays(
        np.float32,
        array_shapes(min_dims=2, max_dims=2, max_side=9),
        elements=st.one_of(st.floats(0, 1, width=32), st.just(np.nan)),
    )
)
def test_raw_round_trip(tmp_path: Path, probability: np.ndarray) -> None:
    grid = Grid(0.1, -3, 4, probability.shape[1], probability.shape[0])
    read_grid, read = read_map(write_raw(tmp_path / 'map', grid, probability))
    assert read_grid == grid
    np.testing.assert_array_equal(np.isnan(read), np.isnan(probability))
    np.testing.assert_allclose(read, probability, atol=0.00501)


def test_scoring_tool_reads_the_same_map(tmp_path: Path) -> None:
    tool = score_map()
    maps = made_maps()
    for file, expected, tolerance in (
        (write_trinary(tmp_path / 'ml', maps.grid, maps.ml), as_probability(maps.ml), 0.0),
        (write_raw(tmp_path / 'live', maps.grid, maps.live), maps.live, 0.00501),
    ):
        probability, origin, resolution = tool.load(file)
        np.testing.assert_allclose(probability, expected, atol=tolerance)
        np.testing.assert_array_equal(origin, maps.grid.origin)
        assert resolution == maps.grid.resolution
        np.testing.assert_allclose(read_map(file)[1], probability, atol=1e-6)


def test_images_with_scale_and_negate_are_read(tmp_path: Path) -> None:
    (tmp_path / 'map.pgm').write_text('P2 # plain\n# by hand\n4 1\n100\n0 25 50\n100 # last\n')
    meta: dict[str, Any] = {
        'image': 'map.pgm',
        'mode': 'scale',
        'resolution': 0.1,
        'origin': [0, 0, 0],
        'negate': 1,
        'occupied_thresh': 0.9,
        'free_thresh': 0.1,
    }
    (tmp_path / 'map.yaml').write_text(yaml.safe_dump(meta))
    np.testing.assert_allclose(read_map(tmp_path / 'map.yaml')[1], [[0.0, 0.1875, 0.5, 1.0]])
    (tmp_path / 'map.yaml').write_text(yaml.safe_dump(meta | {'negate': False}))
    np.testing.assert_allclose(read_map(tmp_path / 'map.yaml')[1], [[1.0, 0.8125, 0.5, 0.0]])


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'image': 'absent.pgm'}, 'cannot be read'),
        ({'image': 'map.yaml'}, 'not a PGM'),
        ({'mode': 'odd'}, 'trinary, scale, raw'),
        ({'resolution': None}, 'not the YAML of a map'),
        ({'resolution': 0.0}, 'above zero'),
        ({'origin': [0, 0, 0.1]}, 'rotated'),
        ({'origin': [0.013, 0, 0]}, 'not a multiple'),
    ],
)
def test_unsupported_map_is_rejected_with_reason(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    file = write_trinary(tmp_path / 'map', GRID, CELLS)
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | change))
    with pytest.raises(InputError, match=message):
        read_map(file)


@pytest.mark.parametrize('text', ['', '[1, 2]', 'image: x', ': : :', 'just words'])
def test_yaml_without_a_map_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / 'map.yaml').write_text(text)
    with pytest.raises(InputError, match='not the YAML of a map'):
        read_map(tmp_path / 'map.yaml')


@pytest.mark.parametrize('content', [b'P5\n3 2\n255\n\x00', b'P2\n3 2\n255\n1 2', b'P2\n3 2\n255\n1 2 3 4 x 6'])
def test_truncated_image_is_rejected(tmp_path: Path, content: bytes) -> None:
    file = write_trinary(tmp_path / 'map', GRID, CELLS)
    (tmp_path / 'map.pgm').write_bytes(content)
    with pytest.raises(InputError, match='damaged or cut short'):
        read_map(file)


def test_errors_of_writing_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='not a folder'):
        write_trinary(tmp_path / 'file' / 'map', GRID, CELLS)
    with pytest.raises(OutputError, match='no cells'):
        write_trinary(tmp_path / 'map', Grid(0.1, 0, 0, 0, 0), np.empty((0, 0), np.int8))
    with pytest.raises(ValueError, match='does not fit'):
        write_trinary(tmp_path / 'map', GRID, CELLS.T)

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(Path, 'open', full)
    with pytest.raises(OutputError, match='disk is full'):
        write_raw(tmp_path / 'map', GRID, as_probability(CELLS))
    with pytest.raises(OutputError, match='disk is full'):
        write_npz(tmp_path / 'maps.npz', made_maps())


def test_occupancy_values() -> None:
    probability = np.array([[0.0, 1.0, 0.123, np.nan]], np.float32)
    np.testing.assert_array_equal(occupancy_values(probability), [[0, 100, 12, -1]])
    np.testing.assert_array_equal(occupancy_values(CELLS), [[0, 0, 100], [-1, 0, -1]])
    assert occupancy_values(CELLS).dtype == occupancy_values(probability).dtype == np.int8


@pytest.mark.parametrize('kind', [np.int8, np.int64, np.uint8, np.float16, np.float32, np.float64])
def test_occupancy_values_are_those_of_the_twin(kind: type[np.generic]) -> None:
    rng = np.random.default_rng(0)
    whole = np.issubdtype(kind, np.integer)
    values = (rng.integers(0 if kind is np.uint8 else -5, 6, 500) if whole else rng.normal(0.5, 0.6, 500)).astype(kind)
    if not whole:
        values[rng.random(500) < 0.3] = np.nan
        values[:3] = np.inf, -np.inf, -0.0

    def twin(value: float) -> int:
        if math.isnan(value) or (whole and value < 0):
            return -1
        if whole or math.isinf(value):
            return 100 if value > 0 else 0
        return min(max(round(float(kind(value) * kind(100.0))), 0), 100)

    found = occupancy_values(values)
    assert found.dtype == np.int8
    assert found.tolist() == [twin(value) for value in values.tolist()]
    assert occupancy_values(values[:0].reshape(0, 4)).shape == (0, 4)


def test_npz_round_trip(tmp_path: Path) -> None:
    maps = made_maps(settings={'p_hit': 0.3, 'over_range': 'discard'})
    write_npz(tmp_path / 'maps.npz', maps)
    archive = read_npz(tmp_path / 'maps.npz')
    assert archive.grid == maps.grid
    assert archive.parameters == maps.parameters
    assert (archive.log_likelihood, archive.objective) == (maps.log_likelihood, maps.objective)
    for name in ('live', 'ml', 'uncertainty'):
        np.testing.assert_array_equal(getattr(archive, name), getattr(maps, name))
        assert getattr(archive, name).dtype == getattr(maps, name).dtype


def test_npz_is_plain_numpy(tmp_path: Path) -> None:
    maps = made_maps()
    write_npz(tmp_path / 'maps.npz', maps)
    with np.load(tmp_path / 'maps.npz', allow_pickle=False) as data:
        assert {name: (data[name].dtype.kind, data[name].shape) for name in data} == {
            'live_map': ('f', maps.grid.shape),
            'ml_map': ('f', maps.grid.shape),
            'uncertainty_map': ('f', maps.grid.shape),
            'dynamic': ('f', (0, 0)),
            'origin': ('f', (2,)),
            'resolution': ('f', ()),
            'log_likelihood': ('f', ()),
            'objective': ('f', ()),
            'parameters': ('U', ()),
        }
        assert data['live_map'].dtype == data['ml_map'].dtype == np.float32
        assert json.loads(str(data['parameters']))['p_hit'] == Parameters().model.p_hit


def test_file_that_is_no_archive_of_maps_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='does not exist'):
        read_npz(tmp_path / 'absent.npz')
    np.savez(tmp_path / 'other.npz', a=1)
    write_npz(tmp_path / 'cut.npz', made_maps())
    (tmp_path / 'cut.npz').write_bytes((tmp_path / 'cut.npz').read_bytes()[:500])
    (tmp_path / 'empty.npz').write_bytes(b'')
    for name in ('other.npz', 'cut.npz', 'empty.npz'):
        with pytest.raises(InputError, match='not an archive of maps'):
            read_npz(tmp_path / name)


@pytest.mark.parametrize('shape', [(1, 1), (7, 5), (300, 40)])
def test_pixels_of_probability_maps_are_shown_by_image_viewers(tmp_path: Path, shape: tuple[int, int]) -> None:
    image = pytest.importorskip('PIL.Image')
    probability = np.random.default_rng(shape[0]).uniform(0, 1, shape).astype(np.float32)
    probability[0, 0] = np.nan
    probability[-1, -1] = probability[-1, -1] if shape == (1, 1) else 0.0
    write_png(tmp_path / 'live_map.png', probability)
    with image.open(tmp_path / 'live_map.png') as shown:
        shown.verify()
    with image.open(tmp_path / 'live_map.png') as shown:
        pixels = np.array(shown.convert('RGB'))[::-1].astype(float)
    assert pixels.shape == (*shape, 3)
    known = ~np.isnan(probability)
    expected = 255 * (1 - probability[known])
    np.testing.assert_allclose(pixels[known], np.repeat(expected[:, None], 3, axis=1), atol=1.1)
    assert (pixels[~known] == list(bytes.fromhex(UNKNOWN_COLOUR[1:]))).all()
