"""The prior of a map, compared with sums over all cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import naive
from forward_grid_mapper.core.common.parameter_groups import SearchParameters
from forward_grid_mapper.core.evidence.neighbourhood import (
    EAST,
    NORTH,
    NORTH_WEST,
    SOUTH_EAST,
    SOUTH_WEST,
    WEST,
    neighbour,
    note_flip,
    patterns,
)
from forward_grid_mapper.core.search.prior import (
    Prior,
    independent_prior,
    log_prior,
    odds_given_neighbours,
    prior_gain,
    prior_gains,
    shapes,
    wall_prior,
)
from samples import plain_search

sides = st.tuples(st.integers(1, 5), st.integers(1, 5))
maps = sides.flatmap(lambda shape: arrays.arrays(np.uint8, shape, elements=st.integers(0, 1)))
seeds = st.integers(0, 2**32 - 1)


def random_prior(seed: int, size: int) -> Prior:
    rng = np.random.default_rng(seed)
    return Prior(rng.uniform(-3, 0, size), rng.uniform(-3, 3, 256))


@settings(deadline=None)
@given(maps)
def test_pattern_of_a_cell_has_its_occupied_neighbours(occupied: np.ndarray) -> None:
    actual = patterns(occupied.ravel(), occupied.shape)
    assert actual.tolist() == [naive.pattern_of(occupied, c, occupied.shape) for c in range(occupied.size)]
    for c in range(occupied.size):
        for k, o in naive.neighbours_of(c, occupied.shape).items():
            assert neighbour(c, k, *occupied.shape) == o


@settings(deadline=None)
@given(maps, st.lists(st.integers(0, 24), max_size=12))
def test_updated_patterns_equal_those_made_from_scratch(occupied: np.ndarray, cells: list[int]) -> None:
    shape = occupied.shape
    pattern = patterns(occupied, shape)
    for c in cells:
        if c < occupied.size:
            occupied.ravel()[c] ^= 1
            note_flip(pattern, c, *shape)
    assert np.array_equal(pattern, patterns(occupied, shape))


@pytest.mark.parametrize('shape', [(1, 1), (4, 1), (1, 2), (4, 2)])
def test_patterns_on_grids_of_one_or_two_cells_width(shape: tuple[int, int]) -> None:
    occupied = np.zeros(shape, np.uint8)
    pattern = patterns(occupied, shape)
    occupied[0, 0] = 1
    note_flip(pattern, 0, *shape)
    assert np.array_equal(pattern, patterns(occupied, shape))


@settings(deadline=None)
@given(maps, seeds)
def test_log_prior_is_a_sum_over_occupied_cells_and_gains_its_differences(occupied: np.ndarray, seed: int) -> None:
    shape, flat = occupied.shape, occupied.ravel()
    prior, pattern = random_prior(seed, occupied.size), patterns(occupied, shape)
    before = naive.log_prior(prior, occupied, shape)
    assert log_prior(prior, flat, pattern) == pytest.approx(before, abs=1e-9)
    gains = prior_gains(prior, flat, pattern, shape[1])
    odds = odds_given_neighbours(prior, occupied == 1)
    for c in range(occupied.size):
        changed = occupied.copy()
        changed.ravel()[c] ^= 1
        exact = naive.log_prior(prior, changed, shape) - before
        actual = prior_gain(prior, flat, pattern, c, shape[1])
        assert actual == pytest.approx(exact, abs=1e-9)
        assert naive.prior_gain(prior, occupied, c, shape) == pytest.approx(exact, abs=1e-9)
        assert gains[c] == actual
        assert odds[c] == (-actual if flat[c] else actual)


PARAMETERS = [
    SearchParameters(),
    plain_search(prior=0.2),
    SearchParameters(wall_cost=3.0, end_cost=0.3),
    SearchParameters(prior=0.5),
]


@settings(deadline=None)
@given(maps, st.sampled_from(PARAMETERS))
def test_prior_of_a_turned_or_mirrored_map_is_the_same(occupied: np.ndarray, parameters: SearchParameters) -> None:
    def actual(cells: np.ndarray) -> float:
        prior = wall_prior(parameters, np.zeros(cells.size, bool), 0.1)
        return log_prior(prior, np.ascontiguousarray(cells).ravel(), patterns(cells, cells.shape))

    for other in (occupied[::-1], occupied[:, ::-1], occupied.T, np.rot90(occupied)):
        assert actual(other) == pytest.approx(actual(occupied), abs=1e-9)


def bits(*directions: int) -> int:
    return sum(1 << k for k in directions)


def test_shapes_distinguish_walls_ends_and_dots() -> None:
    actual = shapes(1.5)
    assert actual[0] == -3.0
    for wall in ((EAST, WEST), (NORTH_WEST, SOUTH_EAST), (EAST, SOUTH_WEST), (NORTH, SOUTH_EAST), range(8)):
        assert actual[bits(*wall)] == 0.0
    for end in ((EAST,), (NORTH_WEST,), (EAST, NORTH), (NORTH_WEST, SOUTH_WEST), (NORTH, NORTH_WEST, WEST)):
        assert actual[bits(*end)] == -1.5
    for pattern in range(1, 256):
        angles = [k * math.pi / 4 for k in range(8) if pattern >> k & 1]
        # the bend of the straightest curve that leads from one neighbour through the cell to another
        bend = min(abs(math.remainder(a - b - math.pi, 2 * math.pi)) for a in angles for b in angles)
        assert actual[pattern] == (0.0 if bend < math.pi / 4 + 1e-9 else -1.5)


@pytest.mark.parametrize('resolution', [0.1, 0.05, 0.025])
def test_cost_of_a_wall_is_that_of_length_and_ends_at_any_cell_size(resolution: float) -> None:
    parameters = SearchParameters(wall_cost=0.8, end_cost=1.3)
    for length in (2.0, 0.5, resolution):
        occupied = np.zeros((3, 100), np.uint8)
        occupied[1, 5 : 5 + round(length / resolution)] = 1
        prior = wall_prior(parameters, np.zeros(occupied.size, bool), resolution)
        actual = log_prior(prior, occupied.ravel(), patterns(occupied, occupied.shape))
        assert actual == pytest.approx(-0.8 * length - 2 * 1.3)


def test_without_cost_of_ends_cells_are_independent() -> None:
    parameters, traversed = plain_search(prior=0.2, wall_cost=5.0), np.zeros(6, bool)
    for prior in (wall_prior(parameters, traversed, 0.1), independent_prior(parameters, traversed)):
        assert not prior.shape.any()
        assert prior.local == pytest.approx(math.log(0.2 / 0.8))


def test_prior_of_a_traversed_cell_forbids_occupying_it() -> None:
    traversed = np.array([True, False, False, False, False, True])
    parameters = SearchParameters(prior=0.3, wall_cost=1.0)
    for prior, odds in (
        (independent_prior(parameters, traversed), math.log(0.3 / 0.7)),
        (wall_prior(parameters, traversed, 0.2), -0.2),
    ):
        assert prior.local[~traversed] == pytest.approx(odds)
        assert (prior.local[traversed] < -1e5).all()
        assert np.isfinite(0.0 * prior.local).all()
