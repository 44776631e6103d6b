"""What all tests need."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from forward_grid_mapper.commands.domain import own_domain

sys.path.insert(0, str(Path(__file__).parent))

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


def pytest_configure() -> None:
    """Have participants of DDS find each other soon, and hear Ctrl-C, here and in the processes that tests start.

    A shell without job control has background commands ignore Ctrl-C, and `nohup` a terminal that closes; processes
    hand that down.
    """
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(Path(__file__).parent / 'fast_discovery.xml'))
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
