"""A simulated campus: true map, paths that meet no wall, and drives that depend only on their number and the seed."""

from __future__ import annotations

import numpy as np
import pytest

from forward_grid_mapper.simulation.campus import START_INTERVAL, campus_drive, campus_path, campus_world, corner
from forward_grid_mapper.simulation.rays import blocked
from forward_grid_mapper.simulation.sonar import front_array
from forward_grid_mapper.simulation.world import building_world, cells_along


@pytest.mark.parametrize('buildings', [1, 2, 5])
def test_true_map_contains_each_building(buildings: int) -> None:
    world, one = campus_world(buildings), building_world(entrance=True)
    drawn = np.zeros(world.grid.shape, bool)
    for segment in world.segments:
        drawn[cells_along(segment, world.grid)] = True
    np.testing.assert_array_equal(drawn, world.reference == 1)
    assert (world.reference == 1).sum() == buildings * (one.reference == 1).sum()
    assert (world.reference == -1).sum() == buildings * (one.reference == -1).sum() > 0
    assert len(world.doors) == buildings * len(one.doors)
    corners = [corner(number, buildings) for number in range(buildings)]
    assert len(set(corners)) == buildings
    apart = np.abs(np.diff(np.array(corners), axis=0))
    assert all(step.tolist() in ([60.0, 0.0], [0.0, 42.0]) for step in apart), 'successive buildings are neighbours'


@pytest.mark.parametrize('first', [0, 2, 4])
def test_paths_lead_through_buildings_and_meet_no_wall(first: int) -> None:
    world = campus_world(5)
    path = campus_path(3000.0, first, 5, np.random.default_rng(first))
    steps = np.hypot(*np.diff(path, axis=0).T)
    assert steps.sum() == pytest.approx(3000.0) and steps.min() > 0
    assert not blocked(path, world.segments)
    corners = [np.array(corner(number, 5)) for number in range(5)]
    inside = [((path >= c) & (path <= c + np.array([42.0, 18.0]))).all(axis=1).any() for c in corners]
    assert sum(inside) >= 3 and inside[first]
    rows, columns = world.grid.cells_of(*path.T)
    assert (world.reference[rows, columns] == 0).all()


def test_drive_depends_only_on_its_number_and_the_seed() -> None:
    def made(number: int, seed: int = 0):
        return campus_drive(number, 2, 400, seed=seed, sonars=front_array())

    one, again, other, seeded = made(3), made(3), made(1), made(3, 1)
    assert one.ranges == again.ranges and one.odometry == again.odometry
    assert len(one.readings) == 400
    assert other.ranges[0].stamp == one.ranges[0].stamp - 2 * START_INTERVAL
    for different in (other, seeded):
        assert [m.range for m in different.ranges] != [m.range for m in one.ranges]
    np.testing.assert_allclose(one.robot[0, :2], other.robot[0, :2], atol=0.2)
