"""The topics and services of maps: messages are made and sent in a thread of their own."""

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
    """Publishes the latest maps, with the same contents for topics and services.

    Attributes
    ----------
    generation : int
        Counts how often maps were forgotten; maps of an earlier generation are not published.
    latest : dict of name → nav_msgs/OccupancyGrid
        The last published messages.
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
            Receives the name of a map that a client requests, a callback for when it is up to date, and a callback that
            receives the reason if it cannot be.

        Raises
        ------
        MapperError
            If two maps have the same topic.
        """
        # rclpy holds the GIL while it sends: at low priority, this thread would delay the executor
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
        self._queued: set[str] = set()
        self._nothing = Grid(resolution, 0, 0, 1, 1), np.full((1, 1), -1, np.int8)
        self._ml_map = self._nothing
        nothing = Grid(resolution, 0, 0, 0, 0)
        self.latest = {name: self._message(nothing, np.zeros(nothing.shape, np.int8)) for name in MAPS}
        self.services = [DeferredService(node, GetMap, f'~/get_{name}', partial(self._get, name)) for name in MAPS]

    def publish(self, name: str, generation: int, grid: Grid, values: NDArray[Any]) -> None:
        """Have a map published; it replaces a waiting one of the same name. May be called from any thread.

        Parameters
        ----------
        name : str
            One of `MAPS`.
        generation : int
        grid : Grid
        values : array of shape `grid.shape`
            As in `grid_message`.
        """
        # held only briefly for maps of any size
        with self._lock:
            if generation != self.generation:
                return
            waits = name in self._queued
            self._queued.add(name)
            self._pending[name] = grid, values
            if name == 'ml_map':
                self._ml_map = grid, values
        if not waits:
            self.worker.put(partial(self._publish, name), partial(self._not_published, name))

    @property
    def ml_map(self) -> tuple[Grid, NDArray[np.int8]]:
        """Grid and cells of the last ML map; a single cell that is not observed if there is none."""
        with self._lock:
            return self._ml_map

    def refresh(self) -> None:
        """Have the whole live map published if only updates were sent and a subscriber needs the whole."""
        if self._updates and self._updates.stale:
            self.worker.put(self._updates.refresh)

    def clear(self) -> None:
        """Have empty maps published; maps of earlier generations are not published after them."""
        with self._lock:
            self.generation += 1
            generation = self.generation
        for name in MAPS:
            self.publish(name, generation, *self._nothing)

    def _publish(self, name: str) -> None:
        with self._lock:
            self._queued.discard(name)
            if name not in self._pending:
                return
            grid, values = self._pending.pop(name)
        message = self._message(grid, values)
        if grid is self._nothing[0] and not message.header.frame_id:
            # after a reset that forgot the frame: subscribers such as Nav2 ignore a map without one, and keep the old
            message.header.frame_id = self.latest[name].header.frame_id
        self.latest[name] = message
        if name == 'live_map' and self._updates:
            self._updates.publish(message)
        else:
            self._out[name].publish(message)

    def _not_published(self, name: str, why: str) -> None:
        # if no thread could start, the next map tries again
        with self._lock:
            self._queued.discard(name)

    def _message(self, grid: Grid, values: NDArray[Any]) -> OccupancyGrid:
        # tf2 refuses the leading slash of ROS 1
        return grid_message(grid, values, self._frame().lstrip('/'), self._node.get_clock().now().to_msg())

    def _get(self, name: str, reply: Reply) -> None:
        def answer() -> None:
            self.worker.put(lambda: reply.send(self.latest[name]), self_answer)

        def self_answer(why: str) -> None:
            reply.send(self.latest[name])

        # an outdated map is better than no answer
        self._before(name, answer, self_answer)
