"""What the node says of itself once a second."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from ..core.grid import Grid
from ..core.placing import Placer
from .em import Run

SILENCE = 3.0
"""Seconds without odometry, or without ranges, that are worth a warning."""


class Health:
    """Watches what arrives and turns it into diagnostics."""

    def __init__(self) -> None:
        self._begin = time.monotonic()
        self._last: dict[str, tuple[int, float]] = {}
        self._rejected = 0
        self._received = 0
        self._slowest = 0

    def taken(self, sent: int) -> None:
        """Note that a reading was taken which was published at `sent`, nanoseconds of the system's clock."""
        self._slowest = max(self._slowest, time.time_ns() - sent)

    def statuses(
        self, name: str, placer: Placer, run: Run | None, last_run: str, grid: Grid, paused: bool, extra: dict[str, Any]
    ) -> list[DiagnosticStatus]:
        """Return the statuses of input and of EM."""
        level, message = self._judge(placer, paused)
        values = {
            'readings received': placer.received,
            'readings accepted': len(placer.buffer),
            'readings waiting for a pose': placer.waiting,
            'readings rejected': sum(placer.rejected.values()),
            **{f'rejected: {reason}': count for reason, count in sorted(placer.rejected.items())},
            'longest delay of a reading (ms)': f'{self._slowest / 1e6:.1f}',
            'odometry received': placer.odometry_received,
            **{f'odometry rejected: {reason}': count for reason, count in sorted(placer.odometry_rejected.items())},
            'clock jumps back': placer.time_jumps,
            'frames without a pose': ', '.join(sorted(placer.unknown_frames)),
            'map frame': placer.map_frame,
            'map size': f'{grid.width} x {grid.height} cells of {grid.resolution} m',
            **extra,
        }
        self._slowest = 0
        em = {'state': str(run) if run else 'idle', 'last run': last_run}
        return [
            status(f'{name}: readings', level, message, name, values),
            status(f'{name}: EM', DiagnosticStatus.OK, em['state'], name, em),
        ]

    def _judge(self, placer: Placer, paused: bool) -> tuple[bytes, str]:
        received, rejected = placer.received, sum(placer.rejected.values())
        new, new_rejected = received - self._received, rejected - self._rejected
        self._received, self._rejected = received, rejected
        silent_odometry = self._silence('odometry', placer.odometry_received)
        silent_ranges = self._silence('range', placer.received)
        if paused:
            return DiagnosticStatus.OK, 'paused'
        if silent_odometry > SILENCE:
            return DiagnosticStatus.WARN, f'no odometry for {silent_odometry:.0f} s'
        if silent_ranges > SILENCE:
            return DiagnosticStatus.WARN, f'no Range for {silent_ranges:.0f} s'
        if placer.unknown_frames and new_rejected:
            return DiagnosticStatus.WARN, f'no pose on the robot for {", ".join(sorted(placer.unknown_frames))}'
        if new and new_rejected > 0.2 * new:
            return DiagnosticStatus.WARN, f'{new_rejected} of {new} readings were rejected in the last second'
        return DiagnosticStatus.OK, 'mapping'

    def _silence(self, stream: str, count: int) -> float:
        now = time.monotonic()
        last, since = self._last.get(stream, (0, self._begin))
        if count != last:
            last, since = count, now
        self._last[stream] = last, since
        return now - since


def array(statuses: list[DiagnosticStatus], stamp: Any) -> DiagnosticArray:
    """Return the message that `/diagnostics` carries."""
    message = DiagnosticArray(status=statuses)
    message.header.stamp = stamp
    return message


def status(name: str, level: bytes, message: str, hardware: str, values: Mapping[str, Any]) -> DiagnosticStatus:
    """Return one status with its keys and values."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, hardware_id=hardware, values=pairs)
