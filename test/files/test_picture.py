"""The picture of a run, which never stops the run."""

from __future__ import annotations

import dataclasses
import sys
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from made_maps import made_maps

from forward_grid_mapper import files
from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.files.panels import DRIVES, coarse, joined_paths, paths_of
from forward_grid_mapper.files.picture import compose, write_picture

PATH = np.stack([np.linspace(-1, 1, 50), np.zeros(50)], axis=1)
PNG = b'\x89PNG\r\n\x1a\n'


@pytest.mark.parametrize(('width', 'height'), [(40, 30), (300, 40), (20, 150), (8, 8)])
@pytest.mark.parametrize('with_reference', [False, True])
def test_picture_of_maps_of_any_shape_is_written(tmp_path: Path, width: int, height: int, with_reference: bool) -> None:
    pytest.importorskip('matplotlib')
    maps = made_maps(width, height)
    reference = (Grid(0.05, -5, -5, 30, 20), np.ones((20, 30), np.int8)) if with_reference else None
    write_picture(tmp_path / 'maps.png', maps, PATH, 'costs $5 or $6_a^b ' * 20, reference)
    assert (tmp_path / 'maps.png').read_bytes().startswith(PNG)


def test_picture_with_letters_that_the_font_lacks_is_written(tmp_path: Path) -> None:
    pytest.importorskip('matplotlib')
    paths = np.array([[-1.0, 0.0], [1.0, 0.0], [np.nan, np.nan], [-1.0, 1.0], [1.0, 1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        write_picture(tmp_path / 'maps.png', made_maps(), paths, '走廊', drives=('星期一', '星期二'))
    assert (tmp_path / 'maps.png').read_bytes().startswith(PNG)


@pytest.mark.parametrize('path', [np.empty((0, 2)), np.zeros((1, 2)), np.full((3, 2), np.nan), np.ones((5, 2))])
def test_picture_with_an_empty_or_unusual_path_is_written(tmp_path: Path, path: np.ndarray) -> None:
    pytest.importorskip('matplotlib')
    write_picture(tmp_path / 'maps.png', made_maps(readings=0), path, 'no readings')
    assert (tmp_path / 'maps.png').read_bytes().startswith(PNG)


@pytest.mark.parametrize('count', [1, 2, 40])
def test_each_drive_has_its_own_colour(tmp_path: Path, count: int) -> None:
    pytest.importorskip('matplotlib')
    image = pytest.importorskip('PIL.Image')
    y = np.linspace(-1, 1, count)
    paths = [np.array([[-1.5, v], [1.5, v], [np.nan, np.nan]]) for v in y]
    names = [f'a$drive_{k}' * 5 for k in range(count)]
    write_picture(
        tmp_path / 'maps.png', made_maps(readings=0), np.concatenate(paths)[:-1], '', None, drives=names[: count - 1]
    )
    with image.open(tmp_path / 'maps.png') as drawn:
        seen = {colour for _, colour in drawn.convert('RGB').getcolors(1_000_000)}
    for k, colour in enumerate(DRIVES):
        assert (tuple(bytes.fromhex(colour[1:])) in seen) == (k < count), colour


@pytest.mark.parametrize('lengths', [[], [2], [3, 0, 1]])
def test_joined_paths_are_parted_again(lengths: list[int]) -> None:
    paths = [np.full((length, 2), float(k)) for k, length in enumerate(lengths)]
    found = paths_of(joined_paths(paths))
    assert [path.tolist() for path in found] == [path.tolist() for path in paths or [np.zeros((0, 2))]]


def test_pyplot_is_not_imported(tmp_path: Path) -> None:
    pytest.importorskip('matplotlib')
    sys.modules.pop('matplotlib.pyplot', None)
    write_picture(tmp_path / 'maps.png', made_maps(), PATH, 'run')
    assert 'matplotlib.pyplot' not in sys.modules


def test_view_is_cropped_to_known_cells() -> None:
    maps = made_maps()
    maps.ml[:], maps.live[:] = -1, np.nan
    maps.ml[10, 5], maps.live[12, 9] = 1, 0.4
    picture = compose(maps, np.empty((0, 2)), '', None)
    np.testing.assert_allclose(picture.view, (-1.5 - 0.2, -1.0 + 0.2, -0.5 - 0.2, -0.2 + 0.2), atol=1e-9)
    ml = picture.panels[1]
    row, column = np.argwhere(ml.values == 1)[0]
    np.testing.assert_allclose(
        (ml.extent[0] + column * 0.1, ml.extent[2] + row * 0.1), (-1.5, -0.5), atol=1e-9, err_msg='cell is not in place'
    )


def test_walls_are_kept_in_coarse_pictures() -> None:
    maps = made_maps(6001, 11)
    picture = compose(maps, np.empty((0, 2)), '', None)
    values = picture.panels[1].values
    assert max(values.shape) <= 2400
    assert (np.fmax.reduce(values, axis=0)[3:-3] == 1).all()


def test_walls_of_fine_maps_are_black_in_the_picture(tmp_path: Path) -> None:
    """Walls of one cell of 2 cm in a map of 20 m: each is black, also between two pixels."""
    image = pytest.importorskip('PIL.Image')
    maps = made_maps(1000, 1000, readings=0)
    maps.ml[3:-3, 3:-3] = 0
    maps.ml[100:-100, 101::131] = 1
    fine = dataclasses.replace(maps, grid=Grid(0.02, 0, 0, 1000, 1000))
    write_picture(tmp_path / 'maps.png', fine, np.empty((0, 2)), 'fine')
    pixels = np.asarray(image.open(tmp_path / 'maps.png').convert('L'))
    height, width = pixels.shape
    # the middle panel, without its edges and its scale
    row = pixels[height // 2, round(0.38 * width) : round(0.63 * width)]
    dark = np.flatnonzero(np.diff((row < 60).astype(int)) == 1)
    assert len(dark) == len(range(101, 1000, 131))


@pytest.mark.parametrize(('shape', 'step'), [((7, 9), 2), ((5, 5), 5), ((4, 6), 3), ((3, 3), 7)])
def test_coarse_blocks_keep_the_largest_value(shape: tuple[int, int], step: int) -> None:
    random = np.random.default_rng(2)
    values = random.uniform(0, 1, shape)
    values[random.uniform(0, 1, shape) < 0.4] = np.nan
    found = coarse(values, step)
    for row, column in np.ndindex(found.shape):
        block = values[row * step : (row + 1) * step, column * step : (column + 1) * step]
        known = block[~np.isnan(block)]
        assert np.isnan(found[row, column]) if not len(known) else found[row, column] == np.float32(known.max())


def test_a_path_far_away_needs_no_memory_for_the_picture(tmp_path: Path) -> None:
    """Odometry jumps by 10 000 km: the map is much smaller than a pixel."""
    tracemalloc.start()
    try:
        write_picture(tmp_path / 'maps.png', made_maps(), np.array([(0.0, 0.0), (1e7, 0.0)]), 'jump')
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


def test_unexplained_readings_end_on_their_axis() -> None:
    maps = made_maps()
    ends = compose(maps, PATH, '', None).unexplained_xy
    odd = maps.readings.select(maps.unexplained)
    np.testing.assert_allclose(np.hypot(ends[:, 0] - odd.x, ends[:, 1] - odd.y), odd.z)
    assert len(ends) == 6


def test_picture_does_not_depend_on_the_number_of_dots_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('matplotlib')
    from forward_grid_mapper.files import drawing

    maps = made_maps()
    assert len(compose(maps, PATH, '', None).unexplained_xy) > 4
    for name, count in (('all', 1000), ('few', 4)):
        monkeypatch.setattr(drawing, '_AT_ONCE', count)
        write_picture(tmp_path / f'{name}.png', maps, PATH[:4], 'run')
    assert (tmp_path / 'all.png').read_bytes() == (tmp_path / 'few.png').read_bytes()


def test_longest_legend_does_not_overlap_the_scale_of_probabilities(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip('matplotlib')
    from matplotlib.figure import Figure

    from forward_grid_mapper.files import drawing

    figures, save = [], Figure.savefig
    monkeypatch.setattr(Figure, 'savefig', lambda figure, path: figures.append(figure) or save(figure, path))
    maps = made_maps(20, 150)
    picture = compose(maps, PATH, '', None, odometry_xy=PATH + 0.1)._replace(unexplained_xy=np.zeros((2_345_678, 2)))
    monkeypatch.setattr(drawing, '_draw_overlay', lambda *rest: None)
    drawing.draw(tmp_path / 'maps.png', picture)
    (figure,) = figures
    legend = max(figure.legends, key=lambda row: len(row.get_texts()))
    scale = figure.axes[-1]
    left = min(scale.get_window_extent().x0, scale.title.get_window_extent().x0)
    assert legend.get_window_extent().x1 < left


def test_thinned_path_covers_the_same_pixels_and_ends() -> None:
    pytest.importorskip('matplotlib')
    from forward_grid_mapper.files.drawing import _thinned

    rng = np.random.default_rng(0)
    path = np.repeat(np.cumsum(rng.normal(0.0, 0.02, (300, 2)), axis=0), 24, axis=0)
    path[4000] = np.nan
    kept = _thinned(path, 0.1)
    assert 50 < len(kept) < 300
    assert np.isnan(kept).any() and np.array_equal(kept[[0, -1]], path[[0, -1]])
    pixels, drawn = ({tuple(cell) for cell in np.floor(p[~np.isnan(p[:, 0])] / 0.025)} for p in (path, kept))
    assert pixels == drawn
    for few in (path[:0], path[:1], path[:2]):
        assert np.array_equal(_thinned(few, 0.1), few)


def test_matplotlib_is_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    monkeypatch.delitem(sys.modules, 'forward_grid_mapper.files.drawing', raising=False)
    monkeypatch.delattr(files, 'drawing', raising=False)
    with pytest.raises(OutputError, match='pip install matplotlib'):
        write_picture(tmp_path / 'maps.png', made_maps(), PATH, 'run')


def test_picture_in_an_absent_folder_is_reported(tmp_path: Path) -> None:
    pytest.importorskip('matplotlib')
    with pytest.raises(OutputError, match='cannot be written'):
        write_picture(tmp_path / 'absent' / 'maps.png', made_maps(), PATH, 'run')
