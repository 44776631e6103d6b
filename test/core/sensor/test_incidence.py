"""The incidence angle up to which surfaces return echoes, and its effect on readings that passed them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.constants import NEIGHBOURHOOD, WEIGHT_CELL
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.runtime.cancelling import NEVER
from forward_grid_mapper.core.sensor.cone_table import cone_table
from forward_grid_mapper.core.sensor.incidence import (
    ZONES,
    count,
    edges_of,
    limit,
    narrowed,
    no_counts,
    slots_of,
)
from forward_grid_mapper.core.sensor.surface_normals import WEIGHT_UNIT, SurfaceNormals, gather, normals_of, square_of
from samples import random_readings

GRID = Grid(0.1, -25, 0, 50, 40)
MODEL = ModelParameters(sigma=0.05, p_hit=0.6, p_rand=0.1, p_lost=0.1, max_incidence_angle=0.7, min_incidence_angle=0.3)
ANGLES = np.array([0.3, 0.5, 0.7])
WHOLE = (0, GRID.height, 0, GRID.width)
WALL = 3.0


def before_wall(echo_up_to: float, share: float = 1.0, count: int = 400, seed: int = 0) -> Readings:
    """Readings at all incidence angles to a wall at y = 3; a share of those up to `echo_up_to` have an echo of it."""
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, count, z_max=3.4)
    readings.x[:] = rng.uniform(-1.5, 1.5, count)
    readings.y[:] = rng.uniform(1.0, 1.6, count)
    off = rng.uniform(-0.65, 0.65, count)
    readings.yaw[:] = math.pi / 2 + off
    readings.half_angle[:] = 0.05
    heard = (np.abs(off) < echo_up_to) & (rng.random(count) < share)
    readings.z[:] = np.where(heard, (WALL - readings.y) / np.cos(off), readings.z_max)
    return readings


def unit_normals(readings: Readings, grid: Grid = GRID) -> SurfaceNormals:
    cones, sums = cone_table(readings, grid, MODEL), np.zeros((3, grid.size), np.int64)
    gather(cones, grid.shape, (0, len(cones)), sums, NEVER)
    return normals_of(sums, grid, MODEL.max_incidence_angle)


def counted(
    readings: Readings,
    normals: SurfaceNormals,
    window: tuple[int, int, int, int] = WHOLE,
    weights: object = None,
    grid: Grid = GRID,
) -> tuple[np.ndarray, np.ndarray]:
    slots, cones = slots_of(normals, window), cone_table(readings, grid, MODEL)
    counts, edges = no_counts(slots), edges_of(MODEL)
    each = np.ones(len(cones), np.int32) if weights is None else weights
    count(cones, each, normals, slots, window, edges, (0, len(cones)), counts, NEVER)
    return counts, slots


def limit_of(readings: Readings) -> np.ndarray:
    """The incidence angle of each cell with known normal, radians; NaN elsewhere."""
    evidence = Evidence(GRID, MODEL)
    evidence.extend(readings)
    normals = evidence.state.normals
    length = np.hypot(normals.x, normals.y).astype(float)
    with np.errstate(divide='ignore', invalid='ignore'):
        out = np.arccos(np.minimum(math.cos(MODEL.max_incidence_angle) / length, 1.0))
    return np.where(normals.known > 0, out, np.nan).reshape(GRID.shape)


ROW = round(WALL / 0.1) - GRID.row


@pytest.mark.parametrize(
    'readings', [before_wall(0.3, 0.9, 120), random_readings(np.random.default_rng(1), GRID, 80)], ids=['wall', 'any']
)
def test_counts_are_those_of_the_twin(readings: Readings) -> None:
    normals = unit_normals(readings)
    counts, slots = counted(readings, normals)
    expected = naive.met(readings, GRID, MODEL, normals, tuple(ANGLES)).reshape(2 * ZONES, -1)
    known = slots >= 0
    assert np.array_equal(known, normals.known > 0)
    assert known.sum() > 20
    assert np.abs(counts[:, slots[known]] * WEIGHT_UNIT - expected[:, known]).max() < 1e-3
    assert expected[:ZONES].sum() > 5
    assert expected[ZONES:].sum() > 5


def test_counts_of_parts_of_readings_and_map_sum_up_to_the_whole() -> None:
    readings = before_wall(0.3, 0.9, 150)
    normals = unit_normals(readings)
    whole, slots = counted(readings, normals)
    parts = [counted(readings.select(part), normals)[0] for part in (slice(0, 40), slice(40, None))]
    assert np.array_equal(parts[0] + parts[1], whole)
    twice = counted(readings, normals, weights=np.full(len(readings), 2, np.int32))[0]
    assert np.abs(twice - 2 * whole).max() <= len(readings)
    window = (12, 33, 7, 30)
    some, numbers = counted(readings, normals, window)
    inside = np.zeros(GRID.shape, bool)
    inside[12:33, 7:30] = True
    assert np.array_equal(numbers >= 0, (slots >= 0) & inside.ravel())
    assert np.array_equal(some[:, numbers[numbers >= 0]], whole[:, slots[numbers >= 0]])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 30 * 64), min_size=2 * ZONES, max_size=2 * ZONES))
def test_limits_are_those_of_the_twin(quanta: list[int]) -> None:
    # counts are multiples of quanta, so sums are exact: an empty zone is a tie for both implementations
    counts = np.array(quanta) / 64
    assert limit(counts) == naive.incidence_limit(counts[:ZONES], counts[ZONES:])


def test_limits_of_typical_surfaces() -> None:
    def zone(echoes: list[float], passes: list[float]) -> int:
        return limit(np.array([*echoes, *passes], float))

    assert zone([9, 0, 0], [1, 9, 9]) == 0, 'glass'
    assert zone([9, 9, 0], [1, 1, 9]) == 1, 'a smooth wall'
    assert zone([9, 9, 9], [1, 1, 1]) == 2, 'a rough wall'
    assert zone([2, 0, 0], [9, 9, 9]) == 2, 'a few echoes in an open door'
    assert zone([9, 3, 3], [1, 6, 6]) == 2, 'a rough wall that is lost at times'
    assert zone([0.9, 0, 0], [0, 1, 0]) == 2, 'one reading of each kind'
    assert zone([0, 0, 0], [0, 0, 0]) == 2, 'nothing'


@pytest.mark.parametrize(('echo_up_to', 'zone'), [(0.65, 2), (0.49, 1), (0.25, 0)])
def test_wall_gets_the_incidence_angle_up_to_which_it_returns_echoes(echo_up_to: float, zone: int) -> None:
    actual = limit_of(before_wall(echo_up_to, 0.95, 1200))[ROW, 15:35]
    assert np.isfinite(actual).sum() > 15
    assert np.isclose(actual, ANGLES[zone], atol=1e-3).sum() > 0.8 * np.isfinite(actual).sum()


def test_cells_passed_by_readings_get_the_incidence_angle_of_the_model() -> None:
    actual = limit_of(before_wall(0.25, 0.2))[ROW, 15:35]
    assert np.nanmin(actual) == pytest.approx(MODEL.max_incidence_angle, abs=1e-3)


@pytest.mark.parametrize('grid', [GRID, Grid(0.05, -50, 0, 100, 80)], ids=['whole cells', 'parts of cells'])
def test_lengths_of_normals_follow_from_sums_around_each_cell(grid: Grid) -> None:
    readings, whole = before_wall(0.45, 0.9), (0, grid.height, 0, grid.width)
    normals = unit_normals(readings, grid)
    counts, slots = counted(readings, normals, whole, grid=grid)
    dense = np.where(slots >= 0, counts[:, np.maximum(slots, 0)], 0).reshape(-1, *grid.shape) * WEIGHT_UNIT
    made = narrowed(unit_normals(readings, grid), counts, slots, edges_of(MODEL), grid, whole)
    (n, part), seen = square_of(grid.resolution), set[int]()
    weight = np.ones(2 * n + 1)
    weight[[0, -1]] = part
    wide = np.pad(dense, ((0, 0), (n, n), (n, n)))
    unit = (grid.resolution / WEIGHT_CELL) ** 2 * WEIGHT_CELL / NEIGHBOURHOOD
    for c in np.flatnonzero(normals.known):
        row, column = divmod(int(c), grid.width)
        square = wide[:, row : row + 2 * n + 1, column : column + 2 * n + 1]
        around = np.einsum('kij,i,j', square, weight, weight) * unit
        zone = naive.incidence_limit(around[:ZONES], around[ZONES:])
        length = math.cos(MODEL.max_incidence_angle) / math.cos(ANGLES[zone])
        assert made.x[c] == pytest.approx(normals.x[c] * length, abs=1e-6)
        assert made.y[c] == pytest.approx(normals.y[c] * length, abs=1e-6)
        seen.add(zone)
    assert seen == set(range(ZONES))
    # for a part of the map they are the same as in the whole
    bottom, top, left, right = (20, 32, 10, 30) if grid is GRID else (40, 64, 20, 60)
    again = narrowed(unit_normals(readings, grid), counts, slots, edges_of(MODEL), grid, (bottom, top, left, right))
    inside = (slice(bottom, top), slice(left, right))
    assert np.array_equal(again.x.reshape(grid.shape)[inside], made.x.reshape(grid.shape)[inside])
    again.x.reshape(grid.shape)[inside] = normals.x.reshape(grid.shape)[inside]
    assert np.array_equal(again.x, normals.x)


def test_smooth_wall_is_not_contradicted_by_readings_at_large_incidence() -> None:
    wall = np.zeros(GRID.shape, np.uint8)
    wall[ROW, 10:40] = 1

    def gained_by_freeing(readings: Readings, normals: SurfaceNormals) -> float:
        evidence = Evidence(GRID, MODEL, start=wall, normals=normals)
        evidence.extend(readings)
        return float(evidence.state.maps.evidence.reshape(GRID.shape)[ROW, 15:35].sum())

    smooth = before_wall(0.25, 0.95)
    counts, slots = counted(smooth, unit_normals(smooth))
    own = narrowed(unit_normals(smooth), counts, slots, edges_of(MODEL), GRID, WHOLE)
    assert gained_by_freeing(smooth, own) < gained_by_freeing(smooth, unit_normals(smooth))


def test_mirrored_drive_has_mirrored_incidence_angles() -> None:
    readings = before_wall(0.3, 0.8)
    mirrored = Readings.from_columns(
        readings.sensor_names,
        **{
            **{name: getattr(readings, name) for name in ('stamp', 'z', 'z_max', 'half_angle', 'sigma', 'y', 'sensor')},
            'x': -readings.x,
            'yaw': math.pi - readings.yaw,
        },
    )
    actual = limit_of(readings)
    differ = ~np.isclose(limit_of(mirrored)[:, ::-1], actual, atol=1e-4, equal_nan=True)
    # readings that meet a cell exactly on the edge of a zone or a cone may be rounded to either side
    assert differ.sum() <= 0.02 * np.isfinite(actual).sum()
