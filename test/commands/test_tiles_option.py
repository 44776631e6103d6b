"""`process_bag --tiles`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drive_samples import FILES, arrays_in, error_of, mapped, tape, write_tape

from forward_grid_mapper.commands.process_bag import SMALLEST_TILE
from forward_grid_mapper.files import drawing


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: path.write_bytes(b''))


def test_maps_in_tiles_have_the_same_output_files(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    whole, tiled = mapped(bag, tmp_path / 'whole'), mapped(bag, tmp_path / 'tiled', '--tiles', 3)
    assert {path.name for path in (tmp_path / 'tiled').iterdir()} == FILES
    assert tiled['map']['width'] == whole['map']['width'] and tiled['statistics']['tiles'] > 4
    np.testing.assert_array_equal(*(arrays_in(tmp_path / name)['live_map'] for name in ('whole', 'tiled')))
    learned = mapped(bag, tmp_path / 'learned', '--tiles', 3, '--learn', 1)
    assert learned['changed_parameters'].keys() == {'p_hit', 'p_rand', 'p_lost', 'sigma'}
    text = (tmp_path / 'tiled' / 'report.txt').read_text('utf-8')
    assert f'\nTiles           {tiled["statistics"]["tiles"]}, searched' in text
    assert '\nTiles' not in (tmp_path / 'whole' / 'report.txt').read_text('utf-8')


@pytest.mark.parametrize('size', [1e20, 1e308])
def test_tile_larger_than_all_maps_is_the_whole_map(tmp_path: Path, size: float) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    assert mapped(bag, tmp_path / 'maps', '--tiles', size)['statistics']['tiles'] == 1


def test_tiles_may_have_the_smallest_size(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    report = mapped(bag, tmp_path / 'maps', '--tiles', SMALLEST_TILE, '--set', 'max_iterations=1')
    assert report['statistics']['tiles'] > 20


@pytest.mark.parametrize('size', ['0', '-5', f'{SMALLEST_TILE - 0.1}', 'nan', 'inf'])
def test_impossible_size_of_tiles_is_rejected(tmp_path: Path, size: str, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    assert f'--tiles {size}: give the edge' in error_of(
        capsys, tmp_path, bag, '-o', tmp_path / 'maps', f'--tiles={size}'
    )
