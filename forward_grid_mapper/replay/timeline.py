"""When a recorded message is due: the stamps of a bag against the wall clock."""

from __future__ import annotations

import time
from collections.abc import Callable

from ..core.messages.message_types import NANOSECONDS

LONGEST_GAP = 60 * NANOSECONDS
"""A longer gap between stamps is not waited for: a clock was set, or a driver does not stamp."""

STEP_BACK = NANOSECONDS
"""A topic whose stamps go back by more begins anew: the recording spans two runs of a clock."""

LATE = 0.5
"""Seconds by which messages may be late before the rest is shifted, so that they do not come in a burst."""


class Timeline:
    """The time of a bag, in nanoseconds, that runs at a rate of the wall clock's.

    Messages keep the order in which they were recorded. One that is stamped earlier than its forerunner, as sensors
    with a latency are, is due at once.

    Parameters
    ----------
    rate : float
        Bag seconds in a second.
    now : callable
        Returns monotonic seconds.

    Attributes
    ----------
    jumps : int
        How often the stamps went back or left a gap that was not waited for.
    """

    def __init__(self, rate: float, now: Callable[[], float] = time.monotonic) -> None:
        self.jumps = 0
        self._rate = rate
        self._now = now
        self._latest: int | None = None
        self._own: dict[str, int] = {}
        self._anchor = 0.0, 0

    def due(self, topic: str, stamp: int) -> float:
        """Return when the next message is to be published, in monotonic seconds; not after now if it is late."""
        now = self._now()
        back = stamp < self._own.get(topic, stamp) - STEP_BACK
        self._own[topic] = stamp
        if self._latest is None or stamp > self._latest + LONGEST_GAP or (back and stamp < self._latest - STEP_BACK):
            self.jumps += self._latest is not None
            self._latest = stamp
            self._anchor = now, stamp
            return now
        if stamp <= self._latest:
            return now
        self._latest = stamp
        wall, begin = self._anchor
        due = wall + (stamp - begin) / NANOSECONDS / self._rate
        if now > due + LATE:
            self._anchor = now, stamp
            return now
        return due

    def time(self) -> int:
        """Return the bag's time, which waits at the last message that `due` was asked for."""
        if self._latest is None:
            return 0
        wall, begin = self._anchor
        return min(self._latest, begin + int((self._now() - wall) * self._rate * NANOSECONDS))
