"""Syncs written data to the disk periodically, in a thread of its own, since a slow disk takes seconds."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

PERIOD = 1.0
"""Seconds between two syncs: what a power cut may lose in addition to a kill."""


class Syncer:
    """Calls fdatasync on the file that changed; the writing thread never waits for it."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._trouble = ''
        self._changed: Path | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name='sync', daemon=True)
        self._thread.start()

    def changed(self, path: Path) -> None:
        """Note that a file was written."""
        with self._lock:
            self._changed = path

    def close(self, seconds: float) -> None:
        """Sync once more, and wait at most this many seconds."""
        self._stop.set()
        self._thread.join(seconds)

    def _work(self) -> None:
        while not self._stop.wait(PERIOD):
            self._flush()
        self._flush()

    def _flush(self) -> None:
        with self._lock:
            path, self._changed = self._changed, None
        if path is None:
            return
        try:
            # its own descriptor, since the writing thread may close its own at any time
            file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                os.fdatasync(file)
            finally:
                os.close(file)
            self._trouble = ''
        except FileNotFoundError:
            # closed by the writing thread, which synced it
            pass
        except OSError as error:
            if error.strerror != self._trouble:
                self._trouble = error.strerror or str(error)
                self._warn(f'the disk does not sync written data: {self._trouble}')
