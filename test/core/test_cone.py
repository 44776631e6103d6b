"""The cells of a cone against a test of every cell of the grid."""

from __future__ import annotations

import math

import numpy as np
import pytest

import naive
from conftest import random_readings
from forward_grid_mapper.core.cone_index import build_cone_index, cone_table, effective_sigma, reach_of, walk
from forward_grid_mapper.core.grid import Grid, cone_boxes
from forward_grid_mapper.core.parameters import ModelParameters

GRID = Grid(0.1, -7, 12, 41, 33)


@pytest.mark.parametrize('nearest', [False, True])
def test_cone_has_the_cells_within_the_angle_and_those_on_the_axis(nearest: bool) -> None:
    rng = np.random.default_rng(1)
    readings = random_readings(rng, GRID, 150)
    model = ModelParameters(cell_distance='nearest' if nearest else 'center')
    table = cone_table(readings, GRID, model)
    reach = reach_of(readings, effective_sigma(readings, model, GRID.resolution), model.cut)
    cells, distances = np.empty(GRID.size, np.int32), np.empty(GRID.size)
    for t in range(len(readings)):
        n = walk(table, t, GRID.shape, nearest, cells, distances)
        found = dict(zip(cells[:n].tolist(), distances[:n] * GRID.resolution, strict=True))
        assert len(found) == n, 'a cell is listed twice'
        pose = (readings.x[t], readings.y[t], readings.yaw[t])
        smaller = naive.cone_cells(pose, readings.half_angle[t], reach[t], GRID, nearest, slack=-1e-9)
        larger = naive.cone_cells(pose, readings.half_angle[t], reach[t], GRID, nearest, slack=1e-9)
        assert set(smaller) <= set(found) <= set(larger)
        for cell, d in found.items():
            assert d == pytest.approx(larger[cell], abs=1e-12)


def test_a_thin_cone_has_no_holes() -> None:
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
        n = walk(table, t, grid.shape, False, cells, distances)
        rows, columns = np.divmod(cells[:n], grid.width)
        steps = np.arange(0.0, table.reach[t] - 1, 0.05)
        on_axis = set(
            zip(
                np.floor(table.y[t] + steps * math.sin(readings.yaw[t])).astype(int).tolist(),
                np.floor(table.x[t] + steps * math.cos(readings.yaw[t])).astype(int).tolist(),
                strict=True,
            )
        )
        assert on_axis <= set(zip(rows.tolist(), columns.tolist(), strict=True))


def test_boxes_hold_their_cones_tightly() -> None:
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


def test_index_lists_every_pair_both_ways() -> None:
    rng = np.random.default_rng(4)
    readings = random_readings(rng, GRID, 60)
    model = ModelParameters(cut=4.0)
    index = build_cone_index(readings, GRID, model)
    table = cone_table(readings, GRID, model)
    sigma = effective_sigma(readings, model, GRID.resolution)
    cells, distances = np.empty(GRID.size, np.int32), np.empty(GRID.size)
    by_cell_free, by_cell_band = [[] for _ in range(GRID.size)], [[] for _ in range(GRID.size)]
    for t in range(len(readings)):
        n = walk(table, t, GRID.shape, False, cells, distances)
        away = dict(zip(cells[:n].tolist(), distances[:n] * GRID.resolution, strict=True))
        free = {c for c, d in away.items() if d < readings.z[t] - model.cut * sigma[t]}
        assert set(index.free_cell[index.free_start[t] : index.free_start[t + 1]].tolist()) == free
        band = index.band_cell[index.band_start[t] : index.band_start[t + 1]].tolist()
        assert set(band) == set(away) - free
        assert [away[c] for c in band] == sorted(away[c] for c in band)
        for k, c in enumerate(band, index.band_start[t]):
            density = naive.normal(readings.z[t], away[c], sigma[t], model.cut)
            assert index.band_density[k] == pytest.approx(density, rel=1e-5, abs=1e-12)
            slot = index.band_slot[k]
            assert index.slot_start[c] <= slot < index.slot_start[c + 1]
            assert index.slot_reading[slot] == t
            by_cell_band[c].append(t)
        for c in free:
            by_cell_free[c].append(t)
    for c in range(GRID.size):
        assert index.seen_reading[index.seen_start[c] : index.seen_start[c + 1]].tolist() == by_cell_free[c]
        assert index.slot_reading[index.slot_start[c] : index.slot_start[c + 1]].tolist() == by_cell_band[c]
    assert index.pairs == sum(map(len, by_cell_free)) + sum(map(len, by_cell_band))
