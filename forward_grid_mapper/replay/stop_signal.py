"""Ctrl-C, SIGTERM and SIGHUP as a request to stop, which ends every wait."""

from __future__ import annotations

import os
import select
import signal
import time
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

AT_ONCE = 3600.0
"""Longest wait of one call of the system, seconds; it accepts only some centuries."""


class StopSignal:
    """Handles the signals in a `with` block; used in the main thread.

    The signals wake `wait` through a pipe: setting a `threading.Event` in a handler may find the event's own lock held
    by the wait, and blocking the signals would not affect the threads that numpy has started.
    """

    def __init__(self) -> None:
        self._requested = False
        self._handlers: dict[signal.Signals, Any] = {}
        self._pipe = (-1, -1)

    def __enter__(self) -> StopSignal:
        """Set the handlers."""
        self._pipe = os.pipe()
        for end in self._pipe:
            os.set_blocking(end, False)
        signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        # `nohup` ignores SIGHUP
        wanted = [number for number in SIGNALS if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN]
        self._handlers = {number: signal.signal(number, self._request) for number in wanted}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the previous handlers; a signal that stopped us is ignored from now on."""
        for number, handler in self._handlers.items():
            signal.signal(number, signal.SIG_IGN if self._requested else handler)
        signal.set_wakeup_fd(-1)
        for end in self._pipe:
            os.close(end)

    def is_set(self) -> bool:
        """Return whether to stop."""
        return self._requested

    def wait(self, seconds: float) -> bool:
        """Wait, unless there was a signal; return whether to stop."""
        deadline = time.monotonic() + seconds
        while not self._requested:
            left = deadline - time.monotonic()
            if left <= 0:
                break
            if select.select([self._pipe[0]], [], [], min(left, AT_ONCE))[0]:
                # signals of other kinds wake it too; the handler of ours has run by now
                os.read(self._pipe[0], 512)
        return self._requested

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._requested = True
