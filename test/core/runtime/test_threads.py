"""Work on several threads; the results of the search do not depend on their number or on memory."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters, SearchParameters
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.runtime import control_groups, threads
from forward_grid_mapper.core.search.search import Search
from samples import PLAIN_MODEL, PLAIN_SEARCH, Found, found_by, random_readings

AREA = Grid(0.1, -13, 4, 60, 50)


@pytest.mark.parametrize('version', [1, 2])
def test_cores_are_bounded_by_the_limits_of_all_control_groups(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: int
) -> None:
    def limit(folder: Path, quota: int | None, period: int = 100_000) -> None:
        if version == 2:
            (folder / 'cpu.max').write_text(f'{"max" if quota is None else quota} {period}\n')
        else:
            (folder / 'cpu.cfs_quota_us').write_text(f'{-1 if quota is None else quota}\n')
            (folder / 'cpu.cfs_period_us').write_text(f'{period}\n')

    group = tmp_path / 'groups' / ('cpu' if version == 1 else '') / 'robot.slice' / 'mapper.service'
    group.mkdir(parents=True)
    path = '/robot.slice/mapper.service'
    (tmp_path / 'own').write_text(f'3:memory:/\n12:cpu,cpuacct:{path}\n' if version == 1 else f'0::{path}\n')
    monkeypatch.setattr(control_groups, 'ROOT', tmp_path / 'groups')
    monkeypatch.setattr(control_groups, 'OWN', tmp_path / 'own')
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: set(range(8)), raising=False)
    assert threads.cores() == 8
    limit(group, None)
    assert threads.cores() == 8
    limit(group, 450_000)
    assert threads.cores() == 4
    limit(group.parent, 100_000, 50_000)
    assert threads.cores() == 2
    limit(group, 50_000)
    assert threads.cores() == 1
    limit(group, 1_600_000)
    limit(group.parent, 1_600_000)
    assert threads.cores() == 8
    limit(group.parent.parent, 300_000)
    assert threads.cores() == 3


def test_unreadable_limit_of_cores_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(control_groups, 'ROOT', tmp_path)
    monkeypatch.setattr(control_groups, 'OWN', tmp_path / 'absent')
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: {0, 1, 2}, raising=False)
    for text in ('', 'max', '100000', 'a b', '100000 0', '1 2 3'):
        (tmp_path / 'cpu.max').write_text(text)
        assert threads.cores() == 3


@given(st.integers(0, 10**7), st.integers(0, 10**7), st.integers(1, 300))
def test_parts_cover_the_range_in_order_and_none_is_small(begin: int, size: int, workers: int) -> None:
    parts = threads.parts(begin, begin + size, workers)
    assert parts[0][0] == begin
    assert parts[-1][1] == begin + size
    assert all(a[1] == b[0] for a, b in itertools.pairwise(parts))
    lengths = [last - first for first, last in parts]
    assert max(lengths) - min(lengths) <= 1
    assert len(parts) == min(workers, max(size // threads.LEAST_PART, 1))


def test_run_each_runs_work_in_parallel_and_waits() -> None:
    meeting, done = threading.Barrier(3, timeout=120), []

    def work(k: int) -> None:
        meeting.wait()
        done.append(k)

    with ThreadPoolExecutor(3) as pool:
        threads.run_each([lambda k=k: work(k) for k in range(3)], pool)
    assert sorted(done) == [0, 1, 2]


def test_single_work_runs_in_the_calling_thread() -> None:
    seen: list[int] = []
    with ThreadPoolExecutor(1) as pool:
        threads.run_each([lambda: seen.append(threading.get_ident())], pool)
    assert seen == [threading.get_ident()]


@pytest.mark.parametrize('count', [1, 3])
def test_error_of_a_thread_is_raised_when_all_have_ended(count: int) -> None:
    ended: list[int] = []

    def work() -> None:
        raise ValueError('of the work')

    def later() -> None:
        time.sleep(0.1)
        ended.append(1)

    with ThreadPoolExecutor(count) as pool:
        with pytest.raises(ValueError, match='of the work'):
            threads.run_each([work, *[later] * (count - 1)], pool)
        assert len(ended) == count - 1


@pytest.mark.parametrize('most', [0, 1])
def test_work_without_a_thread_runs_in_the_calling_thread_and_never_again(
    monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    ran: list[int] = []
    real = threading.Thread.start
    started: list[threading.Thread] = []

    def start(thread: threading.Thread) -> None:
        if len(started) >= most:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        real(thread)

    def work(k: int) -> None:
        time.sleep(0.05)
        ran.append(k)

    with ThreadPoolExecutor(3) as pool:
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, 'start', start)
            threads.run_each([lambda k=k: work(k) for k in range(3)], pool)
        assert sorted(ran) == [0, 1, 2]
        threads.run_each([lambda k=k: work(k) for k in (3, 4)], pool)
    assert sorted(ran) == [0, 1, 2, 3, 4]


def test_no_work_runs_any_more_after_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, ended, real = threading.Barrier(3, timeout=120), [], threads.wait

    def interrupted(ends: object) -> None:
        monkeypatch.setattr(threads, 'wait', real)
        begun.wait()
        raise KeyboardInterrupt

    def work() -> None:
        begun.wait()
        time.sleep(0.1)
        ended.append(1)

    monkeypatch.setattr(threads, 'wait', interrupted)
    with ThreadPoolExecutor(2) as pool:
        with pytest.raises(KeyboardInterrupt):
            threads.run_each([work, work], pool)
        assert len(ended) == 2


@pytest.mark.parametrize('fails', [False, True])
def test_threads_end_with_the_owner_of_the_pool(fails: bool) -> None:
    """Without the garbage collector, which may come much later: one run makes many pools."""
    begun: list[threading.Thread] = []

    def work(pool: ThreadPoolExecutor) -> None:
        begun.append(threading.current_thread())
        time.sleep(0.05)
        if fails:
            raise ValueError

    def run() -> None:
        pool = ThreadPoolExecutor(3)
        with contextlib.suppress(ValueError):
            threads.run_each([lambda: work(pool)] * 3, pool)

    gc.disable()
    try:
        run()
        for thread in begun:
            thread.join(60.0)
    finally:
        gc.enable()
    assert len(begun) == 3 and not any(thread.is_alive() for thread in begun)


def test_results_come_in_the_order_of_the_work_which_runs_in_parallel() -> None:
    meeting = threading.Barrier(3, timeout=120)

    def work(k: int) -> int:
        # the first one ends last
        meeting.wait()
        time.sleep(0.02 * (3 - k % 3))
        return k

    results = threads.in_order([lambda k=k: work(k) for k in range(9)], 3)
    assert list(results) == list(range(9))


def test_work_of_one_thread_begins_when_its_result_is_asked_for() -> None:
    begun: list[int] = []
    results = threads.in_order([lambda k=k: begun.append(threading.get_ident()) for k in range(3)], 1)
    assert not begun
    next(results)
    assert begun == [threading.get_ident()]


def test_error_is_raised_in_the_place_of_its_result_and_no_more_work_begins() -> None:
    begun: list[int] = []

    def work(k: int) -> int:
        begun.append(k)
        if k == 2:
            raise ValueError('of the work')
        return k

    results = threads.in_order([lambda k=k: work(k) for k in range(100)], 2)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match='of the work'):
        next(results)
    assert max(begun) < 10


def test_no_work_begins_once_results_are_no_longer_asked_for() -> None:
    begun: list[int] = []
    results = threads.in_order([lambda k=k: begun.append(k) for k in range(100)], 2)
    next(results)
    results.close()
    count = len(begun)
    assert count < 10
    time.sleep(0.1)
    assert len(begun) == count


def test_work_in_order_runs_in_the_calling_thread_if_the_system_starts_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, 'start', start)
    results = list(threads.in_order([threading.get_ident] * 5, 3))
    assert results == [threading.get_ident()] * 5


def test_number_of_cores_is_at_least_one() -> None:
    assert threads.cores() >= 1


def search(workers: int, memory: float, seed: int, plain: bool) -> tuple[Found, Evidence]:
    readings = random_readings(np.random.default_rng(seed), AREA, 600, z_max=3.0)
    readings.half_angle[:] *= 0.3
    surfaces = PLAIN_MODEL if plain else {}
    model = ModelParameters(p_hit=0.7, p_rand=0.1, sigma=0.06, **surfaces)
    evidence = Evidence(AREA, model, memory=memory, threads=workers)
    evidence.extend(readings)
    assert evidence.state.normals.known.any() != plain
    return found_by(Search(evidence, SearchParameters(**(PLAIN_SEARCH if plain else {})))), evidence


@pytest.mark.parametrize(('seed', 'plain'), [(0, True), (1, False)], ids=['plain', 'whole'])
def test_search_result_does_not_depend_on_threads_or_memory(
    monkeypatch: pytest.MonkeyPatch, seed: int, plain: bool
) -> None:
    first, evidence = search(1, np.inf, seed, plain)
    assert first.progress.shifts > 0
    assert first.progress.flips > 50
    monkeypatch.setattr(threads, 'LEAST_PART', 50)
    half = evidence.state.pairs.cell.nbytes / 2
    for workers, memory in ((3, np.inf), (1, half), (1, 0.0), (3, half), (3, 0.0)):
        other, less = search(workers, memory, seed, plain)
        assert (less.unstored > 0) == (memory < np.inf)
        assert np.array_equal(other.occupied, first.occupied)
        assert np.array_equal(other.evidence, first.evidence)
        assert other.log_prior == first.log_prior
        assert other.progress == first.progress
        assert less.log_likelihood == evidence.log_likelihood


def test_maps_do_not_depend_on_threads_or_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, 'LEAST_PART', 50)
    readings = random_readings(np.random.default_rng(5), AREA, 1500, z_max=3.0)
    made = [
        Mapper(Parameters().varied(values)).run(readings)
        for values in ({'threads': 1}, {'threads': 4}, {'threads': 0, 'max_memory': 0}, {'max_memory': 1})
    ]
    assert made[0].statistics['readings_not_stored'] == 0
    assert made[2].statistics['readings_not_stored'] == len(readings)
    assert 0 < made[3].statistics['readings_not_stored'] < len(readings)
    for other in made[1:]:
        assert np.array_equal(other.ml, made[0].ml)
        assert np.array_equal(other.uncertainty, made[0].uncertainty, equal_nan=True)
        assert other.objective == made[0].objective
