"""An orderly shutdown: any number of SIGINT, SIGTERM and SIGHUP become a single request to stop."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
GRACE = 5.0
"""Longest duration of an orderly shutdown, seconds; then the process is ended."""


class Stopper:
    """Waits for the signals in a thread of its own, so that they interrupt no other.

    It must be created before any other thread, since threads inherit the signal mask. `ros2 launch` sends SIGINT twice;
    the second one would raise KeyboardInterrupt during the shutdown.
    """

    def __init__(self) -> None:
        self.requested = threading.Event()
        self._stop: Callable[[], None] | None = None
        self._lock = threading.Lock()
        # `nohup` ignores SIGHUP, but `sigwait` would receive it
        nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        self._signals = SIGNALS - {signal.SIGHUP} if nohup else SIGNALS
        signal.pthread_sigmask(signal.SIG_BLOCK, self._signals)
        threading.Thread(target=self._wait, daemon=True, name='stopper').start()

    def call(self, stop: Callable[[], None]) -> None:
        """Set the function that ends the program; before, a signal ends it at once, since no data can be lost yet."""
        with self._lock:
            self._stop = stop
            late = self.requested.is_set()
        if late:
            stop()

    def _wait(self) -> None:
        signal.sigwait(self._signals)
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
        # after SIGHUP there is no terminal
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
