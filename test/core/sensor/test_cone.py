"""Cells of a cone, compared with a test of every cell of the grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.grid import Grid, cone_boxes
from forward_grid_mapper.core.common.parameter_groups import GridParameters, ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.sensor.cone import axis_run, rows_of, runs_of, within
from forward_grid_mapper.core.sensor.cone_table import (
    COORDINATE_UNIT,
    _widest,
    cone_of,
    cone_table,
    effective_sigma,
    grid_of,
    reach_of,
    walk,
    walk_resized,
)
from samples import plain_model, random_readings

GRID = Grid(0.1, -7, 12, 41, 33)

Make = Callable[[np.random.Generator, Grid, int], Readings]


SOME = [naive.awkward_readings, random_readings]


MODEL = ModelParameters(surface_offset=0.3)


def walked(table: np.ndarray, t: int, grid: Grid) -> dict[int, float]:
    """Cells that `walk` finds, with their distances in cells."""
    cells, distances = np.empty(grid.size, np.int32), np.empty(grid.size)
    n = walk(table, t, grid.shape, cells, distances)
    found = dict(zip(cells[:n].tolist(), distances[:n].tolist(), strict=True))
    assert len(found) == n, 'a cell is listed twice'
    return found


@pytest.mark.parametrize('make', SOME)
@pytest.mark.parametrize('grid', [GRID, Grid(0.25, -9, -11, 17, 23)], ids=['fine', 'coarse'])
def test_cone_has_the_cells_within_the_angle_and_those_on_the_axis(make: Make, grid: Grid) -> None:
    readings, model = make(np.random.default_rng(1), grid, 150), MODEL
    table = cone_table(readings, grid, model)
    for t in range(len(readings)):
        found = walked(table, t, grid)
        smaller, larger = (naive.cells_of(readings, t, grid, model, slack) for slack in (-1e-9, 1e-9))
        assert set(smaller) <= set(found) <= set(larger)
        for cell, d in found.items():
            assert d * grid.resolution == pytest.approx(
                larger[cell] + naive.surface(grid, model), abs=COORDINATE_UNIT * grid.resolution
            )


@pytest.mark.parametrize('make', SOME)
def test_runs_of_a_row_are_separate_and_from_left_to_right(make: Make) -> None:
    readings = make(np.random.default_rng(2), GRID, 200)
    two = 0
    for reading in cone_table(readings, GRID, MODEL):
        cone = cone_of(reading)
        for row in range(*rows_of(cone, GRID.height)):
            a, b, c, d, _, _ = runs_of(cone, row, GRID.width)
            for first, last in ((a, b), (c, d)):
                assert last < first or 0 <= first <= last < GRID.width
            if a <= b and c <= d:
                two += 1
                assert c > b + 1
    assert two > 0, 'none of the cones has its axis apart from its centres'


@given(
    st.floats(-3, 20) | st.integers(-6, 40).map(lambda n: n / 2),
    st.floats(-15, 15) | st.integers(-30, 30).map(lambda n: n / 2),
    st.floats(-1, 12) | st.integers(-2, 24).map(lambda n: n / 2),
)
def test_within_returns_the_cells_nearer_than_the_radius(x: float, v: float, radius: float) -> None:
    first, last = within(x, v, radius)
    away = {column: math.hypot(column + 0.5 - x, v) for column in range(-20, 40)}
    for column, d in away.items():
        if abs(d - radius) > 1e-9:
            assert (first <= column <= last) == (d <= radius)


def test_axis_along_an_edge_of_cells_belongs_to_one_of_the_two_rows() -> None:
    # the axis runs between two rows: it belongs to one of them, in both directions
    grid = Grid(0.1, -10, -10, 20, 20)
    readings = Readings.from_columns(
        x=0.0, y=0.0, yaw=[0.0, math.pi, -math.pi, math.pi / 2, -math.pi / 2], z=[0.5] * 5, z_max=2.0, half_angle=1e-9
    )
    table = cone_table(readings, grid, ModelParameters(sigma=0.01))
    for t in range(len(readings)):
        rows, columns = np.divmod(list(walked(table, t, grid)), grid.width)
        across, along = (rows, columns) if t < 3 else (columns, rows)
        assert set(across.tolist()) in ({9}, {10})
        # out to 0.5 m and five times half a cell; it begins on the corner of a cell behind, which may belong to it or
        # not
        assert set(along.tolist()) | {10} == set(range(10, 17) if t in (0, 3) else range(3, 11))
    cone = cone_of(table[0])
    assert [axis_run(cone, row)[1] >= axis_run(cone, row)[0] for row in (9, 10, 11)] == [False, True, False]


@pytest.mark.parametrize('half_angle', [1.5, 1.55, math.pi / 2 - 1e-6])
def test_cone_of_nearly_180_degrees_has_all_cells_ahead(half_angle: float) -> None:
    grid = Grid(0.1, -30, -30, 60, 60)
    rng = np.random.default_rng(3)
    for _ in range(20):
        x, y, yaw = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-4, 4)
        readings = Readings.from_columns(x=x, y=y, yaw=yaw, z=2.0, z_max=2.0, half_angle=half_angle)
        found = set(walked(cone_table(readings, grid, plain_model()), 0, grid))
        xs, ys = grid.centers()
        du, dv = np.meshgrid(xs - x, ys - y)
        ahead = du * math.cos(yaw) + dv * math.sin(yaw)
        inside = (np.hypot(du, dv) <= 2.0) & (ahead > np.hypot(du, dv) * math.cos(half_angle) + 1e-9)
        assert set(np.flatnonzero(inside).tolist()) <= found
        # except cells that the axis crosses on its first cell
        behind = np.array([ahead.ravel()[c] for c in found - set(np.flatnonzero(inside).tolist())])
        assert (np.abs(behind) < 0.16).all()


def test_walk_into_a_small_array_returns_the_number_of_all_cells() -> None:
    readings = random_readings(np.random.default_rng(4), GRID, 20)
    table = cone_table(readings, GRID, ModelParameters())
    for t in range(len(readings)):
        whole = walked(table, t, GRID)
        cells, distances = np.full(4, -1, np.int32), np.full(4, -1.0)
        assert walk(table, t, GRID.shape, cells[:3], distances[:3]) == len(whole)
        assert cells[3] == -1, 'written beyond the end'
        n, cells, distances = walk_resized(table, t, GRID.shape, cells, distances)
        assert dict(zip(cells[:n].tolist(), distances[:n].tolist(), strict=True)) == whole


@pytest.mark.parametrize('make', SOME)
def test_grid_of_readings_contains_all_cells_of_their_cones(make: Make) -> None:
    readings, model = make(np.random.default_rng(5), GRID, 150), MODEL
    parameters = GridParameters(resolution=GRID.resolution)
    for t in range(len(readings)):
        one = readings.select(slice(t, t + 1))
        made = grid_of(one, model, parameters)
        wide = Grid(made.resolution, made.column - 5, made.row - 5, made.width + 10, made.height + 10)
        # cells that only touch it may be inside or outside
        rows, columns = np.divmod(np.array([*naive.cells_of(one, 0, wide, model, slack=-1e-9)], int), wide.width)
        assert ((rows >= 5) & (rows < 5 + made.height)).all()
        assert ((columns >= 5) & (columns < 5 + made.width)).all()
    assert grid_of(readings, model, parameters, within=Grid(0.1, 900, 900, 2, 2)).column <= GRID.column


@pytest.mark.parametrize('offset', [0.0, 0.3])
def test_cone_table_has_the_readings_in_units_of_cells(offset: float) -> None:
    readings, model = random_readings(np.random.default_rng(6), GRID, 30), ModelParameters(surface_offset=offset)
    table = cone_table(readings, GRID, model)
    sigma = effective_sigma(readings, model, GRID.resolution)
    reach = reach_of(readings, sigma)
    for t, cone in enumerate(table):
        assert sigma[t] == naive.sigma_of(readings, t, GRID, model)
        assert reach[t] == naive.reach(readings, t, GRID, model)
        assert cone['x'] == pytest.approx(readings.x[t] / 0.1 + 7)
        assert cone['y'] == pytest.approx(readings.y[t] / 0.1 - 12)
        assert math.atan2(cone['axis_y'], cone['axis_x']) == pytest.approx(math.remainder(readings.yaw[t], 2 * math.pi))
        assert math.atan2(cone['sine'], cone['cosine']) == pytest.approx(readings.half_angle[t])
        lengths = [readings.z[t], readings.z_max[t], naive.free_end(readings, t, GRID, model), reach[t]]
        # the surface at this range belongs to an obstacle whose centre is farther by the offset
        expected = pytest.approx([v / 0.1 + offset for v in lengths])
        assert [cone[k] for k in ('z', 'z_max', 'free', 'reach')] == expected
        assert cone['sigma'] == pytest.approx(sigma[t] / 0.1)


def test_thin_cone_has_no_holes() -> None:
    rng = np.random.default_rng(2)
    grid = Grid(0.1, -30, -30, 60, 60)
    model = ModelParameters()
    readings = random_readings(rng, grid, 50, z_max=2.0)
    readings.x[:] *= 0.1
    readings.y[:] *= 0.1
    readings.half_angle[:] = 0.001
    table = cone_table(readings, grid, model)
    cells, distances = np.empty(grid.size, np.int32), np.empty(grid.size)
    for t in range(len(readings)):
        n = walk(table, t, grid.shape, cells, distances)
        rows, columns = np.divmod(cells[:n], grid.width)
        steps = np.arange(0.0, table['reach'][t] - 1, 0.05)
        on_axis = set(
            zip(
                np.floor(table['y'][t] + steps * math.sin(readings.yaw[t])).astype(int).tolist(),
                np.floor(table['x'][t] + steps * math.cos(readings.yaw[t])).astype(int).tolist(),
                strict=True,
            )
        )
        assert on_axis <= set(zip(rows.tolist(), columns.tolist(), strict=True))


def test_boxes_contain_their_cones_tightly() -> None:
    rng = np.random.default_rng(3)
    n = 200
    x, y, yaw = rng.uniform(-5, 5, n), rng.uniform(-5, 5, n), rng.uniform(-9, 9, n)
    half, reach = rng.uniform(0.01, 1.5, n), rng.uniform(0.1, 4, n)
    boxes = cone_boxes(x, y, yaw, half, reach)
    angles = yaw + np.linspace(-1, 1, 4001)[:, None] * half
    px = np.concatenate([x[None], x + reach * np.cos(angles)])
    py = np.concatenate([y[None], y + reach * np.sin(angles)])
    expected = np.stack([px.min(0), px.max(0), py.min(0), py.max(0)])
    assert np.abs(boxes - expected).max() < 1e-5


def test_position_within_a_cell_does_not_depend_on_the_origin_of_the_grid() -> None:
    rng = np.random.default_rng(11)
    readings = random_readings(rng, Grid(0.1, -40, -40, 80, 80), 500)
    near = cone_table(readings, Grid(0.1, -45, -45, 90, 90), MODEL)
    for column, row in ((-3000, 17), (-64, -100_000), (2, 2)):
        other = cone_table(readings, Grid(0.1, column, row, 10, 10), MODEL)
        # bit-identical, although the number of bits before the point differs
        assert np.array_equal(other['x'] + column, near['x'] - 45)
        assert np.array_equal(other['y'] + row, near['y'] - 45)


@pytest.mark.parametrize('seed', range(20))
def test_box_of_all_cones_is_the_union_of_their_boxes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    yaw = np.where(rng.random(n) < 0.3, rng.integers(-9, 9, n) * math.pi / 2, rng.uniform(-9, 9, n))
    columns = rng.uniform(-5, 5, n), rng.uniform(-5, 5, n), yaw, rng.uniform(0.01, 1.5, n), rng.uniform(0, 4, n)
    boxes = cone_boxes(*columns)
    expected = boxes[0].min(), boxes[1].max(), boxes[2].min(), boxes[3].max()
    np.testing.assert_allclose(_widest(*columns), expected, rtol=0, atol=1e-12)
    assert _widest(*columns) == _widest(*(column[::-1].copy() for column in columns)), 'whatever their order'
