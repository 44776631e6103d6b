"""The record of all poses of odometry in a drive, for refining its trajectory later.

`pose_history` only keeps what it needs to place new readings. Each pose takes 32 bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .message_types import NANOSECONDS, Pose2

MOST_POSES = 300_000
"""Most poses, 10 MB. If there are more, those are dropped that interpolation between their neighbours replaces best. At
50 Hz it is 100 minutes of driving without pauses."""

TOLERANCE = 1e-4
"""Metres, and radians: poses with a smaller interpolation error are always dropped, as during standstill."""

PART = 16_384
"""Poses that are thinned in one step, which takes a few milliseconds."""

OVERLAP = 60 * NANOSECONDS
"""Nanoseconds of the drive before that are kept when a new one begins: readings are late by less."""

MOST_LATE = 1024
"""Most poses out of order before they are sorted in; sorting costs the same for many."""


class OdometryRecord:
    """Stamps and poses, sorted by time, one for each stamp; snapshots never change.

    Parameters
    ----------
    most : int
        Most poses that are kept; 0 is no bound.

    Attributes
    ----------
    late : int
        Number of poses that came after one with a later stamp, or the same.
    """

    def __init__(self, most: int = MOST_POSES) -> None:
        self._most = most
        self.clear()

    def __len__(self) -> int:
        return self._size + len(self._late)

    @property
    def newest(self) -> tuple[int, Pose2] | None:
        """The last stamp, ns, and its pose; None if there is none."""
        if not self._size:
            return None
        return int(self._stamp[self._size - 1]), Pose2(*self._pose[self._size - 1].tolist())

    @property
    def since_anew(self) -> int:
        """Number of poses since `begin_anew`, without those kept from before; all, if it was never called."""
        before = int(np.searchsorted(self._stamp[: self._size], self._before, side='right'))
        return self._size - before + sum(stamp > self._before for stamp in self._late)

    def clear(self) -> None:
        """Remove all poses."""
        self._size, self._next, self._anew = 0, 0, False
        # number of rows that snapshots may show
        self._shown = 0
        self.late = 0
        self._before = np.iinfo(np.int64).min
        self._late: dict[int, Pose2] = {}
        self._stamp = np.empty(1024, np.int64)
        self._pose = np.empty((1024, 3))

    def add(self, stamp: int, pose: Pose2) -> None:
        """Add a pose, in any order of stamps; it replaces one of the same stamp."""
        size = self._size
        if size and stamp <= self._stamp[size - 1]:
            self.late += 1
            if self._is_newest(stamp, pose):
                # a message that is sent again changes nothing, and need not be sorted in
                return
            self._late[stamp] = pose
            if len(self._late) >= MOST_LATE:
                self._sort_in()
            return
        if size == len(self._stamp):
            rows = max(2 * size, 1024)
            if self._most:
                rows = max(size + 1, min(rows, self._most + 1))
            self._stamp, self._pose = _longer(self._stamp, rows), _longer(self._pose, rows)
        self._stamp[size] = stamp
        self._pose[size] = pose
        self._size = size + 1
        if self._most and self._size > self._most:
            self._thin()

    def _is_newest(self, stamp: int, pose: Pose2) -> bool:
        """Return whether this is the newest pose, at its stamp."""
        newest = self._size - 1
        equal = stamp == self._stamp[newest] and list(pose) == self._pose[newest].tolist()
        return bool(equal and stamp not in self._late)

    def drop(self, stamp: int) -> None:
        """Remove the pose of the last stamp; snapshots keep it."""
        self._late.pop(stamp, None)
        if self._size and self._stamp[self._size - 1] == stamp:
            self._size -= 1
            # a copy only for a snapshot: if two clocks alternate, every second pose is removed
            if self._size < self._shown:
                self._stamp, self._pose = self._stamp[: self._size].copy(), self._pose[: self._size].copy()
                self._shown = 0
        if self._before == stamp:
            self._before = int(self._stamp[self._size - 1]) if self._size else np.iinfo(np.int64).min

    def extend(self, stamps: Sequence[int], poses: Sequence[Pose2]) -> None:
        """Add many poses with increasing stamps; it is fast without a bound and if they are later than all before."""
        size, end = self._size, self._size + len(stamps)
        if self._most or not stamps or (size and stamps[0] <= self._stamp[size - 1]):
            for stamp, pose in zip(stamps, poses, strict=True):
                self.add(stamp, pose)
            return
        if end > len(self._stamp):
            rows = max(2 * size, end, 1024)
            self._stamp, self._pose = _longer(self._stamp, rows), _longer(self._pose, rows)
        self._stamp[size:end], self._pose[size:end] = stamps, poses
        self._size = end

    def begin_anew(self) -> None:
        """Begin a new drive with the next reading; the last poses before it are kept (`OVERLAP`)."""
        self._sort_in()
        self._anew = True
        newest = int(self._stamp[self._size - 1]) if self._size else 0
        self._before = newest if self._size else self._before
        begin = int(np.searchsorted(self._stamp[: self._size], newest - OVERLAP))
        # copies, so that the memory of the rest is freed
        self._stamp, self._pose = self._stamp[begin : self._size].copy(), self._pose[begin : self._size].copy()
        self._size = len(self._stamp)

    def snapshot(self, first: int | None = None) -> tuple[NDArray[np.int64], Floats]:
        """Return stamps, ns, shape (M,), and x, y, yaw, shape (M, 3), which must not be modified.

        Parameters
        ----------
        first : int, optional
            Stamp of the first reading of the drive, ns: after `begin_anew`, poses begin with the last one before it.
        """
        self._sort_in()
        self._shown = max(self._shown, self._size)
        stamp, pose = self._stamp[: self._size], self._pose[: self._size]
        if not self._anew or first is None:
            return stamp, pose
        begin = max(int(np.searchsorted(stamp, first, side='right')) - 1, 0)
        return stamp[begin:], pose[begin:]

    def since(self, stamp: int) -> tuple[NDArray[np.int64], Floats]:
        """Return stamps and poses from a stamp on, like `snapshot`, without late ones that are not yet sorted in."""
        begin = int(np.searchsorted(self._stamp[: self._size], stamp))
        self._shown = max(self._shown, self._size)
        return self._stamp[begin : self._size], self._pose[begin : self._size]

    def _sort_in(self) -> None:
        """Sort in late poses; into copies, since snapshots share the columns."""
        if not self._late:
            return
        size = self._size
        # usually only the last ones are out of order, of a drive of hours
        begin = int(np.searchsorted(self._stamp[:size], min(self._late)))
        stamp = np.concatenate([self._stamp[begin:size], np.array(list(self._late), np.int64)])
        pose = np.concatenate([self._pose[begin:size], np.array(list(self._late.values()))])
        self._late.clear()
        order = np.argsort(stamp, kind='stable')
        # of equal stamps, keep the one that came last
        order = order[np.append(np.diff(stamp[order]) > 0, True)]
        self._stamp = np.concatenate([self._stamp[:begin], stamp[order]])
        self._pose = np.concatenate([self._pose[:begin], pose[order]])
        self._size = len(self._stamp)
        if self._most and self._size > self._most:
            self._thin()

    def _thin(self) -> None:
        """Drop poses of one part of the drive that are close to interpolation; next time, those of the next part."""
        begin = self._next if self._next < self._size - 2 else 0
        end = min(begin + PART, self._size)
        stay = np.ones(self._size, np.bool_)
        stay[begin:end] = hard_to_interpolate(self._stamp[begin:end], self._pose[begin:end])
        self._next = begin + int(np.count_nonzero(stay[begin:end]))
        self._stamp, self._pose = self._stamp[: self._size][stay], self._pose[: self._size][stay]
        self._size = len(self._stamp)


def hard_to_interpolate(stamp: NDArray[np.int64], pose: Floats) -> NDArray[np.bool_]:
    """Return a mask of the poses that are kept, shape (M,).

    Of every second pose, those with the smallest error of interpolation between their neighbours are dropped: at least
    half of them.
    """
    stay = np.ones(len(stamp), np.bool_)
    before, middle, after = slice(0, -2, 2), slice(1, -1, 2), slice(2, None, 2)
    part = ((stamp[middle] - stamp[before]) / (stamp[after] - stamp[before]))[:, None]
    whole, half = pose[after] - pose[before], pose[middle] - pose[before]
    for turn in (whole[:, 2], half[:, 2]):
        turn[:] = np.remainder(turn + np.pi, 2 * np.pi) - np.pi
    off = np.abs(half - part * whole).max(1)
    stay[middle] = off > max(float(np.median(off)), TOLERANCE)
    return stay


def _longer(column: NDArray[Any], rows: int) -> NDArray[Any]:
    longer = np.empty((rows, *column.shape[1:]), column.dtype)
    longer[: len(column)] = column
    return longer
