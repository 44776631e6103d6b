"""Simulated worlds: layout, reference maps, and no bias of half a cell."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from forward_grid_mapper.simulation.world import (
    WORLDS,
    Floorplan,
    building_tour,
    building_world,
    cells_along,
    corridor_world,
    door_world,
)


@pytest.mark.parametrize('name', WORLDS)
def test_reference_map_is_consistent_with_the_walls(name):
    world = WORLDS[name]()
    assert world.name == name
    assert world.reference.shape == world.grid.shape == world.smooth_cells.shape
    assert set(np.unique(world.reference)) == {-1, 0, 1}
    assert len(world.smooth) == len(world.segments)
    drawn = np.zeros(world.grid.shape, bool)
    for segment in world.segments:
        drawn[cells_along(segment, world.grid)] = True
    assert np.array_equal(drawn, world.reference == 1)
    assert not np.any(world.smooth_cells & ~drawn)
    # free space is closed: it touches neither unknown space nor the border
    free = np.pad(world.reference, 1, constant_values=-1)
    for axis in (0, 1):
        for step in (-1, 1):
            assert not np.any((free == 0) & (np.roll(free, step, axis) == -1))


def test_sizes_and_doors_of_the_worlds_of_the_paper():
    door, corridor = door_world(), corridor_world()
    assert (door.grid.width, door.grid.height) == (122, 107)
    assert [d.width for d in door.doors] == [0.6]
    assert (corridor.grid.width, corridor.grid.height) == (641, 131)
    assert len(corridor.doors) == 6
    assert {d.width for d in corridor.doors} == {0.8, 0.9}
    assert corridor.smooth_cells.sum() == 180
    assert not door.smooth_cells.any()


@pytest.mark.parametrize('name', WORLDS)
def test_doors_are_as_wide_as_their_free_cells_and_walls(name):
    world = WORLDS[name]()
    for door in world.doors:
        center = np.array([door.x, door.y])
        along = np.array([1.0, 0.0] if door.axis == 'x' else [0.0, 1.0])
        for at, value in ((0.0, 0), (door.width / 2 - 0.05, 0), (door.width / 2 + 0.05, 1)):
            for side in (-1, 1):
                x, y = center + side * at * along
                row, column = world.grid.cells_of(x, y)
                assert world.reference[row, column] == value
        ends = world.segments.reshape(-1, 2)
        distance = np.sort(np.hypot(*(ends - center).T))
        assert distance[:2] == pytest.approx(door.width / 2)


@pytest.mark.parametrize('name', WORLDS)
def test_walls_run_along_cell_centres(name):
    world = WORLDS[name]()
    x0, y0, x1, y1 = (world.segments / world.grid.resolution).T
    for low, high in ((x0, x1), (y0, y1)):
        across = low[np.isclose(low, high)]
        assert across - np.floor(across) == pytest.approx(0.5)


def test_space_behind_an_oblique_wall_is_unknown():
    world = WORLDS['rooms']()
    assert world.reference[70, 9] == -1
    assert world.reference[63, 16] == 1


def test_building_is_40_by_16_metres_and_its_tour_enters_every_room():
    world, tour = building_world(), building_tour()
    walls = world.segments.reshape(-1, 2)
    assert walls.max(axis=0) - walls.min(axis=0) == pytest.approx([40.0, 16.0])
    assert {door.width for door in world.doors} == {0.7, 0.8, 0.9}
    for door in world.doors:
        along, across = (0, 1) if door.axis == 'x' else (1, 0)
        at, side = np.array([door.x, door.y])[[along, across]]
        legs = np.stack([tour[:-1], tour[1:]], axis=1)
        through = (legs[..., across].min(axis=1) < side) & (legs[..., across].max(axis=1) > side)
        assert (np.abs(legs[..., along] - at).max(axis=1)[through] < 0.11).sum() == 2
    # sonars 0.25 m from the centre of the robot pass everything even if the robot is 5 cm off
    x, y = world.grid.centers()
    rows, columns = np.nonzero(world.reference == 1)
    for start, end in itertools.pairwise(tour):
        points = start + np.linspace(0, 1, 50)[:, None] * (end - start)
        apart = np.hypot(points[:, :1] - x[columns], points[:, 1:] - y[rows])
        assert apart.min() > 0.3


def test_cells_along_a_segment_keep_their_order():
    grid = WORLDS['rooms']().grid
    rows, columns = cells_along(np.array([0.55, 0.25, 0.15, 0.25]), grid)
    assert rows.tolist() == [2] * 5
    assert columns.tolist() == [5, 4, 3, 2, 1]


def test_smooth_part_and_door_split_a_wall():
    plan = Floorplan('plan', 20, 10)
    plan.box((0, 0), (19, 9))
    plan.wall('x', 5, (0, 19), doors=((3, 5),), smooth=(10, 14))
    world = plan.world(inside=(1, 1))
    assert world.segments[4:, 0] == pytest.approx([0.05, 0.6, 1.0, 1.5])
    assert world.segments[4:, 2] == pytest.approx([0.3, 1.0, 1.5, 1.95])
    assert world.smooth.tolist() == [False] * 5 + [False, True, False]
    assert world.smooth_cells.sum() == 5
