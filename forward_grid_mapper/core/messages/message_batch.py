"""Batches of messages from files, as columns; `message_types` has single messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from heapq import merge
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .message_types import OdometryMessage, Pose2, RangeMessage

Ints = NDArray[np.int64]

REASON = 'U32'
"""The type of reasons (`rep117.REASONS`) in arrays."""


class Ranges(NamedTuple):
    """N Range messages; the fields are those of `RangeMessage`.

    Attributes
    ----------
    place : int64, shape (N,)
        Which message of the batch each is, increasing.
    stamp : int64, shape (N,)
        Nanoseconds.
    frame : int64, shape (N,)
        Index into `frames`.
    range, min_range, max_range, field_of_view, variance : float64, shape (N,)
    frames : tuple of str
        Each `frame_id` once.
    """

    place: Ints
    stamp: Ints
    frame: Ints
    range: Floats
    min_range: Floats
    max_range: Floats
    field_of_view: Floats
    variance: Floats
    frames: tuple[str, ...]

    def of_each(self) -> Iterator[tuple[str, Ints]]:
        """Yield each frame that has messages, and their indices in the order of the batch."""
        order = np.argsort(self.frame, kind='stable')
        first = np.searchsorted(self.frame[order], np.arange(len(self.frames) + 1))
        for number, frame in enumerate(self.frames):
            if len(part := order[first[number] : first[number + 1]]):
                yield frame, part

    def one_by_one(self) -> Iterator[tuple[int, RangeMessage]]:
        """Yield places and messages."""
        columns = (column.tolist() for column in self[:8])
        for place, stamp, frame, *values in zip(*columns, strict=True):
            yield place, RangeMessage(stamp, self.frames[frame], *values)


class Odometry(NamedTuple):
    """M Odometry messages; the fields are those of `OdometryMessage`.

    Attributes
    ----------
    place : int64, shape (M,)
        Which message of the batch each is, increasing.
    stamp : int64, shape (M,)
        Nanoseconds.
    frame : int64, shape (M,)
        Index into `frames`.
    pose : float64, shape (M, 3)
        x, y, yaw; NaN if a message has no planar pose.
    frames : tuple of (str, str)
        Each pair of `frame_id` and `child_frame_id` once.
    """

    place: Ints
    stamp: Ints
    frame: Ints
    pose: Floats
    frames: tuple[tuple[str, str], ...]

    def one_by_one(self) -> Iterator[tuple[int, OdometryMessage]]:
        """Yield places and messages."""
        columns = (column.tolist() for column in self[:4])
        for place, stamp, frame, (x, y, yaw) in zip(*columns, strict=True):
            parent, child = self.frames[frame]
            # NaN stands for a message without a pose
            yield place, OdometryMessage(stamp, parent, child, None if math.isnan(x) else Pose2(x, y, yaw))


class MessageBatch(NamedTuple):
    """Messages in the order in which they were recorded."""

    ranges: Ranges
    odometry: Odometry

    def one_by_one(self) -> Iterator[RangeMessage | OdometryMessage]:
        """Yield the messages in their order."""
        kinds: list[Iterator[tuple[int, RangeMessage | OdometryMessage]]]
        kinds = [self.ranges.one_by_one(), self.odometry.one_by_one()]
        return (message for _, message in merge(*kinds, key=lambda placed: placed[0]))

    def select(self, ranges: NDArray[np.bool_], odometry: NDArray[np.bool_]) -> MessageBatch:
        """Return the messages selected by two masks, shapes (N,) and (M,)."""
        return MessageBatch(
            Ranges._make([*(column[ranges] for column in self.ranges[:8]), self.ranges.frames]),
            Odometry._make([*(column[odometry] for column in self.odometry[:4]), self.odometry.frames]),
        )


def batch_of(messages: list[tuple[int, RangeMessage | OdometryMessage]]) -> MessageBatch:
    """Return messages with their places as a batch; they may come in any order."""
    messages = sorted(messages, key=lambda placed: placed[0])
    ranges = [(place, m) for place, m in messages if isinstance(m, RangeMessage)]
    odometry = [(place, m) for place, m in messages if isinstance(m, OdometryMessage)]
    frames: dict[str, int] = {}
    pairs: dict[tuple[str, str], int] = {}
    stamped = [(place, m.stamp, frames.setdefault(m.frame_id, len(frames))) for place, m in ranges]
    values = np.array([m[2:] for _, m in ranges], np.float64).reshape(-1, 5)
    moved = [(place, m.stamp, pairs.setdefault((m.frame_id, m.child_frame_id), len(pairs))) for place, m in odometry]
    poses = [m.pose or (np.nan, np.nan, np.nan) for _, m in odometry]
    of_ranges = np.array(stamped, np.int64).reshape(-1, 3).T
    of_odometry = np.array(moved, np.int64).reshape(-1, 3).T
    return MessageBatch(
        Ranges._make([*of_ranges, *values.T, tuple(frames)]),
        Odometry._make([*of_odometry, np.array(poses, np.float64).reshape(-1, 3), tuple(pairs)]),
    )


def joined(batches: list[MessageBatch]) -> MessageBatch:
    """Return several batches as one; their places define the order of all messages."""
    ranges = _joined([batch.ranges for batch in batches])
    odometry = _joined([batch.odometry for batch in batches])
    return MessageBatch(Ranges._make(ranges), Odometry._make(odometry))


def _joined(parts: Sequence[Ranges] | Sequence[Odometry]) -> list[Any]:
    """Return the columns of all parts, sorted by place, and the union of their names."""
    names: dict[object, int] = {}
    frames = []
    for part in parts:
        numbers = [names.setdefault(name, len(names)) for name in part.frames]
        frames.append(np.array(numbers or [0], np.int64)[part.frame])
    places = np.concatenate([part.place for part in parts])
    order = np.argsort(places, kind='stable')
    columns: list[Any] = [places[order]]
    for number in range(1, len(parts[0]) - 1):
        column = frames if number == 2 else [part[number] for part in parts]
        columns.append(np.concatenate(column)[order])
    return [*columns, tuple(names)]
