"""The online map in the background: takes readings as they come, in a thread whose kernels leave the node the GIL."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import MapperError
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.maps.map_set import MapSet
from ..core.online_map import OnlineMap

Publish = Callable[[int, Grid, NDArray[np.int8], NDArray[np.float32]], None]
"""Takes the generation of the map, its grid, the ML map and the uncertainty map."""


class OnlineWorker:
    """Keeps an online map of the readings that it is offered, and publishes it at a bounded rate."""

    def __init__(self, parameters: Parameters, publish: Publish, log: Callable[[str], Any]) -> None:
        """Begin without readings; `publish` is called in the worker's thread, `log` takes errors.

        What `publish` is given counts only if its generation is still `generation`.
        """
        self.parameters = parameters
        self._publish, self._log = publish, log
        self._map = OnlineMap(parameters)
        self._waiting: list[Readings] = []
        self._work = threading.Condition()
        self._using = threading.Lock()
        self._ended = False
        self.generation = 0
        self.slowest = 0.0
        self._thread = threading.Thread(target=self._run, name='online', daemon=True)
        self._thread.start()

    def offer(self, readings: Readings) -> None:
        """Have readings added soon."""
        with self._work:
            self._waiting.append(readings)
            self._work.notify()

    def restart(self, parameters: Parameters, readings: Readings | None = None) -> None:
        """Forget the map; begin anew with other parameters and, if given, these readings."""
        with self._work, self._using:
            self.parameters = parameters
            self.generation += 1
            self._map = OnlineMap(parameters)
            self._waiting = [] if readings is None else [readings]
            self._work.notify()

    def adopt(self, maps: MapSet) -> None:
        """Go on from the map that EM found."""
        with self._using:
            self._map.adopt(maps.grid, maps.searched)

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return the grid and a copy of the map to start EM from, or None if there is none yet."""
        with self._using:
            grid, searched = self._map.searched()
        return (grid, searched) if grid.size else None

    @property
    def kept(self) -> int:
        """Number of readings that the map keeps; those that say the same as another one are counted with it."""
        return len(self._map)

    def close(self) -> None:
        """End the thread."""
        with self._work:
            self._ended = True
            self._work.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        published, changed = 0.0, False
        while True:
            with self._work:
                due = published + 1.0 / self.parameters.node.publish_rate - time.monotonic()
                if not self._waiting and not self._ended:
                    self._work.wait(max(due, 0.0) if changed else None)
                if self._ended:
                    return
                todo, self._waiting = self._waiting, []
                generation = self.generation
            if todo:
                self._add(todo, generation)
                changed = True
            if changed and time.monotonic() - published >= 1.0 / self.parameters.node.publish_rate:
                with self._using:
                    generation, found = self.generation, self._map.maps()
                if found[0].size:
                    self._publish(generation, *found)
                published, changed = time.monotonic(), False

    def _add(self, todo: list[Readings], generation: int) -> None:
        for readings in todo:
            begin = time.monotonic()
            try:
                with self._using:
                    if generation == self.generation:
                        self._map.add(readings)
            except MapperError as error:
                self._log(f'{len(readings)} readings are not in the online map: {error}')
            except MemoryError:
                self._log(f'{len(readings)} readings are not in the online map: there is no memory for them')
            self.slowest = max(self.slowest, time.monotonic() - begin)
