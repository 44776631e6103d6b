"""Helpers of the tests of faults: drives, and a journal that gives a node many readings at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.files.journal import Journal

OPTIONS = (
    *('-p', 'range_reliability:=reliable', '-p', 'odom_reliability:=reliable', '-p', 'publish_rate:=10.0'),
    *('-p', 'sensors.sonar.pose:=[0.1, 0.0, 0.4]'),
)


def circle(first: int, count: int) -> list[Any]:
    """Readings of a turning robot with odometry messages, twenty a second."""
    out: list[Any] = []
    for k in range(first, first + count):
        stamp = 2_000_000_000 * NANOSECONDS + k * NANOSECONDS // 20
        out.append(OdometryMessage(stamp, 'odom', 'base_link', Pose2(0.001 * k, 0.0, 0.05 * k)))
        out.append(RangeMessage(stamp, 'sonar', 2.0 + 0.3 * (k % 7 == 0), 0.1, 5.0, 0.3))
    return out


def journal_of(folder: Path, readings: Readings) -> Path:
    """Write a journal as of a node that was killed after these readings."""
    journal = Journal(folder, print)
    assert not list(journal.restore())
    journal.put(readings, ('odom', 'base_link'))
    journal.close()
    return folder
