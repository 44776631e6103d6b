"""The online map in the background: tasks from a queue, results as immutable snapshots."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled, MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.maps.map_set import MapSet
from ..core.online_map import OnlineMap
from .background import Worker


class OnlineSnapshot(NamedTuple):
    """The online map at a moment.

    `epoch` is that of the worker when it was made; `ml` and `uncertainty` are as in `MapSet`, have shape `grid.shape`,
    and nothing changes them.
    """

    epoch: int
    grid: Grid
    ml: NDArray[np.int8]
    uncertainty: NDArray[np.float32]


class OnlineWorker:
    """Keeps an online map of readings, and publishes it at a bounded rate.

    All methods are called by one thread and return at once; the worker's thread owns the map.

    Attributes
    ----------
    epoch : int
        Counts how often the map was begun again or replaced: snapshots of an earlier epoch are out of date.
    kept : int
        Number of readings in the map; those with equal contents are counted separately.
    """

    def __init__(
        self,
        parameters: Parameters,
        publish: Callable[[OnlineSnapshot], object],
        log: Callable[[str], object],
        prepare: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin without readings.

        Parameters
        ----------
        parameters : Parameters
        publish : callable
            Receives a snapshot, in the worker's thread.
        log : callable
            Receives failures.
        prepare : callable
            Called in the worker's thread before anything else.
        """
        self.worker = Worker('online map', log, lasting=True)
        self.epoch = self.kept = 0
        self._parameters = parameters
        self._publish_snapshot, self._log = publish, log
        self._map = OnlineMap(parameters)
        self._start: tuple[Grid, NDArray[np.int8]] | None = None
        # held while the epoch changes, and while a map is stored as the start of EM
        self._lock = threading.Lock()
        self._changed = self._publishing = False
        self._next = 0.0
        self.worker.put(prepare)

    def offer(self, readings: Readings, place: Callable[[Readings], Readings] | None = None) -> None:
        """Have readings added soon, transformed by `place`."""
        wanted = self._map
        self.worker.put(lambda: self._add(wanted, lambda: place(readings) if place else readings))

    def restart(self, parameters: Parameters, readings: Callable[[], Readings] | None = None) -> None:
        """Forget the map; begin again with other parameters and, if given, the readings that `readings` returns.

        It is called in the worker's thread.
        """
        self._map.cancel()
        self.worker.put(self._map.dismantle)
        with self._lock:
            self.epoch, self._start = self.epoch + 1, None
        self._parameters = parameters
        wanted = self._map = OnlineMap(parameters)
        self.kept = 0
        self.worker.forgive()
        if readings is not None:
            self.worker.put(lambda: self._add(wanted, readings))

    def change(self, parameters: Parameters) -> None:
        """Use another `publish_rate`."""
        self._parameters = parameters
        self._next = 0.0

    def adopt(self, maps: MapSet) -> None:
        """Continue from the map that EM found."""
        with self._lock:
            self.epoch, self._start = self.epoch + 1, (maps.grid, maps.searched)
        wanted = self._map
        self.worker.put(lambda: self._adopt(wanted, maps))

    def show(self) -> None:
        """Have the map published again, even if it has not changed."""
        self._changed = True

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return grid and map of the last snapshot, from which EM may start; None if there is none."""
        return self._start

    def tick(self) -> None:
        """Have the map published if it has changed and the period is over; to be called often."""
        if self._changed and not self._publishing and time.monotonic() >= self._next:
            self._next = time.monotonic() + 1.0 / self._parameters.node.publish_rate
            self._publishing, self._changed = True, False
            wanted, epoch = self._map, self.epoch
            self.worker.put(lambda: self._publish(wanted, epoch), self._not_published)

    def close(self, seconds: float) -> None:
        """Cancel the work, and wait at most this many seconds for the end of the thread."""
        self._map.cancel()
        self.worker.close(seconds)

    # in the worker's thread; `wanted` is the map of a task, which may have been replaced since

    def _add(self, wanted: OnlineMap, readings: Callable[[], Readings]) -> None:
        if wanted is not self._map:
            return
        new, taken = readings(), wanted.taken
        try:
            wanted.add(new)
        except Cancelled:
            return
        except (MapperError, MemoryError) as error:
            why = str(error) or 'there is not enough memory'
            if wanted.taken > taken:
                # the readings are in the map, so this is no lasting failure
                self._log(f'online map: the search will continue with the next readings: {why}')
                return
            raise MapperError(f'{counted(len(new), "reading")} cannot be added to the online map: {why}') from None
        finally:
            if wanted is self._map:
                self.kept = len(wanted)
                self._changed = True

    def _adopt(self, wanted: OnlineMap, maps: MapSet) -> None:
        if wanted is self._map:
            try:
                wanted.adopt(maps.grid, maps.searched)
            except Cancelled:
                return
            self._changed = True

    def _not_published(self, why: str) -> None:
        self._publishing, self._changed = False, True

    def _publish(self, wanted: OnlineMap, epoch: int) -> None:
        self._publishing = False
        if wanted is not self._map:
            return
        try:
            grid, ml, uncertainty = wanted.maps()
        except Cancelled:
            return
        _, searched = wanted.searched()
        with self._lock:
            if not grid.size or epoch != self.epoch:
                return
            self._start = grid, searched
        self._publish_snapshot(OnlineSnapshot(epoch, grid, ml, uncertainty))
