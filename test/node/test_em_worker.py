"""EM in the background: after any end of a run, all callers get a response and the next run can begin."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.search.search import Progress
from forward_grid_mapper.node import em
from forward_grid_mapper.node.em import EmWorker, Outcome, Run

READING = Readings.from_columns(names=('sonar',), x=0.0, y=0.0, yaw=0.0, z=[1.0], z_max=4.0, half_angle=0.2)


class Caller:
    """The thread that owns a worker, like the executor of the node."""

    def __init__(self) -> None:
        self.logged: list[str] = []
        self._conclusions: queue.Queue[Callable[[], None]] = queue.Queue()
        self.worker = EmWorker(lambda run: None, self.logged.append, self._conclusions.put)

    def begin(self, done: Callable[[Outcome], Any], readings: Readings = READING) -> bool:
        return self.worker.start(Run(Mapper(Parameters()), Parameters(), lambda: readings), done)

    def conclude(self) -> None:
        # the first run compiles kernels, on a machine that may be busy
        self._conclusions.get(timeout=500.0)()

    def outcome_of(self, readings: Readings = READING) -> Outcome:
        found: list[Outcome] = []
        assert self.begin(found.append, readings)
        self.conclude()
        return found[0]


@pytest.fixture
def caller() -> Iterator[Caller]:
    made = Caller()
    yield made
    made.worker.close(10.0)


@pytest.mark.parametrize(
    ('error', 'reported'),
    [(MemoryError(), 'does not fit into the memory'), (ValueError('odd'), "EM failed: ValueError('odd')")],
)
def test_failing_run_gives_a_reason_and_the_next_begins(
    monkeypatch: pytest.MonkeyPatch, caller: Caller, error: Exception, reported: str
) -> None:
    def fail(*arguments: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(Mapper, 'run', fail)
        assert reported in caller.outcome_of().message
    maps = caller.outcome_of().maps
    assert maps is not None
    assert len(maps.readings) == 1


@pytest.mark.parametrize('where', ['map_grid', 'shortage', 'sensor_health', 'input_warnings', 'Outcome'])
@pytest.mark.parametrize('error', [MemoryError(), KeyError('odd'), SystemExit(3)])
def test_error_at_any_place_gives_an_outcome(
    monkeypatch: pytest.MonkeyPatch, caller: Caller, where: str, error: BaseException
) -> None:
    failing = [True]
    before = getattr(em, where)

    def fail(*arguments: Any, **options: Any) -> Any:
        if failing:
            failing.clear()
            raise error
        return before(*arguments, **options)

    monkeypatch.setattr(em, where, fail)
    outcome = caller.outcome_of()
    if where in ('sensor_health', 'input_warnings') and isinstance(error, Exception):
        assert outcome.maps is not None
        assert 'could not be judged' in outcome.warnings[0]
    else:
        assert outcome.maps is None
        assert outcome.message
    assert caller.worker.current is None
    assert caller.outcome_of().maps is not None


def test_failed_start_of_the_thread_gives_an_outcome(monkeypatch: pytest.MonkeyPatch, caller: Caller) -> None:
    def fail(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', fail)
        assert "can't start new thread" in caller.outcome_of().message
    assert "can't start new thread" in caller.worker.worker.trouble
    assert caller.outcome_of().maps is not None
    # the outcome comes from the task, which has not ended yet
    caller.worker.worker.ask(lambda: None)
    assert caller.worker.worker.trouble == ''


def test_run_without_enough_memory_does_not_begin(monkeypatch: pytest.MonkeyPatch, caller: Caller) -> None:
    monkeypatch.setattr(em, 'shortage', lambda cells, readings, threads: 'there is no space')
    assert caller.outcome_of() == Outcome(None, 'there is no space')


def test_warnings_about_readings_come_with_the_maps(caller: Caller) -> None:
    steps = np.repeat(np.arange(50), 2)
    twice = Readings.from_columns(
        names=('sonar',),
        x=0.02 * steps,
        y=0.0,
        yaw=0.0,
        z=3.0 - 0.02 * steps,
        z_max=4.0,
        half_angle=0.2,
        stamp=steps * 10**8,
    )
    outcome = caller.outcome_of(twice)
    assert outcome.maps is not None
    (warning,) = outcome.warnings
    assert '50 of 100 readings are copies' in warning
    assert caller.outcome_of().warnings == []


def test_maps_are_published_before_sensors_are_judged(monkeypatch: pytest.MonkeyPatch, caller: Caller) -> None:
    order: list[str] = []
    monkeypatch.setattr(em, 'sensor_health', lambda maps: order.append('judged') or {})
    run = Run(Mapper(Parameters()), Parameters(), lambda: READING, lambda maps: order.append('shown'))
    assert caller.worker.start(run, lambda outcome: order.append('answered'))
    caller.conclude()
    assert order == ['shown', 'judged', 'answered']


class Slow:
    """A run that continues until it is cancelled, and then until the test lets it end."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun, self.cancelled, self.may_end = threading.Event(), threading.Event(), threading.Event()
        self.ended = False
        monkeypatch.setattr(Mapper, 'run', self.run)
        monkeypatch.setattr(Mapper, 'cancel', lambda mapper: self.cancelled.set())

    def run(self, *arguments: Any) -> None:
        self.begun.set()
        assert self.cancelled.wait(60.0)
        assert self.may_end.wait(60.0)
        self.ended = True
        raise Cancelled('cancelled')


