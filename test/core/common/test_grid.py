"""`Grid`: validation, cells of points, unions, windows and boxes of cones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import UNKNOWN, Grid, cone_boxes, part_of, united

FINE, COARSE = Grid(0.05, 0, 0, 8, 6), Grid(0.1, 0, 0, 4, 3)


def test_union_of_two_resolutions_is_rejected() -> None:
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
def test_resolution_that_is_not_positive_and_finite_is_rejected(resolution: float) -> None:
    with pytest.raises(ValueError, match='resolution'):
        Grid(resolution, 0, 0, 1, 1)


@pytest.mark.parametrize('name', ['column', 'row', 'width', 'height'])
@pytest.mark.parametrize('value', [1.0, math.nan, '1', None, True])
def test_grid_field_that_is_not_an_integer_is_rejected(name: str, value: object) -> None:
    fields = {'column': 0, 'row': 0, 'width': 1, 'height': 1, name: value}
    with pytest.raises(ValueError, match=name):
        Grid(0.1, **fields)


def test_negative_size_is_rejected_and_negative_position_is_not() -> None:
    with pytest.raises(ValueError, match='width -1'):
        Grid(0.1, 0, 0, -1, 1)
    assert Grid(0.1, np.int64(-3), -4, np.int32(2), 0).size == 0


PLACE = Grid(0.5, -3, 4, 5, 2)
"""From (-1.5, 2) to (1, 3) metres."""


def test_origin_extent_and_cell_centres_of_a_grid() -> None:
    assert PLACE.origin == (-1.5, 2.0)
    assert PLACE.extent == (-1.5, 1.0, 2.0, 3.0)
    assert (PLACE.shape, PLACE.size) == ((2, 5), 10)
    x, y = PLACE.centers()
    assert x.dtype == y.dtype == np.float64
    assert x.tolist() == [-1.25, -0.75, -0.25, 0.25, 0.75]
    assert y.tolist() == [2.25, 2.75]


def test_point_on_a_corner_belongs_to_the_cell_above_and_right() -> None:
    rows, columns = PLACE.cells_of(np.array([-1.5, -1.6, 0.9, 1.0, 0.0]), np.array([2.0, 1.9, 2.9, 3.0, 2.6]))
    assert (rows.dtype, columns.dtype) == (np.int64, np.int64)
    assert rows.tolist() == [0, -1, 1, 2, 1]
    assert columns.tolist() == [0, -1, 4, 5, 3]
    x, y = PLACE.centers()
    rows, columns = PLACE.cells_of(x[:, None] + 0 * y, y + 0 * x[:, None])
    assert columns[:, 0].tolist() == [0, 1, 2, 3, 4] and rows[0].tolist() == [0, 1]


def test_grids_are_immutable_and_hashable() -> None:
    with pytest.raises(AttributeError):
        PLACE.row = 3
    assert {PLACE: 1}[Grid(0.5, -3, 4, 5, 2)] == 1


@pytest.mark.parametrize('seed', range(20))
def test_union_is_the_smallest_grid_that_contains_both(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = (Grid(0.1, *rng.integers(-9, 9, 2).tolist(), *rng.integers(1, 9, 2).tolist()) for _ in range(2))
    both = {(grid.row + r, grid.column + c) for grid in (one, other) for r, c in np.ndindex(grid.shape)}
    rows, columns = ([cell[axis] for cell in both] for axis in (0, 1))
    whole = one.union(other)
    assert (whole.row, whole.row + whole.height - 1) == (min(rows), max(rows))
    assert (whole.column, whole.column + whole.width - 1) == (min(columns), max(columns))
    for grid in (one, other):
        window = whole.window(grid)
        cells = np.full(whole.shape, 0)
        cells[window] = 1
        assert cells[window].shape == grid.shape
        assert (whole.row + window[0].start, whole.column + window[1].start) == (grid.row, grid.column)


def test_union_with_an_empty_grid_is_the_other_grid() -> None:
    empty, line = Grid(0.5, 90, 90, 0, 0), Grid(0.5, 90, 90, 3, 0)
    assert PLACE.union(empty) == PLACE.union(line) == line.union(PLACE) == PLACE
    assert empty.union(line) == line


@pytest.mark.parametrize(
    ('column', 'row', 'width', 'height'), [(-4, 4, 1, 1), (-3, 3, 1, 1), (1, 4, 2, 1), (1, 5, 1, 2)]
)
def test_window_of_a_grid_that_is_not_inside_is_rejected(column: int, row: int, width: int, height: int) -> None:
    with pytest.raises(ValueError, match='not inside'):
        PLACE.window(Grid(0.5, column, row, width, height))


def test_window_of_the_whole_grid_and_of_its_last_cell() -> None:
    assert PLACE.window(PLACE) == (slice(0, 2), slice(0, 5))
    assert PLACE.window(Grid(0.5, 1, 5, 1, 1)) == (slice(1, 2), slice(4, 5))


def test_grid_that_covers_a_box_has_the_cells_that_it_touches() -> None:
    assert Grid.covering((-1.3, 0.7, 2.1, 2.4), 0.5) == Grid(0.5, -3, 4, 5, 1)
    assert Grid.covering((-1.3, 0.7, 2.1, 2.6), 0.5) == PLACE
    assert Grid.covering((0.0, 0.0, 0.0, 0.0), 0.5) == Grid(0.5, 0, 0, 1, 1)
    assert Grid.covering((7.6, 9.1, -3.2, -2.8), 1.0) == Grid(1.0, 7, -4, 3, 2)


@pytest.mark.parametrize('seed', range(8))
def test_box_of_a_sector_is_that_of_its_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 40
    x, y, reach = rng.uniform(-5, 5, count), rng.uniform(-5, 5, count), rng.uniform(0.1, 4, count)
    yaw, half = rng.uniform(-7, 7, count), rng.uniform(0.01, 1.5, count)
    box = cone_boxes(x, y, yaw, half, reach)
    angles = yaw + half * np.linspace(-1, 1, 4001)[:, None]
    arc_x, arc_y = x + reach * np.cos(angles), y + reach * np.sin(angles)
    expected = [
        np.minimum(arc_x.min(0), x),
        np.maximum(arc_x.max(0), x),
        np.minimum(arc_y.min(0), y),
        np.maximum(arc_y.max(0), y),
    ]
    assert box.shape == (4, count)
    np.testing.assert_allclose(box, expected, atol=1e-5)
    assert (box[[0, 2]] <= np.array(expected)[[0, 2]] + 1e-12).all(), 'no point of an arc lies outside'
    assert (box[[1, 3]] >= np.array(expected)[[1, 3]] - 1e-12).all()


def test_box_of_a_cone_around_an_axis_direction_has_the_full_range() -> None:
    quarter = math.pi / 2
    for k, (side, sign) in enumerate(((1, 1), (3, 1), (0, -1), (2, -1))):
        for yaw in (k * quarter, k * quarter - 4 * quarter, k * quarter + 0.2):
            box = cone_boxes(*np.array([[1.0], [2.0], [yaw], [0.2 + 1e-9], [3.0]]))[:, 0]
            assert box[side] == (1.0 if side < 2 else 2.0) + sign * 3.0


def test_union_of_windows() -> None:
    assert united() is None
    assert united(None, None) is None
    assert united((1, 2, 3, 4), None) == (1, 2, 3, 4)
    assert united((1, 2, 3, 9), (0, 1, 5, 6), None, (4, 7, 4, 5)) == (0, 7, 3, 9)


def test_part_beyond_the_grid_is_unknown_and_a_copy() -> None:
    assert UNKNOWN == -1
    values = np.arange(10, dtype=np.int8).reshape(PLACE.shape)
    part = part_of(PLACE, values, Grid(0.5, 0, 5, 3, 2))
    assert part.tolist() == [[8, 9, -1], [-1, -1, -1]] and part.dtype == np.int8
    assert part_of(PLACE, values, PLACE).tolist() == values.tolist()
    part[:] = 7
    assert values[1, 4] == 9, 'a part is a copy'
