"""Scores of perfect, empty, shifted, dotted and closed maps, and of maps on other lattices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.simulation.drive import corridor_drive, door_drive
from forward_grid_mapper.simulation.score import score_map, threshold, visible_surface
from forward_grid_mapper.simulation.world import WORLDS


@pytest.fixture(scope='module', params=['door', 'corridor'])
def case(request):
    recording = door_drive(3) if request.param == 'door' else corridor_drive()
    return recording.world, visible_surface(recording.world, recording.readings)


@pytest.fixture(scope='module')
def door():
    recording = door_drive(3)
    return recording.world, visible_surface(recording.world, recording.readings)


def test_perfect_map_has_perfect_scores(case):
    world, visible = case
    scores = score_map(world.reference, world.grid, world, visible)
    assert (scores.precision, scores.recall, scores.f1, scores.rough_coverage) == (1.0, 1.0, 1.0, 1.0)
    assert (scores.false_dots, scores.longest_gap, scores.column_coverage) == (0, 0, 1.0)
    assert scores.door_widths == tuple(door.width for door in world.doors)
    assert scores.doors_open == len(world.doors)
    assert scores.smooth_recall == 1.0 if world.smooth.any() else math.isnan(scores.smooth_recall)


@pytest.mark.parametrize('value', [-1, 0])
def test_map_without_walls_scores_zero(case, value):
    world, visible = case
    scores = score_map(np.full(world.grid.shape, value, np.int8), world.grid, world, visible)
    assert (scores.precision, scores.recall, scores.f1, scores.false_dots) == (0.0, 0.0, 0.0, 0)
    assert scores.doors_open == (len(world.doors) if value == 0 else 0)
    assert scores.longest_gap > 20


def test_empty_grid_scores_zero(door):
    world, visible = door
    scores = score_map(np.zeros((0, 0), np.int8), Grid(0.1, 0, 0, 0, 0), world, visible)
    assert scores.f1 == 0.0
    assert scores.door_widths == (0.0,)


@pytest.mark.parametrize(('change', 'width', 'open_'), [(1, 0.0, 0), (-1, 0.0, 0)])
def test_closed_or_unknown_door_is_not_open(door, change, width, open_):
    world, visible = door
    ml = world.reference.copy()
    ml[48, 58:64] = change
    scores = score_map(ml, world.grid, world, visible)
    assert scores.door_widths == (width,)
    assert scores.doors_open == open_


@pytest.mark.parametrize(('first', 'last', 'width', 'open_'), [(58, 59, 0.4, 1), (60, 60, 0.3, 1), (60, 61, 0.2, 0)])
def test_half_closed_door_has_the_remaining_width(door, first, last, width, open_):
    world, visible = door
    ml = world.reference.copy()
    ml[50, first : last + 1] = 1
    scores = score_map(ml, world.grid, world, visible)
    assert scores.door_widths == pytest.approx((width,))
    assert scores.doors_open == open_


def test_door_width_is_at_most_the_true_width(door):
    world, visible = door
    ml = world.reference.copy()
    ml[46:51, 50:70] = 0
    assert score_map(ml, world.grid, world, visible).door_widths == (0.6,)


@pytest.mark.parametrize(('cells', 'exact'), [(1, True), (2, False)])
def test_map_shifted_by_one_cell_has_perfect_scores(door, cells, exact):
    world, visible = door
    grid = replace(world.grid, column=cells, row=cells)
    scores = score_map(world.reference, grid, world, visible)
    assert (scores.f1 == 1.0) == exact
    assert (scores.false_dots == 0) == exact


def test_false_dots_count_only_away_from_walls(door):
    world, visible = door
    ml = world.reference.copy()
    ml[37, 30] = ml[70, 60] = 1  # free space
    ml[10, 10] = 1  # solid
    ml[46, 30] = 1  # two cells from a wall
    scores = score_map(ml, world.grid, world, visible)
    assert scores.false_dots == 3
    walls = (world.reference == 1).sum()
    assert scores.precision == pytest.approx(walls / (walls + 4))


def test_dotted_wall_has_full_recall_and_low_column_coverage(door):
    world, visible = door
    ml = world.reference.copy()
    ml[26, 7:115] = 0
    ml[26, 8:115:3] = 1
    scores = score_map(ml, world.grid, world, visible)
    assert scores.recall == scores.rough_coverage == 1.0
    assert scores.column_coverage < 0.9
    assert scores.longest_gap == 2
    ml[26, 20:30] = 0
    assert score_map(ml, world.grid, world, visible).longest_gap > 9


def test_smooth_and_rough_walls_have_separate_scores():
    recording = corridor_drive()
    world = recording.world
    visible = visible_surface(world, recording.readings)
    ml = np.where(world.smooth_cells, 0, world.reference).astype(np.int8)
    scores = score_map(ml, world.grid, world, visible)
    assert scores.rough_coverage == 1.0
    assert scores.smooth_recall == pytest.approx(2 / 180)
    assert scores.recall == pytest.approx(1 - 178 / visible.sum())


def test_larger_and_smaller_grids_of_the_same_lattice(door):
    world, visible = door
    inner = Grid(0.1, 4, 20, 115, 70)
    scores = score_map(world.reference[world.grid.window(inner)], inner, world, visible)
    assert scores == replace(scores, precision=1.0, recall=1.0, f1=1.0, doors_open=1)
    outer = Grid(0.1, -30, -20, 200, 160)
    ml = np.full(outer.shape, -1, np.int8)
    ml[outer.window(world.grid)] = world.reference
    ml[0, 0] = 1
    scores = score_map(ml, outer, world, visible)
    walls = (world.reference == 1).sum()
    assert scores.precision == pytest.approx(walls / (walls + 1))
    assert (scores.recall, scores.false_dots, scores.doors_open) == (1.0, 0, 1)


@pytest.mark.parametrize('factor', [2, 4])
def test_finer_map_has_perfect_scores(door, factor):
    world, visible = door
    grid = Grid(0.1 / factor, 0, 0, world.grid.width * factor, world.grid.height * factor)
    fine = np.kron(world.reference, np.ones((factor, factor), np.int8))
    # a wall of one fine cell is found as well
    thin = fine.copy()
    thin[26 * factor : 27 * factor - 1] = np.minimum(fine[26 * factor : 27 * factor - 1], 0)
    for ml in (fine, thin):
        scores = score_map(ml, grid, world, visible)
        assert (scores.f1, scores.false_dots, scores.door_widths) == (1.0, 0, (0.6,))


def test_coarser_map_has_perfect_scores(door):
    world, visible = door
    grid = Grid(0.2, 0, 0, 61, 54)
    padded = np.pad(world.reference, ((0, 1), (0, 0)), constant_values=-1)
    coarse = padded.reshape(54, 2, 61, 2).max(axis=(1, 3))
    scores = score_map(coarse, grid, world, visible)
    assert scores.f1 == 1.0
    assert scores.doors_open == 1


def test_visible_surface_ends_at_the_largest_range_and_at_walls(door):
    world, visible = door
    assert visible[26, 7:115].all()
    assert not np.any(visible & (world.reference != 1))
    # a single reading, perpendicular to the wall: ± 7.5° of it
    recording = door_drive(0)
    wall = recording.readings.select(np.array([6]))
    seen = visible_surface(world, wall)
    assert set(np.nonzero(seen)[0]) == {48}
    half = (4.85 - wall.y[0]) * math.tan(wall.half_angle[0])
    columns = np.nonzero(seen)[1]
    assert columns[0] == math.floor((wall.x[0] - half) / 0.1)
    assert columns[-1] == math.floor((wall.x[0] + half) / 0.1)
    short = replace(wall, z_max=np.array([0.5]))
    assert not visible_surface(world, short).any()
    # each reading has its own largest range, also next to one with a larger one
    back = wall.yaw[0] + np.array([0.0, math.pi])
    away = replace(wall.select(np.array([0, 0])), yaw=back, z_max=np.array([0.5, 5.0]))
    np.testing.assert_array_equal(visible_surface(world, away), visible_surface(world, away.select(np.array([1]))))


def test_visible_surface_of_first_echoes_is_smaller(door):
    world, visible = door
    readings = door_drive(3).readings
    near = visible_surface(world, readings, depth=0.2)
    assert not np.any(near & ~visible)
    # past the jambs, some cones contain the side walls of the room, but the echoes of the jambs come first
    sides = np.zeros_like(near)
    sides[50:84, [38, 83]] = True
    assert (near & sides).sum() < 0.5 * (visible & sides).sum()
    assert near[26, 7:115].all()


def test_threshold_of_probabilities():
    p = np.array([0.0, 0.34, 0.36, 0.5, 0.64, 0.66, 1.0, np.nan], np.float32)
    assert threshold(p).tolist() == [0, 0, -1, -1, -1, 1, 1, -1]


def test_reference_of_each_world_has_perfect_scores():
    for make in WORLDS.values():
        world = make()
        scores = score_map(world.reference, world.grid, world, world.reference == 1)
        assert scores.f1 == 1.0
        assert scores.doors_open == len(world.doors)
