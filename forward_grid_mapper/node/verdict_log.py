"""What the log is told of the input: each fault when it has lasted, and that all is well again."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any

LOOKS = 2
"""Looks in a row, a second apart, after which a fault is no passing one, as at the start."""

AGAIN = 60.0
"""Seconds after which a fault that came back is told of again."""

MOST = 100
"""Faults that are remembered."""

# of how many seconds a sensor is judged changes with how often it sends
_NUMBER = re.compile(r'\blast second\b|\blast \d+ s\b|\d+(?:\.\d+)?')


class VerdictLog:
    """Tells the log what diagnostics say every second: once when it begins, and once when it has ended."""

    def __init__(self, logger: Any) -> None:
        self._log = logger
        self._seen: dict[str, int] = {}
        self._told: dict[str, float] = {}
        self._open: set[str] = set()
        self._bad = False

    def look(self, faults: Sequence[str], well: bool) -> None:
        """Take the faults of now, and whether readings are mapped without any; numbers in them do not make them new."""
        now = time.monotonic()
        kinds = {_NUMBER.sub('#', fault): fault for fault in faults}
        self._seen = {kind: self._seen.get(kind, 0) + 1 for kind in kinds}
        self._open.intersection_update(kinds)
        for kind, fault in kinds.items():
            # one that came back too early is told of later, if it stays
            if kind in self._open or self._seen[kind] < LOOKS or now < self._told.get(kind, -AGAIN) + AGAIN:
                continue
            if len(self._told) >= MOST:
                self._told.clear()
            self._told[kind] = now
            self._open.add(kind)
            self._bad = True
            self._log.warning(fault)
        if self._bad and well:
            self._bad = False
            self._log.info('readings are mapped without faults again')
