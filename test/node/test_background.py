"""Workers: any error is reported to all callers, and the next work is done."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from forward_grid_mapper.core.common.errors import InputError, MapperError
from forward_grid_mapper.node import background
from forward_grid_mapper.node.background import AT_ONCE, NICE, Inbox, Worker

logged: list[str] = []


@pytest.fixture
def worker() -> Iterator[Worker]:
    logged.clear()
    made = Worker('digger', logged.append)
    yield made
    made.close(10.0)


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


def test_work_is_done_in_order_by_one_thread(worker: Worker) -> None:
    done: list[int] = []
    threads: set[int] = set()
    for k in range(1000):
        worker.put(lambda k=k: (done.append(k), threads.add(threading.get_ident())))
    worker.ask(lambda: None)
    assert done == list(range(1000))
    assert len(threads) == 1 and threading.get_ident() not in threads


@pytest.mark.parametrize(
    ('error', 'why'),
    [
        (MemoryError(), 'there is not enough memory'),
        (InputError('no reading can be mapped'), 'no reading can be mapped'),
        (KeyError('odd'), "KeyError('odd')"),
        (SystemExit(2), 'SystemExit(2)'),
        (KeyboardInterrupt(), 'KeyboardInterrupt()'),
    ],
)
def test_error_is_reported_logged_and_shown(worker: Worker, error: BaseException, why: str) -> None:
    failures: list[str] = []
    worker.put(raising(error), failures.append)
    with pytest.raises(MapperError, match='no second try'):
        worker.ask(raising(InputError('no second try')))
    assert failures == [why]
    assert logged == [f'digger: {why}', 'digger: no second try']
    assert worker.trouble == 'no second try'
    assert worker.ask(lambda: 7) == 7
    assert worker.ask(lambda: worker.trouble) == ''


def test_finished_work_is_released_while_the_worker_waits(worker: Worker) -> None:
    """It may hold the readings of a drive, and the next work may come an hour later."""

    class Held:
        pass

    held = Held()
    gone = threading.Event()
    weakref.finalize(held, gone.set)
    worker.put(partial(isinstance, held, Held))
    del held
    assert gone.wait(60.0)


def test_lasting_trouble_stays_until_it_is_cleared() -> None:
    worker = Worker('digger', logged.append, lasting=True)
    worker.put(raising(KeyError('odd')))
    assert worker.ask(lambda: 1) == 1
    assert worker.trouble == "KeyError('odd')"
    worker.forgive()
    assert worker.trouble == ''
    worker.close(10.0)


def test_worker_continues_after_errors_of_listener_and_log() -> None:
    worker = Worker('digger', raising_log)
    worker.put(raising(KeyError('odd')), lambda why: raising(ValueError('deaf'))())
    assert worker.ask(lambda: 3) == 3
    worker.close(10.0)


def raising_log(text: str) -> None:
    raise MemoryError


def test_failed_start_of_the_thread_is_reported_to_all_callers(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    failures: list[str] = []

    def fail(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', fail)
        worker.put(lambda: None, failures.append)
        with pytest.raises(MapperError, match='new thread'):
            worker.ask(lambda: None)
    assert len(failures) == 1 and "can't start new thread" in failures[0]
    assert 'new thread' in worker.trouble
    assert worker.ask(lambda: 5) == 5


def test_closing_waits_for_the_current_work_and_drops_the_rest(worker: Worker) -> None:
    begun, go_on, done = threading.Event(), threading.Event(), []

    def work() -> None:
        begun.set()
        go_on.wait(60.0)
        done.append('first')

    worker.put(work)
    worker.put(lambda: done.append('second'))
    assert begun.wait(60.0)
    assert worker.waiting == 2
    closing = threading.Thread(target=worker.close, args=(60.0,))
    closing.start()
    assert done == [] and closing.is_alive()
    go_on.set()
    closing.join(60.0)
    assert done == ['first']
    worker.put(lambda: done.append('third'))
    assert done == ['first']


def test_finished_work_is_not_counted_as_waiting(worker: Worker) -> None:
    assert worker.waiting == 0
    worker.ask(lambda: None)
    # the result comes a moment before the thread takes the next work
    end = time.monotonic() + 60.0
    while worker.waiting:
        assert time.monotonic() < end
        time.sleep(0.001)


def test_caller_gets_an_error_without_memory_for_the_reason(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(list[str]):
        def append(self, text: str) -> None:
            raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(background, 'list', Full, raising=False)
        with pytest.raises(MapperError, match='not enough memory'):
            worker.ask(raising(KeyError('odd')))
    assert worker.ask(lambda: 5) == 5


def test_work_counts_as_waiting_while_it_is_taken() -> None:
    worker, counted = Worker('digger', logged.append), list[int]()

    class Counting(deque[Any]):
        def popleft(self) -> Any:
            task = super().popleft()
            counted.append(worker.waiting)
            return task

    worker._tasks = Counting()
    worker.ask(lambda: None)
    worker.close(10.0)
    assert counted == [1]


def test_call_of_a_closed_worker_raises(worker: Worker) -> None:
    worker.close(10.0)
    with pytest.raises(MapperError, match='digger has ended'):
        worker.ask(lambda: None)


@pytest.mark.skipif(sys.platform != 'linux', reason='elsewhere a thread has no priority of its own')
@pytest.mark.parametrize('nice', [NICE, 15, 0])
def test_worker_has_the_given_priority(nice: int) -> None:
    worker = Worker('digger', logged.append, nice=nice)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    found = worker.ask(lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
    assert found == (nice or own)
    assert os.getpriority(os.PRIO_PROCESS, 0) == own, 'nobody else does'
    worker.close(10.0)


class Guard:
    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback, self.triggered = callback, 0

    def trigger(self) -> None:
        self.triggered += 1


class Executor:
    """Stand-in for a node, with what an inbox needs."""

    def create_guard_condition(self, callback: Callable[[], None]) -> Guard:
        self.guard = Guard(callback)
        return self.guard

    def run(self) -> int:
        """Run the callback until it is not triggered again; return the number of turns."""
        turns = 0
        while self.guard.triggered:
            self.guard.triggered = 0
            turns += 1
            self.guard.callback()
        return turns


def test_results_are_delivered_in_order_and_in_portions() -> None:
    executor = Executor()
    inbox, done = Inbox(executor), queue.Queue[Any]()
    threads = [
        threading.Thread(target=lambda n=n: [inbox.put(lambda k=k: done.put((n, k))) for k in range(100)])
        for n in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert executor.run() == -(-300 // AT_ONCE)
    found = [done.get(timeout=300.0) for _ in range(300)]
    for n in range(3):
        assert [k for m, k in found if m == n] == list(range(100))


def test_failing_result_does_not_block_the_others() -> None:
    executor = Executor()
    inbox, done = Inbox(executor), []
    inbox.put(raising(KeyError('odd')))
    inbox.put(lambda: done.append(1))
    with pytest.raises(KeyError):
        executor.run()
    executor.run()
    assert done == [1]


def test_results_for_a_destroyed_node_are_dropped() -> None:
    executor = Executor()
    inbox = Inbox(executor)

    def fail() -> None:
        raise RuntimeError('the guard condition was destroyed')

    executor.guard.trigger = fail
    done: list[int] = []
    inbox.put(lambda: done.append(1))
    inbox.work()
    assert done == []
