"""What all tests need."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from forward_grid_mapper.commands.domain import own_domain

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

COMPILES = ('commands', 'test_warm_up.py')
"""The file whose tests compile all kernels."""

NO_KERNELS = ('bags', 'files')
"""Folders whose tests need no kernel, or few."""

SHARED = Path(__file__).resolve().parents[2] / 'shared'


@pytest.fixture
def shared() -> Path:
    """The folder of real recordings beside the checkout."""
    if not (SHARED / 'data').is_dir():
        pytest.skip(f'the real recordings are not at {SHARED}')
    return SHARED


@pytest.fixture
def domain() -> Iterator[int]:
    """A DDS domain that nobody else has: no other test, and no other run of the tests on this machine."""
    with own_domain() as number:
        yield number


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have all kernels compiled at once, and by one worker alone: the other does meanwhile what needs none of them.

    Whoever calls a kernel that is not in the cache compiles it, so that two workers that began with tests of the core
    would both compile all of it.
    """
    items.sort(key=lambda item: turn(item.path))


def turn(path: Path) -> int:
    """When the tests of a file have their turn; files of one turn come in the order of their names."""
    parts = path.parts[len(HERE.parts) :]
    if parts == COMPILES:
        return 0
    return 1 if parts[:1] and parts[0] in NO_KERNELS else 2


def pytest_configure() -> None:
    """Have participants of DDS find each other soon, and hear Ctrl-C, here and in the processes that tests start.

    A shell without job control has background commands ignore Ctrl-C, and `nohup` a terminal that closes; processes
    hand that down.

    Bytecode is written even where the environment says not to: hundreds of processes start, and each would compile
    the sources of the package, which takes a quarter of a start.
    """
    os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
    sys.dont_write_bytecode = False
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(HERE / 'fast_discovery.xml'))
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
