"""Changes between drives: a door that is closed in one drive gives a warning, and other differences do not."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from forward_grid_mapper.core import drive_changes
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings, of_drives
from forward_grid_mapper.core.drive_changes import change_warnings, changes
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.simulation.drive import corridor_drive, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring
from forward_grid_mapper.simulation.world import World, rooms_world

DOOR = (5.85, 3.45)
THROUGH = ((1.5, 1.5), (3.0, 3.45), (9.0, 3.45))
UP_TO = ((1.5, 1.5), (3.0, 3.45), (5.0, 3.45), (4.0, 3.45), (5.1, 3.45))


def with_closed_door(world: World) -> World:
    """The rooms with their door closed."""
    leaf = np.array([[5.85, 2.9, 5.85, 4.0]])
    return dataclasses.replace(
        world, segments=np.concatenate([world.segments, leaf]), smooth=np.append(world.smooth, False)
    )


@cache
def driven(open_door: bool, path: tuple[tuple[float, float], ...], seed: int, ring: bool = False) -> Readings:
    world = rooms_world() if open_door else with_closed_door(rooms_world())
    sonars = sonar_ring() if ring else front_array()
    return drive(world, np.array(path), 0.1, sonars, NOISY, seed=seed).readings


@pytest.mark.parametrize('order', [1, -1])
def test_door_closed_in_one_drive_gives_a_warning(order: int) -> None:
    drives = [driven(True, THROUGH, 0, True), driven(False, UP_TO, 1, True)][::order]
    maps = Mapper(Parameters()).run(of_drives(drives))
    found = changes(maps, 2)
    assert found
    for change in found:
        assert change.drive == (1 if order == 1 else 0)
        assert abs(change.x - DOOR[0]) < 0.5 and abs(change.y - DOOR[1]) < 0.8
    (warning, *_) = change_warnings(maps, ['monday', 'tuesday'])
    assert warning.startswith('there was an obstacle at x = 5.') and 'The map is free there' in warning


@pytest.mark.parametrize('ring', [False, True])
def test_drives_through_the_same_rooms_have_no_changes(ring: bool) -> None:
    for seed in range(4):
        ways = (THROUGH, THROUGH[::-1], UP_TO)
        drives = [driven(True, way, 10 * seed + k, ring) for k, way in enumerate(ways)]
        assert changes(Mapper(Parameters()).run(of_drives(drives)), 3) == []


def test_person_behind_the_robot_is_no_change() -> None:
    """Two drives with smooth walls, lost echoes and a person, each with other noise."""
    maps = Mapper(Parameters()).run(of_drives([corridor_drive(seed).readings for seed in range(2)]))
    assert changes(maps, 2) == []


def test_single_drive_has_no_changes() -> None:
    maps = Mapper(Parameters()).run(driven(True, THROUGH, 0))
    assert change_warnings(maps, ['monday']) == [] == changes(maps, 1)


def test_each_place_of_a_long_drive_looks_only_at_its_surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two drives through a large hall with many random echoes, and a box in it during the second one."""
    rng, count, size = np.random.default_rng(5), 20_000, 40.0
    x, y = rng.uniform(0.0, size, (2, count))
    yaw, z = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.3, 3.0, count)
    box = np.arange(count) < 40
    x[box], y[box], yaw[box], z[box] = rng.uniform(18.0, 19.0, 40), 20.0, 0.0, 5.0
    z[:20] = 20.3 - x[:20]
    drive = np.where(np.arange(count) < 20, 1, np.arange(count) % 2 * ~box).astype(np.int32)
    readings = Readings.from_columns(
        ('sonar',), x=x, y=y, yaw=yaw, z=z, z_max=6.0, half_angle=0.13, stamp=np.arange(count), drive=drive
    )
    grid = Grid(0.1, 0, 0, 400, 400)
    free, none = np.zeros(grid.shape, np.int8), np.zeros(grid.shape, np.float32)
    random = np.arange(count) % 2 == 0
    random[box] = drive[box] == 1
    maps = MapSet(grid, none, free, none, readings, random, 0.0, 0.0, Parameters())
    sizes: list[int] = []
    densest = drive_changes._densest

    def counting(points: np.ndarray, place: np.ndarray) -> np.ndarray:
        sizes.append(len(points))
        return densest(points, place)

    monkeypatch.setattr(drive_changes, '_densest', counting)
    (found,) = changes(maps, 2)
    assert found.drive == 1
    assert min(found.echoes, found.passed) >= 20
    assert abs(found.x - 20.3) < 0.3 and abs(found.y - 20.0) < 0.3
    assert len(sizes) > 500, 'places'
    assert max(sizes) < 500, 'of ten thousand points'
