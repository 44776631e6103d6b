"""Fixtures and settings of all tests."""

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
"""The file with tests that compile all kernels."""

NO_KERNELS = ('bags', 'files')
"""Folders of tests that need no kernels, or few."""

LONG = ('scale', 'test_library.py', 'test_docs.py')
"""Folders and files that take long, but would come last, alone on one worker, if files were sorted only by name."""

SHARED = Path(__file__).resolve().parents[2] / 'shared'


@pytest.fixture
def shared() -> Path:
    """The folder of real recordings next to the checkout."""
    if not (SHARED / 'data').is_dir():
        pytest.skip(f'the real recordings are not at {SHARED}')
    return SHARED


@pytest.fixture
def domain() -> Iterator[int]:
    """A DDS domain that no other test uses, and no other run of the tests on this machine."""
    with own_domain() as number:
        yield number


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort tests so that one worker compiles all kernels, while the other runs tests without kernels.

    A kernel that is not in the cache is compiled by the process that calls it, so two workers that began with tests of
    the core would both compile all kernels.
    """
    items.sort(key=lambda item: turn(item.path))


def turn(path: Path) -> int:
    """The position of a file in the order of tests; files of the same turn are sorted by name."""
    parts = path.parts[len(HERE.parts) :]
    if parts == COMPILES:
        return 0
    if parts[:1] and parts[0] in NO_KERNELS:
        return 1
    return 2 if parts[:1] and parts[0] in LONG else 3


def pytest_configure() -> None:
    """Set fast discovery for DDS participants, and default signal handlers, also for the processes that tests start.

    In shells without job control, background commands ignore Ctrl-C, and `nohup` ignores the end of a terminal; child
    processes inherit this.

    Bytecode is written even if the environment disables it: hundreds of processes start, and each would compile the
    sources of the package, which takes a quarter of the start.
    """
    os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
    sys.dont_write_bytecode = False
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(HERE / 'fast_discovery.xml'))
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
