"""Changed parts of a map, as `map_msgs/OccupancyGridUpdate`, if all subscribers can use them.

RViz and Nav2's static layer subscribe to a map's topic and to the topic of the same name with `_updates`. Other nodes
subscribe to the map alone: as long as there is one, only whole maps are sent.
"""

from __future__ import annotations

import array
import time
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import QoSProfile, ReliabilityPolicy

WHOLE_MAP_EVERY = 10.0
"""Seconds after which the whole map is sent again if it changed, since updates may arrive before their map."""

UNKNOWN_NODE_NAME = '_NODE_NAME_UNKNOWN_'
"""The middleware's name for a node that it has not discovered yet."""

UPDATES_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Box(NamedTuple):
    """A part of a map, in cells from cell (0, 0)."""

    x: int
    y: int
    width: int
    height: int


def changed_box(before: OccupancyGrid, now: OccupancyGrid) -> Box | None:
    """Return the smallest box around all cells that differ between two maps of the same grid; None if none differ."""
    shape = now.info.height, now.info.width
    differ = np.frombuffer(before.data, np.int8).reshape(shape) != np.frombuffer(now.data, np.int8).reshape(shape)
    rows, columns = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    if not len(rows):
        return None
    x, y = int(columns[0]), int(rows[0])
    return Box(x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1)


def listeners(node: Any, topic: str) -> dict[bytes, tuple[str, str]]:
    """Return the nodes that subscribe to a topic, as (namespace, name) by the GID of the subscription."""
    found = node.get_subscriptions_info_by_topic(topic)
    return {bytes(info.endpoint_gid): (info.node_namespace, info.node_name) for info in found}


class MapUpdates:
    """Publishes changed parts of a map if all subscribers of the map subscribe to its updates as well."""

    def __init__(self, node: Any, whole: Any, kind: Any) -> None:
        """`whole` is the publisher of the map, `kind` is `map_msgs.msg.OccupancyGridUpdate`."""
        self._node, self._whole, self._kind = node, whole, kind
        self._out = node.create_publisher(kind, f'{whole.topic_name}_updates', UPDATES_QOS)
        self._last: OccupancyGrid | None = None
        self._stale = False
        self._sent = 0.0
        self._whole_subscribers: set[bytes] = set()

    @classmethod
    def of(cls, node: Any, whole: Any) -> MapUpdates | None:
        """Return the updates of a map, if map_msgs is installed."""
        try:
            from map_msgs.msg import OccupancyGridUpdate
        except ImportError:
            return None
        return cls(node, whole, OccupancyGridUpdate)

    @property
    def stale(self) -> bool:
        """Whether the map for late subscribers lacks updates."""
        return self._stale

    def publish(self, now: OccupancyGrid) -> None:
        """Publish the map, or its changes since the last time."""
        before, self._last = self._last, now
        if before is None or not _one_grid(before, now) or self._somebody_needs_the_whole():
            self._publish_whole(now)
        elif box := changed_box(before, now):
            self._out.publish(self._update(now, box))
            self._stale = True

    def refresh(self) -> None:
        """Publish the whole map if late subscribers would get an outdated one."""
        if self._stale and self._last is not None and self._somebody_needs_the_whole():
            self._publish_whole(self._last)

    def _publish_whole(self, now: OccupancyGrid) -> None:
        # later subscribers get this map
        self._whole_subscribers = set(listeners(self._node, self._whole.topic_name))
        self._whole.publish(now)
        self._sent, self._stale = time.monotonic(), False

    def _somebody_needs_the_whole(self) -> bool:
        """Return whether there are subscribers, now or later, to whom updates would be of no use."""
        subscribers = listeners(self._node, self._whole.topic_name)
        of_updates = Counter(listeners(self._node, self._out.topic_name).values())
        alone = any(
            count > of_updates[node] or node[1] == UNKNOWN_NODE_NAME
            for node, count in Counter(subscribers.values()).items()
        )
        new = not self._whole_subscribers.issuperset(subscribers)
        return alone or new or not subscribers or time.monotonic() > self._sent + WHOLE_MAP_EVERY

    def _update(self, now: OccupancyGrid, box: Box) -> Any:
        cells = np.frombuffer(now.data, np.int8).reshape(now.info.height, now.info.width)
        part = cells[box.y : box.y + box.height, box.x : box.x + box.width]
        made = self._kind()
        made.header = now.header
        made.x, made.y, made.width, made.height = box
        made.data = array.array('b', part.tobytes())
        return made


def _one_grid(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Return whether two maps have the same grid in the same frame."""
    return bool(
        a.header.frame_id == b.header.frame_id
        and a.info.resolution == b.info.resolution
        and (a.info.width, a.info.height) == (b.info.width, b.info.height)
        and a.info.origin == b.info.origin
    )
