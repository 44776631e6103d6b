"""What stamps say of clocks: odometry's that jump, and those of sensors that are apart from odometry's."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ..core.common.words import counted
from ..core.messages.message_account import MOST_FRAMES
from ..core.messages.message_types import NANOSECONDS
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rep117 import LONGEST_NAME

LASTING = 10.0
"""Seconds for which a jump counts, and between two lines in the log."""

AGAIN = 3
"""Jumps within `LASTING` from which on they are a fault, and not a bag that begins anew."""

WINDOW = 5 * NANOSECONDS
"""Nanoseconds of odometry's stamps for which a sensor is behind or ahead before it is told of."""

FEWEST = 5
"""Readings that this takes at least."""

APART = NANOSECONDS
"""Nanoseconds by which even the least late of them is behind, or the latest ahead."""


class OdometryClock:
    """Tells of jumps in the stamps of odometry: in the log now and then, and as a fault where they come again."""

    def __init__(self, associator: PoseAssociator, warn: Callable[[str], object]) -> None:
        self._associator, self._warn = associator, warn
        self._seen = self._counts()
        self._jumps: deque[float] = deque(maxlen=AGAIN)
        self._next = 0.0

    def look(self) -> None:
        """Look what became of a message that the associator has taken."""
        seen, self._seen = self._seen, self._counts()
        back, ahead = (now - before for now, before in zip(self._seen, seen, strict=True))
        # a reset begins to count anew
        if back <= 0 and ahead <= 0:
            return
        now = time.monotonic()
        self._jumps.append(now)
        if now < self._next:
            return
        self._next = now + LASTING
        if back > 0:
            self._warn(
                f'the clock jumped back ({self._seen[0]} times so far): waiting readings were dropped, and so was the '
                'odometry of the drive, which refine_poses needs; the map is kept'
            )
        else:
            self._warn(
                f'the stamp of an odometry message was more than a second ahead of the others ({self._seen[1]} times '
                'so far): this message is ignored'
            )

    def forget(self) -> None:
        """Forget what jumped."""
        self._jumps.clear()

    def faults(self) -> list[str]:
        """Return what to warn of, in words."""
        if len(self._jumps) < AGAIN or time.monotonic() - self._jumps[0] > LASTING:
            return []
        return ['the stamps of odometry jump again and again: do two nodes publish odometry, or is a clock set?']

    def _counts(self) -> tuple[int, int]:
        return self._associator.time_jumps, self._associator.odometry_rejected['ahead_of_others']


@dataclass(slots=True)
class _Window:
    """The readings of a sensor since odometry's stamp `begin`, and by how much those before were all behind.

    Nanoseconds; a negative lag is of a sensor that is ahead.
    """

    begin: int
    last: int
    least: int
    most: int
    count: int = 1
    lag: int = 0


class SensorClocks:
    """Finds sensors whose stamps stay apart from odometry's; a queue that is worked off is not behind for so long."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._windows: dict[str, _Window] = {}
        self._told: set[str] = set()

    def clear(self) -> None:
        """Forget all sensors."""
        self._windows.clear()

    def note(self, frame: str, stamp: int, odometry: int | None) -> None:
        """Note a reading, and the newest stamp of odometry as it came."""
        # a stamp that nobody filled in is told of as such
        if odometry is None or not stamp:
            return
        lag, window = odometry - stamp, self._windows.get(frame)
        if window is None or odometry < window.begin:
            proper = 0 < len(frame) <= LONGEST_NAME and frame.isprintable()
            if window is not None or (len(self._windows) < MOST_FRAMES and proper):
                self._windows[frame] = _Window(odometry, odometry, lag, lag)
            return
        window.last, window.count = odometry, window.count + 1
        window.least, window.most = min(lag, window.least), max(lag, window.most)
        if odometry - window.begin >= WINDOW and window.count >= FEWEST:
            # the lag that all of them have at least
            common = max(window.least, 0) + min(window.most, 0)
            self._windows[frame] = _Window(odometry, odometry, lag, lag, lag=common)

    def faults(self, odometry: int | None) -> list[str]:
        """Return what to warn of, in words; the log is told once of each sensor."""
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
            busy = '; if the node has too little processor time, play the bag more slowly' if lags is behind else ''
            texts.append(
                f'the stamps of {most}{others} are {lags[most] / NANOSECONDS:.1f} s {side} those of odometry: if a '
                f'clock is wrong, its readings are mapped with wrong poses; synchronise the clocks (NTP, PTP){busy}'
            )
            if lags.keys() - self._told:
                self._told |= lags.keys()
                self._warn(texts[-1])
        return texts
