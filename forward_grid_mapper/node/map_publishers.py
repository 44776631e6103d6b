"""The topics and services that hand out maps: messages are made and sent in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ..core.common.errors import MapperError
from ..core.common.grid import Grid
from .background import Worker
from .deferred import DeferredService, Reply
from .grid_message import grid_message
from .map_updates import MapUpdates

MAPS = ('live_map', 'ml_map', 'uncertainty_map')
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MapPublishers:
    """Publishes the latest maps, the same in topics and services.

    Attributes
    ----------
    generation : int
        How often maps were forgotten; maps of an earlier one are not published any more.
    latest : dict of name → nav_msgs/OccupancyGrid
        What was published last.
    services : list of DeferredService
    """

    def __init__(
        self,
        node: Any,
        resolution: float,
        frame: Callable[[], str],
        before: Callable[[str, Callable[[], None], Callable[[str], object]], None],
    ) -> None:
        """Create topics and services.

        Parameters
        ----------
        node : Node
        resolution : float
            Of the maps, metres.
        frame : callable
            Returns the frame of the maps.
        before : callable
            Given the name of a map that is asked for, what to call when it is up to date, and what to call with the
            reason if it cannot be.

        Raises
        ------
        MapperError
            If two maps were given the same topic.
        """
        # rclpy keeps the GIL while it sends: a thread that gave way with it would have the executor give way as well
        self.worker = Worker('maps', node.get_logger().error, nice=0)
        self.generation = 0
        self._node, self._resolution, self._frame, self._before = node, resolution, frame, before
        self._out = {name: node.create_publisher(OccupancyGrid, f'~/{name}', LATCHED) for name in MAPS}
        topics = [self._out[name].topic_name for name in MAPS]
        if twice := sorted(topic for topic in set(topics) if topics.count(topic) > 1):
            raise MapperError(f'{twice[0]} can have only one map: remap the others to another topic, or not at all')
        self._updates = MapUpdates.of(node, self._out['live_map'])
        self._lock = threading.Lock()
        self._pending: dict[str, tuple[Grid, NDArray[Any]]] = {}
        self._asked: set[str] = set()
        self._nothing = Grid(resolution, 0, 0, 1, 1), np.full((1, 1), -1, np.int8)
        self._ml_map = self._nothing
        nothing = Grid(resolution, 0, 0, 0, 0)
        self.latest = {name: self._message(nothing, np.zeros(nothing.shape, np.int8)) for name in MAPS}
        self.services = [DeferredService(node, GetMap, f'~/get_{name}', partial(self._get, name)) for name in MAPS]

    def publish(self, name: str, generation: int, grid: Grid, values: NDArray[Any]) -> None:
        """Have a map of a generation published, instead of one of the same name that still waits for it; any thread.

        Parameters
        ----------
        name : str
            One of `MAPS`.
        generation : int
        grid : Grid
        values : array of shape `grid.shape`
            As in `grid_message`.
        """
        # held for a moment only, whatever the size of the map
        with self._lock:
            if generation != self.generation:
                return
            waits = name in self._asked
            self._asked.add(name)
            self._pending[name] = grid, values
            if name == 'ml_map':
                self._ml_map = grid, values
        if not waits:
            self.worker.put(partial(self._publish, name), partial(self._not_published, name))

    @property
    def ml_map(self) -> tuple[Grid, NDArray[np.int8]]:
        """Grid and cells of the ML map that was given last; a single cell not observed if none was."""
        with self._lock:
            return self._ml_map

    def refresh(self) -> None:
        """Have the whole live map published where somebody needs it, after only parts of it were."""
        if self._updates and self._updates.stale:
            self.worker.put(self._updates.refresh)

    def clear(self) -> None:
        """Have empty maps published, after which none of those that were there before comes."""
        with self._lock:
            self.generation += 1
            generation = self.generation
        for name in MAPS:
            self.publish(name, generation, *self._nothing)

    def _publish(self, name: str) -> None:
        with self._lock:
            self._asked.discard(name)
            if name not in self._pending:
                return
            grid, values = self._pending.pop(name)
        message = self._message(grid, values)
        self.latest[name] = message
        if name == 'live_map' and self._updates:
            self._updates.publish(message)
        else:
            self._out[name].publish(message)

    def _not_published(self, name: str, why: str) -> None:
        # where no thread could start, the next map tries again
        with self._lock:
            self._asked.discard(name)

    def _message(self, grid: Grid, values: NDArray[Any]) -> OccupancyGrid:
        # tf2 refuses the leading slash that ROS 1 had
        return grid_message(grid, values, self._frame().lstrip('/'), self._node.get_clock().now().to_msg())

    def _get(self, name: str, reply: Reply) -> None:
        def answer() -> None:
            self.worker.put(lambda: reply.send(self.latest[name]), self_answer)

        def self_answer(why: str) -> None:
            reply.send(self.latest[name])

        # what cannot be brought up to date is better than no answer
        self._before(name, answer, self_answer)
