"""Faults of clocks: jumps in the stamps of odometry, and sensors whose stamps differ from those of odometry."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ..core.common.words import counted
from ..core.messages.message_types import NANOSECONDS
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.sensor_records import has_room

JUMP_SPAN = 10.0
"""Seconds for which a jump counts, and between two warnings in the log."""

AGAIN = 3
"""Jumps within `JUMP_SPAN` that are a fault; fewer may be a bag that is played again."""

WINDOW = 5 * NANOSECONDS
"""Nanoseconds of odometry, by stamps, for which a sensor must be behind or ahead before a warning."""

FEWEST = 5
"""Fewest readings within `WINDOW`."""

APART = NANOSECONDS
"""Nanoseconds by which all readings within `WINDOW` must be behind, or all ahead."""


class OdometryClock:
    """Warns of jumps in the stamps of odometry: in the log, and as a fault if they repeat."""

    def __init__(self, associator: PoseAssociator, warn: Callable[[str], object]) -> None:
        self._associator, self._warn = associator, warn
        self._seen = self._counts()
        self._jumps: deque[float] = deque(maxlen=AGAIN)
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

    def faults(self) -> list[str]:
        """Return the faults, in words."""
        if len(self._jumps) < AGAIN or time.monotonic() - self._jumps[0] > JUMP_SPAN:
            return []
        return ['the stamps of odometry jump again and again: do two nodes publish odometry, or is a clock set?']

    def _counts(self) -> tuple[int, int]:
        return self._associator.time_jumps, self._associator.odometry_rejected['ahead_of_others']


@dataclass(slots=True)
class _Window:
    """The readings of a sensor since the stamp `begin` of odometry.

    Nanoseconds; `lag` is that of the window before: the smallest if all were behind, negative if all ahead, else 0.
    """

    begin: int
    last: int
    least: int
    most: int
    count: int = 1
    lag: int = 0


class SensorClocks:
    """Finds sensors whose stamps differ from those of odometry for longer than it takes to work off a queue."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._windows: dict[str, _Window] = {}
        self._logged: set[str] = set()

    def clear(self) -> None:
        """Forget all sensors."""
        self._windows.clear()

    def note(self, frame: str, stamp: int, odometry: int | None) -> None:
        """Note the stamp of a reading, and the newest stamp of odometry at its arrival."""
        # unset stamps have their own warning
        if odometry is None or not stamp:
            return
        lag, window = odometry - stamp, self._windows.get(frame)
        if window is None or odometry < window.begin:
            if has_room(self._windows, frame):
                self._windows[frame] = _Window(odometry, odometry, lag, lag)
            return
        window.last, window.count = odometry, window.count + 1
        window.least, window.most = min(lag, window.least), max(lag, window.most)
        if odometry - window.begin >= WINDOW and window.count >= FEWEST:
            # the smallest lag if all are behind, the smallest lead if all are ahead
            common = max(window.least, 0) + min(window.most, 0)
            self._windows[frame] = _Window(odometry, odometry, lag, lag, lag=common)

    def faults(self, odometry: int | None) -> list[str]:
        """Return the faults, in words; each sensor is logged once."""
        found = {
            frame: window.lag
            for frame, window in self._windows.items()
            if abs(window.lag) > APART and odometry is not None and odometry - window.last < 2 * WINDOW
        }
        behind = {frame: lag for frame, lag in found.items() if lag > 0}
        ahead = {frame: -lag for frame, lag in found.items() if lag < 0}
        texts = []
        for lags, side in ((behind, 'behind'), (ahead, 'ahead of')):
            if not lags:
                continue
            most = max(lags, key=lambda frame: lags[frame])
            others = f' (and {counted(len(lags) - 1, "sensor")} more)' if len(lags) > 1 else ''
            texts.append(
                f'the stamps of {most}{others} are {lags[most] / NANOSECONDS:.1f} s {side} those of odometry: if a '
                'clock is wrong, its readings are mapped with wrong poses; synchronise the clocks (NTP, PTP); if the '
                'node has too little processor time, play the bag more slowly'
            )
            if lags.keys() - self._logged:
                self._logged |= lags.keys()
                self._warn(texts[-1])
        return texts
