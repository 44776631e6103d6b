"""The live map in the background: adds readings as they arrive, and gives immutable snapshots."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.maps.log_odds_map import LogOddsMap
from .background import Worker

BATCH = 20_000
"""Most readings that are added at once, so that a reset does not wait long."""


Place = Callable[[Readings], Readings]
"""Transforms readings to the frame of the map."""


class LiveSnapshot(NamedTuple):
    """The live map at a moment: float32 probabilities, NaN where not observed, shape `grid.shape`."""

    generation: int
    grid: Grid
    probability: NDArray[np.float32]


class LiveMap:
    """Keeps the log-odds map in its own thread; all methods except `snapshot` return at once.

    Attributes
    ----------
    generation : int
        Generation of the current map; tasks for an earlier one are dropped.
    grid : Grid
        Grid of the current map.
    """

    def __init__(
        self,
        parameters: Parameters,
        publish: Callable[[LiveSnapshot], object],
        log: Callable[[str], object],
        prepare: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin without readings.

        Parameters
        ----------
        parameters : Parameters
        publish : callable
            Receives a snapshot, in the map's thread.
        log : callable
            Receives failures.
        prepare : callable
            Called in the map's thread before anything else.
        """
        self.worker = Worker('live map', log, lasting=True)
        self.generation = 0
        self.grid = Grid(parameters.grid.resolution, 0, 0, 0, 0)
        self._publish_snapshot = publish
        self._parameters = parameters
        self._map = LogOddsMap(parameters)
        self._offered = self._published = 0
        self._publishing = False
        self.worker.put(prepare)

    def offer(self, readings: Readings, place: Place | None = None) -> None:
        """Have readings added soon, transformed by `place`."""
        self._offered += len(readings)
        for first in range(0, len(readings), BATCH):
            part = readings.select(slice(first, first + BATCH))
            self.worker.put(partial(self._add, part, place, self.generation))

    def replace(self, made: LogOddsMap) -> None:
        """Continue from another map instead of all readings so far."""
        self.worker.put(partial(self._replace, made, self.generation))
        self.touch()

    def touch(self) -> None:
        """Have the map published again."""
        self._published = -1

    def change(self, parameters: Parameters) -> None:
        """Use other parameters for later readings."""
        self._parameters = parameters
        self.worker.put(lambda: self._map.change(parameters))

    def restart(self, parameters: Parameters, generation: int) -> None:
        """Begin again without readings; later snapshots have another generation."""
        self.generation = generation
        self._offered = self._published = 0
        self._parameters = parameters
        self.worker.forgive()
        self.worker.put(self._clear)

    def publish(self, now: bool = False) -> None:
        """Have the map published if readings were added since the last time; with `now`, even if a request waits."""
        if self._offered != self._published and (now or not self._publishing):
            self._publishing = True
            self._published = self._offered
            self.worker.put(partial(self._publish, self.generation), self._not_published)

    def when_added(self, work: Callable[[], None], failed: Callable[[str], object]) -> None:
        """Have `work` called, in the map's thread, after all readings so far were added."""
        self.worker.put(work, failed)

    def snapshot(self) -> LiveSnapshot:
        """Wait until all readings so far were added, and return the map; must not be called by the executor.

        Raises
        ------
        MapperError
            If there is no memory for it.
        """
        return self.worker.ask(partial(self._snapshot, self.generation))

    def _add(self, readings: Readings, place: Place | None, generation: int) -> None:
        if generation != self.generation:
            return
        try:
            self._map.add(readings if place is None else place(readings))
        except (MapperError, MemoryError) as error:
            why = str(error) or 'there is not enough memory'
            raise MapperError(f'{counted(len(readings), "reading")} cannot be added to the live map: {why}') from None
        self.grid = self._map.grid

    def _replace(self, made: LogOddsMap, generation: int) -> None:
        if generation == self.generation:
            made.change(self._parameters)
            self._map = made
            self.grid = made.grid

    def _clear(self) -> None:
        self._map = LogOddsMap(self._parameters)
        self.grid = self._map.grid

    def _snapshot(self, generation: int) -> LiveSnapshot:
        return LiveSnapshot(generation, self._map.grid, self._map.probability())

    def _publish(self, generation: int) -> None:
        self._publishing = False
        if generation == self.generation:
            self._publish_snapshot(self._snapshot(generation))

    def _not_published(self, why: str) -> None:
        self._publishing = False
        self._published = -1
