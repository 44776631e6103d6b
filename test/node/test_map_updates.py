"""Updates of the live map, with a stand-in for map_msgs: all subscribers have the latest map."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from builtin_interfaces.msg import Time
from inside import Inside
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Header

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.node import map_updates
from forward_grid_mapper.node.grid_message import grid_message
from forward_grid_mapper.node.map_updates import WHOLE_MAP_EVERY, Box, MapUpdates, changed_box
from forward_grid_mapper.node.mapper_node import MapperNode


class Update:
    """Stand-in for `map_msgs/OccupancyGridUpdate`: std_msgs/Header, int32 x and y, uint32 width and height, int8[]."""

    def __init__(self) -> None:
        self.header = Header()
        self.x = self.y = self.width = self.height = 0
        self.data: Any = []


def cells(message: Any) -> Any:
    shape = (
        (message.height, message.width) if isinstance(message, Update) else (message.info.height, message.info.width)
    )
    return np.array(message.data, np.int8).reshape(shape)


class Listener:
    """Combines maps and updates like RViz and the static layer of Nav2; subscribes to updates if `follows`."""

    numbers = itertools.count()

    def __init__(self, name: str, follows: bool) -> None:
        self.name, self.follows = name, follows
        self.gid = next(Listener.numbers).to_bytes(2, 'big')
        self.map: OccupancyGrid | None = None
        self.cells: Any = None

    def whole(self, message: OccupancyGrid) -> None:
        self.map, self.cells = message, cells(message)

    def part(self, update: Update) -> None:
        if self.map is None or not self.follows:
            return
        # otherwise the update is rejected there with a warning
        assert update.header.frame_id == self.map.header.frame_id
        assert update.x >= 0 and update.x + update.width <= self.map.info.width
        assert update.y >= 0 and update.y + update.height <= self.map.info.height
        self.cells[update.y : update.y + update.height, update.x : update.x + update.width] = cells(update)


class Network:
    """A node with publishers and listeners; the topic of the map keeps its last message."""

    def __init__(self) -> None:
        self.listeners: list[Listener] = []
        self.sent: list[Any] = []
        self.kept: OccupancyGrid | None = None

    def create_publisher(self, kind: Any, topic: str, quality: Any) -> Any:
        return SimpleNamespace(topic_name=topic, publish=self._publish)

    def _publish(self, message: Any) -> None:
        self.sent.append(message)
        if isinstance(message, Update):
            for listener in self.listeners:
                listener.part(message)
        else:
            self.kept = message
            for listener in self.listeners:
                listener.whole(message)

    def get_subscriptions_info_by_topic(self, topic: str) -> list[Any]:
        return [
            SimpleNamespace(endpoint_gid=listener.gid, node_namespace='/', node_name=listener.name)
            for listener in self.listeners
            if topic == 'map' or listener.follows
        ]

    def join(self, name: str, follows: bool) -> Listener:
        made = Listener(name, follows)
        self.listeners.append(made)
        if self.kept is not None:
            made.whole(self.kept)
        return made


@pytest.fixture
def network() -> Network:
    return Network()


@pytest.fixture
def updates(network: Network) -> MapUpdates:
    return MapUpdates(network, network.create_publisher(OccupancyGrid, 'map', None), Update)


def message(values: Any, column: int = 0, frame: str = 'odom') -> OccupancyGrid:
    grid = Grid(0.1, column, 0, values.shape[1], values.shape[0])
    return grid_message(grid, values, frame, Time(sec=5))


def test_box_is_the_smallest_with_all_changes() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        shape = tuple(rng.integers(1, 8, 2))
        before, now = (rng.choice([-1, 0, 1], shape, p=[0.1, 0.8, 0.1]).astype(np.int8) for _ in range(2))
        box = changed_box(message(before), message(now))
        differ = [(x, y) for y in range(shape[0]) for x in range(shape[1]) if before[y, x] != now[y, x]]
        if not differ:
            assert box is None
            continue
        xs, ys = zip(*differ, strict=True)
        assert box == Box(min(xs), min(ys), max(xs) - min(xs) + 1, max(ys) - min(ys) + 1)


def test_subscriber_of_updates_gets_only_changes(network: Network, updates: MapUpdates) -> None:
    rviz = network.join('rviz', follows=True)
    values = np.zeros((6, 9), np.int8)
    updates.publish(message(values))
    values[2, 3] = values[3, 5] = 1
    updates.publish(message(values))
    whole, update = network.sent
    assert isinstance(whole, OccupancyGrid) and isinstance(update, Update)
    assert (update.x, update.y, update.width, update.height) == (3, 2, 3, 2)
    assert list(update.data) == [100, 0, 0, 0, 0, 100]
    assert update.header.frame_id == 'odom' and update.header.stamp.sec == 5
    assert np.array_equal(rviz.cells, 100 * values)
    updates.publish(message(values))
    assert len(network.sent) == 2


def test_subscriber_without_updates_gets_whole_maps(network: Network, updates: MapUpdates) -> None:
    network.join('rviz', follows=True)
    network.join('amcl', follows=False)
    for k in range(5):
        updates.publish(message(np.full((2, 2), k % 2, np.int8)))
    assert all(isinstance(sent, OccupancyGrid) for sent in network.sent) and len(network.sent) == 5


def test_without_subscribers_the_whole_map_is_published(network: Network, updates: MapUpdates) -> None:
    for k in range(3):
        updates.publish(message(np.full((2, 2), k % 2, np.int8)))
    assert all(isinstance(sent, OccupancyGrid) for sent in network.sent)


def test_subscriber_with_unknown_name_gets_whole_maps(network: Network, updates: MapUpdates) -> None:
    network.join(map_updates.UNKNOWN_NODE_NAME, follows=True)
    for k in range(3):
        updates.publish(message(np.full((2, 2), k % 2, np.int8)))
    assert all(isinstance(sent, OccupancyGrid) for sent in network.sent)


def test_late_subscriber_gets_the_latest_map_without_changes(network: Network, updates: MapUpdates) -> None:
    network.join('rviz', follows=True)
    values = np.zeros((3, 3), np.int8)
    updates.publish(message(values))
    values[1, 1] = 1
    updates.publish(message(values))
    assert updates.stale
    late = network.join('saver', follows=False)
    assert not np.array_equal(late.cells, 100 * values)
    updates.refresh()
    assert np.array_equal(late.cells, 100 * values)
    assert not updates.stale
    sent = len(network.sent)
    updates.refresh()
    assert len(network.sent) == sent


def test_whole_map_is_sent_at_intervals(network: Network, updates: MapUpdates, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(map_updates.time, 'monotonic', lambda: now)
    network.join('rviz', follows=True)
    kinds = []
    for k in range(25):
        updates.publish(message(np.full((2, 2), k % 2, np.int8)))
        kinds.append(isinstance(network.sent[-1], OccupancyGrid))
        now += 1.0
    assert [k for k, whole in enumerate(kinds) if whole] == [
        0,
        int(WHOLE_MAP_EVERY) + 1,
        2 * (int(WHOLE_MAP_EVERY) + 1),
    ]


@pytest.mark.parametrize('seed', range(40))
def test_all_subscribers_have_the_latest_map_in_random_cases(network: Network, updates: MapUpdates, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, column, frame = np.zeros((3, 4), np.int8), 0, 'odom'
    # in most cases all subscribe to updates, so that updates are sent at all
    others = seed % 3 == 0
    for _ in range(60):
        what = rng.random()
        if what < 0.15:
            network.join(f'node_{rng.integers(4)}', follows=not others or bool(rng.random() < 0.5))
        elif what < 0.2 and network.listeners:
            network.listeners.pop(int(rng.integers(len(network.listeners))))
        elif what < 0.3:
            values = np.pad(values, ((0, int(rng.integers(3))), (int(rng.integers(3)), 0)), constant_values=-1)
            column -= 1
        elif what < 0.36:
            # the same size at another place
            values, column = np.roll(values, 1, axis=1), column + 1
        elif what < 0.39:
            frame = {'odom': 'map', 'map': 'odom'}[frame]
        values = values.copy()
        for _ in range(int(rng.integers(4))):
            values[rng.integers(values.shape[0]), rng.integers(values.shape[1])] = rng.integers(-1, 2)
        updates.publish(message(values, column, frame))
        updates.refresh()
        expected = np.where(values < 0, -1, 100 * values)
        for listener in network.listeners:
            assert np.array_equal(listener.cells, expected)
            assert listener.map is not None and listener.map.header.frame_id == frame
            assert listener.map.info.origin.position.x == pytest.approx(0.1 * column)
    assert others or any(isinstance(sent, Update) for sent in network.sent)


def test_node_publishes_updates_of_its_live_map(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    """Their topic is named after that of the live map, also if it is remapped."""
    modules = {name: ModuleType(name) for name in ('map_msgs', 'map_msgs.msg')}
    modules['map_msgs.msg'].OccupancyGridUpdate = Update  # type: ignore[attr-defined]
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    made: list[str] = []
    sent: list[Update] = []
    create = MapperNode.create_publisher

    def create_publisher(node: Any, kind: Any, topic: str, *options: Any, **more: Any) -> Any:
        if kind is not Update:
            return create(node, kind, topic, *options, **more)
        made.append(topic)
        return SimpleNamespace(topic_name=topic, publish=sent.append)

    monkeypatch.setattr(MapperNode, 'create_publisher', create_publisher)
    monkeypatch.setattr(map_updates, 'listeners', lambda node, topic: {b'1': ('/', 'rviz')})
    robot = inside(publish_rate=50.0).start()
    assert made == ['/forward_grid_mapper/live_map_updates']
    robot.drive(0, 20)
    robot.until(lambda: robot.node.maps.latest['live_map'].info.width)
    wholes: list[OccupancyGrid] = []
    monkeypatch.setattr(robot.node.maps._out['live_map'], 'publish', wholes.append)
    # the same readings again change probabilities, not the size of the map
    for k in range(20):
        robot.odometry(200.0 + 0.05 * k, 0.001 * k)
        robot.range(200.0 + 0.05 * k)
    robot.until(lambda: sent)
    latest = robot.node.maps.latest['live_map']
    assert not wholes
    assert 0 < sent[0].width <= latest.info.width
    # a subscriber without updates comes when the map no longer changes
    robot.until(lambda: not robot.node.maps.worker.waiting)
    everybody = {b'1': ('/', 'rviz'), b'2': ('/', 'saver')}
    monkeypatch.setattr(
        map_updates, 'listeners', lambda node, topic: everybody if topic.endswith('live_map') else {b'1': ('/', 'rviz')}
    )
    robot.until(lambda: wholes)
    assert wholes.pop().data == robot.node.maps.latest['live_map'].data
    assert robot.call(robot.node.reset)[0]
    robot.until(lambda: wholes)
    assert wholes[0].info.width == 1
