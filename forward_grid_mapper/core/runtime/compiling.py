"""Whether kernels are compiled just now, rather than found in the cache."""

from __future__ import annotations

import threading
from typing import Any

from numba.core import event

events: Any = event


class _Compilations(events.Listener):  # type: ignore[misc]
    """Counts compilations: those begun, and those that run. Kernels may be compiled in several threads."""

    def __init__(self) -> None:
        self.begun = self.running = 0
        self._lock = threading.Lock()

    def on_start(self, event: Any) -> None:
        """Note the begin of a compilation."""
        with self._lock:
            self.begun += 1
            self.running += 1

    def on_end(self, event: Any) -> None:
        """Note its end."""
        with self._lock:
            self.running -= 1


_compilations = _Compilations()
events.register('numba:compile', _compilations)


def compiling() -> bool:
    """Return whether a kernel is being compiled."""
    return _compilations.running > 0


def count() -> int:
    """Return how many compilations this process has begun; a kernel that calls another begins two."""
    return _compilations.begun
