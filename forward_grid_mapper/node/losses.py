"""Messages that were lost before the node could take them, estimated from what did arrive.

A middleware keeps a bounded number of messages for a subscription, and drops the oldest of more, also where the
subscription is reliable; neither side is told. Publishers number their messages, so the gaps tell. Where a middleware
hands out no numbers, gaps in the stamps of a sensor do, as long as it measures at a steady rate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

MOST_STREAMS = 256
"""Publishers, or sensors, of a topic that are told apart."""

STRANGE = 100
"""Messages missing at once from which on a publisher that was not known is the likelier cause, if there is one."""

LASTING = 10.0
"""Seconds for which a loss is worth a warning."""

STEADY = 8
"""Intervals of about the same length after which a sensor counts as steady."""


class Losses:
    """Counts the messages lost on one topic.

    Attributes
    ----------
    lost : int
        Messages so far.
    recent : float
        When some were lost last, by `time.monotonic`.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        """Begin with nothing lost; `publishers` returns how many publish the topic now."""
        self._publishers = publishers
        self.clear()
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget which message came last, since nobody listened for a while."""
        self._newest: list[int] = []
        self._stamps: dict[str, tuple[int, float, int]] = {}

    def clear(self) -> None:
        """Begin to count anew."""
        self._told = self.lost = 0
        self.recent = -LASTING

    def taken(self, info: dict[str, Any], frame: str, stamp: int) -> None:
        """Note a message, with what rclpy says of it, its frame_id, and its stamp in nanoseconds."""
        number = info.get('publication_sequence_number')
        missing = self._by_stamp(frame, stamp) if number is None else self._by_number(number)
        if missing:
            self.add(missing)

    def told(self, info: Any) -> None:
        """Note what the middleware says of losses; what it says and what gaps tell may be the same messages."""
        self._told += info.total_count_change
        if self._told > self.lost:
            self.add(self._told - self.lost)

    def add(self, missing: int) -> None:
        """Note messages that nobody will take any more."""
        self.lost += missing
        self.recent = time.monotonic()

    def _by_number(self, number: int) -> int:
        """Return how many messages are missing before this one, of the publisher whose numbers come nearest."""
        before = [(number - newest, k) for k, newest in enumerate(self._newest) if newest < number]
        if before:
            gap, k = min(before)
            if gap <= STRANGE or self._publishers() <= len(self._newest):
                self._newest[k] = number
                return gap - 1
        if len(self._newest) == MOST_STREAMS:
            self._newest.clear()
        self._newest.append(number)
        return 0

    def _by_stamp(self, frame: str, stamp: int) -> int:
        """Return how many messages of a sensor's usual interval fit between its last one and this one, less one."""
        last, interval, steady = self._stamps.get(frame, (stamp, 0.0, 0))
        if len(self._stamps) >= MOST_STREAMS and frame not in self._stamps:
            return 0
        step, missing = stamp - last, 0
        if interval and 0.7 * interval < step < 1.3 * interval:
            interval, steady = interval + 0.1 * (step - interval), steady + 1
        elif interval and steady >= STEADY and step >= 1.7 * interval:
            missing = round(step / interval) - 1
        elif step > 0:
            interval, steady = float(step), 0
        self._stamps[frame] = stamp, interval, steady
        return missing
