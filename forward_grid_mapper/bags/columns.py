"""Deserializes messages of a channel: known layouts by numpy, many at once, and all others one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.messages.message_batch import MessageBatch, Odometry, Ranges, batch_of
from ..core.messages.message_types import NANOSECONDS, OdometryMessage, RangeMessage, planar_pose_of
from .decoder import Decoder
from .layouts import Layout, Path, by_length
from .poses import paths_of_pose

MOST_LAYOUTS = 64
"""Most layouts of a channel; if sensors share a topic, each has its own."""

VALUES: tuple[Path, ...] = tuple((name,) for name in ('range', 'min_range', 'max_range', 'field_of_view', 'variance'))
_STAMP: tuple[Path, ...] = (('sec',), ('nanosec',))
_SECONDS = ('i4', 'u4')

Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]
Convert = Callable[[Any], 'RangeMessage | OdometryMessage | None']


class _Known:
    """A layout, with one message that has it."""

    def __init__(self, layout: Layout, first: RangeMessage | OdometryMessage | None, paths: Sequence[Path], row: Bytes):
        self._layout, self._first, self._paths = layout, first, paths
        self._fixed = row[layout.fixed]

    def matching(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return which messages, shape (N, length), are of this layout."""
        same: NDArray[np.bool_] = (rows[:, self._layout.fixed] == self._fixed).all(axis=1)
        return same

    def batch(self, places: Places, rows: Bytes) -> list[MessageBatch]:
        """Return messages of this layout; none if they contain no data of the robot."""
        if self._first is None:
            return []
        seconds, nanoseconds, *values = (self._layout.column(path, rows) for path in self._paths)
        stamp = seconds.astype(np.int64) * NANOSECONDS + nanoseconds.astype(np.int64)
        empty, frame, one = batch_of([]), np.zeros(len(places), np.int64), self._first
        floats = [column.astype(np.float64) for column in values]
        if isinstance(one, RangeMessage):
            if len(floats) < len(VALUES):
                floats.append(np.zeros(len(places)))
            return [empty._replace(ranges=Ranges._make([places, stamp, frame, *floats, (one.frame_id,)]))]
        nothing = (np.nan, np.nan, np.nan)
        pose = [planar_pose_of(*row) or nothing for row in zip(*(column.tolist() for column in floats), strict=True)]
        names = ((one.frame_id, one.child_frame_id),)
        return [empty._replace(odometry=Odometry(places, stamp, frame, np.array(pose).reshape(-1, 3), names))]


class Columns:
    """Decodes the messages of a channel.

    Parameters
    ----------
    decoder : Decoder
        Of the channel.
    convert : callable
        Converts a decoded message, or returns None if it contains no data of the robot.
    """

    def __init__(self, decoder: Decoder, convert: Convert) -> None:
        self._decoder, self._convert = decoder, convert
        self._known: dict[int, list[_Known]] = {}
        self._count = 0

    def decode(self, places: Places, data: Sequence[bytes]) -> tuple[list[MessageBatch], list[int]]:
        """Return the decoded messages, and the places of those that do not fit their type."""
        found: list[MessageBatch] = []
        bad: list[int] = []
        for which, rows in by_length(data):
            left = np.arange(len(which))
            for known in self._known.get(rows.shape[1], ()):
                left = self._take(known, places[which], rows, left, found)
            while len(left) and (new := self._new_layout(data[which[left[0]]])) is not None:
                left = self._take(new, places[which], rows, left, found)
            wrong, slow = self._one_by_one((int(places[k]), data[k]) for k in which[left].tolist())
            bad += wrong
            found += slow
        return found, bad

    @staticmethod
    def _take(
        known: _Known, places: Places, rows: Bytes, left: NDArray[np.int64], found: list[MessageBatch]
    ) -> NDArray[np.int64]:
        """Add the messages of a layout to `found`; return the remaining ones."""
        if not len(left):
            return left
        same = known.matching(rows[left] if len(left) < len(rows) else rows)
        if same.any():
            found += known.batch(places[left[same]], rows[left[same]])
        return left[~same]

    def _new_layout(self, data: bytes) -> _Known | None:
        """Return the layout of a message; None if there is none, if there are too many, or if it is unreliable."""
        if self._count >= MOST_LAYOUTS:
            return None
        try:
            store = self._decoder.fitting(data)
            message = self._decoder(data)
            layout = Layout(store, self._decoder.msgtype, data, self._decoder.ros1)
            paths = _paths(message)
            kinds = [layout.fields[path][1].str[1:] for path in paths[:2]]
            first = self._convert(message)
            if any(kind not in _SECONDS for kind in kinds) or not layout.agrees(self._decoder, paths):
                return None
        except Exception:  # errors of rosbags for bytes that do not fit, or ours for an unexpected type
            return None
        self._count += 1
        made = _Known(layout, first, paths, np.frombuffer(data, np.uint8))
        self._known.setdefault(len(data), []).append(made)
        return made

    def _one_by_one(self, messages: Iterable[tuple[int, bytes]]) -> tuple[list[int], list[MessageBatch]]:
        bad, good = [], []
        for place, data in messages:
            try:
                converted = self._convert(self._decoder(data))
            except Exception:  # of many classes, for bytes that do not fit or a definition with other fields
                bad.append(place)
                continue
            if converted is not None:
                good.append((place, converted))
        return bad, [batch_of(good)] if good else []


class InOrder(Columns):
    """Decodes messages in order, since each depends on those before it."""

    def decode(self, places: Places, data: Sequence[bytes]) -> tuple[list[MessageBatch], list[int]]:
        """Return the decoded messages, and the places of those that do not fit their type."""
        bad, found = self._one_by_one(zip(places.tolist(), data, strict=True))
        return found, bad


def _paths(message: Any) -> list[Path]:
    """Return the paths of seconds, nanoseconds and values of a message, as ordered in `Ranges` or `planar_pose_of`."""
    if hasattr(message, 'field_of_view'):
        values = VALUES if hasattr(message, 'variance') else VALUES[:-1]
        header: Path = ('header',)
    else:
        header, values = paths_of_pose(message)
    return [*((*header, 'stamp', *name) for name in _STAMP), *values]
