"""The standard map, compared with its twin in plain Python, and properties that the node relies on."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.constants import ARC
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.grid import Grid, cone_boxes
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.maps.log_odds_kernel import direction_of_yaw
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap, map_grid
from forward_grid_mapper.core.sensor.cone_table import effective_sigma, reach_of
from samples import random_readings

AREA = Grid(0.1, -10, 5, 20, 16)


def logit(p: float) -> float:
    return math.log(p / (1 - p))


PAPER = {'live_directions': 1, 'live_echo_width': 1000.0}


@pytest.mark.parametrize('arc', [(0.05, 0.05), (0.12, 0.3), (1.0, 0.2)])
@pytest.mark.parametrize('directions', [1, 2, 3, 4, 7])
@pytest.mark.parametrize('width', [0.1, 1000.0])
def test_log_odds_are_those_of_the_twin(arc: tuple[float, float], directions: int, width: float) -> None:
    readings = random_readings(np.random.default_rng(directions), AREA, 40)
    parameters = Parameters().varied({'live_directions': directions, 'live_echo_width': width})
    live = LogOddsMap(parameters, arc)
    live.add(readings)
    p = parameters.live
    logits = logit(p.live_p_occupied), logit(p.live_p_free), logit(p.live_p_free_no_echo)
    expected = naive.live_log_odds(readings, live.grid, arc, logits, width, directions)
    assert live.log_odds() == pytest.approx(expected, abs=1e-4, nan_ok=True)


@pytest.mark.parametrize('half_angle', [1e-6, 0.02, 0.13, 0.6, 1.3, 1.55])
@pytest.mark.parametrize('degrees', [0, 1e-9, 30, 45, 90, 135, 180, 200, 270, 359])
def test_cone_along_the_lattice_has_the_cells_of_the_twin(half_angle: float, degrees: float) -> None:
    live = LogOddsMap(Parameters())
    for x, y in ((0.05, 0.05), (0.031, 0.072)):
        live.clear()
        live.add(Readings.from_columns(x=x, y=y, yaw=math.radians(degrees), z=[1.43], z_max=2.0, half_angle=half_angle))
        pose = (x, y, math.radians(degrees))
        # cells on an edge may be inside or outside, by rounding
        most = set(naive.cone_cells(pose, half_angle, 1.43 + ARC[1], live.grid, 1e-6))
        least = set(naive.cone_cells(pose, half_angle - 1e-9, 1.43 + ARC[1] - 1e-6, live.grid, -1e-6))
        known = set(np.flatnonzero(np.isfinite(live.log_odds())).tolist())
        assert least <= known <= most


def test_readings_at_large_incidence_do_not_remove_a_wall() -> None:
    # a wall along y, 1 m before the sensor
    def probability_of_wall(directions: int) -> float:
        live = LogOddsMap(Parameters().varied({'live_directions': directions}))
        beam = {'half_angle': 0.1, 'z_max': 5.0}
        live.add(Readings.from_columns(x=0.05, y=0.05, yaw=0.0, z=[1.0] * 3, **beam))
        live.add(Readings.from_columns(x=1.05, y=-0.95, yaw=math.pi / 2, z=[3.0] * 20, **beam))
        row, column = live.grid.cells_of(np.array(1.05), np.array(0.05))
        return float(live.probability()[row, column])

    assert probability_of_wall(1) < 0.01
    assert probability_of_wall(4) > 0.9


def test_cells_without_echo_are_the_same_for_any_number_of_directions() -> None:
    one, four = (LogOddsMap(Parameters().varied({'live_directions': n})) for n in (1, 4))
    yaw = np.linspace(0.0, 3.0, 9)
    readings = Readings.from_columns(x=0.05, y=0.05, yaw=yaw, z=np.full(9, 2.0), z_max=2.0, half_angle=0.6)
    for live in (one, four):
        live.add(readings)
    np.testing.assert_array_equal(one.log_odds(), four.log_odds())
    assert np.nanmax(one.log_odds()) <= 0.0


def test_longer_arc_gives_less_evidence_for_each_cell() -> None:
    def on_axis(z: float) -> float:
        live = LogOddsMap(Parameters())
        live.add(Readings.from_columns(x=0.05, y=0.05, yaw=0.0, z=[z], z_max=9.0, half_angle=0.25))
        row, column = live.grid.cells_of(np.array(0.05 + z), np.array(0.05))
        return float(live.log_odds()[row, column])

    whole = logit(Parameters().live.live_p_occupied)
    assert on_axis(0.4) == pytest.approx(whole, abs=1e-5)
    for z in (1.0, 2.0, 4.0):
        assert on_axis(z) == pytest.approx(whole * 0.2 / (2 * z * math.sin(0.25)), abs=1e-5)


def test_weight_decreases_with_the_sine_of_the_angle_to_the_axis() -> None:
    live = LogOddsMap(Parameters().varied({'live_p_free': 0.2}))
    live.add(Readings.from_columns(x=0.0, y=0.0, yaw=0.0, z=[4.0], z_max=5.0, half_angle=0.6))
    rows, columns = live.grid.cells_of(np.full(5, 3.05), np.array([0.05, 0.55, 1.05, 1.55, 2.05]))
    sines = np.sin(np.arctan2([0.05, 0.55, 1.05, 1.55, 2.05], 3.05))
    actual = live.log_odds()[rows, columns]
    assert actual == pytest.approx((1 - (sines / math.sin(0.6)) ** 2) * logit(0.2), abs=1e-6)
    assert actual[0] < actual[1] < actual[2] < actual[3] < actual[4] < 0


@pytest.mark.parametrize('half_angle', [1e-6, 0.005, 0.02])
def test_thin_cone_is_one_and_a_half_cells_wide(half_angle: float) -> None:
    live = LogOddsMap(Parameters().varied({'live_p_free': 0.2}))
    # the distance of the axis from the centres of its cells is up to half a cell
    readings = Readings.from_columns(x=0.05, y=0.05, yaw=0.1, z=[3.0], z_max=5.0, half_angle=half_angle)
    live.add(readings)
    xs, ys = live.grid.centers()
    for row, column in zip(*np.nonzero(np.isfinite(live.log_odds())), strict=True):
        dx, dy = xs[column] - 0.05, ys[row] - 0.05
        if math.hypot(dx, dy) < 2.9:
            off_axis = dy * math.cos(0.1) - dx * math.sin(0.1)
            weight = 1 - (off_axis / 0.075) ** 2
            assert live.log_odds()[row, column] == pytest.approx(weight * logit(0.2), abs=1e-6)


@pytest.mark.parametrize('some', [random_readings, naive.awkward_readings])
def test_map_does_not_depend_on_order_and_batches_of_readings(some: object) -> None:
    rng = np.random.default_rng(1)
    readings = some(rng, AREA, 200)
    whole = LogOddsMap(Parameters())
    whole.add(readings)
    parts = LogOddsMap(Parameters())
    for part in np.array_split(rng.permutation(len(readings)), 23):
        parts.add(readings.select(part))
    assert parts.grid == whole.grid
    assert np.array_equal(parts.log_odds(), whole.log_odds(), equal_nan=True)


def test_only_cells_of_cones_have_a_probability() -> None:
    readings = random_readings(np.random.default_rng(2), AREA, 1)
    live = LogOddsMap(Parameters())
    live.add(readings)
    known = np.isfinite(live.probability()).ravel()
    pose = (readings.x[0], readings.y[0], readings.yaw[0])
    cells = naive.cone_cells(pose, readings.half_angle[0], readings.z[0] + ARC[1], live.grid)
    assert set(np.flatnonzero(known).tolist()) == set(cells)


def test_map_on_a_larger_grid_has_the_same_values() -> None:
    readings = random_readings(np.random.default_rng(3), AREA, 30)
    live = LogOddsMap(Parameters())
    live.add(readings)
    wide = Grid(0.1, -300, -300, 600, 600)
    assert np.array_equal(live.log_odds(wide)[wide.window(live.grid)], live.log_odds(), equal_nan=True)
    assert np.isfinite(live.log_odds(wide)).sum() == np.isfinite(live.log_odds()).sum()


def test_map_above_max_cells_is_rejected_and_unchanged() -> None:
    live = LogOddsMap(Parameters().varied({'max_cells': 10_000}))
    near = random_readings(np.random.default_rng(4), AREA, 5, z_max=1.0)
    live.add(near)
    before = live.log_odds()
    far = near.select(slice(0, 1))
    far.x[:] = 1e6
    with pytest.raises(InputError, match='max_cells'):
        live.add(far)
    assert np.array_equal(live.log_odds(), before, equal_nan=True)


def test_growth_without_memory_leaves_the_map_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    live = LogOddsMap(Parameters())
    near = random_readings(np.random.default_rng(4), AREA, 5, z_max=1.0)
    live.add(near)
    before, grid = live.log_odds(), live.grid
    far = dataclasses.replace(near, x=near.x + 50.0)
    with monkeypatch.context() as patched, pytest.raises(MemoryError):
        patched.setattr(np, 'full', lambda *arguments: (_ for _ in ()).throw(MemoryError))
        live.add(far)
    assert live.grid == grid and np.array_equal(live.log_odds(), before, equal_nan=True)
    live.add(near)
    assert np.nanmax(np.abs(live.log_odds())) > np.nanmax(np.abs(before))


def test_cell_with_log_odds_near_zero_is_known() -> None:
    live = LogOddsMap(Parameters().varied({'live_p_occupied': 0.8, 'live_p_free': 0.2}))
    both = Readings.from_columns(x=0.05, y=0.05, yaw=0.0, z=[1.0, 2.0], z_max=4.0, half_angle=0.1)
    live.add(both)
    row, column = live.grid.cells_of(np.array(1.05), np.array(0.05))
    assert live.probability()[row, column] == pytest.approx(0.5, abs=0.02)


def test_thin_beam_updates_the_cells_that_it_crosses() -> None:
    live = LogOddsMap(Parameters())
    live.add(Readings.from_columns(x=0.05, y=0.02, yaw=0.0, z=[1.0] * 5, z_max=4.0, half_angle=0.005))
    row, column = live.grid.cells_of(np.array([0.55, 1.05]), np.array([0.05, 0.05]))
    free, occupied = live.probability()[row, column]
    assert free < 0.1
    assert occupied > 0.9


def test_deep_arc_does_not_depend_on_the_order() -> None:
    rng = np.random.default_rng(5)
    readings = random_readings(rng, AREA, 40)
    maps = []
    for order in (np.arange(40), np.arange(40)[::-1]):
        live = LogOddsMap(Parameters(), (3.0, 3.0))
        for k in order:
            live.add(readings.select(np.array([k])))
        maps.append(live.log_odds())
    assert np.array_equal(*maps, equal_nan=True)


def test_map_without_readings_has_no_cells() -> None:
    live = LogOddsMap(Parameters())
    live.add(random_readings(np.random.default_rng(0), AREA, 0))
    assert live.probability().shape == (0, 0)


@pytest.mark.parametrize('seed', range(20))
def test_map_does_not_depend_on_when_the_grid_grew(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # A drive away from the origin, so that the grid grows to the left as well. On edges and centres of cells, small
    # errors decide which cells the axis crosses.
    count = 300
    readings = dataclasses.replace(
        random_readings(rng, Grid(0.1, -300, -300, 600, 600), count, z_max=3.0),
        half_angle=np.full(count, 0.2),
        x=np.round(20 * (np.linspace(0.0, -25.0, count) + rng.uniform(-1, 1, count))) / 20,
        y=np.round(20 * (np.linspace(0.0, 21.0, count) + rng.uniform(-1, 1, count))) / 20,
        yaw=rng.integers(0, 8, count) * math.pi / 4,
    )
    whole = LogOddsMap(Parameters())
    whole.add(readings)
    cuts = np.sort(rng.choice(count, 12, replace=False))
    parts = LogOddsMap(Parameters())
    for which in np.split(np.arange(count), cuts):
        parts.add(readings.select(which))
    assert parts.grid == whole.grid
    np.testing.assert_array_equal(parts.log_odds(), whole.log_odds())


def test_sum_of_maps_is_the_map_of_all_their_readings() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        readings = random_readings(rng, AREA, 30)
        cut = int(rng.integers(0, 31))
        whole, part, rest = (LogOddsMap(Parameters()) for _ in range(3))
        whole.add(readings)
        part.add(readings.select(slice(0, cut)))
        rest.add(readings.select(slice(cut, 30)))
        part.add_map(rest)
        np.testing.assert_array_equal(part.log_odds(whole.grid), whole.log_odds())


@pytest.mark.parametrize('count', [1, 2, 16, 17, 500])
def test_grid_of_the_map_covers_the_boxes_of_all_cones(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(10):
        readings = random_readings(rng, Grid(0.1, -100, -50, 200, 100), count)
        p = Parameters()
        reach = np.maximum(reach_of(readings, effective_sigma(readings, p.model, 0.1)) + 0.03, readings.z + ARC[1])
        b = cone_boxes(readings.x, readings.y, readings.yaw, readings.half_angle, reach)
        assert map_grid(readings, p) == Grid.covering((b[0].min(), b[1].max(), b[2].min(), b[3].max()), 0.1)


@pytest.mark.parametrize('directions', [1, 2, 4, 5])
def test_opposite_yaws_are_the_same_direction(directions: int) -> None:
    yaw = np.random.default_rng(0).uniform(-9.0, 9.0, 300)
    for angle in yaw:
        k = direction_of_yaw(angle, directions)
        assert direction_of_yaw(angle + math.pi, directions) == k
        assert abs(math.remainder(angle - k * math.pi / directions, math.pi)) <= math.pi / directions / 2 + 1e-9
