"""Choosing and making shifts, compared with plain Python and with evaluations of whole maps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from move_cases import GRID, PRIORS, height, model_of, neighbours, prior_of, random_case, seeds

import naive
from forward_grid_mapper.core.evidence.cell_flip import flip
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.neighbourhood import patterns
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.search.search import LEAST
from forward_grid_mapper.core.search.shifts import (
    BATCH,
    best_shifts,
    mark_observing,
    ratio_batch,
    shift_in_order,
    try_shifts,
    unsettle,
)
from forward_grid_mapper.core.sensor.forward_model import expectations


def joints(evidence: Evidence, cells: np.ndarray, readings: np.ndarray | None = None) -> np.ndarray:
    slot = np.full(GRID.size, -1, np.int32)
    slot[cells] = np.arange(len(cells))
    place, joint = np.full(GRID.size, -1, np.int32), np.zeros(len(cells) * 8, np.int64)
    which = np.arange(len(evidence)) if readings is None else readings
    try_shifts(evidence.state, which, slot, place, ratio_batch(), joint)
    assert (place == -1).all()
    return joint.reshape(-1, 8)


def positions(evidence: Evidence, t: int, c: int, o: int) -> str:
    """Position of the two cells of a shift in the cone of reading t."""
    free, band, _, _ = naive.pairs_of(evidence.state, t)
    places = ['free' if k in free else 'band' if k in band else 'off' for k in (c, o)]
    if places == ['band', 'band']:
        places.append('behind' if band.index(o) > band.index(c) else 'before')
    return ' '.join(places)


@pytest.mark.parametrize('filled', [0.02, 0.15, 0.6])
def test_joint_gain_of_a_reading_is_the_difference_of_two_evaluations(filled: float) -> None:
    tried: dict[str, int] = {}
    for seed in range(12):
        evidence, readings = random_case(seed, 12, filled=filled)
        maps = evidence.state.maps
        cells = np.flatnonzero(maps.occupied)[:12]
        for t in range(len(readings)):
            one = readings.select(slice(t, t + 1))
            free, band, _, logs = naive.pairs_of(evidence.state, t)
            reading_state = evidence.state.reading_states[t]
            single = dict(zip(band, logs, strict=True))
            single |= {c: reading_state['release' if maps.occupied[c] else 'occupy'] for c in free}
            joint = joints(evidence, cells, np.array([t]))

            def evaluate(*changes: int) -> float:
                changed = maps.occupied.copy()  # noqa: B023
                changed[list(changes)] ^= 1
                shaped = changed.reshape(GRID.shape)
                return float(expectations(one, GRID, shaped, model_of(evidence)).log_likelihood[0])  # noqa: B023

            before = evaluate()
            for i, c in enumerate(cells.tolist()):
                for o in neighbours(c):
                    if maps.occupied[o]:
                        continue
                    k = next(k for k, other in naive.neighbours_of(c, GRID.shape).items() if other == o)
                    actual = (int(single.get(c, 0)) + int(single.get(o, 0)) + int(joint[i, k])) * QUANTUM
                    # both ratios are rounded, which matters more the less likely the shift makes the reading
                    exact = evaluate(c, o) - before
                    ratios = [math.exp(int(single.get(k, 0)) * QUANTUM) for k in (c, o)]
                    error = 2e-7 * (1 + (ratios[0] + ratios[1] / (1 - model_of(evidence).p_hit)) / math.exp(exact))
                    assert actual == pytest.approx(exact, abs=error), positions(evidence, t, c, o)
                    place = positions(evidence, t, c, o)
                    tried[place] = tried.get(place, 0) + 1
    wanted = {'band band behind', 'band band before', 'free free', 'free band', 'band free', 'off off'}
    wanted |= {'off band', 'band off', 'off free', 'free off'}
    assert set(tried) == wanted


@pytest.mark.parametrize('memory', [math.inf, 0.0])
@pytest.mark.parametrize('filled', [0.15, 0.6])
def test_joint_gains_of_more_ratios_than_a_batch_are_the_sums_over_single_readings(
    filled: float, memory: float
) -> None:
    evidence, readings = random_case(1, 400, memory, filled)
    cells = np.flatnonzero(evidence.state.maps.occupied)
    single = [joints(evidence, cells, np.array([t])) for t in range(len(readings))]
    assert sum(np.count_nonzero(joint) for joint in single) > 2 * BATCH
    assert np.array_equal(joints(evidence, cells), sum(single))


@pytest.mark.parametrize('memory', [math.inf, 0.0])
@pytest.mark.parametrize('seed', range(10))
@PRIORS
def test_best_shifts_are_those_found_by_brute_force(seed: int, memory: float, prior: Prior) -> None:
    evidence, readings = random_case(seed, memory=memory)
    maps = evidence.state.maps
    cells = np.flatnonzero((maps.occupied == 1) & (maps.seen > 0))
    kept = maps.occupied.copy()
    targets, gains = best_shifts(evidence.state, prior, LEAST, cells, joints(evidence, cells))
    assert np.array_equal(maps.occupied, kept)
    assert np.array_equal(maps.pattern, patterns(kept, GRID.shape))
    before = height(evidence, readings, prior)
    for c, target, actual in zip(cells.tolist(), targets.tolist(), gains.tolist(), strict=True):
        exact = {}
        for o in neighbours(c):
            if not maps.occupied[o] and maps.seen[o]:
                maps.occupied[[c, o]] ^= 1
                exact[o] = height(evidence, readings, prior) - before
                maps.occupied[[c, o]] ^= 1
        best = max(exact.values(), default=-1.0)
        if target < 0:
            assert best < 1e-3
            assert actual == 0
        else:
            assert exact[target] == pytest.approx(actual, abs=1e-4)
            assert exact[target] == pytest.approx(best, abs=1e-4)
    assert (targets >= 0).any()


@pytest.mark.parametrize('seed', range(4))
def test_joint_gain_of_weight_three_equals_that_of_three_readings(seed: int) -> None:
    heavy, readings = random_case(seed)
    heavy.add_multiplicity(np.repeat(np.arange(len(readings)), 2))
    thrice = Evidence(GRID, model_of(heavy), start=heavy.state.maps.occupied.reshape(GRID.shape))
    thrice.extend(readings.select(np.repeat(np.arange(len(readings)), 3)))
    cells = np.flatnonzero(heavy.state.maps.occupied)
    assert np.array_equal(joints(heavy, cells), joints(thrice, cells))


@pytest.mark.parametrize('seed', range(4))
def test_joint_gains_of_parts_add_up_with_and_without_stored_pairs(seed: int) -> None:
    evidence, _ = random_case(seed)
    cells = np.flatnonzero(evidence.state.maps.occupied)
    whole = joints(evidence, cells)
    half = [joints(evidence, cells, part) for part in (np.arange(13), np.arange(13, len(evidence)))]
    assert np.array_equal(whole, sum(half))
    for memory in (0.0, 3000.0):
        assert np.array_equal(whole, joints(random_case(seed, memory=memory)[0], cells))


@pytest.mark.parametrize('seed', range(10))
@PRIORS
def test_shifts_in_order_stop_without_gain_and_return_the_total_gain(seed: int, prior: Prior) -> None:
    evidence, readings = random_case(seed)
    maps = evidence.state.maps
    cells = np.flatnonzero((maps.occupied == 1) & (maps.seen > 0))
    targets, gains = best_shifts(evidence.state, prior, LEAST, cells, joints(evidence, cells))
    order = np.argsort(-gains, kind='stable')[: int((targets >= 0).sum())]
    start = before = height(evidence, readings, prior)
    old = maps.occupied.copy()
    moves, total = 0, 0.0
    for k in order:
        made, actual = shift_in_order(evidence.state, prior, LEAST, cells[[k]], targets[[k]])
        after = height(evidence, readings, prior)
        assert after - before == pytest.approx(actual, abs=1e-4)
        assert (actual > 0) == (made == 1)
        moves, total, before = moves + made, total + actual, after
    assert moves > 0
    assert maps.occupied.sum() == old.sum()
    assert before - start == pytest.approx(total, abs=1e-3)
    twin, _ = random_case(seed)
    at_once = shift_in_order(twin.state, prior, LEAST, cells[order], targets[order])
    assert at_once == (moves, pytest.approx(total))
    assert np.array_equal(twin.state.maps.occupied, maps.occupied)
    assert np.array_equal(twin.state.maps.evidence, maps.evidence)


def test_shifts_from_free_cells_or_onto_occupied_cells_are_skipped() -> None:
    evidence, _ = random_case(1)
    occupied, free = (np.flatnonzero(evidence.state.maps.occupied == v) for v in (1, 0))
    before = evidence.state.maps.occupied.copy()
    for cells, targets in ((free[:5], free[5:10]), (occupied[:5], occupied[5:10])):
        assert shift_in_order(evidence.state, prior_of('none'), LEAST, cells, targets) == (0, 0.0)
    assert np.array_equal(evidence.state.maps.occupied, before)


@settings(max_examples=25, deadline=None)
@given(seeds, st.lists(st.integers(0, GRID.size - 1), min_size=1, max_size=4), st.sampled_from([math.inf, 0.0]))
def test_readings_that_see_a_flip_are_found_and_their_cells_unsettled(
    seed: int, cells: list[int], memory: float
) -> None:
    evidence, readings = random_case(seed, 25, memory=memory)
    stored, _ = random_case(seed, 25)
    flip(evidence.state, 5)
    since = int(evidence.state.clock[0])
    for c in cells:
        flip(evidence.state, c)
    seen_by = [set().union(*naive.pairs_of(stored.state, t)[:2]) for t in range(len(readings))]
    sees = np.zeros(len(readings), np.uint8)
    mark_observing(evidence.state, np.array(cells), sees)
    assert sees.tolist() == [int(bool(seen & set(cells))) for seen in seen_by]
    settled = np.ones(GRID.size, np.uint8)
    unsettle(evidence.state, since, settled)
    unsettled = set().union(*(seen for seen in seen_by if seen & set(cells)))
    assert set(np.flatnonzero(settled == 0).tolist()) == unsettled


def test_stop_flag_ends_shifts() -> None:
    evidence, _ = random_case(1)
    occupied = np.flatnonzero(evidence.state.maps.occupied)
    before = evidence.state.maps.occupied.copy()
    evidence.state.stop[0] = 1
    assert not joints(evidence, occupied).any()
    assert shift_in_order(evidence.state, prior_of('none'), LEAST, occupied, occupied + 1) == (0, 0.0)
    assert np.array_equal(evidence.state.maps.occupied, before)
