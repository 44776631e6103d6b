"""Simulated sonars: analytic distances, cones, noise, smooth walls, people, and mirrored worlds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.simulation.rays import NOTHING, blocked, cast, cast_discs
from forward_grid_mapper.simulation.sonar import (
    GHOST_SHARE,
    NOISE_FREE,
    NOISY,
    NoiseModel,
    SonarArray,
    front_array,
    measure,
    sonar_ring,
)
from forward_grid_mapper.simulation.world import WORLDS, Floorplan, World

ONE = SonarArray((0.0,), 0.0, math.radians(15.0), 6.0, 0.1)


def room(smooth: bool = False, size: int = 200) -> World:
    """Return a square room whose left and right walls are the rows and columns 0 and size - 1."""
    plan = Floorplan('room', size, size)
    plan.wall('x', size - 1, (0, size - 1), smooth=(0, size - 1) if smooth else None)
    plan.wall('x', 0, (0, size - 1))
    plan.wall('y', 0, (0, size - 1))
    plan.wall('y', size - 1, (0, size - 1))
    return plan.world(inside=(size // 2, size // 2))


def measure_at(world, x, y, yaw, sonars=ONE, noise=NOISE_FREE, seed=0, people=None):
    robot = np.atleast_2d(np.array([x, y, yaw], float).T)
    return measure(world, sonars, robot, noise, np.random.default_rng(seed), people)


def test_cast_returns_the_nearest_wall():
    segments = np.array([[2.0, -1.0, 2.0, 1.0], [3.0, -5.0, 3.0, 5.0], [-9.0, -1.0, -9.0, 1.0]])
    angles = np.array([[0.0, math.pi / 4, math.pi / 2, math.pi]])
    distance, hit = cast(np.zeros((1, 2)), angles, segments, 5.0)
    assert distance[0] == pytest.approx([2.0, 3.0 * math.sqrt(2.0), math.inf, math.inf])
    assert hit[0].tolist() == [0, 1, NOTHING, NOTHING]


def test_cast_of_many_rays_equals_single_rays():
    rng = np.random.default_rng(1)
    segments, origins = rng.uniform(0, 10, (20, 4)), rng.uniform(0, 10, (3000, 2))
    angles = rng.uniform(-4, 4, (3000, 5))
    distance, hit = cast(origins, angles, segments, 3.0)
    for n in range(0, 3000, 113):
        alone, alone_hit = cast(origins[n : n + 1], angles[n : n + 1], segments, 3.0)
        assert np.array_equal(alone[0], distance[n])
        assert np.array_equal(alone_hit[0], hit[n])


def test_distance_to_discs():
    centers = np.array([[2.0, 0.0], [2.0, 0.5], [-2.0, 0.0], [np.nan, np.nan]])
    distance = cast_discs(np.zeros((4, 2)), np.zeros((4, 1)), centers, 0.25)
    assert distance[:, 0] == pytest.approx([1.75, math.inf, math.inf, math.inf])


def test_path_through_a_wall_is_blocked():
    wall = np.array([[1.0, -1.0, 1.0, 1.0]])
    assert blocked(np.array([[0.0, 0.0], [2.0, 0.0]]), wall)
    assert not blocked(np.array([[0.0, 0.0], [0.9, 0.0], [0.9, 3.0], [3.0, 3.0]]), wall)


@pytest.mark.parametrize(('degrees', 'nearest'), [(90.0, 0.0), (95.0, 0.0), (82.5, 0.0), (110.0, 12.5), (60.0, 22.5)])
def test_range_is_that_of_the_nearest_point_in_the_cone(degrees, nearest):
    # the wall runs along y = 19.95; `nearest` is the angle between its normal and the nearest edge of the cone
    z = measure_at(room(), 10.0, 17.0, math.radians(degrees))
    assert z[0, 0] == pytest.approx(2.95 / math.cos(math.radians(nearest)), rel=2e-5)


def test_wider_cone_has_a_shorter_range_to_an_oblique_wall():
    angles = [5.0, 15.0, 30.0]
    ranges = [
        measure_at(room(), 10.0, 17.0, math.radians(60.0), replace(ONE, field_of_view=math.radians(angle)))[0, 0]
        for angle in angles
    ]
    assert ranges == pytest.approx([2.95 / math.cos(math.radians(30.0 - a / 2)) for a in angles], rel=2e-5)


def test_range_into_a_corner():
    # both walls are 1.95 m away; at 45° the edges of the cone meet them first
    z = measure_at(room(), 18.0, 18.0, math.radians(45.0))
    assert z[0, 0] == pytest.approx(1.95 / math.cos(math.radians(37.5)), rel=2e-5)


def test_range_ends_at_the_centre_of_the_walls_cell():
    world = WORLDS['door']()
    x = y = 3.75
    row, column = world.grid.cells_of(x, y)
    wall = row + np.flatnonzero(world.reference[row:, column] == 1)[0]
    centre = world.grid.centers()[1][wall]
    assert measure_at(world, x, y, math.pi / 2)[0, 0] == pytest.approx(centre - y, rel=2e-5)


def test_wall_out_of_range_is_no_echo_and_too_near_is_min_range():
    assert measure_at(room(), 10.0, 10.0, 0.0)[0, 0] == math.inf
    assert measure_at(room(), 19.9, 10.0, 0.0)[0, 0] == ONE.min_range


def test_noise_statistics():
    noise = NoiseModel(sigma=0.05, p_random=0.1, p_lost=0.2)
    robot = np.tile([17.0, 10.0, 0.0], (40_000, 1))
    z = measure(room(), ONE, robot, noise, np.random.default_rng(5))[:, 0]
    assert np.isinf(z).mean() == pytest.approx(0.2, abs=0.01)
    near = np.abs(z - 2.95) < 0.25
    fraction = 0.7 + 0.1 * 0.5 / (6.0 - 0.1)
    assert near.mean() == pytest.approx(fraction, abs=0.01)
    assert z[near].mean() == pytest.approx(2.95, abs=0.002)
    assert z[near].std() == pytest.approx(0.05, abs=0.004)
    random = z[np.isfinite(z) & ~near]
    assert random.min() >= 0.1
    assert random.max() < 6.0
    assert np.histogram(random, 4, (0.1, 6.0))[0].min() > 500


def test_ranges_depend_only_on_the_seed():
    world = WORLDS['door']()
    robot = np.column_stack([np.linspace(1.5, 10.5, 20), np.full(20, 3.75), np.zeros(20)])
    first, again, other = (measure(world, sonar_ring(), robot, NOISY, np.random.default_rng(s)) for s in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_smooth_wall_returns_echoes_only_near_its_normal():
    world = room(smooth=True)
    yaws = np.radians(np.repeat([90.0, 116.0, 120.0, 135.0], 4000))
    z = measure_at(world, np.full(len(yaws), 10.0), np.full(len(yaws), 17.0), yaws).reshape(4, -1)
    assert z[0] == pytest.approx(2.95, rel=2e-5)
    # rays of this cone between 18.5° and 20° from the normal return an echo
    assert np.all((z[1] > 2.95 / math.cos(math.radians(18.4))) & (z[1] < 2.95 / math.cos(math.radians(20.0))))
    # mirrored sound meets no other wall within 10 m
    assert np.all(np.isinf(z[2:]))


def test_smooth_wall_mirrors_echoes_of_other_walls():
    # at 45° the mirrored axis meets the right wall, which is rough and returns an echo
    z = measure_at(room(smooth=True), np.full(8000, 17.0), np.full(8000, 18.5), np.full(8000, math.radians(45.0)))[:, 0]
    ghost = np.isfinite(z)
    assert ghost.mean() == pytest.approx(GHOST_SHARE, abs=0.02)
    assert z[ghost] == pytest.approx(2.95 * math.sqrt(2.0), rel=1e-5)


def test_person_occludes_the_wall():
    people = np.array([[18.0, 10.0], [np.nan, np.nan]])
    z = measure_at(room(), np.array([17.0, 17.0]), np.array([10.0, 10.0]), np.zeros(2), people=people)
    assert z[:, 0] == pytest.approx([0.75, 2.95], rel=2e-5)


@pytest.mark.parametrize('name', ['door', 'rooms'])
def test_mirrored_world_gives_mirrored_ranges(name):
    world = WORLDS[name]()
    mirrored = replace(world, segments=world.segments * [-1.0, 1.0, -1.0, 1.0])
    robot = np.column_stack([np.linspace(1.5, 5.0, 30), np.full(30, 3.75), np.linspace(0.0, 6.0, 30)])
    flipped = np.column_stack([-robot[:, 0], robot[:, 1], math.pi - robot[:, 2]])
    ring = sonar_ring()
    ranges = measure(world, ring, robot, NOISE_FREE, np.random.default_rng(0))
    other = measure(mirrored, ring, flipped, NOISE_FREE, np.random.default_rng(0))
    assert other == pytest.approx(ranges[:, -np.arange(24) % 24])


def test_poses_and_names_of_sonar_arrays():
    ring, front = sonar_ring(16, radius=0.3), front_array()
    assert ring.names[:2] == ('sonar_00', 'sonar_01')
    name, pose = ring.extrinsics[4]
    assert name == 'sonar_04'
    assert pose == pytest.approx((0.0, 0.3, math.pi / 2))
    assert len(front.extrinsics) == 8
    assert all(abs(pose.yaw) <= math.pi / 2 for _, pose in front.extrinsics)
    poses = ring.poses(np.array([[1.0, 2.0, math.pi / 2]]))
    assert poses[0, 0] == pytest.approx((1.0, 2.3, math.pi / 2))
