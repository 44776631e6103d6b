"""The table of sensors: broken sensors are named, and no others."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning.sensor_health import (
    BIN,
    BINS,
    LEAST_READINGS,
    LEAST_SHARE_OF_OTHERS,
    WINDOW,
    _commonest_ranges,
    commonest_range,
    first_obstacles,
    health_counts,
    health_of_counts,
    health_warning,
    sensor_health,
)
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.sensor.forward_model import ForwardModel
from forward_grid_mapper.simulation.drive import corridor_drive, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring
from forward_grid_mapper.simulation.world import rooms_world

WAY = np.array([[2.0, 2.0], [5.0, 2.0], [5.0, 3.4], [9.5, 3.4], [9.5, 6.0], [7.0, 6.0]])


def mapped(readings: Readings) -> MapSet:
    return Mapper(Parameters()).run(readings)


def rooms(front: bool = False) -> Readings:
    sonars = front_array() if front else sonar_ring()
    return drive(rooms_world(), WAY, 0.05 if front else 0.1, sonars, NOISY).readings


def broken(readings: Readings, random: int, dead: int, body: int) -> Readings:
    """The readings with one sensor with random ranges, one without echoes, and one that sees the robot."""
    rng = np.random.default_rng(1)
    z = readings.z.copy()
    z = np.where(readings.sensor == random, rng.uniform(0.1, readings.z_max), z)
    z = np.where(readings.sensor == dead, readings.z_max, z)
    z = np.where(readings.sensor == body, 0.18 + 0.01 * rng.standard_normal(len(z)), z)
    return dataclasses.replace(readings, z=z)


def suspects(readings: Readings) -> dict[str, str]:
    return {name: row.verdict for name, row in sensor_health(mapped(readings)).items() if row.suspect}


@pytest.mark.parametrize('numbers', [(3, 8, 15), (0, 6, 18), (20, 1, 12)])
def test_only_the_broken_sensors_of_a_ring_are_named(numbers: tuple[int, int, int]) -> None:
    random, dead, body = (f'sonar_{k:02d}' for k in numbers)
    table = sensor_health(mapped(broken(rooms(), *numbers)))
    assert {name: row.verdict for name, row in table.items() if row.verdict != 'ok'} == {
        random: 'mostly random',
        dead: 'never hears anything',
        body: 'always short',
    }
    assert table[dead].no_echo == 1 and table[body].short > 0.9 and table[random].random > 0.5
    assert table[body].common == pytest.approx(0.18, abs=0.01)
    warning = health_warning(table)
    assert all(name in warning for name in (random, dead, body)) and warning.count('sonar_') == 3
    assert '0.18 m' in warning and 'drift' not in warning
    # one sensor with a wrong pose is no sign of drift, several may be
    both = {name: dataclasses.replace(table[random], verdict='often random') for name in (random, dead)}
    assert 'does odometry drift (refine_poses)?' in health_warning(both)


@pytest.mark.parametrize('numbers', [(1, 5, 0), (7, 0, 4)])
def test_sensor_that_sees_the_robot_is_found_by_comparison(numbers: tuple[int, int, int]) -> None:
    found = suspects(broken(rooms(front=True), *numbers))
    assert list(found) == sorted(f'sonar_{k:02d}' for k in numbers)
    assert found[f'sonar_{numbers[2]:02d}'] == 'always short'


def test_sensor_that_sees_the_robot_now_and_then_is_found() -> None:
    """Its other readings are right, so less than `SAME` of all are alike; but its short ones are."""
    whole = rooms(front=True)
    always = broken(whole, -1, -1, 4)
    now_and_then = np.random.default_rng(2).random(len(whole)) < 0.65
    readings = dataclasses.replace(whole, z=np.where(now_and_then, always.z, whole.z))
    maps = mapped(readings)
    table = sensor_health(maps)
    assert {name: row.verdict_text for name, row in table.items() if row.suspect} == {
        'sonar_04': 'always short: 0.18 m'
    }
    assert table['sonar_04'].same < 0.8 < table['sonar_04'].alike
    counts = health_counts(maps.readings, maps.forward_model(), maps.ml, maps.unexplained)
    assert health_of_counts(readings.sensor_names, counts)['sonar_04'].verdict == 'always short'


@pytest.mark.parametrize(('front', 'sensor', 'verdict'), [(False, 5, 'often random'), (True, 3, 'mostly random')])
def test_sensor_with_a_wrong_pose_is_named(front: bool, sensor: int, verdict: str) -> None:
    """The walls along which the robot drives still explain about half of its readings."""
    readings = rooms(front)
    turned = readings.yaw + np.where(readings.sensor == sensor, math.radians(20.0), 0.0)
    found = suspects(dataclasses.replace(readings, yaw=turned))
    assert found == {readings.sensor_names[sensor]: verdict}


def test_correct_sensors_are_ok() -> None:
    table = sensor_health(mapped(rooms()))
    assert {row.verdict for row in table.values()} == {'ok'}
    assert health_warning(table) == ''
    assert all(row.random < 0.2 for row in table.values())


@pytest.mark.parametrize('broken_too', [False, True])
def test_something_beside_a_parked_robot_is_no_fault(broken_too: bool) -> None:
    """It stands where the robot drove before, so no map can explain its echoes; the robot is parked for hours."""
    readings = rooms()
    last = readings.select(np.flatnonzero(readings.stamp > readings.stamp.max() - 50_000_000))
    behind = last.sensor_names.index('sonar_12')
    seen = dataclasses.replace(last, z=np.where(last.sensor == behind, 0.3, last.z))
    parked = [dataclasses.replace(seen, stamp=seen.stamp + k * 10**8) for k in range(1, 2000)]
    columns = (field.name for field in dataclasses.fields(Readings) if field.name != 'sensor_names')
    all_of = {name: np.concatenate([getattr(r, name) for r in (readings, *parked)]) for name in columns}
    whole = dataclasses.replace(readings, **all_of)
    if broken_too:
        whole = dataclasses.replace(whole, z=np.where(whole.sensor == 4, 0.18, whole.z))
    maps = mapped(whole)
    counts = health_counts(maps.readings, maps.forward_model(), maps.ml, maps.unexplained)
    of_counts = health_of_counts(whole.sensor_names, counts)
    table = sensor_health(maps)
    assert table['sonar_12'].short > 0.9 and of_counts['sonar_12'].short > 0.9
    assert not any(row.suspect for name, row in of_counts.items() if name != 'sonar_04')
    assert [name for name, row in table.items() if row.suspect] == (['sonar_04'] if broken_too else [])


def test_places_do_not_depend_on_whole_turns_of_the_yaw() -> None:
    maps = mapped(rooms())
    turns = np.random.default_rng(0).integers(-3, 4, len(maps.readings))
    turned = dataclasses.replace(maps.readings, yaw=maps.readings.yaw + 2 * math.pi * turns)
    one, other = (health_counts(r, maps.forward_model(), maps.ml, maps.unexplained) for r in (maps.readings, turned))
    # the yaw of a few readings is rounded to the other side of a border
    np.testing.assert_allclose(other['places'], one['places'], atol=2)


@pytest.mark.parametrize('heading', [0.0, 0.2, 0.4, 2.0])
def test_sensors_beside_smooth_walls_are_not_short(heading: float) -> None:
    """They hear the walls of a corridor at one range all the time; those that look ahead never do."""
    yaw = np.radians([-90.0, -25.0, 25.0, 90.0])
    along, sensor = (v.ravel() for v in np.meshgrid(np.arange(0.0, 20.0, 0.1), np.arange(4), indexing='ij'))
    readings = Readings.from_columns(
        names=('right', 'front_right', 'front_left', 'left'),
        x=along * math.cos(heading),
        y=along * math.sin(heading),
        yaw=heading + yaw[sensor],
        # the far end of the corridor comes near at last
        z=np.where(np.abs(yaw[sensor]) > 1.0, 0.86, np.where(along > 18.0, 22.0 - along, 4.0)),
        z_max=np.full(len(along), 4.0),
        half_angle=np.full(len(along), 0.17),
        sensor=sensor,
    )
    table = sensor_health(mapped(readings))
    assert {row.verdict for row in table.values()} == {'ok'}
    assert table['left'].same == table['right'].same == 1.0


def test_smooth_walls_and_a_follower_give_no_warning() -> None:
    table = sensor_health(mapped(corridor_drive(0).readings))
    assert health_warning(table) == ''
    # sensors at the back of the robot
    assert 'something moves near it' in {table[f'sonar_{k:02d}'].verdict for k in (11, 12, 13)}


@pytest.mark.parametrize(
    ('silent', 'random', 'verdict'),
    [(970, 5, 'ok'), (970, 25, 'never hears anything'), (1000, 0, 'never hears anything')],
)
def test_sensor_with_few_echoes_is_ok_if_the_map_explains_them(silent: int, random: int, verdict: str) -> None:
    """A robot may pause for hours where one of its sensors gets no echo of the wall in front of it."""
    ranges = np.zeros((3, 400), np.int64)
    ranges[:, 10], ranges[:, 30] = 1, [1000 - silent, 900, 900]
    counts = {
        'readings': np.full(3, 1000),
        'no_echo': np.array([silent, 100, 100]),
        'missed': np.array([800, 0, 0]),
        'random': np.array([random, 20, 20]),
        'short': np.zeros(3, np.int64),
        'places': np.full(3, 10),
        'places_random': np.full(3, 2),
        'places_short': np.zeros(3, np.int64),
        'ranges': ranges,
        'short_ranges': np.zeros_like(ranges),
    }
    table = health_of_counts(('left', 'front', 'right'), counts)
    assert [row.verdict for row in table.values()] == [verdict, 'ok', 'ok']


def test_sensor_with_few_readings_has_no_verdict() -> None:
    readings = broken(rooms(), 3, 8, 15)
    rare = readings.select((readings.sensor != 8) | (np.arange(len(readings)) < 300))
    table = sensor_health(mapped(rare))
    assert table['sonar_08'].verdict == 'few readings' and not table['sonar_08'].suspect


def test_sensors_without_readings_and_a_single_sensor() -> None:
    readings = rooms().select(rooms().sensor == 5)
    table = sensor_health(mapped(readings))
    assert table['sonar_04'].verdict == 'few readings' and math.isnan(table['sonar_04'].random)
    assert str(table['sonar_04']) == 'no readings: few readings'
    assert table['sonar_05'].verdict == 'ok'
    alone = dataclasses.replace(readings, sensor=np.zeros(len(readings), np.int32), sensor_names=('only',))
    table = sensor_health(mapped(alone))
    assert table['only'].verdict == 'ok'
    # without others, it cannot differ from them
    warning = health_warning({'only': dataclasses.replace(table['only'], verdict='mostly random')})
    assert 'the only sensor' in warning and 'only (mostly random)' in warning and 'others' not in warning


def test_distance_of_first_obstacles() -> None:
    grid = Grid(0.1, -5, -10, 60, 20)
    ml = np.full(grid.shape, -1, np.int8)
    rows, columns = grid.cells_of(np.array([2.05]), np.array([0.05]))
    ml[rows, columns] = 1
    readings = Readings.from_columns(
        ('a',), x=[0.0, 0.0, 0.0, 9.0], y=0.05, yaw=[0.0, 0.2, 1.0, 0.0], z=[3.0] * 4, z_max=[3.0, 3.0, 3.0, 3.0],
        half_angle=0.25,
    )  # fmt: skip
    model = Parameters().model
    found = first_obstacles(ForwardModel(readings, grid, model), ml)
    assert found[:2] == pytest.approx(2.0, abs=0.1)
    assert np.isinf(found[2:]).all()
    nearer = dataclasses.replace(readings, z=np.full(4, 1.5), z_max=np.full(4, 1.5))
    assert np.isinf(first_obstacles(ForwardModel(nearer, grid, model), ml)).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 1.5))
def test_posts_of_one_cell_are_found(seed: int, half_angle: float) -> None:
    rng = np.random.default_rng(seed)
    grid = Grid(0.1, -30, -20, 60, 50)
    ml = np.zeros(grid.shape, np.int8)
    x, y, yaw = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-4, 4)
    away, side = rng.uniform(0.3, 1.9), rng.uniform(-0.99, 0.99) * half_angle
    # the cell that contains a point of the cone, if its centre is in the cone as well
    rows, columns = grid.cells_of(np.array([x + away * np.cos(yaw + side)]), np.array([y + away * np.sin(yaw + side)]))
    ml[rows, columns] = 1
    readings = Readings.from_columns(x=x, y=y, yaw=yaw, z=2.5, z_max=2.5, half_angle=half_angle)
    model = Parameters().model
    (found,) = first_obstacles(ForwardModel(readings, grid, model), ml)
    distances = naive.cells_of(dataclasses.replace(readings, z=readings.z_max), 0, grid, model)
    assert found == pytest.approx(distances.get(int(rows[0] * grid.width + columns[0]), np.inf), abs=1e-9)
    xs, ys = grid.centers()
    u, v = xs[columns[0]] - x, ys[rows[0]] - y
    if abs(math.remainder(math.atan2(v, u) - yaw, 2 * math.pi)) < half_angle:
        assert np.isfinite(found)


def test_ray_with_the_largest_float_as_range_ends() -> None:
    grid = Grid(0.1, -5, -10, 60, 20)
    ml = np.zeros(grid.shape, np.int8)
    rows, columns = grid.cells_of(np.array([5.45, 0.55]), np.array([0.05, -0.95]))
    ml[rows[0], columns[0]] = 1
    without_end = float(np.finfo(np.float32).max)
    readings = Readings.from_columns(
        x=[0.0, 0.0, 50.0, -1e6], y=0.05, yaw=[0.0, 2.0, math.pi, 0.0], z=[1.0] * 4, z_max=without_end, half_angle=0.2
    )
    found = first_obstacles(ForwardModel(readings, grid, Parameters().model), ml)
    assert found[0] == pytest.approx(5.45 - 0.03, abs=1e-6)
    assert np.isinf(found[1])
    assert found[2] == pytest.approx(50 - 5.45 - 0.03, abs=1e-6)
    assert found[3] == pytest.approx(1e6 + 5.45 - 0.03, abs=1e-3)


def test_most_frequent_range() -> None:
    count, middle = commonest_range(np.array([1.0, 3.05, 3.0, 3.1, 5.0]))
    assert (count, middle) == (3, pytest.approx(3.05))
    assert commonest_range(np.empty(0))[0] == 0


@given(st.lists(st.floats(0.0, 8.0), min_size=1, max_size=30))
def test_most_frequent_range_from_counts_is_near_that_of_the_ranges(ranges: list[float]) -> None:
    """Bins lose the position within 5 cm: the count may be smaller, but the middle is that of a window with it."""
    z = np.array(ranges)
    row = np.bincount(np.minimum(z / BIN, BINS - 1).astype(np.int64), minlength=BINS)
    ((count, middle),) = _commonest_ranges(row[None])
    assert 1 <= count <= commonest_range(z)[0]
    assert count == np.count_nonzero(np.abs((np.floor(z / BIN) + 0.5) * BIN - middle) < WINDOW / 2)


def test_sensor_with_far_fewer_readings_than_the_others_has_no_verdict() -> None:
    readings = rooms()
    mine = np.flatnonzero(readings.sensor == 8)
    usual = np.count_nonzero(readings.sensor == 9)
    others = np.flatnonzero(readings.sensor != 8)
    rare = readings.select(np.concatenate([np.repeat(others, 3), mine[: LEAST_READINGS + 1]]))
    assert LEAST_READINGS < np.count_nonzero(rare.sensor == 8) < LEAST_SHARE_OF_OTHERS * 3 * usual
    assert sensor_health(mapped(rare))['sonar_08'].verdict == 'few readings'


def test_sensor_with_a_wrong_pose_is_named_if_most_readings_have_no_echo() -> None:
    readings = rooms(front=True)
    silent = np.random.default_rng(3).random(len(readings)) < 0.7
    readings = dataclasses.replace(readings, z=np.where(silent, readings.z_max, readings.z))
    assert suspects(readings) == {}
    turned = readings.yaw + np.where(readings.sensor == 3, math.radians(90.0), 0.0)
    maps = mapped(dataclasses.replace(readings, yaw=turned))
    table = sensor_health(maps)
    assert {name: row.verdict for name, row in table.items() if row.suspect} == {'sonar_03': 'often random'}
    assert table['sonar_03'].random < 0.3
    counts = health_counts(maps.readings, maps.forward_model(), maps.ml, maps.unexplained)
    assert health_of_counts(readings.sensor_names, counts)['sonar_03'].verdict == 'often random'
