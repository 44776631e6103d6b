"""The times at which recorded messages are published: the stamps of a bag against the wall clock."""

from __future__ import annotations

import time
from collections.abc import Callable

from ..core.messages.message_types import NANOSECONDS

LONGEST_GAP = 60 * NANOSECONDS
"""A longer gap between stamps is skipped: a clock was set, or a driver does not set stamps."""

STEP_BACK = NANOSECONDS
"""If the stamps of a topic go back by more, its time begins again: the recording spans two runs of a clock."""

LATE = 0.5
"""Delay of messages, seconds, from which the rest is shifted, so that they are not sent in a burst."""


class Timeline:
    """The time of a bag, in nanoseconds, at a rate relative to the wall clock.

    Messages keep the order of the recording. A message with an earlier stamp than the one before, as of sensors with a
    latency, is due at once.

    Parameters
    ----------
    rate : float
        Bag seconds for each second.
    now : callable
        Returns monotonic seconds.

    Attributes
    ----------
    jumps : int
        Number of times that the stamps went back or left a gap that was skipped.
    """

    def __init__(self, rate: float, now: Callable[[], float] = time.monotonic) -> None:
        self.jumps = 0
        self._rate = rate
        self._now = now
        self._latest: int | None = None
        self._own: dict[str, int] = {}
        self._anchor = 0.0, 0

    def due(self, topic: str, stamp: int) -> float:
        """Return the time at which to publish the next message, monotonic seconds; not after now if it is late."""
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
        """Return the bag's time, at most that of the last message for which `due` was called."""
        if self._latest is None:
            return 0
        wall, begin = self._anchor
        # at a high rate the product may be infinite
        return begin + int(min((self._now() - wall) * self._rate * NANOSECONDS, self._latest - begin))
