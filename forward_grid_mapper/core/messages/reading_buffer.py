"""The buffer of accepted readings: it grows up to a bound, and any thread can take snapshots of it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Readings
from .thinning import kept

Columns = dict[str, NDArray[Any]]

LARGE = 65_536
"""From this many rows on, columns are copied to larger ones in steps, so that no reading waits for a long copy."""

STEP = 1024
"""Readings between two steps of the copy."""


class _Thinned(NamedTuple):
    """The columns of the `stay` readings that remain of the first `size`, for the buffer's state `version`."""

    columns: Columns
    stay: int
    size: int
    version: int


_InBackground = Callable[[Callable[[], _Thinned], Callable[[_Thinned | None], None]], None]


class ReadingBuffer:
    """Columns that grow with the readings, and are thinned (`thinning`) if there are more than `bound`.

    It needs 76 bytes for each reading. One thread appends; any may take snapshots, which are views of the columns. So
    stored rows never change: columns that are full, or thinned, are replaced by others.

    While large columns fill up, their rows are copied to `_next_columns` in steps: `_copied` of them so far. While
    `_is_thinning`, other columns are being made, perhaps in another thread; they are of no use if `_version` has
    changed meanwhile. After a failure, thinning begins again once there are more readings than `_size_at_failure`.

    Attributes
    ----------
    bound : int
        Most readings that `bounded` returns; up to an eighth more are stored. 0 is no bound.
    before_thinning : list of callable
        Called before readings are dropped, by the thread that appends: the last chance to process new ones.
    run_in_background : callable, optional
        Takes two functions. It calls the first in another thread, and the second, with the result, in the thread that
        appends; with None if the first failed. By default, `append` blocks during thinning.
    """

    _TYPES = {
        f.name: np.float64 for f in fields(Readings) if f.name not in ('stamp', 'sensor', 'sensor_names', 'drive')
    } | {
        'stamp': np.int64,
        'sensor': np.int32,
        'number': np.int64,
    }

    def __init__(self, bound: int = 0) -> None:
        self.bound = bound
        self.before_thinning: list[Callable[[], None]] = []
        self.run_in_background: _InBackground | None = None
        self._version = 0
        self._next_columns: Columns | None = None
        # locked while columns are replaced, so that a snapshot never mixes old and new ones
        self._lock = threading.Lock()
        self.clear()

    def __len__(self) -> int:
        """Return the number of readings that were appended, including thinned ones."""
        return self._count

    @property
    def stored(self) -> int:
        """Number of readings in memory."""
        return self._size

    @property
    def room(self) -> int:
        """Number of readings up to and including the one that starts the next thinning; large without bound."""
        if not self.bound or self._is_thinning:
            return sys.maxsize
        return max(max(self.bound, self._size_at_failure) + self.bound // 8 + 1 - self._size, 1)

    def clear(self) -> None:
        """Remove all readings and sensor names."""
        with self._lock:
            self._size = self._count = 0
            self._names: dict[str, int] = {}
            self._columns: Columns = {name: np.empty(1024, kind) for name, kind in self._TYPES.items()}
        self._first, self._last = sys.maxsize, -sys.maxsize
        self._counts: list[int] = []
        self._silent: list[int] = []
        self._discard_pending()

    def append(self, sensor: str, **values: float) -> None:
        """Add one reading of the sensor named `sensor`; `values` are the other columns of `Readings`."""
        if self._size == len(self._columns['z']):
            self._reserve(1)
        number = self._number_of(sensor)
        self._counts[number] += 1
        self._silent[number] += values['z'] >= values['z_max']
        self._first, self._last = min(self._first, stamp := int(values['stamp'])), max(self._last, stamp)
        values['sensor'], values['number'] = number, self._count
        for name, column in self._columns.items():
            column[self._size] = values[name]
        self._size += 1
        self._count += 1
        if not self._size % STEP:
            self._copy_ahead()
        self._thin()

    def extend(self, readings: Readings) -> None:
        """Add many readings at once."""
        count = len(readings)
        ahead = self._size + count
        # the copy in steps, which `append` starts, needs this much free space
        self._reserve(count + (ahead // 3 if ahead >= LARGE else 0))
        sensors = np.array([self._number_of(name) for name in readings.sensor_names] or [0], np.int32)
        for number, count_of, silent in zip(sensors.tolist(), *readings.counts(), strict=False):
            self._counts[number] += count_of
            self._silent[number] += silent
        if count:
            self._first = min(self._first, int(readings.stamp.min()))
            self._last = max(self._last, int(readings.stamp.max()))
        end = self._size + count
        for name, column in self._columns.items():
            if name == 'sensor':
                column[self._size : end] = sensors[readings.sensor]
            elif name == 'number':
                column[self._size : end] = np.arange(self._count, self._count + count)
            else:
                column[self._size : end] = getattr(readings, name)
        self._size = end
        self._count += count
        self._thin()

    @property
    def stamps(self) -> tuple[int, int]:
        """The first and the last stamp of all appended readings, also of thinned ones; there must be a reading."""
        return self._first, self._last

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return the number of appended readings of each sensor, and of those without echo."""
        return dict(zip(list(self._names), zip(self._counts, self._silent, strict=False), strict=False))

    def _number_of(self, sensor: str) -> int:
        number = self._names.setdefault(sensor, len(self._names))
        if number == len(self._counts):
            self._counts.append(0)
            self._silent.append(0)
        return number

    def snapshot(self, start: int = 0) -> Readings:
        """Return the stored readings from number `start` on; all appended readings are numbered from 0.

        They are views: later appends, also in another thread, do not change them.
        """
        with self._lock:
            size, columns, names = self._size, self._columns, tuple(self._names)
        begin = int(np.searchsorted(columns['number'][:size], start)) if start else 0
        views = {name: column[begin:size] for name, column in columns.items() if name != 'number'}
        return Readings(**views, sensor_names=names)

    def bounded(self) -> Readings:
        """Return the readings for mapping: all stored ones, thinned to `bound`."""
        return bounded(self.snapshot(), self.bound)

    def _reserve(self, count: int) -> None:
        """Make room for `count` more readings."""
        size = len(self._columns['z'])
        while size < self._size + count:
            size *= 2
        if size > len(self._columns['z']):
            if self._next_columns is None or len(self._next_columns['z']) < size:
                self._next_columns, self._copied = _empty(self._columns, size), 0
            self._copy_up_to(self._size)
            with self._lock:
                self._columns = self._next_columns
            self._next_columns = None

    def _copy_ahead(self) -> None:
        """Copy some rows to larger columns if these are needed soon; once every `STEP` readings is enough."""
        size = len(self._columns['z'])
        if size < LARGE or self._size <= size - size // 4:
            return
        if self._next_columns is None:
            self._next_columns, self._copied = _empty(self._columns, 2 * size), 0
        self._copy_up_to(min(self._copied + 5 * STEP, self._size))

    def _copy_up_to(self, end: int) -> None:
        assert self._next_columns is not None
        for name, column in self._columns.items():
            self._next_columns[name][self._copied : end] = column[self._copied : end]
        self._copied = end

    def _discard_pending(self) -> None:
        """Discard a begun copy and a begun thinning, since they are of columns that are no longer the buffer's."""
        self._version += 1
        self._next_columns, self._copied = None, 0
        self._is_thinning, self._size_at_failure = False, 0

    def _thin(self) -> None:
        """Begin to thin if there are too many readings."""
        # not for each reading beyond the bound: thinning once for many costs the same
        slack = self.bound // 8
        if not self.bound or self._is_thinning or self._size <= max(self.bound, self._size_at_failure) + slack:
            return
        self._is_thinning = True
        columns, size, version, names = self._columns, self._size, self._version, tuple(self._names)

        def thin() -> _Thinned:
            views = {name: column[:size] for name, column in columns.items()}
            readings = Readings(**{name: view for name, view in views.items() if name != 'number'}, sensor_names=names)
            stay = kept(readings, self.bound)
            # snapshots are views of the old columns, which therefore must not change
            thinned = _empty(columns, len(columns['z']))
            for name, view in views.items():
                # unlike indexing, np.take releases the GIL
                np.take(view, stay, out=thinned[name][: len(stay)], mode='clip')
            return _Thinned(thinned, len(stay), size, version)

        if self.run_in_background is None:
            self._use_thinned(thin())
        else:
            self.run_in_background(thin, self._use_thinned)

    def _use_thinned(self, thinned: _Thinned | None) -> None:
        """Replace the columns by thinned ones and what was appended since; without them, try again later."""
        if thinned is None:
            self._is_thinning, self._size_at_failure = False, self._size
            return
        if thinned.version != self._version:
            return
        try:
            self._replace_columns(thinned)
        except MemoryError:
            self._is_thinning, self._size_at_failure = False, self._size
            raise
        # so many readings may have come meanwhile that thinning is due again
        self._thin()

    def _replace_columns(self, thinned: _Thinned) -> None:
        """Continue with thinned columns, and the rows that were appended since."""
        for callback in self.before_thinning:
            callback()
        columns, tail = thinned.columns, slice(thinned.size, self._size)
        size = thinned.stay + self._size - thinned.size
        if size > len(columns['z']):
            columns = _grown(columns, thinned.stay, 2 * size)
        for name, column in self._columns.items():
            columns[name][thinned.stay : size] = column[tail]
        with self._lock:
            self._columns, self._size = columns, size
        self._discard_pending()


def bounded(readings: Readings, bound: int) -> Readings:
    """Return the readings thinned to `bound`; 0 is no bound."""
    return readings if not bound or len(readings) <= bound else readings.select(kept(readings, bound))


def _empty(like: Columns, size: int) -> Columns:
    return {name: np.empty(size, column.dtype) for name, column in like.items()}


def _grown(columns: Columns, count: int, size: int) -> Columns:
    """Return longer columns with the first `count` rows of `columns`."""
    grown = _empty(columns, size)
    for name, column in columns.items():
        grown[name][:count] = column[:count]
    return grown
