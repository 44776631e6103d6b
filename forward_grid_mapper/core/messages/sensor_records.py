"""Records of sensors by frame: which sensors get one, where messages are watched for the faults of each sensor.

Messages name their frame themselves, so a faulty driver, or anyone in the network, can send new names without end. So
only the sensors that are heard first have records, at most `MOST_FRAMES`. None is for a name that no frame can have,
since warnings and diagnostics show the names. Readings of sensors beyond the bound are mapped too, but not watched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from .rep117 import proper_name

MOST_FRAMES = 1000
"""Most sensors with records of their own, to limit memory and time; robots have some dozens of sensors."""

Record = TypeVar('Record')


def has_room(records: Mapping[str, object], frame: str) -> bool:
    """Return whether a sensor has a record, or may get one."""
    return frame in records or (len(records) < MOST_FRAMES and proper_name(frame))


def record_of(records: dict[str, Record], frame: str, make: Callable[[], Record]) -> Record | None:
    """Return the record of a sensor, which `make` makes for a new one; None if it may not get one."""
    if frame not in records and has_room(records, frame):
        records[frame] = make()
    return records.get(frame)
