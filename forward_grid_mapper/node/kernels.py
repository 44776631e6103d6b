"""Compilation of kernels in the background, in the order in which they are needed."""

from __future__ import annotations

import gc
import importlib
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import ClassVar

from ..core import warm_up
from ..core.common.errors import Cancelled
from .background import Worker


class Kernels:
    """Compiles the kernels of each step of `warm_up.STEPS`.

    Attributes
    ----------
    stage : str
        The step that is compiled; '' when all are done.
    at_work : set of Kernels
        Instances whose threads still compile or import; the interpreter must not shut down meanwhile.
    """

    at_work: ClassVar[set[Kernels]] = set()

    def __init__(
        self, log: Callable[[str], object], error: Callable[[str], object], online: bool, refine: bool = False
    ) -> None:
        """`log` receives notes, `error` failures.

        Without `online`, the kernels of the online map are left out; without `refine`, those of the trajectory.
        """
        self._log = log
        self._late = threading.Lock()
        self.worker = Worker('kernels', error, lasting=True)
        wanted = {'online map': online, 'trajectory': refine}
        self._steps = {name: step for name, step in warm_up.STEPS.items() if wanted.get(name, True)}
        self._left = len(self._steps)
        self._done = {name: threading.Event() for name in self._steps}
        self.stage = next(iter(self._steps))

    def begin(self, ready: Callable[[], None]) -> None:
        """Begin to compile; `ready` is called, in another thread, when the kernels of the live map are compiled."""
        self.at_work.add(self)
        self._log('preparing kernels; the first start compiles them, which takes one to three minutes')
        begin = time.monotonic()
        # the collector would scan all objects of the compiler again and again, and delay the executor
        gc.disable()
        for name in self._steps:
            self.worker.put(partial(self._compile, name, ready, begin), lambda why: self._give_up(ready))

    def wait(self, name: str, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for the kernels of a step; a step that was left out is compiled in this thread.

        Raises
        ------
        Cancelled
            When `stop` returns true.
        """
        with self._late:
            if name not in self._done:
                begin = time.monotonic()
                warm_up.STEPS[name]()
                self._done[name] = threading.Event()
                self._done[name].set()
                self._log(f'{name} kernels are ready after {time.monotonic() - begin:.1f} s')
        while not self._done[name].wait(0.1):
            if stop():
                raise Cancelled('cancelled while kernels were compiled')

    def release(self) -> None:
        """Let all who wait continue if the compilation has not begun, since it will not begin any more."""
        if self not in self.at_work:
            for done in list(self._done.values()):
                done.set()

    def has(self, name: str) -> bool:
        """Return whether the kernels of a step are compiled."""
        return name in self._done and self._done[name].is_set()

    def _compile(self, name: str, ready: Callable[[], None], begin: float) -> None:
        self.stage = name
        self._steps[name]()
        self._log(f'{name} kernels are ready after {time.monotonic() - begin:.1f} s')
        self._done[name].set()
        if name == 'live map':
            ready()
        self._count_done()

    def _give_up(self, ready: Callable[[], None]) -> None:
        """Let all who wait continue: kernels are compiled when first used, and a failure is reported there."""
        first = not self.has('live map')
        for done in list(self._done.values()):
            done.set()
        if first:
            ready()
        self._count_done()

    def _count_done(self) -> None:
        """Count a step that ended or failed; the last one ends the work."""
        self._left -= 1
        if not self._left:
            self._end()

    def _end(self) -> None:
        self.stage = ''
        # imported while the collector is off, since pictures need about 100 000 further objects; a failure is reported
        # when pictures are drawn, and must not prevent that the collector is enabled
        with suppress(Exception):
            importlib.import_module('..files.drawing', __package__)
        # these objects live as long as the process; the collector need not scan them again
        gc.freeze()
        gc.enable()
        self.at_work.discard(self)
        self.worker.finish()
