"""The readings that were accepted so far: a buffer that grows up to a bound, and can be looked at from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import fields

import numpy as np

from ..common.readings import Readings
from .thinning import kept


class ReadingBuffer:
    """Columns that grow as readings come, and are thinned (`thinning`) when more than `bound` are held.

    76 bytes a reading. One thread appends; any may take snapshots.

    Attributes
    ----------
    bound : int
        Readings that `bounded` returns at the most; up to an eighth more are held. 0 is no bound.
    before_thinning : list of callable
        Called before readings are dropped, by the thread that appends: the last moment to look at those that are new.
    """

    _TYPES = {f.name: np.float64 for f in fields(Readings) if f.name not in ('stamp', 'sensor', 'sensor_names')} | {
        'stamp': np.int64,
        'sensor': np.int32,
        'number': np.int64,
    }

    def __init__(self, bound: int = 0) -> None:
        self.bound = bound
        self.before_thinning: list[Callable[[], None]] = []
        # held while columns are replaced, so that a snapshot never mixes old and new ones
        self._lock = threading.Lock()
        self.clear()

    def __len__(self) -> int:
        """Return how many readings were ever appended; the thinned ones count."""
        return self._count

    @property
    def held(self) -> int:
        """Number of readings in memory."""
        return self._size

    def clear(self) -> None:
        """Forget every reading and every sensor name."""
        with self._lock:
            self._size = self._count = 0
            self._names: dict[str, int] = {}
            self._columns = {name: np.empty(1024, kind) for name, kind in self._TYPES.items()}

    def append(self, sensor: str, **values: float) -> None:
        """Add one reading of the sensor named `sensor`; `values` are the other columns of `Readings`."""
        if self._size == len(self._columns['z']):
            self._reserve(1)
        values['sensor'] = self._names.setdefault(sensor, len(self._names))
        values['number'] = self._count
        for name, column in self._columns.items():
            column[self._size] = values[name]
        self._size += 1
        self._count += 1
        self._thin()

    def extend(self, readings: Readings) -> None:
        """Add many readings at once."""
        count = len(readings)
        self._reserve(count)
        sensors = np.array(
            [self._names.setdefault(name, len(self._names)) for name in readings.sensor_names] or [0], np.int32
        )
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

    def snapshot(self, start: int = 0) -> Readings:
        """Return what is held of readings number `start`, counted from 0 as `len` does, and later.

        They are views: later appends do not change them, and may go on in another thread.
        """
        with self._lock:
            size, columns, names = self._size, self._columns, tuple(self._names)
        begin = int(np.searchsorted(columns['number'][:size], start)) if start else 0
        views = {name: column[begin:size] for name, column in columns.items() if name != 'number'}
        return Readings(**views, sensor_names=names)

    def bounded(self) -> Readings:
        """Return the readings to map from: all that is held, thinned to `bound`."""
        readings = self.snapshot()
        if not self.bound or len(readings) <= self.bound:
            return readings
        return readings.select(kept(readings, self.bound))

    def _reserve(self, count: int) -> None:
        size = len(self._columns['z'])
        while size < self._size + count:
            size *= 2
        if size > len(self._columns['z']):
            grown = {name: np.empty(size, column.dtype) for name, column in self._columns.items()}
            for name, column in self._columns.items():
                grown[name][: self._size] = column[: self._size]
            with self._lock:
                self._columns = grown

    def _thin(self) -> None:
        # not at every reading beyond the bound: thinning costs the same for many
        if not self.bound or self._size <= self.bound + self.bound // 8:
            return
        for look in self.before_thinning:
            look()
        stay = kept(self.snapshot(), self.bound)
        # snapshots are views of the old columns, which therefore must not change
        thinned = {name: np.empty_like(column) for name, column in self._columns.items()}
        for name, column in self._columns.items():
            thinned[name][: len(stay)] = column[stay]
        with self._lock:
            self._columns, self._size = thinned, len(stay)
