"""Ctrl-C and SIGTERM as a request to stop that every wait notices, however often they come."""

from __future__ import annotations

import os
import select
import signal
import time
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignal:
    """Takes the signals in a `with` block; used in the main thread.

    The signals wake `wait` through a pipe: setting a `threading.Event` in a handler may meet the wait inside the
    event's own lock, and blocking the signals would not reach the threads that numpy has started.
    """

    def __init__(self) -> None:
        self._requested = False
        self._handlers: dict[signal.Signals, Any] = {}
        self._pipe = (-1, -1)

    def __enter__(self) -> StopSignal:
        """Begin to take signals."""
        self._pipe = os.pipe()
        for end in self._pipe:
            os.set_blocking(end, False)
        signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        self._handlers = {number: signal.signal(number, self._request) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave signals to who had them before; a second one of those that stopped us means nothing any more."""
        for number, handler in self._handlers.items():
            signal.signal(number, signal.SIG_IGN if self._requested else handler)
        signal.set_wakeup_fd(-1)
        for end in self._pipe:
            os.close(end)

    def is_set(self) -> bool:
        """Return whether to stop."""
        return self._requested

    def wait(self, seconds: float) -> bool:
        """Wait, but not after a signal; return whether to stop."""
        deadline = time.monotonic() + seconds
        while not self._requested:
            left = deadline - time.monotonic()
            if left <= 0:
                break
            if select.select([self._pipe[0]], [], [], left)[0]:
                # a signal of another kind wakes us too; ours has run its handler by now
                os.read(self._pipe[0], 512)
        return self._requested

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._requested = True
