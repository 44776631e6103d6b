"""Work in the background: threads that survive failures, and results in order for the executor."""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

from ..core.common.errors import MapperError

T = TypeVar('T')

NICE = 10
"""Niceness of workers, so that the executor gets a core at once when a message arrives."""

AT_ONCE = 20
"""Most results that the executor handles in one turn."""


class _Task(NamedTuple):
    work: Callable[[], None]
    failed: Callable[[str], object]


def _ignore(why: str) -> None:
    """Ignore a failure."""


def reason(error: BaseException) -> str:
    """Return the reason of a failure in words."""
    if isinstance(error, MapperError):
        return str(error)
    return 'there is not enough memory' if isinstance(error, MemoryError) else repr(error)


class Worker:
    """A thread that runs tasks one after the other; it starts with the first.

    If a task raises, or the thread cannot start, its callback `failed` is called, the reason is logged and kept in
    `trouble`, and the next task runs.

    Attributes
    ----------
    trouble : str
        Reason of the last failure. A later success clears it, unless failures are `lasting`: then only `forgive` does.
    """

    def __init__(self, name: str, log: Callable[[str], object], lasting: bool = False, nice: int = NICE) -> None:
        """Prepare; `nice` is the niceness of the thread."""
        self.name, self.trouble = name, ''
        self._nice = nice
        self._log, self._lasting = log, lasting
        self._tasks: deque[_Task] = deque()
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = self._busy = False

    @property
    def waiting(self) -> int:
        """Number of tasks that are not done, including the running one."""
        return len(self._tasks) + self._busy

    def put(self, work: Callable[[], None], failed: Callable[[str], object] = _ignore) -> None:
        """Have `work` called after all earlier tasks; `failed` is called with the reason if it raises.

        Both are called in the worker's thread, `failed` in the caller's if no thread can start.
        """
        with self._wake:
            if self._closed:
                return
            self._tasks.append(_Task(work, failed))
            self._wake.notify()
            start = self._thread is None
            if start:
                self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        if start:
            self._start()

    def ask(self, work: Callable[[], T]) -> T:
        """Have `work` called, and wait for its result.

        Raises
        ------
        MapperError
            If it failed.
        """
        ended = threading.Event()
        found: list[T] = []
        why = list[str]()

        def do() -> None:
            found.append(work())
            ended.set()

        def fail(text: str) -> None:
            try:
                why.append(text)
            finally:
                ended.set()

        self.put(do, fail)
        while not ended.wait(0.5):
            if self._closed:
                raise MapperError(f'{self.name} has ended')
        if not found:
            raise MapperError(why[0] if why else 'there is not enough memory')
        return found[0]

    def forgive(self) -> None:
        """Clear `trouble`."""
        self.trouble = ''

    def close(self, seconds: float) -> None:
        """Drop the tasks that have not begun, and wait at most this many seconds for the running one."""
        with self._wake:
            self._closed = True
            self._tasks.clear()
            self._wake.notify()
            thread = self._thread
        if thread is not None and thread.is_alive():
            thread.join(seconds)

    def finish(self) -> None:
        """End after the running task; may be called by that task."""
        with self._wake:
            self._closed = True
            self._wake.notify()

    def _start(self) -> None:
        assert self._thread is not None
        try:
            self._thread.start()
        except BaseException as error:
            with self._wake:
                self._thread = None
                tasks = list(self._tasks)
                self._tasks.clear()
            for task in tasks:
                self._fail(task, error)

    def _run(self) -> None:
        # Linux has a priority for each thread, which the threads that it starts inherit
        if self._nice and sys.platform == 'linux':
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        while True:
            with self._wake:
                while not self._tasks and not self._closed:
                    self._wake.wait()
                if self._closed:
                    return
                # in this order, so that no other thread finds all tasks done meanwhile
                self._busy = True
                task = self._tasks.popleft()
            try:
                task.work()
                if not self._lasting:
                    self.trouble = ''
            except BaseException as error:
                self._fail(task, error)
            # objects that the task refers to are released before the next task arrives
            del task
            self._busy = False

    def _fail(self, task: _Task, error: BaseException) -> None:
        try:
            why = reason(error)
            self.trouble = why
            self._log(f'{self.name}: {why}')
        except BaseException:
            why = 'there is not enough memory'
        try:
            task.failed(why)
        except BaseException as another:
            self.trouble = f'{why}; and this could not be reported: {another!r}'


class Inbox:
    """Calls from other threads that run in the executor's thread: in order, a few at a time.

    That thread owns the state of the node, which therefore needs no locks.
    """

    def __init__(self, node: Any) -> None:
        self._work: deque[Callable[[], None]] = deque()
        self._guard = node.create_guard_condition(self.work)

    def put(self, work: Callable[[], None]) -> None:
        """Have `work` called by the executor soon; may be called from any thread."""
        self._work.append(work)
        self._wake()

    def work(self) -> None:
        """Run waiting calls; called by the executor."""
        try:
            for _ in range(min(len(self._work), AT_ONCE)):
                self._work.popleft()()
        finally:
            if self._work:
                self._wake()

    def _wake(self) -> None:
        try:
            self._guard.trigger()
        except Exception:
            # the node was destroyed, and its executor does not run
            self._work.clear()
