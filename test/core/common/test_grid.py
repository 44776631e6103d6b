"""Grids: one lattice each, and nothing that is no grid."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import Grid, part_of

FINE, COARSE = Grid(0.05, 0, 0, 8, 6), Grid(0.1, 0, 0, 4, 3)


def test_grids_of_two_resolutions_are_never_joined() -> None:
    values = np.zeros(FINE.shape, np.int8)
    empty = Grid(0.1, 0, 0, 0, 0)
    for join in (
        lambda: FINE.union(COARSE),
        lambda: FINE.union(empty),
        lambda: FINE.window(COARSE),
        lambda: part_of(FINE, values, COARSE),
    ):
        with pytest.raises(ValueError, match=r'0\.05 m.*0\.1 m'):
            join()
    assert COARSE.union(empty) == empty.union(COARSE) == COARSE


@pytest.mark.parametrize('resolution', [0.0, -0.1, math.nan, math.inf, '0.1', None])
def test_the_resolution_is_a_length(resolution: float) -> None:
    with pytest.raises(ValueError, match='resolution'):
        Grid(resolution, 0, 0, 1, 1)


@pytest.mark.parametrize('name', ['column', 'row', 'width', 'height'])
@pytest.mark.parametrize('value', [1.0, math.nan, '1', None, True])
def test_cells_are_counted_in_whole_numbers(name: str, value: object) -> None:
    fields = {'column': 0, 'row': 0, 'width': 1, 'height': 1, name: value}
    with pytest.raises(ValueError, match=name):
        Grid(0.1, **fields)


def test_sizes_are_not_negative_but_places_may_be() -> None:
    with pytest.raises(ValueError, match='width -1'):
        Grid(0.1, 0, 0, -1, 1)
    assert Grid(0.1, np.int64(-3), -4, np.int32(2), 0).size == 0
