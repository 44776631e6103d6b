"""How long commands wait for the node that they start, with stand-ins for the node and its client."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from forward_grid_mapper.commands.live_node import LONGEST_COMPILATION, LONGEST_SILENCE, Limit, LiveNode
from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.core.common.parameters import Parameters

SECONDS = 10.0
"""Time that passes in each turn of the client."""


def diagnostics(kernels: str, name: str = 'forward_grid_mapper: background') -> Any:
    pairs = [SimpleNamespace(key='EM', value='1 to do'), SimpleNamespace(key='kernels', value=kernels)]
    return SimpleNamespace(status=[SimpleNamespace(name=name, values=pairs)])


class Turned:
    """A node that was started; each turn of its client takes some seconds, and may bring diagnostics."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, comes: Callable[[float], Any]) -> None:
        self.now, self.told, self.ended = 0.0, list[str](), None
        monkeypatch.setitem(sys.modules, 'rclpy', SimpleNamespace(spin_once=self._turn))
        self._comes = comes
        self.node: Any = LiveNode(folder, Parameters(), [], self.told.append)
        self.node._limit = Limit(lambda: self.now)
        self.node._process = SimpleNamespace(poll=lambda: self.ended)

    def _turn(self, client: Any, timeout_sec: float) -> None:
        self.now += SECONDS
        if message := self._comes(self.now):
            self.node._limit.hear(message)

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        self.node._wait(lambda: self.now >= end, 'running EM')


@pytest.fixture
def turned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[float], Any]], Turned]:
    return lambda comes: Turned(tmp_path, monkeypatch, comes)


def test_compilation_on_a_slow_computer_is_waited_for_with_a_note(turned: Any) -> None:
    made = turned(lambda now: diagnostics('2 to do' if now < 10 * LONGEST_SILENCE else 'idle'))
    made.wait(10.5 * LONGEST_SILENCE)
    assert made.told[0] == made.told[-1] == 'running EM'
    assert 'running EM: waiting until the node has compiled its kernels (2 to do), at most 60 minutes' in made.told


def test_compilation_is_not_waited_for_without_end(turned: Any) -> None:
    made = turned(lambda now: diagnostics('1 to do'))
    with pytest.raises(MapperError, match=r'running EM: the node still compiles after 60 minutes; .* warm_up'):
        made.wait(10 * LONGEST_COMPILATION)
    assert LONGEST_COMPILATION <= made.now <= LONGEST_COMPILATION + SECONDS
    # the next call has a time of its own
    made.wait(LONGEST_COMPILATION / 2)


@pytest.mark.parametrize(
    'comes',
    [
        lambda now: None,
        lambda now: diagnostics('idle'),
        lambda now: diagnostics("RuntimeError('broken')"),
        lambda now: diagnostics('1 to do', 'another_node: background'),
    ],
)
def test_node_that_does_not_answer_is_not_waited_for_long(turned: Any, comes: Callable[[float], Any]) -> None:
    made = turned(comes)
    made.wait(LONGEST_SILENCE / 2)
    with pytest.raises(MapperError, match='running EM: the node has not answered for 180 s; it printed nothing'):
        made.wait(10 * LONGEST_SILENCE)
    assert made.now <= 1.5 * LONGEST_SILENCE + 2 * SECONDS


def test_node_that_hangs_while_it_compiles_is_not_waited_for_long(turned: Any) -> None:
    made = turned(lambda now: diagnostics('1 to do') if now < 3 * LONGEST_SILENCE else None)
    with pytest.raises(MapperError, match='has not answered for 180 s'):
        made.wait(10 * LONGEST_SILENCE)
    assert made.now <= 4 * LONGEST_SILENCE + SECONDS


def test_node_that_ends_is_reported_at_once(turned: Any, tmp_path: Path) -> None:
    made = turned(lambda now: diagnostics('1 to do'))
    made.ended = 1
    (tmp_path / 'node.log').write_text('a\nb\nc\nmapper: error: no\n')
    with pytest.raises(MapperError, match=r'the node ended; its last words: b \| c \| mapper: error: no'):
        made.wait(LONGEST_SILENCE)
    assert made.now == 0.0
