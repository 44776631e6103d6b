"""Compilation in the background: the order, waiting for it, and errors."""

from __future__ import annotations

import gc
import importlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from patience import PATIENCE

from forward_grid_mapper.core import warm_up
from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.node.kernels import Kernels


class Compiling:
    """Steps that wait until the test lets them continue."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[str] = []
        self.lines: list[str] = []
        self.ready: list[str] = []
        self.failing = ''
        self.go_on = {name: threading.Event() for name in warm_up.STEPS}
        monkeypatch.setattr(warm_up, 'STEPS', {name: self._step(name) for name in warm_up.STEPS})

    def _step(self, name: str) -> Callable[[], None]:
        def compile_it() -> None:
            assert self.go_on[name].wait(60.0)
            if name == self.failing:
                raise MemoryError
            self.done.append(name)

        return compile_it

    def begin(self, online: bool = True, refine: bool = True) -> Kernels:
        kernels = Kernels(self.lines.append, self.lines.append, online, refine)
        kernels.begin(lambda: self.ready.append(kernels.stage))
        return kernels


@pytest.fixture
def compiling(monkeypatch: pytest.MonkeyPatch) -> Iterator[Compiling]:
    made = Compiling(monkeypatch)
    yield made
    for event in made.go_on.values():
        event.set()
    gc.enable()
    gc.unfreeze()


def ended(kernels: Kernels) -> None:
    """Wait until compilation is done and the thread has ended."""
    for thread in threading.enumerate():
        if thread.name == 'kernels':
            thread.join(PATIENCE)
    assert kernels not in Kernels.at_work and not kernels.worker.waiting
    assert 'kernels' not in {thread.name for thread in threading.enumerate()}


def test_kernels_of_the_live_map_are_compiled_first(compiling: Compiling) -> None:
    kernels = compiling.begin()
    assert not kernels.has('live map') and kernels.stage == 'live map' and not gc.isenabled()
    compiling.go_on['live map'].set()
    kernels.wait('live map')
    assert not kernels.has('EM')
    stopped = iter([False, True])
    with pytest.raises(Cancelled):
        kernels.wait('EM', lambda: next(stopped))
    for event in compiling.go_on.values():
        event.set()
    kernels.wait('EM')
    ended(kernels)
    assert compiling.ready == ['live map'] and compiling.done == list(warm_up.STEPS)
    assert (kernels.stage, kernels in Kernels.at_work, gc.isenabled()) == ('', False, True)


def test_unneeded_steps_are_compiled_once_they_are_waited_for(compiling: Compiling) -> None:
    for event in compiling.go_on.values():
        event.set()
    kernels = compiling.begin(online=False, refine=False)
    ended(kernels)
    assert compiling.done == [name for name in warm_up.STEPS if name not in ('online map', 'trajectory')]
    assert not kernels.has('trajectory')
    for _ in range(2):
        kernels.wait('trajectory')
        assert kernels.has('trajectory')
    assert compiling.done.count('trajectory') == 1 and 'online map' not in compiling.done
    assert any(line.startswith('trajectory kernels are ready') for line in compiling.lines)


@pytest.mark.parametrize('failing', ['live map', 'EM'])
def test_failing_step_blocks_no_caller(compiling: Compiling, failing: str) -> None:
    compiling.failing = failing
    for event in compiling.go_on.values():
        event.set()
    kernels = compiling.begin()
    for name in warm_up.STEPS:
        kernels.wait(name)
    ended(kernels)
    assert len(compiling.ready) == 1
    assert any('there is not enough memory' in text for text in compiling.lines)
    assert kernels.worker.trouble and kernels not in Kernels.at_work and gc.isenabled()


def test_garbage_collector_is_enabled_after_an_error_of_drawing(
    compiling: Compiling, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> None:
        raise AttributeError('matplotlib was built for another numpy')

    monkeypatch.setattr(importlib, 'import_module', fail)
    for event in compiling.go_on.values():
        event.set()
    kernels = compiling.begin()
    ended(kernels)
    assert gc.isenabled() and kernels not in Kernels.at_work and kernels.worker.trouble == ''


def test_failed_start_of_the_thread_blocks_no_caller(compiling: Compiling, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, 'start', fail)
    kernels = compiling.begin()
    assert len(compiling.ready) == 1 and all(kernels.has(name) for name in warm_up.STEPS)
    assert gc.isenabled() and kernels not in Kernels.at_work
