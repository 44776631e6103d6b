"""One orderly end, however often Ctrl-C is pressed: SIGINT and SIGTERM become a single request to stop."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable

SIGNALS = {signal.SIGINT, signal.SIGTERM}
GRACE = 5.0
"""Seconds that an orderly end may take before the process is ended anyway."""


class Stopper:
    """Waits for the signals in a thread of its own, so that they interrupt nothing.

    To be made before any other thread, since threads inherit the signal mask. `ros2 launch` sends SIGINT twice, which
    would otherwise hit the cleanup as a KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.requested = threading.Event()
        self._stop: Callable[[], None] | None = None
        self._lock = threading.Lock()
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        threading.Thread(target=self._wait, daemon=True, name='stopper').start()

    def call(self, stop: Callable[[], None]) -> None:
        """Set what ends the program; until then a signal ends it at once, since nothing can be lost yet."""
        with self._lock:
            self._stop = stop
            late = self.requested.is_set()
        if late:
            stop()

    def _wait(self) -> None:
        signal.sigwait(SIGNALS)
        with self._lock:
            self.requested.set()
            stop = self._stop
        if stop is None:
            self._exit(0)
        else:
            stop()
            threading.Event().wait(GRACE)
            self._exit(1)

    @staticmethod
    def _exit(code: int) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