def test_second_run_does_not_begin_before_the_end_of_the_first(monkeypatch: pytest.MonkeyPatch, caller: Caller) -> None:
    slow, outcomes = Slow(monkeypatch), []
    assert caller.begin(outcomes.append)
    assert slow.begun.wait(60.0)
    assert not caller.begin(outcomes.append)
    caller.worker.cancel()
    # a cancelled run has not ended yet
    assert slow.cancelled.wait(60.0)
    assert not caller.begin(outcomes.append)
    slow.may_end.set()
    caller.conclude()
    assert slow.ended
    assert [outcome.message for outcome in outcomes] == ['EM was cancelled']
    assert caller.begin(outcomes.append)
    caller.conclude()


def test_caller_that_fails_with_the_maps_gets_a_failure(caller: Caller) -> None:
    outcomes: list[tuple[str, Outcome]] = []

    def odd(outcome: Outcome) -> None:
        outcomes.append(('odd', outcome))
        if outcome.maps is not None:
            raise KeyError('odd')

    def failing(outcome: Outcome) -> None:
        raise MemoryError

    assert caller.begin(odd)
    assert caller.worker.current is not None
    caller.worker.current.callers += [failing, lambda outcome: outcomes.append(('last', outcome))]
    caller.conclude()
    assert [name for name, _ in outcomes] == ['odd', 'odd', 'last']
    assert outcomes[1][1].maps is None and "KeyError('odd')" in outcomes[1][1].message
    assert outcomes[2][1].maps is not None
    assert len(caller.logged) == 2


def test_closing_cancels_and_waits_for_the_end(monkeypatch: pytest.MonkeyPatch, caller: Caller) -> None:
    slow = Slow(monkeypatch)
    assert caller.begin(lambda outcome: None)
    assert slow.begun.wait(60.0)
    closed = threading.Thread(target=lambda: caller.worker.close(60.0))
    closed.start()
    assert slow.cancelled.wait(60.0)
    assert closed.is_alive() and not slow.ended
    slow.may_end.set()
    closed.join(60.0)
    assert slow.ended


def test_run_that_waits_for_kernels_can_be_cancelled() -> None:
    conclusions: queue.Queue[Callable[[], None]] = queue.Queue()
    waits = threading.Event()

    def prepare(stop: Callable[[], bool]) -> None:
        waits.set()
        while not stop():
            pass
        raise Cancelled('cancelled while kernels were compiled')

    worker = EmWorker(lambda run: None, print, conclusions.put, prepare)
    outcomes: list[Outcome] = []
    assert worker.start(Run(Mapper(Parameters()), Parameters(), lambda: READING), outcomes.append)
    assert waits.wait(60.0)
    assert worker.current is not None
    assert 'waiting for the compilation of kernels' in str(worker.current)
    worker.cancel()
    conclusions.get(timeout=500.0)()
    assert outcomes[0].message == 'EM was cancelled'


def test_text_of_a_run_has_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(Mapper(Parameters()), Parameters(), lambda: READING)
    monkeypatch.setattr(em.time, 'monotonic', lambda: run.begin + 12.34)
    assert run.seconds == pytest.approx(12.34)
    assert str(run) == 'starting, 12.3 s'
    assert not (run.by_itself or run.cancel_requested or run.map_shown or run.cancelled) and run.uses_all_readings()
    run.stage, run.count, run.progress = 'search', 70, Progress(3, 400, 5, 61.5)
    assert str(run).startswith('search of 70 readings, 12.3 s, iteration 3, ')
    assert str(run).endswith(' nats gained')
    run.cancelled = True
    assert str(run).endswith(' nats gained, being cancelled')


def test_summary_of_a_run_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    statistics = {'iterations': 7, 'flips': 8, 'shifts': 9, 'occupied': 10, 'converged': True}
    maps: Any = SimpleNamespace(statistics=statistics, readings=range(5), log_likelihood=-1.25, objective=-2.5)
    warnings: list[str] = []
    monkeypatch.setattr(em, 'quality_warning', lambda maps, warned: ''.join(warnings) + '; see above' * warned)
    line = (
        '5 readings, 10 occupied cells, 3.21 seconds '
        '(7 iterations, 8 flips, 9 shifts, log-likelihood -1.2, objective -2.5)'
    )
    assert em.summary(maps, 3.21) == line
    statistics['converged'] = False
    assert em.summary(maps, 3.21) == f'{line}; NOT converged: raise max_iterations'
    warnings.append('it does not fit')
    assert em.summary(maps, 3.21) == f'{line}; NOT converged: raise max_iterations; WARNING: it does not fit'
    assert em.summary(maps, 3.21, True).endswith('WARNING: it does not fit; see above')


@pytest.mark.parametrize(('threads', 'expected'), [(0, 6), (2, 2)])
def test_memory_check_uses_the_number_of_threads(
    monkeypatch: pytest.MonkeyPatch, caller: Caller, threads: int, expected: int
) -> None:
    requested: list[tuple[int, int]] = []
    monkeypatch.setattr(em, 'cores', lambda: 6)
    monkeypatch.setattr(em, 'shortage', lambda cells, count, cores: requested.append((count, cores)) or 'too much')
    parameters, outcomes = Parameters.from_flat({'threads': threads}), list[Outcome]()
    assert caller.worker.start(Run(Mapper(parameters), parameters, lambda: READING), outcomes.append)
    caller.conclude()
    assert requested == [(1, expected)] and outcomes == [Outcome(None, 'too much')]
