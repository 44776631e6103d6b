"""Asks the disk now and then to keep what was written, in a thread of its own: a slow one takes seconds for it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

PERIOD = 1.0
"""Seconds between two requests."""


class Syncer:
    """Calls fdatasync on the files that changed; whoever writes never waits for it."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._trouble = ''
        self._changed: dict[int, int] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name='sync', daemon=True)
        self._thread.start()

    def changed(self, file: int) -> None:
        """Note that something was written to an open file, which may be closed right away."""
        with self._lock:
            if file not in self._changed:
                self._changed[file] = os.dup(file)

    def closed(self, file: int) -> None:
        """Note that the file is closed, so that its number may come to mean another."""
        with self._lock:
            copy = self._changed.pop(file, None)
            if copy is not None:
                # numbers below zero are nobody's
                self._changed[-copy - 1] = copy

    def close(self, seconds: float) -> None:
        """Ask once more, and give it so many seconds."""
        self._stop.set()
        self._thread.join(seconds)

    def _work(self) -> None:
        while not self._stop.wait(PERIOD):
            self._flush()
        self._flush()

    def _flush(self) -> None:
        with self._lock:
            files, self._changed = list(self._changed.values()), {}
        for file in files:
            try:
                os.fdatasync(file)
            except OSError as error:
                if error.strerror != self._trouble:
                    self._trouble = error.strerror or str(error)
                    self._warn(f'the disk does not keep what is written to it: {self._trouble}')
            finally:
                os.close(file)
