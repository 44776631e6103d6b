"""Estimates of lost messages, from the messages that arrived.

A middleware keeps a bounded number of messages for a subscription, and drops the oldest of more, even if QoS is
reliable; neither side is informed. Publishers number their messages, so losses follow from gaps. If a middleware gives
no numbers, losses follow from gaps in the stamps of a sensor, if it measures at a steady rate.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from ..core.messages.message_types import NANOSECONDS

MOST_STREAMS = 256
"""Most publishers, or sensors, of a topic that are distinguished."""

NEW_PUBLISHER_GAP = 100
"""Gap, messages, from which an unknown publisher is more likely than a loss, if there is one."""

LOSS_WARNING = 10.0
"""Seconds for which the node warns of a loss."""

STEADY = 8
"""Intervals of similar length after which the rate of a sensor is steady; this many longer ones are another rate."""

SWITCHED_OFF = 60 * NANOSECONDS
"""Nanoseconds without a stamp from which a sensor was rather switched off than its messages lost."""


class _Stream(NamedTuple):
    """The stamps of a sensor: the last one, the usual interval, and how many intervals were like that.

    `gap` is the last interval, if that was longer than usual, and `again` how many in succession were like it.
    """

    last: int
    interval: float = 0.0
    steady: int = 0
    gap: int = 0
    again: int = 0


class Losses:
    """Counts the messages lost on one topic.

    A loss that the middleware reports may be seen as a gap too, before or after the report, so the larger of both
    counts is taken.

    Attributes
    ----------
    recent : float
        Time of the last loss, by `time.monotonic`.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        """Begin with no losses; `publishers` returns the number of publishers of the topic."""
        self._publishers = publishers
        self.clear()
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget the last numbers and stamps, since the node was not subscribed for a while."""
        self._newest: list[int] = []
        self._stamps: dict[str, _Stream] = {}

    def clear(self) -> None:
        """Set the counts to 0."""
        self._reported = self._in_gaps = self._dropped = 0
        self.recent = -LOSS_WARNING

    @property
    def lost(self) -> int:
        """Number of lost messages so far."""
        return self._dropped + max(self._reported, self._in_gaps)

    def taken(self, info: dict[str, Any], frame: str, stamp: int) -> None:
        """Note a message: rclpy's info, frame_id, and stamp in nanoseconds."""
        number = info.get('publication_sequence_number')
        missing = self._by_stamp(frame, stamp) if number is None else self._by_number(number)
        self._add(in_gaps=missing)

    def reported(self, info: Any) -> None:
        """Note losses that the middleware reports."""
        self._add(reported=info.total_count_change)

    def dropped(self) -> None:
        """Note a message that arrived, and that the node could not keep."""
        self._add(dropped=1)

    def _add(self, in_gaps: int = 0, reported: int = 0, dropped: int = 0) -> None:
        self._in_gaps += in_gaps
        self._reported += reported
        self._dropped += dropped
        if in_gaps or reported or dropped:
            self.recent = time.monotonic()

    def _by_number(self, number: int) -> int:
        """Return the number of messages missing before this one, for the publisher with the nearest number."""
        before = [(number - newest, k) for k, newest in enumerate(self._newest) if newest < number]
        if before:
            gap, k = min(before)
            if gap <= NEW_PUBLISHER_GAP or self._publishers() <= len(self._newest):
                self._newest[k] = number
                return gap - 1
        if len(self._newest) == MOST_STREAMS:
            self._newest.clear()
        self._newest.append(number)
        return 0

    def _by_stamp(self, frame: str, stamp: int) -> int:
        """Return the number of missing messages: usual intervals since the sensor's last message, minus one."""
        last, interval, steady, gap, again = self._stamps.get(frame, _Stream(stamp))
        if len(self._stamps) >= MOST_STREAMS and frame not in self._stamps:
            return 0
        step, missing = stamp - last, 0
        again = again + 1 if 0.7 * gap < step < 1.3 * gap else 1
        gap = 0
        if interval and 0.7 * interval < step < 1.3 * interval:
            interval, steady = interval + 0.1 * (step - interval), steady + 1
        elif interval and steady >= STEADY and 1.7 * interval <= step < SWITCHED_OFF and again < STEADY:
            missing, gap = round(step / interval) - 1, step
        elif 0 < step < SWITCHED_OFF:
            # after many equal gaps, the sensor has another rate
            interval, steady = float(step), again if again >= STEADY else 0
        self._stamps[frame] = _Stream(stamp, interval, steady, gap, again)
        return missing
