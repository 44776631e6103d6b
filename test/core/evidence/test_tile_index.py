"""Lists of readings by tile: each reading once, none missing, also after lists have grown."""

from __future__ import annotations

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.tile_index import CHUNK, SHIFT, insert, more_chunks, no_tiles
from samples import plain_model, random_readings


@pytest.mark.parametrize('some', [naive.awkward_readings, random_readings])
@pytest.mark.parametrize('grid', [Grid(0.1, -7, 12, 41, 33), Grid(0.1, 0, 0, 8, 16), Grid(0.1, 3, 3, 1, 9)])
@pytest.mark.parametrize('batches', [1, 7])
def test_tile_lists_each_reading_that_sees_one_of_its_cells_once(some: object, grid: Grid, batches: int) -> None:
    readings = some(np.random.default_rng(1), grid, 300)
    evidence = Evidence(grid, plain_model(sigma=0.03))
    for part in np.array_split(np.arange(len(readings)), batches):
        evidence.extend(readings.select(part))
    tiles = evidence.state.tiles
    expected: list[set[int]] = [set() for _ in tiles.head]
    for t in range(len(readings)):
        free, band, _, _ = naive.pairs_of(evidence.state, t)
        for c in free + band:
            row, column = divmod(c, grid.width)
            expected[(row >> SHIFT) * tiles.across + (column >> SHIFT)].add(t)
    assert [naive.readings_of_tile(tiles, k) for k in range(len(tiles.head))] == [sorted(e) for e in expected]
    assert max(map(len, expected)) > CHUNK, 'too few to need a chain'


def test_tiles_cover_all_cells_of_a_grid() -> None:
    for height, width, up, across in (
        (1, 1, 1, 1),
        (8, 8, 1, 1),
        (9, 8, 2, 1),
        (8, 9, 1, 2),
        (16, 17, 2, 3),
        (0, 0, 0, 0),
    ):
        tiles = no_tiles(height, width)
        assert (tiles.across, len(tiles.head)) == (across, up * across)
        assert all(naive.readings_of_tile(tiles, k) == [] for k in range(len(tiles.head)))


def test_lists_keep_their_readings_as_they_grow() -> None:
    rng = np.random.default_rng(2)
    tiles = more_chunks(no_tiles(40, 50))
    kept: list[list[int]] = [[] for _ in tiles.head]
    for t in range(2000):
        if tiles.used[0] + len(tiles.head) > len(tiles.chunks):
            room = len(tiles.chunks)
            tiles = more_chunks(tiles)
            assert len(tiles.chunks) > room
        row = int(rng.integers(40))
        first, last = sorted(rng.integers(0, 50, 2).tolist())
        for _ in range(2):
            insert(tiles, row, first, last, t)
        for column in range(first >> SHIFT, (last >> SHIFT) + 1):
            kept[(row >> SHIFT) * tiles.across + column].append(t)
    assert [naive.readings_of_tile(tiles, k) for k in range(len(tiles.head))] == kept
    assert tiles.used[0] == sum(-(-len(list_) // CHUNK) for list_ in kept)
