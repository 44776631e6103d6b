"""Which sensors have stopped sending while others go on."""

from __future__ import annotations

import time
from collections.abc import Iterator

from ..core.messages.message_account import MOST_FRAMES
from ..core.messages.rep117 import LONGEST_NAME

TIME_OUT = 3.0
"""Least seconds without a message after which a sensor is silent."""

USUAL = 5.0
"""Times its usual interval for which a sensor that sends rarely may be quiet."""


def _patience(interval: float) -> float:
    """Return the seconds after which a sensor that sends once in `interval` is silent."""
    return max(TIME_OUT, USUAL * interval)


class Heard:
    """When each sensor sent last, and how long it usually takes until it sends again.

    A sensor is silent when others sent something long after it. So none is where nothing comes at all: a robot that is
    switched off, or a bag that has ended.
    """

    def __init__(self) -> None:
        self._sensors: dict[str, tuple[float, float]] = {}
        self._newest = 0.0

    def __contains__(self, frame: str) -> bool:
        return frame in self._sensors

    def __iter__(self) -> Iterator[str]:
        return iter(self._sensors)

    def clear(self) -> None:
        """Forget all sensors."""
        self._sensors.clear()

    def note(self, frame: str) -> None:
        """Note that a message of a sensor came."""
        now = self._newest = time.monotonic()
        before = self._sensors.get(frame)
        if before is not None:
            last, interval = before
            gap = now - last
            if not interval:
                interval = gap
            elif gap < _patience(interval):
                interval += 0.1 * (gap - interval)
            self._sensors[frame] = now, interval
        elif len(self._sensors) < MOST_FRAMES and frame.isprintable() and 0 < len(frame) <= LONGEST_NAME:
            self._sensors[frame] = now, 0.0

    @property
    def patience(self) -> float:
        """Seconds after which all are silent if nothing came."""
        return min((_patience(usual) for _, usual in self._sensors.values()), default=TIME_OUT)

    def silent(self) -> dict[str, float]:
        """Return the sensors that are silent, and for how many seconds."""
        now, newest = time.monotonic(), self._newest
        return {f: now - last for f, (last, usual) in self._sensors.items() if newest - last > _patience(usual)}
