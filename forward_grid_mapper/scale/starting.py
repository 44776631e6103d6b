"""Starts processes without interruption by signals."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any


@contextmanager
def signals_later() -> Iterator[None]:
    """Defer signals until the end of the block: processes that are interrupted at their start print tracebacks.

    Processes that are started in the block inherit the mask, and so ignore Ctrl-C, which terminals send to them too.
    """
    # multiprocessing would start it with its first process, and unmask Ctrl-C
    resource_tracker.ensure_running()
    kept: list[int] = []
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, lambda number, frame: kept.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
    if kept:
        signal.raise_signal(kept[0])
