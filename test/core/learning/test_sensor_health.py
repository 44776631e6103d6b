"""The table of sensors names those that are broken, and no others."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.learning.sensor_health import (
    commonest_range,
    first_obstacles,
    health_warning,
    sensor_health,
)
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
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
    """The same with one sensor that makes up its ranges, one that hears nothing, and one that hears the robot."""
    rng = np.random.default_rng(1)
    z = readings.z.copy()
    z = np.where(readings.sensor == random, rng.uniform(0.1, readings.z_max), z)
    z = np.where(readings.sensor == dead, readings.z_max, z)
    z = np.where(readings.sensor == body, 0.18 + 0.01 * rng.standard_normal(len(z)), z)
    return dataclasses.replace(readings, z=z)


def suspects(readings: Readings) -> dict[str, str]:
    return {name: row.verdict for name, row in sensor_health(mapped(readings)).items() if row.suspect}


@pytest.mark.parametrize('numbers', [(3, 8, 15), (0, 6, 18), (20, 1, 12)])
def test_exactly_the_broken_sensors_of_a_ring_are_named(numbers: tuple[int, int, int]) -> None:
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
    assert '0.18 m' in warning


@pytest.mark.parametrize('numbers', [(1, 5, 0), (7, 0, 4)])
def test_a_body_that_the_map_believes_is_found_by_the_others(numbers: tuple[int, int, int]) -> None:
    found = suspects(broken(rooms(front=True), *numbers))
    assert list(found) == sorted(f'sonar_{k:02d}' for k in numbers)
    assert found[f'sonar_{numbers[2]:02d}'] == 'always short'


def test_sound_sensors_are_ok() -> None:
    table = sensor_health(mapped(rooms()))
    assert {row.verdict for row in table.values()} == {'ok'}
    assert health_warning(table) == ''
    assert all(row.random < 0.2 for row in table.values())


def test_neither_smooth_walls_nor_a_follower_are_a_sensors_fault() -> None:
    table = sensor_health(mapped(corridor_drive(0).readings))
    assert health_warning(table) == ''
    # behind the robot
    assert 'something moves near it' in {table[f'sonar_{k:02d}'].verdict for k in (11, 12, 13)}


def test_few_readings_are_not_judged() -> None:
    readings = broken(rooms(), 3, 8, 15)
    rare = readings.select((readings.sensor != 8) | (np.arange(len(readings)) < 300))
    table = sensor_health(mapped(rare))
    assert table['sonar_08'].verdict == 'few readings' and not table['sonar_08'].suspect


def test_names_without_readings_and_sensors_alone() -> None:
    readings = rooms().select(rooms().sensor == 5)
    table = sensor_health(mapped(readings))
    assert table['sonar_04'].verdict == 'few readings' and math.isnan(table['sonar_04'].random)
    assert str(table['sonar_04']) == 'no readings: few readings'
    assert table['sonar_05'].verdict == 'ok'
    alone = dataclasses.replace(readings, sensor=np.zeros(len(readings), np.int32), sensor_names=('only',))
    assert sensor_health(mapped(alone))['only'].verdict == 'ok'


def test_first_obstacles() -> None:
    grid = Grid(0.1, -5, -10, 60, 20)
    ml = np.full(grid.shape, -1, np.int8)
    rows, columns = grid.cells_of(np.array([2.05]), np.array([0.05]))
    ml[rows, columns] = 1
    readings = Readings.from_columns(
        ('a',), x=[0.0, 0.0, 0.0, 9.0], y=0.05, yaw=[0.0, 0.2, 1.0, 0.0], z=[3.0] * 4, z_max=[3.0, 3.0, 3.0, 3.0],
        half_angle=0.25,
    )  # fmt: skip
    found = first_obstacles(readings, grid, ml)
    assert found[:2] == pytest.approx(2.0, abs=0.1)
    assert np.isinf(found[2:]).all()
    assert np.isinf(first_obstacles(dataclasses.replace(readings, z_max=np.full(4, 1.5)), grid, ml)).all()


def test_commonest_range() -> None:
    count, middle = commonest_range(np.array([1.0, 3.05, 3.0, 3.1, 5.0]))
    assert (count, middle) == (3, pytest.approx(3.05))
    assert commonest_range(np.empty(0))[0] == 0
