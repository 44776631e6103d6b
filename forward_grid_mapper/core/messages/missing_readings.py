"""Checks of Range messages before association: readings without an echo that the driver leaves out.

REP 117 asks for +inf if there is no echo: the evidence that a cone is free. Many drivers of cheap sonars send nothing
then. This is no error either, but the map lacks the free space, most of all in front of smooth walls.

So the intervals between the stamps of a sensor are counted. A sensor whose readings are left out pauses again and again
for many periods while others send, and no reading of any sensor is without an echo. Messages that get lost one by one
make short pauses only. Sensors that are triggered in turn, each after the echo of the one before, have longer intervals
in a wide place than in a narrow one: by at most the time in which all wait for an echo from max_range.
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from .message_batch import Ranges
from .message_types import NANOSECONDS, RangeMessage
from .sensor_records import record_of

EDGES: NDArray[np.int64] = np.round(np.geomspace(1e6, 10.0 * NANOSECONDS, 200)).astype(np.int64)
"""Nanoseconds between which intervals are counted; shorter and longer ones are not."""

EDGE_LIST: list[int] = EDGES.tolist()

MIDDLES = np.sqrt(EDGES[:-1].astype(np.float64) * EDGES[1:])
"""Nanoseconds that stand for the intervals of each pair of edges."""

PAUSE_PERIODS = 3.5
"""A pause is an interval of at least this many periods."""

SLOWEST_SOUND = 300.0
"""Metres per second, less than on the coldest day."""

LONGEST_SONAR_RANGE = 20.0
"""Metres; no sonar waits for an echo from farther away, so a larger max_range is in another unit or not stated."""

LEAST_INTERVALS = 100
"""Fewest intervals of a sensor."""

LEAST_PAUSE_SHARE = 0.15
"""Fraction of its time for which a sensor pauses and others do not."""

LEAST_SENSORS = 2
"""Fewest such sensors; a single one may have a bad contact."""

MOST_NO_ECHO = 0.002
"""Largest fraction of readings without an echo, if they are left out."""


class _Intervals:
    """The lengths of the intervals between stamps."""

    def __init__(self) -> None:
        self._last: int | None = None
        self.counts = np.zeros(len(MIDDLES), np.int64)

    def add(self, stamp: int) -> None:
        """Count the interval from the latest stamp to this one."""
        if self._last is not None and EDGE_LIST[0] <= stamp - self._last < EDGE_LIST[-1]:
            # for single numbers ten times as fast as that of numpy
            self.counts[bisect_right(EDGE_LIST, stamp - self._last) - 1] += 1
        self._last = stamp

    def add_all(self, stamps: NDArray[np.int64]) -> None:
        """Apply `add` to each stamp, shape (N,)."""
        if not len(stamps):
            return
        steps = np.diff(stamps if self._last is None else np.append(np.int64(self._last), stamps))
        steps = steps[(steps >= EDGES[0]) & (steps < EDGES[-1])]
        at = np.searchsorted(EDGES, steps, side='right') - 1
        self.counts += np.bincount(at, minlength=len(self.counts))
        self._last = int(stamps[-1])

    @property
    def period(self) -> float:
        """The usual interval, nanoseconds; pauses are up to three quarters of the intervals."""
        total = np.cumsum(self.counts)
        return float(MIDDLES[np.searchsorted(total, 0.25 * total[-1])])

    def longer(self, than: float) -> float:
        """Return the time in intervals that are longer than this many nanoseconds, nanoseconds."""
        return float((self.counts * MIDDLES)[than < MIDDLES].sum())


class MissingReadings:
    """Counts the intervals of each sensor, and warns if readings without an echo seem to be left out."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all messages."""
        self._by_frame: dict[str, _Intervals] = {}
        self._together = _Intervals()
        self._count = self._silent = 0
        self._largest_max_range = 0.0

    def add(self, message: RangeMessage) -> None:
        """Take a message."""
        self._count += 1
        self._silent += not 0.0 < message.range < message.max_range
        if self._largest_max_range < message.max_range < LONGEST_SONAR_RANGE:
            self._largest_max_range = message.max_range
        self._together.add(message.stamp)
        if own := record_of(self._by_frame, message.frame_id, _Intervals):
            own.add(message.stamp)

    def add_all(self, messages: Ranges) -> None:
        """Apply `add` to many messages."""
        echo = (messages.range > 0.0) & (messages.range < messages.max_range)
        self._count += len(echo)
        self._silent += len(echo) - int(np.count_nonzero(echo))
        self._largest_max_range = float(
            messages.max_range[messages.max_range < LONGEST_SONAR_RANGE].max(initial=self._largest_max_range)
        )
        self._together.add_all(messages.stamp)
        for frame, part in messages.of_each():
            if own := record_of(self._by_frame, frame, _Intervals):
                own.add_all(messages.stamp[part])

    def warnings(self) -> list[str]:
        """Return a warning; empty if there is no suspicion."""
        if self._silent > MOST_NO_ECHO * self._count:
            return []
        missing = {}
        waiting = len(self._by_frame) * 2.0 * self._largest_max_range / SLOWEST_SOUND * NANOSECONDS
        for frame, own in self._by_frame.items():
            if own.counts.sum() >= LEAST_INTERVALS:
                pause = max(PAUSE_PERIODS * own.period, own.period + waiting)
                # while all sensors pause, the driver has stopped
                missing[frame] = (own.longer(pause) - self._together.longer(pause)) / own.longer(0.0)
        found = sorted(frame for frame, part in missing.items() if part > LEAST_PAUSE_SHARE)
        if len(found) < LEAST_SENSORS:
            return []
        names, most = ', '.join(found[:3]), max(missing.values())
        more = f' and {len(found) - 3} more' if len(found) > 3 else ''
        return [
            f'sensors {names}{more} send nothing for up to {most:.0%} of the time while others send, and no reading is '
            'without an echo: does the driver leave out readings without an echo? It must send them with the range '
            '+inf (REP 117), since they are the evidence for free space. Ignore this if the robot switches sensors off '
            'for a time'
        ]
