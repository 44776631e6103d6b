"""Post-processing of the map found by the search: passes, extended walls, and unknown cells among the free ones."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.constants import FREE_GROWTH, FREE_MARGIN, LONGEST_GAP, MOST_AGAINST_EXTENSION
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.learned_normals import usual_limits
from forward_grid_mapper.core.maps.free_space import (
    PASS_UNIT,
    count_passes,
    direction_of,
    expected_passes,
    noticed_by,
    passes_by_direction,
)
from forward_grid_mapper.core.maps.post_processing import grown_through, post_process
from forward_grid_mapper.core.maps.wall_extension import extend
from forward_grid_mapper.core.runtime import threads
from samples import plain_model, random_readings

GRID = Grid(0.1, 0, 0, 14, 11)
MOST_AGAINST = MOST_AGAINST_EXTENSION * GRID.resolution
NOWHERE = np.zeros(GRID.shape, bool)


def off_the_lattice(seed: int, count: int = 40) -> Readings:
    readings = (naive.awkward_readings, random_readings)[seed % 2](np.random.default_rng(seed), GRID, count)
    readings.x[:] += 0.001234
    readings.y[:] -= 0.000777
    readings.z[:] = np.minimum(readings.z + 0.000345, readings.z_max)
    readings.sigma[:] *= 1.0017
    return readings


def made(readings: Readings, model: ModelParameters, occupied: np.ndarray, **options: object) -> Evidence:
    evidence = Evidence(GRID, model, start=occupied.reshape(GRID.shape), **options)
    evidence.extend(readings)
    return evidence


@pytest.mark.parametrize('seed', range(12))
@pytest.mark.parametrize('filled', [0.0, 0.1, 0.5])
def test_expected_passes_are_those_of_the_twin(seed: int, filled: float) -> None:
    rng = np.random.default_rng(seed)
    readings = off_the_lattice(seed)
    model = plain_model(
        p_hit=rng.choice([0.05, 0.6, 0.98]),
        p_rand=rng.choice([0.01, 0.4]),
        p_lost=rng.choice([0.0, 0.3]),
        sigma=0.06,
        surface_offset=rng.choice([0.0, 0.3]),
    )
    occupied = (rng.random(GRID.size) < filled).astype(np.uint8)
    evidence = made(readings, model, occupied)
    actual = expected_passes(evidence, occupied)
    expected = naive.passed(readings, GRID, occupied, model)
    assert np.abs(passes_by_direction(evidence, occupied) * PASS_UNIT - expected).max() < 2e-6 * len(readings)
    assert np.abs(actual.all - expected.sum(axis=0)).max() < 8e-6 * len(readings)
    assert (actual.all <= evidence.state.maps.seen + 1e-9).all()
    assert np.abs(actual.noticing - actual.all).max() < 1e-9, (
        'without a limit of the incidence, any surface notices all'
    )
    again = Evidence(GRID, model, memory=0.0, start=occupied.reshape(GRID.shape))
    again.extend(readings)
    assert np.array_equal(expected_passes(again, occupied), actual)


@pytest.mark.parametrize('seed', range(8))
@pytest.mark.parametrize('angles', [[0.1], [0.3], [0.7], [1.5], [0.5, 0.7], [0.2, 0.7, 1.2]])
def test_noticing_passes_are_those_of_the_twin(seed: int, angles: list[float]) -> None:
    rng = np.random.default_rng(seed)
    passes = np.where(rng.random((4, 50)) < 0.3, 0.0, rng.gamma(0.7, 3.0, (4, 50)))
    passes[:, :2] *= 1000.0
    passed, whole, out = np.round(passes / PASS_UNIT).astype(np.int64), np.empty(50), np.empty(50)
    p_hit = rng.choice([0.05, 0.65, 0.98])
    count_passes(passed, np.concatenate([noticed_by(angle) for angle in angles]), p_hit, whole, out)
    assert np.array_equal(whole, passed.sum(axis=0) * PASS_UNIT)
    expected = naive.noticing(passed * PASS_UNIT, p_hit, angles)
    finite = np.isfinite(expected)
    assert finite[2:].all()
    assert out[finite] == pytest.approx(expected[finite], rel=5e-3, abs=2e-3)
    assert (out >= -1e-12).all() and (out <= passes.sum(axis=0) + 1e-9).all()


@pytest.mark.parametrize('turn', [1j, -1, 1 + 0j])
def test_directions_of_view_turn_and_mirror_with_the_lattice(turn: complex) -> None:
    rng = np.random.default_rng(3)
    for u, v in rng.normal(size=(200, 2)):
        bearing = math.atan2(v, u)
        assert direction_of(u, v) == round(bearing / (math.pi / 4)) % 4
        turned = complex(u, v) * turn
        assert direction_of(turned.real, turned.imag) == (direction_of(u, v) + (2 if turn == 1j else 0)) % 4
        assert direction_of(-u, v) == (-direction_of(u, v)) % 4


def test_cells_passed_in_one_direction_only_are_unknown() -> None:
    beams = {'z': np.full(50, 1.3), 'z_max': 1.3, 'half_angle': 0.02}
    model = plain_model(sigma=0.05, max_incidence_angle=0.7)
    free = np.zeros(GRID.shape, np.uint8)
    along = Readings.from_columns(x=0.05, y=0.55, yaw=0.0, **beams)
    # along the row, the column and both diagonals of one cell
    x, y, yaw = np.array([(0.05, 0.55, 0.0), (1.05, 0.05, 2.0), (0.65, 0.15, 1.0), (1.35, 0.25, 3.0)]).T
    star = {name: np.repeat(column, 50) for name, column in (('x', x), ('y', y), ('yaw', yaw * math.pi / 4))}
    around = Readings.from_columns(**star, z=np.full(200, 1.3), z_max=1.3, half_angle=0.02)
    actual = post_process(made(along, model, free), 0.0, 0.9, 1.5, NOWHERE)
    assert (actual == -1).all(), 'a wall at a slant would have let all of them pass'
    assert (post_process(made(along, model, free), 0.0, 0.9, 0.0, NOWHERE) == 0).any()
    actual = post_process(made(around, model, free), 0.0, 0.9, 1.5, NOWHERE)
    assert actual[5, 10] == 0
    far = np.flatnonzero(actual[5] == 0)
    assert far[0] == 10 - round(FREE_GROWTH / 0.1) - round(FREE_MARGIN / 0.1), (
        'as far as it leads on, and a cell beside'
    )


@pytest.mark.parametrize(
    ('most', 'least', 'usual'),
    [
        (0.7, 0.3, [0.5, 0.7]),
        (0.7, 0.7, [0.7]),
        (0.7, 1.5708, [0.7]),
        (1.2, 0.2, [0.7, 1.2]),
        (math.pi / 2, 0.3, [math.pi / 2]),
    ],
)
def test_unknown_surface_has_one_of_the_larger_limits(most: float, least: float, usual: list[float]) -> None:
    model = plain_model(max_incidence_angle=most, min_incidence_angle=least)
    assert usual_limits(model) == pytest.approx(usual)


@pytest.mark.parametrize(('least', 'free'), [(0.7, True), (0.1, False)])
def test_beams_in_one_direction_clear_a_cell_only_if_any_surface_would_return_them_at_a_slant(
    least: float, free: bool
) -> None:
    # at 0.7 rad, diagonal surfaces return 39 % of the beams along a row, and at 0.4 rad 1 %
    beams = {'z': np.full(50, 1.3), 'z_max': 1.3, 'half_angle': 0.02}
    along = Readings.from_columns(x=0.05, y=0.55, yaw=0.0, **beams)
    model = plain_model(sigma=0.05, max_incidence_angle=0.7, min_incidence_angle=least)
    evidence = made(along, model, np.zeros(GRID.shape, np.uint8))
    actual = post_process(evidence, 0.0, 0.9, 1.0, NOWHERE)
    assert (actual == 0).any() == free


def test_free_space_grows_only_through_passed_cells() -> None:
    known, passed = np.zeros((3, 12), bool), np.ones((3, 12), bool)
    known[1, 2], passed[:, 7] = True, False
    assert np.array_equal(grown_through(known, passed, 3).any(axis=0), np.arange(12) <= 5)
    assert np.array_equal(grown_through(known, passed, 9).any(axis=0), np.arange(12) <= 6)
    assert np.array_equal(grown_through(known, passed, 0), known)


def test_free_growth_and_margin_are_within_the_margin_of_tiles() -> None:
    assert FREE_GROWTH + FREE_MARGIN <= LONGEST_GAP / 2


def test_expected_passes_of_another_map_use_weights() -> None:
    readings, model = off_the_lattice(3), plain_model(sigma=0.06)
    occupied = (np.random.default_rng(0).random(GRID.size) < 0.2).astype(np.uint8)
    evidence = made(readings, model, occupied)
    weight = 1 + np.arange(len(readings)) % 3
    evidence.add_multiplicity(np.repeat(np.arange(len(readings)), weight - 1))
    actual = expected_passes(evidence, occupied)
    expected = naive.passed(readings, GRID, occupied, model, weight)
    assert np.abs(actual.all - expected.sum(axis=0)).max() < 8e-6 * weight.sum()


def test_passes_do_not_depend_on_threads_or_incidence_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = random_readings(np.random.default_rng(5), GRID, 300)
    occupied = (np.random.default_rng(1).random(GRID.size) < 0.1).astype(np.uint8)
    whole, slanted = plain_model(), plain_model(max_incidence_angle=0.5)
    one = expected_passes(made(readings, whole, occupied), occupied)
    monkeypatch.setattr(threads, 'LEAST_PART', 20)
    assert np.array_equal(expected_passes(made(readings, whole, occupied, threads=3), occupied), one)
    two = made(readings, slanted, occupied)
    assert two.state.normals.known.any()
    assert np.array_equal(expected_passes(two, occupied).all, one.all)


@pytest.mark.parametrize('seed', range(30))
def test_walls_are_extended_as_in_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    occupied = (rng.random(GRID.shape) < 0.05).astype(np.uint8)
    for _ in range(3):
        x, y, k = int(rng.integers(GRID.width)), int(rng.integers(GRID.height)), int(rng.integers(8))
        for n in range(int(rng.integers(3, 7))):
            u, v = x + n * naive.STEPS[k][0], y + n * naive.STEPS[k][1]
            if 0 <= u < GRID.width and 0 <= v < GRID.height:
                occupied[v, u] = 1
    evidence = made(random_readings(rng, GRID, 15), plain_model(), occupied)
    evidence.state.maps.evidence[:] = rng.uniform(-2 * MOST_AGAINST, 6 * MOST_AGAINST, GRID.size) / QUANTUM
    barred = (rng.random(GRID.shape) < 0.1).astype(np.uint8)
    for steps in (1, 3):
        out = np.zeros(GRID.size, np.uint8)
        extend(evidence.state, steps, barred.ravel(), out)
        actual, seen = (
            a.reshape(GRID.shape) for a in (evidence.state.maps.evidence * QUANTUM, evidence.state.maps.seen)
        )
        expected = naive.extended_walls(occupied, actual, seen, steps, barred)
        assert np.array_equal(out.reshape(GRID.shape), expected)


def wall_at(row: int, first: int, last: int) -> np.ndarray:
    occupied = np.zeros(GRID.shape, np.uint8)
    occupied[row, first : last + 1] = 1
    return occupied


def seen_by_all(occupied: np.ndarray) -> Evidence:
    evidence = made(off_the_lattice(1), plain_model(), occupied)
    evidence.state.maps.seen[:], evidence.state.maps.evidence[:] = 1, 1
    return evidence


def test_walls_are_extended_up_to_the_limit_or_contrary_evidence() -> None:
    evidence = seen_by_all(wall_at(5, 4, 8))
    assert np.array_equal(post_process(evidence, 0.0, 0.0, 0.0, NOWHERE) == 1, wall_at(5, 4, 8) == 1)
    assert np.array_equal(post_process(evidence, 0.2, 0.0, 0.0, NOWHERE) == 1, wall_at(5, 2, 10) == 1)
    evidence.state.maps.evidence.reshape(GRID.shape)[5, 10] = round(-1.1 * MOST_AGAINST / QUANTUM)
    evidence.state.maps.evidence.reshape(GRID.shape)[5, 2] = round(-0.9 * MOST_AGAINST / QUANTUM)
    assert np.array_equal(post_process(evidence, 0.3, 0.0, 0.0, NOWHERE) == 1, wall_at(5, 1, 9) == 1)
    assert np.array_equal(evidence.observed() == 1, wall_at(5, 4, 8) == 1), 'the search goes on from its own map'


def test_walls_are_not_extended_over_traversed_or_passed_cells() -> None:
    traversed = NOWHERE.copy()
    traversed[5, 10] = True
    evidence = seen_by_all(wall_at(5, 4, 8))
    assert np.array_equal(post_process(evidence, 0.3, 0.0, 0.0, traversed) == 1, wall_at(5, 1, 9) == 1)
    # ten readings that went through a gap
    readings = Readings.from_columns(x=1.15, y=0.05, yaw=math.pi / 2, z=np.full(10, 1.0), z_max=1.3, half_angle=0.02)
    evidence = made(readings, plain_model(sigma=0.05), wall_at(5, 4, 8))
    evidence.state.maps.seen[:], evidence.state.maps.evidence[:] = 1, 1
    assert np.array_equal(post_process(evidence, 0.6, 0.0, 0.0, NOWHERE)[5] == 1, np.arange(14) <= 13)
    actual = post_process(evidence, 0.6, 1.0, 0.0, NOWHERE)
    assert actual[5, 11] == 0
    assert (actual[5, 9:11] == 1).all(), 'up to what is known'


def test_wall_of_three_cells_is_not_extended() -> None:
    assert np.array_equal(
        post_process(seen_by_all(wall_at(5, 4, 6)), 0.3, 0.0, 0.0, NOWHERE) == 1, wall_at(5, 4, 6) == 1
    )


@pytest.mark.parametrize('seed', range(6))
def test_cells_with_too_few_passes_are_unknown(seed: int) -> None:
    readings, model = random_readings(np.random.default_rng(seed), GRID, 12), plain_model(sigma=0.06)
    occupied = (np.random.default_rng(seed).random(GRID.size) < 0.05).astype(np.uint8)
    evidence = made(readings, model, occupied)
    traversed = np.random.default_rng(seed).random(GRID.shape) < 0.01
    plain = evidence.observed()
    plain[traversed & (plain < 0)] = 0
    passed = expected_passes(evidence, occupied).all.reshape(GRID.shape)
    assert np.array_equal(post_process(evidence, 0.0, 0.0, 0.0, traversed), plain)
    for least in (0.5, 1.5):
        actual = post_process(evidence, 0.0, least, 0.0, traversed)
        known = ((passed >= least) | traversed) & (plain == 0)
        beside = naive.box_sum(known.astype(int)) > 0
        expected = np.where((plain == 0) & ~beside, -1, plain)
        assert np.array_equal(actual, expected)
    assert (post_process(evidence, 0.0, 100.0, 0.0, NOWHERE) != 0).all()


def test_cells_behind_a_wall_are_unknown() -> None:
    # fifty echoes of a wall 0.6 m ahead, and one that went through a gap
    readings = Readings.from_columns(x=0.05, y=0.55, yaw=0.0, z=np.full(50, 0.6), z_max=1.3, half_angle=0.02)
    evidence = made(readings, dataclasses.replace(plain_model(), sigma=0.05), wall_at(5, 6, 6))
    actual = post_process(evidence, 0.0, 0.9, 0.0, NOWHERE)
    assert actual[5, :7].tolist() == [0] * 6 + [1]
    assert (actual[5, 9:] == -1).all()
    assert math.isfinite(evidence.log_likelihood)


@pytest.mark.parametrize('parts', [1, 2, 4])
def test_margins_and_extensions_are_lengths_in_metres(parts: int) -> None:
    grid = Grid(0.1 / parts, 0, 0, 14 * parts, 11 * parts)
    wall = np.zeros(grid.shape, np.uint8)
    wall[5 * parts, 4 * parts : 9 * parts] = 1
    evidence = Evidence(grid, plain_model(sigma=0.05), start=wall)
    # a thin beam along the middle of a row, repeated so often that the cells are known to be free
    readings = Readings.from_columns(
        x=0.01, y=0.75 + 0.05 / parts, yaw=0.0, z=np.full(20, 1.35), z_max=2.0, half_angle=0.002
    )
    evidence.extend(readings)
    evidence.state.maps.seen[:], evidence.state.maps.evidence[:] = 1, 1
    actual = post_process(evidence, 0.3, 1.0, 0.0, np.zeros(grid.shape, bool))
    columns = np.flatnonzero(actual[5 * parts] == 1)
    assert (columns[0], columns[-1]) == (1 * parts, 12 * parts - 1)
    free = np.flatnonzero(actual[:, 7 * parts] == 0)
    assert len(free) * grid.resolution == pytest.approx(2 * FREE_MARGIN + grid.resolution)
