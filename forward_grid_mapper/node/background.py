"""Work in the background: threads that live on whatever their work raises, and results that come back in order."""

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
"""What workers give way by (nice), so that the executor gets a core at once when a message comes."""

AT_ONCE = 20
"""Results that the executor takes in one turn; the others wait for the next."""


class _Task(NamedTuple):
    work: Callable[[], None]
    failed: Callable[[str], object]


def _nobody(why: str) -> None:
    """Be whom a failure does not concern."""


def reason(error: BaseException) -> str:
    """Return what went wrong, in words."""
    if isinstance(error, MapperError):
        return str(error)
    return 'there is not enough memory' if isinstance(error, MemoryError) else repr(error)


class Worker:
    """A thread that does one piece of work after the other; it starts with the first.

    Whatever a piece raises, or if the thread cannot start, `failed` of that piece is told, the log and `trouble` say
    so, and the next piece is done.

    Attributes
    ----------
    trouble : str
        What failed last; empty once something succeeded after it, unless failures are `lasting`: then until `forgive`.
    """

    def __init__(self, name: str, log: Callable[[str], object], lasting: bool = False, nice: int = NICE) -> None:
        """Prepare; `nice` is by what the thread gives way to the executor."""
        self.name, self.trouble = name, ''
        self._nice = nice
        self._log, self._lasting = log, lasting
        self._tasks: deque[_Task] = deque()
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = self._busy = False

    @property
    def waiting(self) -> int:
        """Number of pieces that are not done, the one that is being done included."""
        return len(self._tasks) + self._busy

    def put(self, work: Callable[[], None], failed: Callable[[str], object] = _nobody) -> None:
        """Have `work` done after all that was put before; `failed` is called with the reason if it raises.

        Either is called in the worker's thread, `failed` in the caller's if there can be no thread.
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
        """Have `work` done and wait for what it returns.

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
        """Forget what failed."""
        self.trouble = ''

    def close(self, seconds: float) -> None:
        """Leave what was not begun undone, and wait so long for what was."""
        with self._wake:
            self._closed = True
            self._tasks.clear()
            self._wake.notify()
            thread = self._thread
        if thread is not None and thread.is_alive():
            thread.join(seconds)

    def finish(self) -> None:
        """End once the piece that is being done is done; may be called by that piece."""
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
                # in this order, so that nobody who looks meanwhile finds that all is done
                self._busy = True
                task = self._tasks.popleft()
            try:
                task.work()
                if not self._lasting:
                    self.trouble = ''
            except BaseException as error:
                self._fail(task, error)
            # what the work refers to is not kept until the next piece comes
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
    """What other threads want done in the executor's thread: in order, and a few at a time.

    That thread owns the state of the node, which therefore needs no locks.
    """

    def __init__(self, node: Any) -> None:
        self._work: deque[Callable[[], None]] = deque()
        self._guard = node.create_guard_condition(self.work)

    def put(self, work: Callable[[], None]) -> None:
        """Have `work` called by the executor soon; any thread."""
        self._work.append(work)
        self._wake()

    def work(self) -> None:
        """Do what waits; called by the executor."""
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
            # the node has been destroyed: nobody is there to do it
            self._work.clear()
