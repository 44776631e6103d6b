"""Evidence whose computation stops half way: out of memory, or cancelled."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from failing import Allocations
from test_evidence import GRID, random_case, snapshot

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence import evidence as module
from forward_grid_mapper.core.evidence import indexed_readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.maps.free_space import expected_passes
from forward_grid_mapper.core.runtime import threads

LARGE = Grid(0.1, GRID.column - 9, GRID.row - 11, GRID.width + 30, GRID.height + 25)
AGAIN = np.array([0, 3, 45, 45])
EARLY, LATE = slice(0, 40), slice(40, 60)

Step = Callable[[Evidence], None]


def full_state(evidence: Evidence) -> list[object]:
    """The whole state, including normals of surfaces and the readings of each tile."""
    normals, tiles = evidence.state.normals, evidence.state.tiles
    lists = [tiles.head.tolist(), tiles.fill.tolist(), tiles.latest.tolist(), int(tiles.used[0])]
    sums = [] if evidence._bearing_sums is None else evidence._bearing_sums.tolist()
    counts = [len(evidence), evidence.pairs, evidence.unstored, evidence.grid, evidence._not_renewed]
    return [snapshot(evidence), [np.asarray(array).tolist() for array in normals], lists, sums, counts]


def case(seed: int) -> tuple[Readings, Any, np.ndarray]:
    readings, model, occupied = random_case(seed, 60)
    # enough echoes from about the same place, so that normals are known
    readings.x[:30], readings.y[:30] = readings.x[0], readings.y[0]
    readings.z[:30] = np.minimum(readings.z[0], 0.5 * readings.z_max[:30])
    return readings, dataclasses.replace(model, max_incidence_angle=0.5), occupied


def steps(readings: Readings) -> dict[str, tuple[list[Step], Step]]:
    """Steps done before, and the step that fails."""

    def first(evidence: Evidence) -> None:
        evidence.extend(readings.select(EARLY))

    def more(evidence: Evidence) -> None:
        evidence.extend(readings.select(LATE), AGAIN)

    def grow(evidence: Evidence) -> None:
        evidence.grow(LARGE)

    return {'first': ([], first), 'more': ([first], more), 'grow': ([first, more], grow)}


@pytest.mark.slow
@pytest.mark.parametrize('memory', [np.inf, 3000.0])
@pytest.mark.parametrize('name', ['first', 'more', 'grow'])
@pytest.mark.parametrize('renewable', [True, False])
def test_step_without_memory_leaves_the_state_unchanged(
    monkeypatch: pytest.MonkeyPatch, name: str, memory: float, renewable: bool
) -> None:
    readings, model, occupied = case(20)
    before, fails = steps(readings)[name]
    monkeypatch.setattr(threads, 'LEAST_PART', 5)

    def made() -> Evidence:
        evidence = Evidence(GRID, model, memory, 3, start=occupied.reshape(GRID.shape), renewable=renewable)
        for step in before:
            step(evidence)
        return evidence

    whole = made()
    fails(whole)
    assert whole.state.normals.known.any()
    expected = full_state(whole)
    allocations = Allocations(monkeypatch)
    failed = 0
    for which in range(1, 1000):
        evidence = made()
        untouched = full_state(evidence)
        try:
            with allocations.failing(which):
                fails(evidence)
        except MemoryError:
            failed += 1
            assert full_state(evidence) == untouched
            fails(evidence)
        assert full_state(evidence) == expected
        if allocations.count < which:
            break
    assert failed > 8


@pytest.mark.parametrize('kernel', ['insert_readings', 'evaluate_all'])
@pytest.mark.parametrize('name', ['first', 'more', 'grow'])
def test_cancelled_step_leaves_the_state_unchanged(monkeypatch: pytest.MonkeyPatch, name: str, kernel: str) -> None:
    readings, model, occupied = case(21)
    before, fails = steps(readings)[name]
    monkeypatch.setattr(threads, 'LEAST_PART', 5)
    stop = np.zeros(1, np.uint8)
    evidence = Evidence(GRID, model, threads=2, start=occupied.reshape(GRID.shape), stop=stop, renewable=True)
    whole = Evidence(GRID, model, threads=2, start=occupied.reshape(GRID.shape), renewable=True)
    for step in before:
        step(evidence)
        step(whole)
    fails(whole)
    untouched = full_state(evidence)
    where = indexed_readings if kernel == 'insert_readings' else module
    real = getattr(where, kernel)

    def halfway(s: Any, *rest: Any) -> Any:
        if s.stop is not stop:
            return real(s, *rest)
        if kernel == 'insert_readings':
            (begin, end, words), totals = rest
            done = real(s, (begin, (begin + end) // 2, words), totals)
        else:
            begin, end, new = rest
            done = real(s, begin, (begin + end) // 2, new)
        stop[0] = 1
        return done

    with monkeypatch.context() as patch:
        patch.setattr(where, kernel, halfway)
        with pytest.raises(Cancelled):
            fails(evidence)
    stop[0] = 0
    assert full_state(evidence) == untouched
    fails(evidence)
    assert full_state(evidence) == full_state(whole)


@pytest.mark.parametrize('at_once', [False, True])
def test_evidence_is_complete_after_a_cancelled_rebuild(at_once: bool) -> None:
    readings, model, occupied = case(22)
    stop = np.zeros(1, np.uint8)
    evidence = Evidence(GRID, model, start=occupied.reshape(GRID.shape), stop=stop)
    evidence.extend(readings)
    if not at_once:
        evidence.state.maps.occupied[::3] ^= 1
    stop[0] = 1
    with pytest.raises(Cancelled):
        evidence.flip(np.arange(0, GRID.size, 3)) if at_once else evidence.rebuild()
    fresh = Evidence(GRID, model, start=evidence.state.maps.occupied.reshape(GRID.shape))
    fresh.extend(readings)
    assert snapshot(evidence) == snapshot(fresh)


@pytest.mark.parametrize('readings', [[-1], [3, 40], [10**9]])
def test_weight_for_unknown_readings_is_rejected(readings: list[int]) -> None:
    some, model, occupied = case(23)
    evidence = Evidence(GRID, model, start=occupied.reshape(GRID.shape))
    evidence.extend(some.select(EARLY))
    before = full_state(evidence)
    with pytest.raises(ValueError, match='there are 40'):
        evidence.add_multiplicity(np.array(readings))
    with pytest.raises(ValueError, match='there are 40'):
        evidence.extend(some.select(slice(0, 0)), np.array(readings))
    assert full_state(evidence) == before


def test_fewer_threads_are_used_if_memory_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    readings, model, occupied = case(24)
    monkeypatch.setattr(threads, 'LEAST_PART', 5)
    one = Evidence(GRID, model, start=occupied.reshape(GRID.shape))
    one.extend(readings)
    used: list[int] = []
    real = indexed_readings.run_each
    monkeypatch.setattr(indexed_readings, 'run_each', lambda work, pool: used.append(len(work)) or real(work, pool))
    for limit in (10**9, 5 * 24 * GRID.size, 0):
        monkeypatch.setattr(indexed_readings, 'THREAD_MEMORY', limit)
        used.clear()
        many = Evidence(GRID, model, threads=12, start=occupied.reshape(GRID.shape))
        many.extend(readings)
        assert snapshot(many) == snapshot(one)
        assert max(used) == {10**9: 12, 0: 1}.get(limit, max(used))
        assert used[0] == 1 or limit
    assert used == [1, 1, 1]


def in_lockstep(work: Callable[[], None], files: tuple[str, ...]) -> None:
    """Make the threads that `work` starts wait for each other before each line of `files`."""
    barrier = threading.Barrier(2)

    def line(frame: Any, event: str, argument: object) -> Any:
        if event == 'line':
            try:
                barrier.wait(2.0)
            except threading.BrokenBarrierError:
                return None
        return line

    def call(frame: Any, event: str, argument: object) -> Any:
        return line if frame.f_code.co_filename in files and frame.f_code.co_name == 'work' else None

    threading.settrace(call)
    try:
        work()
    finally:
        threading.settrace(sys.gettrace())  # type: ignore[arg-type]


def test_threads_in_lockstep_give_the_result_of_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    readings, model, occupied = case(25)
    monkeypatch.setattr(threads, 'LEAST_PART', 30)
    start = occupied.reshape(GRID.shape)
    alone, both = Evidence(GRID, model, start=start), Evidence(GRID, model, threads=2, start=start)
    alone.extend(readings)
    passed: list[np.ndarray] = []
    files = (module.__file__, expected_passes.__globals__['__file__'])
    in_lockstep(lambda: both.extend(readings), files)
    in_lockstep(lambda: passed.append(expected_passes(both, both.state.maps.occupied)), files)
    assert alone.state.normals.known.any()
    for one, two in zip(alone.state.normals, both.state.normals, strict=True):
        assert np.array_equal(one, two)
    assert snapshot(alone) == snapshot(both)
    assert np.array_equal(passed[0], expected_passes(alone, alone.state.maps.occupied))
