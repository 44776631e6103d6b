"""Bridges: gaps in walls close at once where next to nothing speaks against it, and doors stay open."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import naive
from conftest import plain_model, plain_search, random_readings
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import SearchParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.neighbourhood import patterns
from forward_grid_mapper.core.search.gap_closing import (
    MOST_AGAINST_CELL,
    MOST_AGAINST_GAP,
    MOST_AGAINST_PASSAGE,
    PASSAGE,
    close_gaps,
)
from forward_grid_mapper.core.search.prior import Prior, local_prior, shapes
from forward_grid_mapper.core.search.search import LEAST, Search
from forward_grid_mapper.core.sensor.forward_model import log_likelihood

GRID = Grid(0.1, 0, 0, 24, 14)
MODEL = plain_model(p_hit=0.7, p_rand=0.4, p_lost=0.4, sigma=0.05)
WALL = 8
GAP = range(9, 13)
FREE, LOOKED_THROUGH = 1, 12


def room(through: int, gap: range = GAP) -> Readings:
    """Five echoes in each column from the wall in row 8, but in its gap `through` readings that heard nothing."""
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


def searched(readings: Readings, **values: object) -> np.ndarray:
    evidence = Evidence(GRID, MODEL)
    evidence.extend(readings)
    result = Search(
        evidence, plain_search(**{'line_bonus': 0.3, 'end_cost': 1.0, 'isolated_cost': 2.0, **values})
    ).run()
    return result.occupied.reshape(GRID.shape)


def prior_for(parameters: SearchParameters) -> Prior:
    return Prior(local_prior(parameters, np.zeros(GRID.size, bool)), shapes(parameters))


def bridged(evidence: Evidence, prior: Prior, longest: int) -> tuple[int, float]:
    cells = np.flatnonzero(evidence.state.maps.occupied)
    return close_gaps(evidence.state, prior, LEAST, cells, longest)


def test_a_gap_that_few_looked_through_is_closed_and_only_by_a_bridge() -> None:
    readings = room(FREE)
    open_, closed = (searched(readings, bridges=longest) for longest in (0, 10))
    assert not open_[:, list(GAP)].any()
    assert closed[WALL, list(GAP)].all()
    assert np.array_equal(np.delete(open_, list(GAP), axis=1), np.delete(closed, list(GAP), axis=1))
    assert closed.sum() == open_.sum() + len(GAP)


def test_a_gap_wider_than_asked_for_stays() -> None:
    assert not searched(room(FREE), bridges=len(GAP))[:, list(GAP)].any()
    assert searched(room(FREE), bridges=len(GAP) + 1)[WALL, list(GAP)].all()


def test_a_door_stays_open() -> None:
    assert not searched(room(LOOKED_THROUGH), bridges=20, end_cost=50.0)[:, list(GAP)].any()


def test_a_bridge_never_stands_on_what_nobody_saw() -> None:
    assert not searched(room(0), bridges=20, end_cost=50.0)[:, list(GAP)].any()


def test_a_bridge_that_does_not_gain_is_taken_back() -> None:
    evidence = Evidence(GRID, MODEL)
    evidence.extend(room(FREE))
    start = np.zeros(GRID.shape, np.uint8)
    start[WALL, [c for c in range(2, 22) if c not in GAP]] = 1
    evidence.state.maps.occupied[:] = start.ravel()
    evidence.rebuild()
    before = [array.copy() for array in evidence.state.maps]
    cheap = SearchParameters(line_bonus=0.0, end_cost=0.1, isolated_cost=0.0)
    assert bridged(evidence, prior_for(cheap), 10) == (0, 0.0)
    assert evidence.state.clock[0] == 2 * len(GAP), 'it was tried'
    for old, new in zip(before, evidence.state.maps, strict=True):
        assert np.array_equal(old, new)


@pytest.mark.parametrize('step', [(0, 1), (1, 1), (1, 0), (1, -1), (1, 2), (3, 1)])
def test_bridges_lead_in_any_direction(step: tuple[int, int]) -> None:
    # two pieces of a straight wall; nothing is said of the cells between but that they were seen
    evidence = Evidence(GRID, MODEL)
    occupied = np.zeros(GRID.shape, np.uint8)
    reach = np.array([n for n in range(-30, 31) if abs(n) >= 6]) / (3 * max(step))
    for f in reach:
        y, x = 6 + round(f * step[0]), 11 + round(f * step[1])
        if 0 <= y < GRID.height and 0 <= x < GRID.width:
            occupied[y, x] = 1
    maps = evidence.state.maps
    maps.occupied[:], maps.seen[:], maps.pattern[:] = occupied.ravel(), 1, patterns(occupied, GRID.shape)
    flips, gain = bridged(evidence, prior_for(SearchParameters()), 10)
    assert flips > 0
    assert gain > 0
    assert maps.occupied.sum() == occupied.sum() + flips
    assert maps.occupied[6 * GRID.width + 11]


@pytest.mark.parametrize('seed', range(20))
def test_what_bridges_gain_is_told_and_they_stand_where_they_may(seed: int) -> None:
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

    before, told = height(), maps.evidence * QUANTUM
    flips, gain = bridged(evidence, prior, 6)
    assert height() - before == pytest.approx(gain, abs=1e-4)
    built = (maps.occupied == 1) & ~start.ravel()
    assert built.sum() == flips
    assert (maps.occupied[start.ravel()] == 1).all()
    assert (maps.seen[built] > 0).all()
    assert np.array_equal(maps.pattern, patterns(maps.occupied, GRID.shape))
    if flips == 1:
        assert told[built] >= -MOST_AGAINST_CELL


@pytest.mark.parametrize(
    ('gap', 'against', 'resolution', 'stands'),
    [
        (1, 0.99, 0.1, True),
        (1, 1.01, 0.1, False),
        (3, 0.99, 0.1, True),
        (3, 1.01, 0.1, False),
        # 0.25 m
        (5, 0.79, 0.05, True),
        (5, 0.81, 0.05, False),
        # 0.5 m, through which a robot may go
        (5, 0.29, 0.1, True),
        (5, 0.31, 0.1, False),
    ],
)
def test_no_cell_may_have_much_against_it_nor_all_together(
    gap: int, against: float, resolution: float, stands: bool
) -> None:
    assert (MOST_AGAINST_CELL, MOST_AGAINST_GAP, MOST_AGAINST_PASSAGE, PASSAGE) == (1.0, 4.0, 1.5, 0.35)
    evidence = Evidence(dataclasses.replace(GRID, resolution=resolution), MODEL)
    maps = evidence.state.maps
    occupied = np.zeros(GRID.shape, np.uint8)
    occupied[5, 2 : 15 + gap] = 1
    occupied[5, 8 : 8 + gap] = 0
    maps.occupied[:], maps.seen[:], maps.pattern[:] = occupied.ravel(), 1, patterns(occupied, GRID.shape)
    maps.evidence.reshape(GRID.shape)[5, 8 : 8 + gap] = round(-against / QUANTUM)
    flips, gain = bridged(evidence, prior_for(SearchParameters(end_cost=20.0)), 8)
    assert flips == (gap if stands else 0)
    assert (gain > 0) == stands


def test_bridges_stop_when_told() -> None:
    evidence = Evidence(GRID, MODEL)
    evidence.extend(room(FREE))
    evidence.state.stop[0] = 1
    assert close_gaps(evidence.state, prior_for(SearchParameters()), LEAST, np.arange(4), 9) == (0, 0.0)
