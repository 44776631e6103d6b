"""Moves of whole walls: gaps are closed in one move, doors stay open, and short walls are removed in one move."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import naive
from forward_grid_mapper.core.common.constants import (
    MOST_AGAINST_GAP,
    MOST_AGAINST_METRE,
    MOST_AGAINST_PASSAGE,
    PASSAGE,
)
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import SearchParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.neighbourhood import patterns
from forward_grid_mapper.core.search import search as search_module
from forward_grid_mapper.core.search.gap_closing import close_gaps, remove_short_walls
from forward_grid_mapper.core.search.prior import Prior, wall_prior
from forward_grid_mapper.core.search.search import LEAST, Search
from forward_grid_mapper.core.sensor.forward_model import log_likelihood
from samples import found_by, plain_model, plain_search, random_readings

GRID = Grid(0.1, 0, 0, 24, 14)
MODEL = plain_model(p_hit=0.7, p_rand=0.4, p_lost=0.4, sigma=0.05)
WALL = 8
GAP = range(9, 13)
FEW_PASSED, MANY_PASSED = 1, 12


def room(through: int, gap: range = GAP) -> Readings:
    """Five echoes in each column of the wall in row 8; in those of its gap, `through` readings without echo."""
    columns = [c for c in range(2, 22) for _ in range(through if c in gap else 5)]
    echo = np.array([c not in gap for c in columns])
    return Readings.from_columns(
        x=[0.1 * c + 0.05 for c in columns],
        y=0.05,
        yaw=np.pi / 2,
        z=np.where(echo, 0.8, 1.2),
        z_max=1.2,
        half_angle=0.02,
        stamp=np.arange(len(columns)),
    )


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch):
    def run(readings: Readings, longest: int = 10, **values: object) -> np.ndarray:
        monkeypatch.setattr(search_module, 'LONGEST_GAP', longest * GRID.resolution)
        evidence = Evidence(GRID, MODEL)
        evidence.extend(readings)
        result = found_by(Search(evidence, plain_search(**{'prior': 0.4, 'wall_cost': 1.0, 'end_cost': 1.5, **values})))
        return result.occupied.reshape(GRID.shape)

    return run


def prior_for(parameters: SearchParameters, resolution: float = GRID.resolution) -> Prior:
    return wall_prior(parameters, np.zeros(GRID.size, bool), resolution)


def closed(evidence: Evidence, prior: Prior, longest: int) -> tuple[int, float]:
    cells = np.flatnonzero(evidence.state.maps.occupied)
    return close_gaps(evidence.state, prior, LEAST, cells, longest)


def test_gap_passed_by_few_readings_is_closed_only_as_a_whole(searched) -> None:
    readings = room(FEW_PASSED)
    open_, shut = (searched(readings, longest) for longest in (1, 10))
    assert not open_[:, list(GAP)].any()
    assert shut[WALL, list(GAP)].all()
    assert np.array_equal(np.delete(open_, list(GAP), axis=1), np.delete(shut, list(GAP), axis=1))
    assert shut.sum() == open_.sum() + len(GAP)


def test_gap_longer_than_the_limit_stays_open(searched) -> None:
    assert not searched(room(FEW_PASSED), len(GAP))[:, list(GAP)].any()
    assert searched(room(FEW_PASSED), len(GAP) + 1)[WALL, list(GAP)].all()


def test_gap_passed_by_many_readings_stays_open(searched) -> None:
    assert not searched(room(MANY_PASSED), 20, end_cost=50.0)[:, list(GAP)].any()


def test_gap_that_no_reading_saw_stays_open(searched) -> None:
    assert not searched(room(0), 20, end_cost=50.0)[:, list(GAP)].any()


def test_closing_a_gap_without_gain_is_undone() -> None:
    evidence = Evidence(GRID, MODEL)
    evidence.extend(room(FEW_PASSED))
    start = np.zeros(GRID.shape, np.uint8)
    start[WALL, [c for c in range(2, 22) if c not in GAP]] = 1
    evidence.state.maps.occupied[:] = start.ravel()
    evidence.rebuild()
    before = [array.copy() for array in evidence.state.maps]
    cheap = SearchParameters(wall_cost=4.0, end_cost=0.1)
    assert closed(evidence, prior_for(cheap), 10) == (0, 0.0)
    assert evidence.state.clock[0] == 2 * len(GAP), 'it was tried'
    for old, new in zip(before, evidence.state.maps, strict=True):
        assert np.array_equal(old, new)


@pytest.mark.parametrize('step', [(0, 1), (1, 1), (1, 0), (1, -1), (1, 2), (3, 1)])
def test_gaps_are_closed_in_any_direction(step: tuple[int, int]) -> None:
    # two pieces of a straight wall; of the cells between, readings say only that they were seen
    evidence = Evidence(GRID, MODEL)
    occupied = np.zeros(GRID.shape, np.uint8)
    reach = np.array([n for n in range(-30, 31) if abs(n) >= 6]) / (3 * max(step))
    for f in reach:
        y, x = 6 + round(f * step[0]), 11 + round(f * step[1])
        if 0 <= y < GRID.height and 0 <= x < GRID.width:
            occupied[y, x] = 1
    maps = evidence.state.maps
    maps.occupied[:], maps.seen[:], maps.pattern[:] = occupied.ravel(), 1, patterns(occupied, GRID.shape)
    flips, gain = closed(evidence, prior_for(SearchParameters()), 10)
    assert flips > 0
    assert gain > 0
    assert maps.occupied.sum() == occupied.sum() + flips
    assert maps.occupied[6 * GRID.width + 11]


@pytest.mark.parametrize('seed', range(20))
def test_gain_of_closed_gaps_is_exact_and_only_allowed_cells_are_closed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    readings = random_readings(rng, GRID, 12, z_max=1.5)
    start = rng.random(GRID.shape) < 0.08
    evidence = Evidence(GRID, MODEL, start=start)
    evidence.extend(readings)
    maps = evidence.state.maps
    prior = prior_for(SearchParameters(end_cost=3.0))

    def height() -> float:
        shaped = maps.occupied.reshape(GRID.shape)
        return log_likelihood(readings, GRID, shaped, MODEL) + naive.log_prior(prior, shaped, GRID.shape)

    before, actual = height(), maps.evidence * QUANTUM
    flips, gain = closed(evidence, prior, 6)
    assert height() - before == pytest.approx(gain, abs=1e-4)
    built = (maps.occupied == 1) & ~start.ravel()
    assert built.sum() == flips
    assert (maps.occupied[start.ravel()] == 1).all()
    assert (maps.seen[built] > 0).all()
    assert np.array_equal(maps.pattern, patterns(maps.occupied, GRID.shape))
    if flips == 1:
        assert actual[built] >= -MOST_AGAINST_METRE * GRID.resolution


@pytest.mark.parametrize(
    ('gap', 'against', 'resolution', 'stands'),
    [
        (1, 0.99, 0.1, True),
        (1, 1.01, 0.1, False),
        (3, 0.99, 0.1, True),
        (3, 1.01, 0.1, False),
        # 0.25 m
        (5, 0.49, 0.05, True),
        (5, 0.51, 0.05, False),
        # 0.5 m, wide enough for a robot
        (5, 0.29, 0.1, True),
        (5, 0.31, 0.1, False),
    ],
)
def test_gap_with_too_much_evidence_against_it_stays_open(
    gap: int, against: float, resolution: float, stands: bool
) -> None:
    assert (MOST_AGAINST_METRE, MOST_AGAINST_GAP, MOST_AGAINST_PASSAGE, PASSAGE) == (10.0, 4.0, 1.5, 0.35)
    evidence = Evidence(dataclasses.replace(GRID, resolution=resolution), MODEL)
    maps = evidence.state.maps
    occupied = np.zeros(GRID.shape, np.uint8)
    occupied[5, 2 : 15 + gap] = 1
    occupied[5, 8 : 8 + gap] = 0
    maps.occupied[:], maps.seen[:], maps.pattern[:] = occupied.ravel(), 1, patterns(occupied, GRID.shape)
    maps.evidence.reshape(GRID.shape)[5, 8 : 8 + gap] = round(-against / QUANTUM)
    flips, gain = closed(evidence, prior_for(SearchParameters(end_cost=20.0), resolution), 8)
    assert flips == (gap if stands else 0)
    assert (gain > 0) == stands


def test_stop_flag_ends_the_moves() -> None:
    evidence = Evidence(GRID, MODEL)
    evidence.extend(room(FEW_PASSED))
    evidence.state.stop[0] = 1
    assert close_gaps(evidence.state, prior_for(SearchParameters()), LEAST, np.arange(4), 9) == (0, 0.0)
    evidence.state.maps.occupied[:] = 1
    assert remove_short_walls(evidence.state, prior_for(SearchParameters()), LEAST, np.arange(4), 1000) == (0, 0.0)


def test_limit_of_evidence_against_a_gap_scales_with_the_exponent() -> None:
    for exponent, stands in ((1.0, False), (0.5, True)):
        evidence = Evidence(GRID, dataclasses.replace(MODEL, likelihood_exponent=exponent))
        maps = evidence.state.maps
        occupied = np.zeros(GRID.shape, np.uint8)
        occupied[5, 2:8] = occupied[5, 9:15] = 1
        maps.occupied[:], maps.seen[:], maps.pattern[:] = occupied.ravel(), 1, patterns(occupied, GRID.shape)
        maps.evidence.reshape(GRID.shape)[5, 8] = round(-1.5 / QUANTUM)
        flips, _ = closed(evidence, prior_for(SearchParameters(end_cost=20.0)), 8)
        assert flips == stands


# Short walls


def removed(evidence: Evidence, prior: Prior, longest: int) -> tuple[int, float]:
    cells = np.flatnonzero(evidence.state.maps.occupied)
    return remove_short_walls(evidence.state, prior, LEAST, cells, longest)


def components(occupied: np.ndarray) -> list[set[int]]:
    """Twin in plain Python: sets of connected cells, by union of neighbours until nothing changes."""
    left = [{int(c)} for c in np.flatnonzero(occupied.ravel())]
    joined = True
    while joined:
        joined = False
        for i, one in enumerate(left):
            beside = {o for c in one for o in naive.neighbours_of(c, occupied.shape).values()}
            for j in range(i + 1, len(left)):
                if left[j] & beside:
                    left[i] = one | left.pop(j)
                    joined = True
                    break
            if joined:
                break
    return left


@pytest.mark.parametrize('seed', range(15))
@pytest.mark.parametrize('longest', [1, 3, 6])
def test_short_walls_are_removed_as_in_the_twin(seed: int, longest: int) -> None:
    rng = np.random.default_rng(seed)
    start = (rng.random(GRID.shape) < 0.18).astype(np.uint8)
    evidence = Evidence(GRID, MODEL, start=start)
    maps = evidence.state.maps
    # no readings: the gain of each cell is set here
    maps.evidence[:] = np.round(rng.uniform(-4.0, 0.5, GRID.size) / QUANTUM)
    maps.evidence[start.ravel() == 0] = 0
    prior = prior_for(SearchParameters(end_cost=1.5))
    expected, total = start.ravel().copy(), 0.0
    for wall in components(start):
        cells = sorted(wall)
        without = expected.copy()
        without[cells] = 0
        gain = maps.evidence[cells].sum() * QUANTUM + (
            naive.log_prior(prior, without, GRID.shape) - naive.log_prior(prior, expected, GRID.shape)
        )
        if 1 < len(cells) <= longest and gain > 10.0 * LEAST[0]:
            expected, total = without, total + gain
    flips, gain = removed(evidence, prior, longest)
    assert np.array_equal(maps.occupied, expected)
    assert flips == start.sum() - expected.sum()
    assert gain == pytest.approx(total, abs=1e-5)
    assert np.array_equal(maps.pattern, patterns(maps.occupied, GRID.shape))


def test_short_wall_that_single_flips_keep_is_removed_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    # one echo in each of three neighbouring columns: less than the two ends of a wall cost
    readings = Readings.from_columns(
        x=np.array([0.85, 0.95, 1.05]),
        y=0.05,
        yaw=np.pi / 2,
        z=np.full(3, 0.8),
        z_max=1.2,
        half_angle=0.02,
        stamp=np.arange(3),
    )
    found = []
    for short in (0.1, 0.5):
        monkeypatch.setattr(search_module, 'SHORT_WALL', short)
        evidence = Evidence(GRID, MODEL)
        evidence.extend(readings)
        found.append(found_by(Search(evidence, plain_search(prior=0.4, wall_cost=1.0, end_cost=4.0))).occupied.sum())
    assert found == [3, 0]
