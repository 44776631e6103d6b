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


class ReadingBuffer:
    """Columns that grow with the readings, and are thinned (`thinning`) if there are more than `bound`.

    It needs 76 bytes for each reading. One thread appends; any may take snapshots.

    Attributes
    ----------
    bound : int
        Most readings that `bounded` returns; up to an eighth more are stored. 0 is no bound.
    before_thinning : list of callable
        Called before readings are dropped, by the thread that appends: the last chance to process new ones.
    aside : callable, optional
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
        self.aside: Callable[[Callable[[], _Thinned], Callable[[_Thinned | None], None]], None] | None = None
        self._version = 0
        self._larger: Columns | None = None
        # locked while columns are replaced, so that a snapshot never mixes old and new ones
        self._lock = threading.Lock()
        self.clear()

    def __len__(self) -> int:
        """Return the number of readings that were appended, including thinned ones."""
        return self._count

    @property
    def held(self) -> int:
        """Number of readings in memory."""
        return self._size

    @property
    def room(self) -> int:
        """Number of readings up to and including the one that starts the next thinning; large without bound."""
        if not self.bound or self._thinning:
            return sys.maxsize
        return max(max(self.bound, self._failed_at) + self.bound // 8 + 1 - self._size, 1)

    def clear(self) -> None:
        """Remove all readings and sensor names."""
        with self._lock:
            self._size = self._count = 0
            self._names: dict[str, int] = {}
            self._columns: Columns = {name: np.empty(1024, kind) for name, kind in self._TYPES.items()}
        self._first, self._last = sys.maxsize, -sys.maxsize
        self._counts: list[int] = []
        self._silent: list[int] = []
        self._begin_anew()

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
            self._move_on()
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
        size = len(self._columns['z'])
        while size < self._size + count:
            size *= 2
        if size > len(self._columns['z']):
            if self._larger is None or len(self._larger['z']) < size:
                self._larger, self._moved = _empty(self._columns, size), 0
            self._move(self._size)
            with self._lock:
                self._columns = self._larger
            self._larger = None

    def _move_on(self) -> None:
        """Copy some rows to larger columns if these are needed soon; once every `STEP` readings is enough."""
        size = len(self._columns['z'])
        if size < LARGE or self._size <= size - size // 4:
            return
        if self._larger is None:
            self._larger, self._moved = _empty(self._columns, 2 * size), 0
        self._move(min(self._moved + 5 * STEP, self._size))

    def _move(self, end: int) -> None:
        assert self._larger is not None
        for name, column in self._columns.items():
            self._larger[name][self._moved : end] = column[self._moved : end]
        self._moved = end

    def _begin_anew(self) -> None:
        """Discard results for columns that are no longer those of the buffer."""
        self._version += 1
        self._larger, self._moved = None, 0
        self._thinning, self._failed_at = False, 0

    def _thin(self) -> None:
        # not for each reading beyond the bound: thinning once for many costs the same
        slack = self.bound // 8
        if not self.bound or self._thinning or self._size <= max(self.bound, self._failed_at) + slack:
            return
        self._thinning = True
        columns, size, version, names = self._columns, self._size, self._version, tuple(self._names)

        def thin() -> _Thinned:
            views = {name: column[:size] for name, column in columns.items()}
            held = Readings(**{name: view for name, view in views.items() if name != 'number'}, sensor_names=names)
            stay = kept(held, self.bound)
            # snapshots are views of the old columns, which therefore must not change
            thinned = _empty(columns, len(columns['z']))
            for name, view in views.items():
                # unlike indexing, np.take releases the GIL
                np.take(view, stay, out=thinned[name][: len(stay)], mode='clip')
            return _Thinned(thinned, len(stay), size, version)

        if self.aside is None:
            self._take_thinned(thin())
        else:
            self.aside(thin, self._take_thinned)

    def _take_thinned(self, thinned: _Thinned | None) -> None:
        """Replace the columns by thinned ones and what was appended since; without them, try again later."""
        if thinned is None:
            self._thinning, self._failed_at = False, self._size
            return
        if thinned.version != self._version:
            return
        try:
            self._go_on_with(thinned)
        except MemoryError:
            self._thinning, self._failed_at = False, self._size
            raise
        # so many readings may have come meanwhile that thinning is due again
        self._thin()

    def _go_on_with(self, thinned: _Thinned) -> None:
        for look in self.before_thinning:
            look()
        columns, tail = thinned.columns, slice(thinned.size, self._size)
        size = thinned.stay + self._size - thinned.size
        if size > len(columns['z']):
            columns = _grown(columns, thinned.stay, 2 * size)
        for name, column in self._columns.items():
            columns[name][thinned.stay : size] = column[tail]
        with self._lock:
            self._columns, self._size = columns, size
        self._begin_anew()


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
