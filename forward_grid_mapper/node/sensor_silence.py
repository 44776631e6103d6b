"""Sensors that have stopped sending while others still send, and how often sensors paused."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

from ..core.messages.sensor_records import has_room

TIME_OUT = 3.0
"""Shortest time without a message, seconds, after which a sensor is silent."""

SILENT_INTERVALS = 5.0
"""Time without a message, in usual intervals, after which a sensor that sends rarely is silent."""

PAUSE = 0.5
"""Shortest time without a message, seconds, that counts as a pause; also at least `SILENT_INTERVALS` intervals."""


class _Sensor(NamedTuple):
    """The time of the last message of a sensor, its usual interval, and the idle time of all until then."""

    last: float
    usual: float
    idle: float


def _patience(interval: float) -> float:
    """Return the seconds after which a sensor with this usual interval is silent."""
    return max(TIME_OUT, SILENT_INTERVALS * interval)


class SensorSilence:
    """The time of the last message of each sensor, and its usual interval.

    A sensor is silent if others sent something long after it. The time in which no messages arrive at all does not
    count, as when a robot is switched off, or a bag has ended or is paused.

    Attributes
    ----------
    pauses : int
        How often any sensor paused, while others sent, and then sent again.
    """

    def __init__(self) -> None:
        self._sensors: dict[str, _Sensor] = {}
        self._newest = self._idle = 0.0
        self.pauses = 0

    def __contains__(self, frame: str) -> bool:
        return frame in self._sensors

    def __iter__(self) -> Iterator[str]:
        return iter(self._sensors)

    def clear(self) -> None:
        """Forget all sensors."""
        self._sensors.clear()
        self.pauses = 0

    def note(self, frame: str) -> None:
        """Note a message of a sensor."""
        now = time.monotonic()
        gap, self._newest = now - self._newest, now
        self._idle += gap if gap > PAUSE else 0.0
        if gap > TIME_OUT and gap > self.patience:
            # after a pause of all sensors, the others are not silent because one of them is the first; a sensor whose
            # interval is not known yet may send as rarely
            for known, sensor in self._sensors.items():
                if sensor.usual and known != frame:
                    self._sensors[known] = sensor._replace(last=sensor.last + gap)
        before = self._sensors.get(frame)
        if before is not None:
            last, interval, idle = before
            gap = now - last
            if interval and gap - (self._idle - idle) > max(PAUSE, SILENT_INTERVALS * interval):
                self.pauses += 1
            if not interval:
                interval = gap
            elif gap < _patience(interval):
                interval += 0.1 * (gap - interval)
            self._sensors[frame] = _Sensor(now, interval, self._idle)
        elif has_room(self._sensors, frame):
            self._sensors[frame] = _Sensor(now, 0.0, self._idle)

    @property
    def patience(self) -> float:
        """Seconds without any message after which all sensors are silent."""
        return min((_patience(sensor.usual) for sensor in self._sensors.values()), default=TIME_OUT)

    def silent(self) -> dict[str, float]:
        """Return the silent sensors, and the seconds since their last message, without pauses of all."""
        now, newest = time.monotonic(), self._newest
        return {f: now - each.last for f, each in self._sensors.items() if newest - each.last > _patience(each.usual)}
