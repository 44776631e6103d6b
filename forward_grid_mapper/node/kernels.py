"""Compilation in the background while the node listens already: what is needed first, first."""

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
    """Says of each step of `warm_up.STEPS` whether its kernels are there.

    Attributes
    ----------
    stage : str
        What is being compiled; empty when all is there.
    at_work : set of Kernels
        Those whose threads still compile or import, during which the interpreter must not be taken down.
    """

    at_work: ClassVar[set[Kernels]] = set()

    def __init__(
        self, log: Callable[[str], object], error: Callable[[str], object], online: bool, refine: bool = False
    ) -> None:
        """`log` takes notes, `error` what went wrong.

        The kernels of the online map are left out without `online`, those that find a trajectory without `refine`.
        """
        self._log = log
        self.worker = Worker('kernels', error, lasting=True)
        wanted = {'online map': online, 'trajectory': refine}
        self._steps = {name: step for name, step in warm_up.STEPS.items() if wanted.get(name, True)}
        self._left = len(self._steps)
        self._done = {name: threading.Event() for name in self._steps}
        self.stage = next(iter(self._steps))

    def begin(self, ready: Callable[[], None]) -> None:
        """Begin to compile; `ready` is called, in another thread, when the live map has its kernels."""
        self.at_work.add(self)
        self._log('preparing kernels; the first start compiles them, which takes half a minute or more')
        begin = time.monotonic()
        # the collector would go through all that the compiler made again and again, and keep the executor waiting
        gc.disable()
        for name in self._steps:
            self.worker.put(partial(self._compile, name, ready, begin), lambda why: self._give_up(ready))

    def wait(self, name: str, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for the kernels of a step; those of a step that was left out are compiled by who needs them.

        Raises
        ------
        Cancelled
            When `stop` returns true.
        """
        while name in self._done and not self._done[name].wait(0.1):
            if stop():
                raise Cancelled('cancelled while kernels were compiled')

    def has(self, name: str) -> bool:
        """Return whether the kernels of a step are there, or it was left out."""
        return name not in self._done or self._done[name].is_set()

    def _compile(self, name: str, ready: Callable[[], None], begin: float) -> None:
        self.stage = name
        self._steps[name]()
        self._log(f'kernels of the {name} are ready after {time.monotonic() - begin:.1f} s')
        self._done[name].set()
        if name == 'live map':
            ready()
        self._one_less()

    def _give_up(self, ready: Callable[[], None]) -> None:
        """Let everybody go on: whoever needs a kernel compiles it, and says so if it fails."""
        first = not self.has('live map')
        for done in self._done.values():
            done.set()
        if first:
            ready()
        self._one_less()

    def _one_less(self) -> None:
        """Count a step that is over, well or not; the last one ends the work."""
        self._left -= 1
        if not self._left:
            self._end()

    def _end(self) -> None:
        self.stage = ''
        # what a picture needs is a hundred thousand objects more, and there as well by now; a fault in it is told of
        # when pictures are drawn, and must not leave the collector off
        with suppress(Exception):
            importlib.import_module('..files.drawing', __package__)
        # what is there by now stays; the collector need not look at it again
        gc.freeze()
        gc.enable()
        self.at_work.discard(self)
        self.worker.finish()
