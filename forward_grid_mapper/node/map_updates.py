"""A map sent only where it changed, as `map_msgs/OccupancyGridUpdate`, to those who can put the parts together.

RViz and Nav2's static layer listen to a map's topic and to the same name with `_updates`. The map itself stays what it
is for everybody else: as long as a node listens to it and not to its updates, whole maps are sent and nothing else.
"""

from __future__ import annotations

import array
import time
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import QoSProfile, ReliabilityPolicy

WHOLE = 10.0
"""Seconds after which the whole map is sent again if it changed: the two topics may overtake each other."""

UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""What a middleware calls a node that it has not found yet."""

FEW = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Box(NamedTuple):
    """A part of a map, in cells from its first one."""

    x: int
    y: int
    width: int
    height: int


def changed_box(before: OccupancyGrid, now: OccupancyGrid) -> Box | None:
    """Return the smallest box that holds all cells in which two maps of one grid differ; None if there are none."""
    shape = now.info.height, now.info.width
    differ = np.frombuffer(before.data, np.int8).reshape(shape) != np.frombuffer(now.data, np.int8).reshape(shape)
    rows, columns = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    if not len(rows):
        return None
    x, y = int(columns[0]), int(rows[0])
    return Box(x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1)


def listeners(node: Any, topic: str) -> dict[bytes, tuple[str, str]]:
    """Return the nodes that listen to a topic, (namespace, name) by the identity of the subscription."""
    found = node.get_subscriptions_info_by_topic(topic)
    return {bytes(info.endpoint_gid): (info.node_namespace, info.node_name) for info in found}


class MapUpdates:
    """Publishes a map: where it changed, if everybody who listens to the map listens to its updates as well."""

    def __init__(self, node: Any, whole: Any, kind: Any) -> None:
        """`whole` is the publisher of the map, `kind` is `map_msgs.msg.OccupancyGridUpdate`."""
        self._node, self._whole, self._kind = node, whole, kind
        self._out = node.create_publisher(kind, f'{whole.topic_name}_updates', FEW)
        self._last: OccupancyGrid | None = None
        self._stale = False
        self._sent = 0.0
        self._heard: set[bytes] = set()

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
        """Whether the map that late subscribers get lacks updates."""
        return self._stale

    def publish(self, now: OccupancyGrid) -> None:
        """Publish the map, or what changed of it since the last time."""
        before, self._last = self._last, now
        if before is None or not _one_grid(before, now) or self._somebody_needs_the_whole():
            self._publish_whole(now)
        elif box := changed_box(before, now):
            self._out.publish(self._update(now, box))
            self._stale = True

    def refresh(self) -> None:
        """Publish the whole map if late subscribers would get one that lacks updates."""
        if self._stale and self._last is not None and self._somebody_needs_the_whole():
            self._publish_whole(self._last)

    def _publish_whole(self, now: OccupancyGrid) -> None:
        # who comes from here on gets this map
        self._heard = set(listeners(self._node, self._whole.topic_name))
        self._whole.publish(now)
        self._sent, self._stale = time.monotonic(), False

    def _somebody_needs_the_whole(self) -> bool:
        """Return whether parts would leave anybody without the map, now or later."""
        heard = listeners(self._node, self._whole.topic_name)
        follow = Counter(listeners(self._node, self._out.topic_name).values())
        alone = any(count > follow[node] or node[1] == UNKNOWN for node, count in Counter(heard.values()).items())
        new = not self._heard.issuperset(heard)
        return alone or new or not heard or time.monotonic() > self._sent + WHOLE

    def _update(self, now: OccupancyGrid, box: Box) -> Any:
        cells = np.frombuffer(now.data, np.int8).reshape(now.info.height, now.info.width)
        part = cells[box.y : box.y + box.height, box.x : box.x + box.width]
        made = self._kind()
        made.header = now.header
        made.x, made.y, made.width, made.height = box
        made.data = array.array('b', part.tobytes())
        return made


def _one_grid(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Return whether two maps have the same cells in the same frame."""
    return bool(
        a.header.frame_id == b.header.frame_id
        and a.info.resolution == b.info.resolution
        and (a.info.width, a.info.height) == (b.info.width, b.info.height)
        and a.info.origin == b.info.origin
    )
