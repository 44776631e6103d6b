"""Choosing and making flips, compared with plain Python and with evaluations of whole maps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from move_cases import GRID, PRIORS, gain, height, neighbours, prior_of, random_case, seeds

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.evidence.cell_flip import flip
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.state import BLOCK_SHIFT
from forward_grid_mapper.core.search.flips import (
    WORTH_WAITING,
    any_above,
    flip_in_order,
    free_unneeded,
    highest,
    promising,
)
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.search.search import LEAST
from samples import plain_model, random_readings

NOTHING = (0.0, 0.0)
WHOLE = (0, GRID.height, 0, GRID.width)


def listed(
    evidence: Evidence, prior: Prior, least: tuple[float, float] = LEAST, window: tuple[int, int, int, int] = WHOLE
) -> tuple[np.ndarray, np.ndarray]:
    cells, gains = np.empty(GRID.size, np.int64), np.empty(GRID.size)
    evidence.state.maps.touched[:] = 1
    n = promising(evidence.state, prior, least, window, cells, gains)
    return cells[:n], gains[:n]


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('name', ['none', 'less', 'shapes'])
def test_promising_cells_are_those_with_a_gain(seed: int, name: str) -> None:
    prior = prior_of(name)
    evidence, _ = random_case(seed)
    least = (0.01, 0.002)
    seen = evidence.state.maps.seen
    cells, gains = listed(evidence, prior, least)
    assert cells.tolist() == [
        c for c in range(GRID.size) if seen[c] and gain(evidence, prior, c) > least[0] + least[1] * int(seen[c])
    ]
    assert gains.tolist() == [gain(evidence, prior, c) for c in cells]
    assert len(cells) > 0
    for bottom, top, left, right in ((2, 5, 3, 11), (0, 9, 4, 4), (8, 9, 0, 12)):
        inside = [c for c in cells if bottom <= c // GRID.width < top and left <= c % GRID.width < right]
        assert listed(evidence, prior, least, (bottom, top, left, right))[0].tolist() == inside


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('name', ['none', 'less', 'shapes'])
def test_promising_cells_of_an_empty_map_are_found_at_any_threshold(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    prior = prior_of(name)
    evidence, _ = random_case(seed)
    maps, least = evidence.state.maps, (0.01, 0.0)
    maps.occupied[:] = maps.pattern[:] = 0
    needed = (least[0] - prior.local - prior.shape[0]) / QUANTUM
    maps.evidence[:] = np.rint(needed) + rng.integers(-3, 4, GRID.size)
    maps.evidence[rng.random(GRID.size) < 0.9] = -(1 << 40)
    expected = [c for c in range(GRID.size) if maps.seen[c] and gain(evidence, prior, c) > least[0]]
    assert listed(evidence, prior, least)[0].tolist() == expected


@pytest.mark.parametrize('seed', range(5))
def test_flip_touches_the_blocks_of_all_cells_whose_gain_may_change(seed: int) -> None:
    rng, area = np.random.default_rng(seed), Grid(0.1, 0, 0, 70, 50)
    evidence = Evidence(area, plain_model(), start=rng.random(area.shape) < 0.1)
    evidence.extend(random_readings(rng, area, 60, z_max=2.0))
    maps, parts = evidence.state.maps, []
    rows, columns = np.indices(area.shape)
    for c in rng.choice(area.size, 30, replace=False):
        before = maps.evidence.copy()
        maps.touched[:] = 0
        flip(evidence.state, int(c))
        row, column = divmod(int(c), area.width)
        # the prior of a cell depends on the patterns of its neighbours
        near = (np.abs(rows - row) <= 2) & (np.abs(columns - column) <= 2)
        assert maps.touched[np.flatnonzero((maps.evidence != before) | near.ravel()) >> BLOCK_SHIFT].all()
        parts.append(maps.touched.mean())
    assert 0 < min(parts) < max(parts) < 1


def test_only_touched_blocks_of_the_window_are_searched_and_are_not_touched_then() -> None:
    evidence, _ = random_case(0)
    prior, maps = prior_of('none'), evidence.state.maps
    every, _ = listed(evidence, prior)
    assert {*(every >> BLOCK_SHIFT).tolist()} == {0, 1}
    assert not maps.touched.any()
    cells = np.empty(GRID.size, np.int64)
    maps.touched[1] = 1
    n = promising(evidence.state, prior, LEAST, WHOLE, cells, np.empty(GRID.size))
    assert cells[:n].tolist() == every[every >> BLOCK_SHIFT == 1].tolist()
    maps.touched[:] = 1
    promising(evidence.state, prior, LEAST, (0, 2, 0, GRID.width), cells, np.empty(GRID.size))
    assert maps.touched.tolist() == [0, 1]


@pytest.mark.parametrize('seed', range(20))
def test_any_above_finds_blocks_with_promising_or_occupied_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, floor = 200, np.int64(rng.integers(-5, 5))
    evidence = rng.integers(floor - 6, floor + 2, size)
    occupied, pattern = ((rng.random(size) < 0.03).astype(np.uint8) * np.uint8(k) for k in (1, 64))
    for _ in range(50):
        begin, end = sorted(rng.integers(0, size, 2).tolist())
        some = any(evidence[c] > floor or occupied[c] or pattern[c] for c in range(begin, end))
        assert any_above(evidence, occupied, pattern, floor, begin, end) == some


@pytest.mark.parametrize('seed', range(10))
@PRIORS
def test_local_maxima_are_cells_with_no_better_neighbour(seed: int, prior: Prior) -> None:
    evidence, _ = random_case(seed)
    # make ties
    evidence.state.maps.evidence[:] = evidence.state.maps.evidence >> 23 << 23
    cells, gains = listed(evidence, prior, NOTHING)
    room = np.zeros(GRID.size)
    actual = cells[highest(evidence.state, cells, gains, room)].tolist()
    assert not room.any()
    expected = []
    for c in cells:
        rivals = [(gain(evidence, prior, o), -o) for o in neighbours(c) if o in cells]
        if all((gain(evidence, prior, c), -c) > rival for rival in rivals):
            expected.append(int(c))
    assert actual == expected
    assert len(actual) > 0
    assert not any(set(neighbours(c)) & set(actual) for c in actual), 'no two that are neighbours'


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('memory', [math.inf, 0.0])
@PRIORS
def test_flips_in_order_stop_without_gain_and_return_the_total_gain(seed: int, memory: float, prior: Prior) -> None:
    evidence, readings = random_case(seed, memory=memory)
    twin, _ = random_case(seed)
    cells, gains = listed(evidence, prior)
    order = np.argsort(-gains, kind='stable')
    before = height(evidence, readings, prior)
    flips, total = flip_in_order(evidence.state, prior, LEAST, cells[order], gains[order])
    assert height(evidence, readings, prior) - before == pytest.approx(total, abs=1e-6 * len(readings) * max(flips, 1))
    made, expected = 0, 0.0
    for c, at_first in zip(cells[order].tolist(), gains[order].tolist(), strict=True):
        now = gain(twin, prior, c)
        if now > LEAST[0] + LEAST[1] * twin.state.maps.seen[c] and now > WORTH_WAITING * at_first:
            flip(twin.state, c)
            made, expected = made + 1, expected + now
    assert (flips, total) == (made, expected)
    assert np.array_equal(evidence.state.maps.occupied, twin.state.maps.occupied)


@settings(deadline=None)
@given(seeds, st.sampled_from([0.0, 0.001, 0.1]))
def test_unneeded_occupied_cells_are_freed_one_after_the_other(seed: int, rounding: float) -> None:
    evidence, _ = random_case(seed, filled=0.4)
    twin, _ = random_case(seed, filled=0.4)
    prior, occupied = prior_of('none'), np.flatnonzero(evidence.state.maps.occupied)
    made, expected = 0, 0.0
    for c in occupied.tolist():
        now = gain(twin, prior, c)
        if twin.state.maps.seen[c] and now >= -min(rounding * twin.state.maps.seen[c], 0.1):
            flip(twin.state, c)
            made, expected = made + 1, expected + now
    assert free_unneeded(evidence.state, prior, (0.2, rounding), occupied) == (made, expected)
    assert np.array_equal(evidence.state.maps.occupied, twin.state.maps.occupied)


def test_stop_flag_ends_flips() -> None:
    evidence, _ = random_case(1)
    cells, gains = listed(evidence, prior_of('none'))
    before = evidence.state.maps.occupied.copy()
    evidence.state.stop[0] = 1
    assert flip_in_order(evidence.state, prior_of('none'), LEAST, cells, gains) == (0, 0.0)
    assert np.array_equal(evidence.state.maps.occupied, before)
