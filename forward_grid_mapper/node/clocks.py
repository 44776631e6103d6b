"""Faults of clocks: jumps in the stamps of odometry, and sensors whose stamps differ from those of odometry."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any

from ..core.common.words import counted
from ..core.messages.message_types import NANOSECONDS
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.sensor_records import has_room

JUMP_SPAN = 10.0
"""Seconds for which a jump counts, and between two warnings in the log."""

JUMPS_OF_A_FAULT = 3
"""Jumps within `JUMP_SPAN` that are a fault; fewer may be a bag that is played again."""

LOG_AGAIN_AFTER = 60.0
"""Seconds before a sensor whose fault has ended and begins again is logged again."""

WINDOW = 5 * NANOSECONDS
"""Nanoseconds, by arrivals, for which a sensor must be behind or ahead before a warning."""

LEAST_READINGS = 5
"""Fewest readings within `WINDOW`."""

LEAST_LAG = NANOSECONDS
"""Nanoseconds by which all readings within `WINDOW` must be behind, or all ahead."""

DELAYS_VALID_FOR = 30 * NANOSECONDS
"""Nanoseconds after which the delays of messages are found anew, since a clock may have been set."""

MOST_KEPT = 4000
"""Most odometry messages that are kept to compare readings with, and most readings that wait for odometry."""


class OdometryClock:
    """Warns of jumps in the stamps of odometry: in the log, and as a fault if they repeat."""

    def __init__(self, associator: PoseAssociator, warn: Callable[[str], object]) -> None:
        self._associator, self._warn = associator, warn
        self._seen = self._counts()
        self._jumps: deque[float] = deque(maxlen=JUMPS_OF_A_FAULT)
        self._next = 0.0

    def check(self) -> None:
        """Check for a jump after each message that the associator processed."""
        seen, self._seen = self._seen, self._counts()
        back, ahead = (now - before for now, before in zip(self._seen, seen, strict=True))
        # a reset sets the counters to 0
        if back <= 0 and ahead <= 0:
            return
        now = time.monotonic()
        self._jumps.append(now)
        if now < self._next:
            return
        self._next = now + JUMP_SPAN
        if back > 0:
            self._warn(
                f'the clock jumped back ({counted(self._seen[0], "time")} so far): waiting readings were dropped, and '
                'so was the odometry of the drive, which refine_poses needs; the map is kept: call reset to begin a '
                'new one, as after the restart of a simulation'
            )
        else:
            self._warn(
                'the stamp of an odometry message was more than a second ahead of the others '
                f'({counted(self._seen[1], "time")} so far): this message is ignored'
            )

    def forget(self) -> None:
        """Forget the jumps."""
        self._jumps.clear()

    @property
    def jumped(self) -> bool:
        """Whether a jump still counts."""
        return bool(self._jumps) and time.monotonic() - self._jumps[-1] < JUMP_SPAN

    def faults(self) -> list[str]:
        """Return the faults, in words."""
        if len(self._jumps) < JUMPS_OF_A_FAULT or time.monotonic() - self._jumps[0] > JUMP_SPAN:
            return []
        return ['the stamps of odometry jump again and again: do two nodes publish odometry, or is a clock set?']

    def _counts(self) -> tuple[int, int]:
        associator = self._associator
        jumps = associator.time_jumps - associator.jumps_before_begin
        return jumps, associator.odometry_rejected['ahead_of_others']


class Arrivals:
    """When messages arrived.

    Some middlewares do not say it. Then a message arrived as long after it was sent as the fastest of the sender's last
    ones: the node may take messages late, and the clock of the sender may be wrong.
    """

    def __init__(self) -> None:
        self._delays: dict[str, tuple[int, int, int]] = {}

    def clear(self) -> None:
        """Forget all senders."""
        self._delays.clear()

    def of(self, sender: str, info: Mapping[str, Any]) -> int:
        """Return the time at which a message arrived, nanoseconds of the system's clock, from rclpy's info."""
        if received := info.get('received_timestamp'):
            return int(received)
        now, sent = time.time_ns(), info.get('source_timestamp')
        if not sent or not has_room(self._delays, sender):
            return now
        begin, least, before = self._delays.get(sender, (now, now - sent, now - sent))
        if not 0 <= now - begin < DELAYS_VALID_FOR:
            begin, least, before = now, now - sent, least
        least = min(least, now - sent)
        self._delays[sender] = begin, least, before
        return int(sent + min(least, before))


@dataclass(slots=True)
class _Window:
    """The readings of a sensor that arrived since `begin`.

    Nanoseconds; `lag` is that of the window before: the smallest if all were behind, negative if all ahead, else 0.
    `last` is the arrival of the newest odometry when the last reading was taken.
    """

    begin: int
    last: int
    least: int
    most: int
    count: int = 1
    lag: int = 0


@dataclass(slots=True)
class _Wrong:
    """How long the stamps of a sensor were wrong, nanoseconds, and the largest lag of that time."""

    time: int = 0
    lag: int = 0


class SensorClocks:
    """Finds sensors whose stamps differ from those of the odometry that arrives at the same time.

    Stamps are compared by the times at which the middleware received the messages. So it does not matter how late the
    node takes them, nor in which order, nor how fast the time of a simulation passes.
    """

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._windows: dict[str, _Window] = {}
        self._logged: dict[tuple[str, str], float] = {}
        self._open: set[tuple[str, str]] = set()
        self._wrong: dict[str, _Wrong] = {}
        self._odometry: deque[tuple[int, int]] = deque(maxlen=MOST_KEPT)
        self._early: list[tuple[int, str, int]] = []

    def clear(self) -> None:
        """Forget all sensors; `notes` are kept."""
        self._begin_anew()
        self._logged.clear()
        self._open.clear()

    def _begin_anew(self) -> None:
        self._windows.clear()
        self._odometry.clear()
        self._early.clear()

    def forget(self) -> None:
        """Forget everything."""
        self.clear()
        self._wrong.clear()

    def note_odometry(self, stamp: int, arrived: int) -> None:
        """Note the stamp of an odometry message, and the time at which the middleware received it."""
        if not stamp:
            return
        if self._odometry:
            newest, before = self._odometry[-1]
            if newest - arrived > LEAST_LAG or before - stamp > LEAST_LAG:
                # a clock was set back, or a bag begins again
                self._begin_anew()
            else:
                arrived = max(arrived, newest)
        self._odometry.append((arrived, stamp))
        while self._early and self._early[0][0] <= arrived:
            self._compare(*heappop(self._early))

    def note(self, frame: str, stamp: int, arrived: int) -> None:
        """Note the stamp of a reading, and the time at which the middleware received it."""
        # unset stamps have their own warning
        if not stamp or not has_room(self._windows, frame):
            return
        if self._odometry and arrived <= self._odometry[-1][0]:
            self._compare(arrived, frame, stamp)
        elif len(self._early) < MOST_KEPT:
            # odometry that arrived earlier may still wait for the node
            heappush(self._early, (arrived, frame, stamp))

    def _compare(self, arrived: int, frame: str, stamp: int) -> None:
        odometry = self._odometry_at(arrived)
        if odometry is None or not has_room(self._windows, frame):
            return
        lag, newest, window = odometry - stamp, self._odometry[-1][0], self._windows.get(frame)
        if window is None:
            self._windows[frame] = _Window(arrived, newest, lag, lag)
            return
        window.last, window.count = newest, window.count + 1
        window.least, window.most = min(lag, window.least), max(lag, window.most)
        if arrived - window.begin >= WINDOW and window.count >= LEAST_READINGS:
            # the smallest lag if all are behind, the smallest lead if all are ahead
            common = max(window.least, 0) + min(window.most, 0)
            if abs(common) > LEAST_LAG:
                wrong = self._wrong.setdefault(frame, _Wrong())
                wrong.time += arrived - window.begin
                wrong.lag = max(wrong.lag, common, key=abs)
            self._windows[frame] = _Window(arrived, newest, lag, lag, lag=common)

    def _odometry_at(self, arrived: int) -> int | None:
        """Return the stamp of odometry at an arrival, between two messages in proportion; None before the first."""
        known = self._odometry
        # nearly all readings arrived after the last message but one
        k = len(known) - 1 if len(known) > 1 and known[-2][0] < arrived else bisect_left(known, (arrived, 0))
        if k == 0:
            return None
        (begin, before), (end, after) = known[k - 1], known[k]
        return before + round((after - before) * (arrived - begin) / (end - begin)) if end > begin else after

    def faults(self) -> list[str]:
        """Return the faults, in words; a sensor is logged when its fault begins, but not often."""
        newest = self._odometry[-1][0] if self._odometry else 0
        found = {
            frame: window.lag
            for frame, window in self._windows.items()
            if abs(window.lag) > LEAST_LAG and newest - window.last < 2 * WINDOW
        }
        behind = {frame: lag for frame, lag in found.items() if lag > 0}
        ahead = {frame: -lag for frame, lag in found.items() if lag < 0}
        now, texts, current = time.monotonic(), [], set()
        for lags, side, late in ((behind, 'behind', 'them'), (ahead, 'ahead of', 'odometry')):
            if not lags:
                continue
            texts.append(
                f'the stamps of {_named(lags)} {side} those of odometry that arrives at the same time: unless the '
                f'network delays {late} so much, these readings are mapped with wrong poses; drivers must stamp a '
                'reading when it is measured, and all computers must have the same time (NTP, PTP)'
            )
            keys = {(side, frame) for frame in lags}
            current |= keys
            if any(now >= self._logged.get(key, -LOG_AGAIN_AFTER) + LOG_AGAIN_AFTER for key in keys - self._open):
                self._logged |= dict.fromkeys(keys, now)
                self._open |= keys
                self._warn(texts[-1])
        self._open &= current
        return texts

    def notes(self) -> list[str]:
        """Return warnings about the readings so far, for a report, or none."""
        texts = []
        for sign, side in ((1, 'behind'), (-1, 'ahead of')):
            lags = {frame: sign * wrong.lag for frame, wrong in self._wrong.items() if sign * wrong.lag > 0}
            if lags:
                longest = max(self._wrong[frame].time for frame in lags) / NANOSECONDS
                texts.append(
                    f'the stamps of {_named(lags)} {side} those of odometry that arrived at the same time, for '
                    f'{longest:.0f} s so far: readings of that time are most likely mapped with wrong poses; drivers '
                    'must stamp a reading when it is measured, and all computers must have the same time (NTP, PTP)'
                )
        return texts


def _named(lags: Mapping[str, int]) -> str:
    """Return the sensor with the largest lag, the number of the others, and that lag, in words."""
    # the first one of those whose lags look the same, so that the text does not change all the time
    most = max(sorted(lags), key=lambda frame: round(lags[frame] / NANOSECONDS, 1))
    others = f' (and {counted(len(lags) - 1, "sensor")} more)' if len(lags) > 1 else ''
    return f'{most}{others} are {lags[most] / NANOSECONDS:.1f} s'
