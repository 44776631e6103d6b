"""Evidence (the gain of flipping each cell), compared with evaluations of whole maps."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import GridParameters, ModelParameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.cell_flip import _zone, find_observing, flip
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.evidence.indexing import ALLOCATED_WORDS, reading_state_table
from forward_grid_mapper.core.runtime import threads
from forward_grid_mapper.core.search.flips import gain_of
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.search.search import ROUNDING
from forward_grid_mapper.core.sensor.cone_table import grid_of
from forward_grid_mapper.core.sensor.density import CUT, causes_of
from forward_grid_mapper.core.sensor.forward_model import expectations
from samples import plain_model, random_readings

GRID = Grid(0.1, -4, 7, 12, 9)
WIDE = Grid(0.1, -7, 12, 41, 33)
MODEL = plain_model(p_hit=0.6, p_rand=0.1, p_lost=0.1, sigma=0.06)
OFF = ROUNDING + 3e-8
"""Largest error of a log, in nats."""

SOME = [naive.awkward_readings, random_readings]
seeds = st.integers(0, 2**32 - 1)


def random_model(rng: np.random.Generator) -> ModelParameters:
    return plain_model(
        p_hit=rng.choice([0.05, 0.6, 0.98, rng.uniform(0.01, 0.98)]),
        p_rand=rng.choice([1e-4, 0.1, 0.4]),
        p_lost=rng.choice([0.0, 0.25]),
        sigma=rng.uniform(0.01, 0.3),
    )


def random_case(seed: int, count: int = 60) -> tuple[Readings, ModelParameters, np.ndarray]:
    rng = np.random.default_rng(seed)
    readings = SOME[seed % 2](rng, GRID, count)
    occupied = (rng.random(GRID.size) < rng.choice([0.0, 0.1, 0.5, 1.0])).astype(np.uint8)
    return readings, random_model(rng), occupied


def without_ties(readings: Readings, model: ModelParameters) -> Readings:
    """The readings for which rounding does not decide whether a cell is in the cone or within the cut of the noise."""
    kept = []
    for t in range(len(readings)):
        away = naive.cells_of(readings, t, GRID, model, 1e-9)
        width = CUT * naive.sigma_of(readings, t, GRID, model)
        cut = any(abs(abs(readings.z[t] - d) - width) < 1e-9 for d in [*away.values(), readings.z_max[t]])
        if not cut and set(away) == set(naive.cells_of(readings, t, GRID, model, -1e-9)):
            kept.append(t)
    assert len(kept) > 8
    return readings.select(np.array(kept))


def evidence_of(readings: Readings, model: ModelParameters, occupied: np.ndarray, **options: object) -> Evidence:
    grid = options.pop('grid', GRID)
    made = Evidence(grid, model, start=occupied.reshape(grid.shape), **options)
    made.extend(readings)
    return made


def snapshot(evidence: Evidence, logs: bool = True) -> list[object]:
    """The whole state of readings and cells, except when they changed and where they are stored."""
    s, n = evidence.state, len(evidence)
    kept = (
        'floor',
        'max_range',
        'through',
        'runs',
        'bands',
        'blocking',
        'multiplicity',
        'occupy',
        'release',
        'likelihood',
    )
    reading_states = [s.reading_states[name][:n].tolist() for name in kept]
    stored = [naive.pairs_of(s, t) for t in range(n) if s.reading_states[t]['stored']] if logs else []
    return [*(array.tolist() for array in s.maps), *reading_states, stored, evidence.log_likelihood]


def rebuilt(evidence: Evidence, readings: Readings, model: ModelParameters) -> Evidence:
    return evidence_of(readings, model, evidence.state.maps.occupied)


@pytest.mark.parametrize('seed', range(24))
def test_each_log_is_the_difference_of_two_evaluations_of_its_reading(seed: int) -> None:
    readings, model, occupied = random_case(seed)
    readings = without_ties(readings, model)
    evidence = evidence_of(readings, model, occupied)
    state = evidence.state
    for t in range(len(readings)):
        away = naive.cells_of(readings, t, GRID, model)
        z, z_max, sigma = readings.z[t], readings.z_max[t], naive.sigma_of(readings, t, GRID, model)

        def evaluate(cells: np.ndarray) -> float:
            met = [d for c, d in away.items() if cells[c]]  # noqa: B023
            return math.log(naive.likelihood(z, z_max, sigma, met, model))  # noqa: B023

        before = evaluate(occupied)
        reading_state = state.reading_states[t]
        assert reading_state['likelihood'] * QUANTUM == pytest.approx(before, abs=OFF)
        free, band, _, logs = naive.pairs_of(state, t)
        actual = dict(zip(band, logs, strict=True))
        actual |= {c: reading_state['release' if occupied[c] else 'occupy'] for c in free}
        assert set(actual) == set(away)
        for c, log in actual.items():
            changed = occupied.copy()
            changed[c] ^= 1
            assert log * QUANTUM == pytest.approx(evaluate(changed) - before, abs=2e-7 + OFF)
        assert reading_state['blocking'] == occupied[free].sum()


@pytest.mark.parametrize('seed', range(24))
def test_evidence_of_each_cell_is_the_gain_of_flipping_it(seed: int) -> None:
    readings, model, occupied = random_case(seed)
    readings = without_ties(readings, model)
    evidence = evidence_of(readings, model, occupied)
    maps = evidence.state.maps

    def evaluate(cells: np.ndarray) -> float:
        return float(expectations(readings, GRID, cells.reshape(GRID.shape), model).log_likelihood.sum())

    prior = Prior(np.full(GRID.size, -2.0), np.zeros(256))
    before = evaluate(occupied)
    assert evidence.log_likelihood == pytest.approx(before, abs=1e-6 * len(readings))
    each = expectations(readings, GRID, occupied.reshape(GRID.shape), model).log_likelihood
    ours = evidence.state.reading_states['likelihood'][: len(evidence)] * QUANTUM
    assert np.abs(ours - each).max() < OFF
    for c in range(GRID.size):
        changed = occupied.copy()
        changed[c] ^= 1
        gain = evaluate(changed) - before
        assert maps.evidence[c] * QUANTUM == pytest.approx(gain, abs=3e-7 * maps.seen[c] + 1e-9)
        assert gain_of(evidence.state, prior, c) - maps.evidence[c] * QUANTUM == (2.0 if occupied[c] else -2.0)


@pytest.mark.parametrize('some', SOME)
def test_map_independent_causes_are_those_of_the_forward_model(some: object) -> None:
    readings, model = some(np.random.default_rng(0), GRID, 100), MODEL
    sigma = np.array([naive.sigma_of(readings, t, GRID, model) for t in range(len(readings))])
    reading_states = reading_state_table(readings, sigma, model, GRID.resolution)
    causes = causes_of(readings, sigma, model, GRID.resolution)
    assert reading_states['floor'] == pytest.approx(causes.random + causes.lost)
    assert np.array_equal(reading_states['max_range'], causes.max_range)
    assert (reading_states['multiplicity'] == 1).all()


@pytest.mark.parametrize('some', SOME)
@pytest.mark.parametrize('grid', [WIDE, Grid(0.25, 0, 0, 9, 20)], ids=['fine', 'coarse'])
def test_observing_readings_of_a_cell_are_those_whose_cone_has_it(some: object, grid: Grid) -> None:
    readings = some(np.random.default_rng(1), grid, 250)
    model = plain_model(sigma=0.03)
    evidence = evidence_of(readings, model, np.zeros(grid.size, np.uint8), grid=grid)
    state = evidence.state
    expected: list[dict[int, int]] = [{} for _ in range(grid.size)]
    for t in range(len(readings)):
        free, band, _, _ = naive.pairs_of(state, t)
        for zone, cells in ((1, band), (2, free)):
            for c in cells:
                expected[c][t] = zone
    for c in range(grid.size):
        n = find_observing(state, c)
        assert n == len(expected[c]) == state.maps.seen[c]
        assert {int(t): int(zone) + 1 for t, zone in state.observing[:n]} == expected[c]
    zones = [[_zone(cone, state.lattice, *divmod(c, grid.width)) for c in range(grid.size)] for cone in state.cones]
    assert zones == [[observing.get(t, 0) for observing in expected] for t in range(len(readings))]


@settings(max_examples=60, deadline=None)
@given(seeds, st.lists(st.integers(0, GRID.size - 1), max_size=25), st.sampled_from([math.inf, 0, 4000]))
def test_state_after_flips_equals_a_state_built_from_the_new_map(seed: int, cells: list[int], memory: float) -> None:
    readings, model, occupied = random_case(seed, 40)
    evidence = evidence_of(readings, model, occupied, memory=memory)
    for c in cells:
        flip(evidence.state, c)
        occupied[c] ^= 1
    assert np.array_equal(evidence.state.maps.occupied, occupied)
    fresh = evidence_of(readings, model, occupied, memory=memory)
    assert snapshot(evidence) == snapshot(fresh)
    evidence.rebuild()
    assert snapshot(evidence) == snapshot(fresh)
    assert evidence.state.clock[0] == len(cells)


@settings(max_examples=80, deadline=None)
@given(seeds, st.lists(st.sets(st.integers(0, GRID.size - 1), max_size=30), max_size=4), st.sampled_from([math.inf, 0]))
def test_state_after_flips_at_once_equals_one_built_from_the_new_map(
    seed: int, sets: list[set[int]], memory: float
) -> None:
    readings, model, occupied = random_case(seed, 40)
    evidence = evidence_of(readings, model, occupied, memory=memory)
    evidence.add_multiplicity(np.arange(0, 40, 3))
    for cells in sets:
        evidence.flip(np.array(sorted(cells), np.int64))
        occupied[list(cells)] ^= 1
    fresh = evidence_of(readings, model, occupied, memory=memory)
    fresh.add_multiplicity(np.arange(0, 40, 3))
    assert snapshot(evidence) == snapshot(fresh)


def test_flips_at_once_evaluate_only_readings_that_see_them() -> None:
    readings = random_readings(np.random.default_rng(2), GRID, 50)
    evidence = evidence_of(readings, MODEL, np.zeros(GRID.size, np.uint8))
    evidence.state.clock[0] = 7
    evidence.flip(np.array([50, 3]))
    observing = {int(t) for c in (50, 3) for t in evidence.state.observing[: find_observing(evidence.state, c), 0]}
    assert 0 < len(observing) < 50
    assert set(np.flatnonzero(evidence.state.reading_states['changed'] == 7)) == observing


@settings(max_examples=40, deadline=None)
@given(seeds, st.lists(st.integers(0, GRID.size - 1), max_size=10), st.booleans())
def test_flipping_cells_twice_restores_the_state(seed: int, cells: list[int], backwards: bool) -> None:
    readings, model, occupied = random_case(seed, 40)
    evidence = evidence_of(readings, model, occupied)
    before = snapshot(evidence)
    for c in [*cells, *(cells[::-1] if backwards else cells)]:
        flip(evidence.state, c)
    assert snapshot(evidence) == before


def test_flip_marks_the_readings_that_it_changed() -> None:
    readings = random_readings(np.random.default_rng(2), GRID, 50)
    evidence = evidence_of(readings, MODEL, np.zeros(GRID.size, np.uint8))
    for now, c in enumerate((50, 3, 50), 1):
        before = evidence.state.reading_states['changed'].copy()
        flip(evidence.state, c)
        sees = np.zeros(len(readings), bool)
        sees[evidence.state.observing[: find_observing(evidence.state, c), 0]] = True
        assert np.array_equal(evidence.state.reading_states['changed'], np.where(sees, now, before))


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('part', [0.0, 0.3, 0.9])
def test_state_does_not_depend_on_how_many_readings_are_stored(seed: int, part: float) -> None:
    readings, model, occupied = random_case(seed, 150)
    whole = evidence_of(readings, model, occupied)
    words = int(whole._totals[ALLOCATED_WORDS])
    less = evidence_of(readings, model, occupied, memory=part * 4 * words)
    assert whole.unstored == 0 < less.unstored
    assert less.unstored < len(readings) or part == 0.0
    assert sum(less.state.reading_states['stored']) == len(less) - less.unstored
    assert less.state.pairs.cell.nbytes <= part * 4 * words
    assert less.nbytes < whole.nbytes
    for c in np.random.default_rng(seed).permutation(GRID.size)[:20]:
        flip(whole.state, c)
        flip(less.state, c)
    assert snapshot(less, logs=False) == snapshot(whole, logs=False)
    assert less.pairs == whole.pairs


@pytest.mark.parametrize('cuts', [[50], [1, 2, 3, 60], [0, 99, 100]])
@pytest.mark.parametrize('memory', [math.inf, 6000.0, 0.0])
def test_readings_in_portions_give_the_state_of_all_at_once(cuts: list[int], memory: float) -> None:
    readings, model, occupied = random_case(8, 100)
    whole = evidence_of(readings, model, occupied, memory=memory)
    parts = Evidence(GRID, model, memory=memory, start=occupied.reshape(GRID.shape))
    for part in np.split(np.arange(100), cuts):
        parts.extend(readings.select(part))
    assert snapshot(parts) == snapshot(whole)
    assert len(parts) == len(whole) == 100
    assert (parts.pairs, parts.unstored) == (whole.pairs, whole.unstored)


def test_readings_in_portions_stay_within_the_memory_limit() -> None:
    readings, model, _ = random_case(8, 100)
    evidence = Evidence(GRID, model, memory=6000.0)
    for part in np.split(np.arange(100), 10):
        evidence.extend(readings.select(part))
        assert evidence.state.pairs.cell.nbytes <= 6000


def test_readings_added_after_flips_give_the_state_of_the_new_map() -> None:
    readings, model, occupied = random_case(9, 100)
    evidence = evidence_of(readings.select(slice(0, 60)), model, np.zeros(GRID.size, np.uint8))
    for c in np.flatnonzero(occupied):
        flip(evidence.state, c)
    evidence.extend(readings.select(slice(60, 100)))
    assert snapshot(evidence) == snapshot(evidence_of(readings, model, occupied))


@pytest.mark.parametrize('memory', [math.inf, 3000.0])
@pytest.mark.parametrize('workers', [2, 3, 8])
def test_number_of_threads_does_not_change_the_state(
    monkeypatch: pytest.MonkeyPatch, memory: float, workers: int
) -> None:
    readings, model, occupied = random_case(10, 101)
    one = evidence_of(readings, model, occupied, memory=memory)
    monkeypatch.setattr(threads, 'LEAST_PART', 7)
    assert len(threads.parts(0, 101, workers)) == workers
    many = evidence_of(readings, model, occupied, memory=memory, threads=workers)
    assert snapshot(many) == snapshot(one)
    for evidence in (one, many):
        evidence.state.maps.occupied[::3] ^= 1
        evidence.rebuild()
    assert snapshot(many) == snapshot(one)
    for evidence in (one, many):
        evidence.flip(np.arange(0, GRID.size, 5))
    assert snapshot(many) == snapshot(one)


@pytest.mark.parametrize('memory', [math.inf, 0.0])
@pytest.mark.parametrize('seed', [12, 13])
def test_reading_of_weight_three_equals_three_readings(seed: int, memory: float) -> None:
    readings, model, occupied = random_case(seed, 40)
    thrice = evidence_of(readings.select(np.repeat(np.arange(40), 3)), model, occupied)
    heavy = evidence_of(readings, model, occupied, memory=memory)
    heavy.add_multiplicity(np.repeat(np.arange(40), 2))
    assert (heavy.state.reading_states['multiplicity'] == 3).all()
    for c in range(0, GRID.size, 5):
        assert np.array_equal(heavy.state.maps.evidence, thrice.state.maps.evidence)
        assert np.array_equal(heavy.state.maps.seen, thrice.state.maps.seen)
        assert heavy.log_likelihood == thrice.log_likelihood
        flip(heavy.state, c)
        flip(thrice.state, c)
    actual = heavy.state.maps.evidence.copy()
    heavy.rebuild()
    assert np.array_equal(heavy.state.maps.evidence, actual)


def test_readings_that_gain_weight_are_marked_as_changed() -> None:
    readings, model, occupied = random_case(14, 10)
    evidence = evidence_of(readings, model, occupied)
    flip(evidence.state, 0)
    flip(evidence.state, 0)
    before = evidence.state.reading_states['changed'].copy()
    evidence.add_multiplicity(np.array([3, 7, 3]))
    assert evidence.state.reading_states['multiplicity'].tolist() == [1, 1, 1, 3, 1, 1, 1, 2, 1, 1]
    before[[3, 7]] = 2
    assert np.array_equal(evidence.state.reading_states['changed'], before)


@pytest.mark.parametrize('seed', [0, 1, 2, 3, 5, 7])
@pytest.mark.parametrize('memory', [math.inf, 4000.0, 0.0])
def test_state_on_a_grown_grid_equals_that_on_a_large_grid(seed: int, memory: float) -> None:
    readings, model, _ = random_case(seed, 120)
    early, late = readings.select(slice(0, 80)), readings.select(slice(80, 120))
    box = grid_of(early, model, GridParameters())
    small = Grid(0.1, box.column - 3, box.row - 5, box.width + 6, box.height + 7)
    large = Grid(0.1, small.column - 24, small.row - 16, small.width + 37, small.height + 41)
    grown = evidence_of(early, model, np.zeros(small.size, np.uint8), grid=small, memory=memory)
    whole = evidence_of(early, model, np.zeros(large.size, np.uint8), grid=large, memory=memory)
    rng = np.random.default_rng(seed)
    for c in rng.permutation(small.size)[:10]:
        flip(grown.state, c)
        flip(whole.state, large.width * (c // small.width + 16) + c % small.width + 24)
    grown.grow(large)
    assert grown.grid == large
    for c in rng.permutation(large.size)[:30]:
        flip(grown.state, c)
        flip(whole.state, c)
    for evidence in (grown, whole):
        evidence.extend(late)
    assert snapshot(grown) == snapshot(whole)
    found = [
        [evidence.state.observing[: find_observing(evidence.state, c)].tolist() for c in range(large.size)]
        for evidence in (grown, whole)
    ]
    assert found[0] == found[1]


def test_cells_that_no_reading_sees_are_unknown() -> None:
    readings, model = random_readings(np.random.default_rng(3), WIDE, 4), MODEL
    occupied = np.ones(WIDE.size, np.uint8)
    evidence = evidence_of(readings, model, occupied, grid=WIDE)
    seen = set().union(*(naive.cells_of(readings, t, WIDE, model) for t in range(4)))
    assert set(np.flatnonzero(evidence.observed().ravel() != -1).tolist()) == seen
    assert (evidence.observed()[evidence.observed() != -1] == 1).all()
    assert (evidence.state.maps.evidence[evidence.state.maps.seen == 0] == 0).all()


def test_without_readings_log_likelihood_is_zero_and_all_cells_unknown() -> None:
    evidence = evidence_of(random_readings(np.random.default_rng(0), GRID, 0), MODEL, np.zeros(GRID.size, np.uint8))
    flip(evidence.state, 3)
    evidence.rebuild()
    assert (len(evidence), evidence.pairs, evidence.log_likelihood) == (0, 0, 0.0)
    assert (evidence.observed() == -1).all()


def test_cells_outside_of_the_grid_are_left_out() -> None:
    readings = random_readings(np.random.default_rng(4), WIDE, 60)
    evidence = evidence_of(readings, MODEL, np.ones(GRID.size, np.uint8))
    exact = expectations(readings, GRID, np.ones(GRID.shape), MODEL)
    assert evidence.log_likelihood == pytest.approx(exact.log_likelihood.sum(), abs=1e-6 * 60)


def test_building_can_be_cancelled() -> None:
    stop = np.zeros(1, np.uint8)
    evidence = evidence_of(random_case(0)[0], MODEL, np.zeros(GRID.size, np.uint8), stop=stop)
    stop[0] = 1
    with pytest.raises(Cancelled):
        evidence.rebuild()
    with pytest.raises(Cancelled):
        evidence.extend(random_case(0)[0])


def test_far_from_the_origin_evidence_differs_only_by_rounding() -> None:
    readings = random_readings(np.random.default_rng(5), GRID, 60)
    occupied = np.zeros(GRID.size, np.uint8)
    near = evidence_of(readings, MODEL, occupied)
    moved = dataclasses.replace(readings, x=readings.x + 5000.0, y=readings.y - 3000.0)
    far = evidence_of(moved, MODEL, occupied, grid=dataclasses.replace(GRID, column=49996, row=-29993))
    assert np.array_equal(near.state.maps.seen, far.state.maps.seen)
    assert np.abs(near.state.maps.evidence - far.state.maps.evidence).max() * QUANTUM < 1e-4
