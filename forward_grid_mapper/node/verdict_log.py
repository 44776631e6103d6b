"""The log of input faults: each fault once it lasts, and the end of all faults once that lasts."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any

CHECKS_BEFORE_LOG = 2
"""Consecutive checks, a second apart, after which a fault is logged: at the start, some faults pass."""

CHECKS_UNTIL_END = 10
"""Consecutive checks without a fault after which it has ended: many faults come and go, and some take seconds to be
found."""

LOG_AGAIN_AFTER = 60.0
"""Seconds before a fault that returned is logged again."""

MOST_FAULTS = 100
"""Most faults that are remembered."""

# the time over which readings are judged depends on the rate of the sensor
_NUMBER = re.compile(r'\blast second\b|\blast \d+ s\b|\d+(?:\.\d+)?')


class VerdictLog:
    """Logs what diagnostics report every second: a fault once, and the end of all faults."""

    def __init__(self, logger: Any) -> None:
        self._log = logger
        self._seen: dict[str, int] = {}
        self._logged: dict[str, float] = {}
        self._open: dict[str, int] = {}
        self._bad = False
        self._well = 0

    def update(self, faults: Sequence[str], well: bool) -> None:
        """Update with the current faults, and whether mapping is free of faults; numbers do not distinguish faults."""
        now = time.monotonic()
        kinds = {_NUMBER.sub('#', fault): fault for fault in faults}
        self._seen = {kind: self._seen.get(kind, 0) + 1 for kind in kinds}
        absent = {kind: 0 if kind in kinds else checks + 1 for kind, checks in self._open.items()}
        self._open = {kind: checks for kind, checks in absent.items() if checks < CHECKS_UNTIL_END}
        for kind, fault in kinds.items():
            # a fault that returned too early is logged later, if it lasts
            if (
                kind in self._open
                or self._seen[kind] < CHECKS_BEFORE_LOG
                or now < self._logged.get(kind, -LOG_AGAIN_AFTER) + LOG_AGAIN_AFTER
            ):
                continue
            if len(self._logged) >= MOST_FAULTS:
                self._logged.clear()
            self._logged[kind] = now
            self._open[kind] = 0
            self._bad = True
            self._log.warning(fault)
        self._well = self._well + 1 if well and not kinds else 0
        if self._bad and self._well >= CHECKS_UNTIL_END:
            self._bad = False
            self._log.info('readings are mapped without faults again')
