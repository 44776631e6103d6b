"""Tells whether kernels are being compiled, that is, were not found in the cache."""

from __future__ import annotations

import threading
from typing import Any

from numba.core import event

events: Any = event


class _Compilations(events.Listener):  # type: ignore[misc]
    """Counts compilations that were begun, and those that are running; several threads may compile."""

    def __init__(self) -> None:
        self.begun = self.running = 0
        self._lock = threading.Lock()

    def on_start(self, event: Any) -> None:
        """Count the start of a compilation."""
        with self._lock:
            self.begun += 1
            self.running += 1

    def on_end(self, event: Any) -> None:
        """Count its end."""
        with self._lock:
            self.running -= 1


_compilations = _Compilations()
events.register('numba:compile', _compilations)


def compiling() -> bool:
    """Return whether a kernel is being compiled."""
    return _compilations.running > 0


def count() -> int:
    """Return the number of compilations that this process has begun; two for a kernel that calls another one."""
    return _compilations.begun
