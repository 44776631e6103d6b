"""Fixtures of the tests of the node."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from forward_grid_mapper.node.background import NICE

sys.path.insert(0, str(Path(__file__).parent))

# for all tests of this process, since workers of nodes get hardly any time while tests that wait have more priority
if hasattr(os, 'nice'):
    os.nice(max(NICE - os.nice(0), 0))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A monotonic clock that stays at `now`, seconds."""
    made = SimpleNamespace(now=50.0)
    monkeypatch.setattr(time, 'monotonic', lambda: made.now)
    return made


@pytest.fixture
def start(domain: int, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Start nodes in other processes, and end them after the test; `ready` waits until they subscribe."""
    from robot import NodeProcess

    nodes = []

    def begin(*arguments: str, ready: bool = True, **changes: str) -> NodeProcess:
        node = NodeProcess(domain, tmp_path / f'node_{len(nodes)}.log', arguments, **changes)
        nodes.append(node)
        if ready:
            node.wait_for('ready:')
        return node

    yield begin
    for node in nodes:
        if node.process.poll() is None:
            node.stop()


@pytest.fixture
def robot(domain: int) -> Iterator[Any]:
    from robot import Robot

    made = Robot(domain)
    yield made
    made.close()


@pytest.fixture
def inside(domain: int, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Make nodes in this process, and end them after the test."""
    from inside import Inside

    nodes = []

    def begin(**parameters: Any) -> Inside:
        node = Inside(domain, tmp_path, **parameters)
        nodes.append(node)
        return node

    yield begin
    for node in nodes:
        node.close()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> type[Any]:
    """A refiner that finds a trajectory at once; with `quick.accepts = False` it rejects it."""
    from drift_samples import QuickRefiner

    from forward_grid_mapper.node import refining

    refiner = type('Quick', (QuickRefiner,), {})
    monkeypatch.setattr(refining, 'Refiner', refiner)
    return refiner
