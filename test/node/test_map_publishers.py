"""Topics and services of the maps: the newest map of each, and none from before a reset."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='maps are messages of ROS')

from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid
from stand_ins import PlainNode

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.node import map_publishers
from forward_grid_mapper.node.grid_message import grid_message
from forward_grid_mapper.node.map_publishers import MAPS, MapPublishers

GRID = Grid(0.1, -20, 10, 3, 2)
"""The first cell is at x = -20, y = 10, in cells."""

CELLS = np.array([[-1, 0, 1], [1, 0, -1]], np.int8)


class Publishing(PlainNode):
    """A node with its messages and services in lists."""

    def __init__(self, **topics: str) -> None:
        super().__init__()
        self.topics = topics
        self.sent: list[tuple[str, OccupancyGrid]] = []
        self.services: dict[str, Any] = {}
        self.stamp = Time(sec=7)

    def create_publisher(self, kind: Any, name: str, quality: Any) -> Any:
        topic = self.topics.get(name.removeprefix('~/'), name)
        return SimpleNamespace(topic_name=topic, publish=lambda message: self.sent.append((topic, message)))

    def create_service(self, kind: Any, name: str, accept: Any, **options: Any) -> Any:
        self.services[name] = accept
        return SimpleNamespace(send_response=lambda response, header: None)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: self.stamp))

    def widths(self, name: str) -> list[int]:
        return [message.info.width for topic, message in self.sent if topic == f'~/{name}']


def at_once(name: str, answer: Callable[[], None], failed: Callable[[str], object]) -> None:
    answer()


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Publishing:
    monkeypatch.setattr(map_publishers.MapUpdates, 'of', lambda *rest: None)
    return Publishing()


@pytest.fixture
def maps(node: Publishing) -> Iterator[MapPublishers]:
    made = MapPublishers(node, 0.1, lambda: '/odom', at_once)
    yield made
    made.worker.close(10.0)


class Busy:
    """Keeps the worker busy until it is released."""

    def __init__(self, maps: MapPublishers) -> None:
        self._begun, self._go_on = threading.Event(), threading.Event()
        maps.worker.put(self._work)
        assert self._begun.wait(60.0)

    def _work(self) -> None:
        self._begun.set()
        assert self._go_on.wait(60.0)

    def release(self, maps: MapPublishers) -> None:
        self._go_on.set()
        maps.worker.ask(lambda: None)


def answers(maps: MapPublishers, name: str) -> list[Any]:
    got: list[Any] = []
    maps._get(name, SimpleNamespace(send=got.append))
    maps.worker.ask(lambda: None)
    return got


def test_message_of_a_map() -> None:
    made = grid_message(GRID, CELLS, 'map', Time(sec=3, nanosec=5))
    assert (made.header.frame_id, made.header.stamp.sec, made.header.stamp.nanosec) == ('map', 3, 5)
    assert made.info.map_load_time == made.header.stamp
    assert (made.info.width, made.info.height) == (3, 2) and made.info.resolution == pytest.approx(0.1)
    position, rotation = made.info.origin.position, made.info.origin.orientation
    assert (position.x, position.y) == pytest.approx((-2.0, 1.0))
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.0, 0.0, 0.0, 1.0)
    assert list(made.data) == [-1, 0, 100, 100, 0, -1]
    assert list(grid_message(GRID, CELLS.T.copy().T, 'map', Time()).data) == list(made.data)
    chances = np.array([[np.nan, 0.0, 0.254], [0.256, 0.999, 1.0]], np.float32)
    assert list(grid_message(GRID, chances, 'map', Time()).data) == [-1, 0, 25, 26, 100, 100]


def test_empty_map_is_returned_before_the_first_one(maps: MapPublishers) -> None:
    for name in MAPS:
        (message,) = answers(maps, name)
        assert (message.info.width, message.info.height, len(message.data)) == (0, 0, 0)
        assert (message.info.origin.position.x, message.info.origin.position.y) == (0.0, 0.0)
    grid, cells = maps.ml_map
    assert grid == Grid(0.1, 0, 0, 1, 1) and cells.shape == (1, 1) and cells[0, 0] == -1


def test_map_is_published_and_kept(node: Publishing, maps: MapPublishers) -> None:
    maps.publish('ml_map', 0, GRID, CELLS)
    (message,) = answers(maps, 'ml_map')
    assert node.sent == [('~/ml_map', message)] and maps.latest['ml_map'] is message
    # tf2 rejects a leading slash
    assert message.header.frame_id == 'odom' and message.header.stamp.sec == 7
    assert maps.ml_map == (GRID, CELLS)
    for name in ('uncertainty_map', 'live_map'):
        maps.publish(name, 0, Grid(0.1, 0, 0, 3, 1), np.zeros((1, 3), np.float32))
    assert answers(maps, 'uncertainty_map')[0].info.width == 3
    assert maps.ml_map == (GRID, CELLS), 'only the ML map is'


def test_map_of_nothing_replaces_the_old_one_even_if_the_frame_is_forgotten(node: Publishing) -> None:
    """Nav2 rejects a map with an empty frame_id as malformed, and would keep the map that was deleted."""
    frames = ['odom']
    maps = MapPublishers(node, 0.1, lambda: frames[0], at_once)
    maps.publish('ml_map', 0, GRID, CELLS)
    assert answers(maps, 'ml_map')[0].header.frame_id == 'odom'
    # as after `reset`, once odometry has come in another frame
    frames[0] = ''
    maps.clear()
    (nothing,) = answers(maps, 'ml_map')
    assert (nothing.info.width, nothing.info.height, nothing.header.frame_id) == (1, 1, 'odom')
    assert ('~/ml_map', nothing) in node.sent
    maps.publish('ml_map', 1, GRID, CELLS)
    assert answers(maps, 'ml_map')[0].header.frame_id == '', 'the frame of a map is never guessed'
    maps.worker.close(10.0)


def test_only_the_newest_of_waiting_maps_is_published(node: Publishing, maps: MapPublishers) -> None:
    busy = Busy(maps)
    for width in (1, 2, 5):
        maps.publish('live_map', 0, Grid(0.1, 0, 0, width, 1), np.zeros((1, width), np.int8))
        maps.publish('ml_map', 0, Grid(0.1, 0, 0, width + 1, 1), np.zeros((1, width + 1), np.int8))
    assert maps.ml_map[0].width == 6, 'also before it goes out'
    assert maps.worker.waiting == 3
    busy.release(maps)
    assert (node.widths('live_map'), node.widths('ml_map')) == ([5], [6])
    maps.publish('live_map', 0, Grid(0.1, 0, 0, 9, 1), np.zeros((1, 9), np.int8))
    maps.worker.ask(lambda: None)
    assert node.widths('live_map') == [5, 9]


def test_maps_from_before_a_reset_are_not_published(node: Publishing, maps: MapPublishers) -> None:
    busy = Busy(maps)
    maps.publish('ml_map', 0, GRID, CELLS)
    maps.clear()
    assert maps.generation == 1
    maps.publish('ml_map', 0, GRID, CELLS)
    maps.publish('live_map', 2, GRID, CELLS)
    busy.release(maps)
    assert [node.widths(name) for name in MAPS] == [[1], [1], [1]]
    assert maps.ml_map[0].shape == (1, 1)
    maps.publish('ml_map', 1, GRID, CELLS)
    maps.worker.ask(lambda: None)
    assert node.widths('ml_map') == [1, 3]


def test_requested_map_is_updated_before_the_response(node: Publishing) -> None:
    requests: list[tuple[str, Callable[[], None], Callable[[str], object]]] = []
    maps = MapPublishers(node, 0.1, lambda: 'map', lambda *rest: requests.append(rest))
    got: list[Any] = []
    for _ in range(2):
        maps._get('live_map', SimpleNamespace(send=got.append))
    assert got == [] and [name for name, _, _ in requests] == ['live_map', 'live_map']
    maps.publish('live_map', 0, GRID, CELLS)
    requests[0][1]()
    maps.worker.ask(lambda: None)
    assert [message.info.width for message in got] == [3]
    # if the update fails, the last map is returned
    requests[1][2]('no memory')
    assert [message.info.width for message in got] == [3, 3]
    maps.worker.close(10.0)


def test_map_that_cannot_be_published_blocks_no_others(
    node: Publishing, maps: MapPublishers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*rest: Any) -> Any:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(map_publishers, 'grid_message', fail)
        maps.publish('ml_map', 0, GRID, CELLS)
        (message,) = answers(maps, 'ml_map')
    assert message.info.width == 0 and node.sent == []
    assert node.warned == ['maps: there is not enough memory']
    maps.publish('ml_map', 0, GRID, CELLS)
    assert answers(maps, 'ml_map')[0].info.width == 3


def test_publishing_thread_has_normal_priority(maps: MapPublishers) -> None:
    """A lower priority would slow down the executor, since the thread holds the GIL."""
    found = maps.worker.ask(lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
    assert found == os.getpriority(os.PRIO_PROCESS, 0)


def test_only_the_live_map_has_updates(node: Publishing, monkeypatch: pytest.MonkeyPatch) -> None:
    updates = SimpleNamespace(published=[], stale=False, refreshed=0)
    updates.publish = updates.published.append
    updates.refresh = lambda: setattr(updates, 'refreshed', updates.refreshed + 1)
    of: list[str] = []
    monkeypatch.setattr(map_publishers.MapUpdates, 'of', lambda node, out: (of.append(out.topic_name), updates)[1])
    maps = MapPublishers(node, 0.1, lambda: 'map', at_once)
    assert of == ['~/live_map']
    for name in MAPS:
        maps.publish(name, 0, GRID, CELLS)
    for stale in (False, True):
        updates.stale = stale
        maps.refresh()
    maps.worker.ask(lambda: None)
    assert updates.published == [maps.latest['live_map']] and updates.refreshed == 1
    assert [topic for topic, _ in node.sent] == ['~/ml_map', '~/uncertainty_map']
    maps.worker.close(10.0)


def test_two_maps_on_one_topic_are_rejected(node: Publishing) -> None:
    node.topics = {'ml_map': '/map', 'live_map': '/map'}
    with pytest.raises(MapperError, match=r'^/map can have only one map'):
        MapPublishers(node, 0.1, lambda: 'map', at_once)
    node.topics = {'ml_map': '/map'}
    MapPublishers(node, 0.1, lambda: 'map', at_once)


def test_next_map_retries_a_failed_start_of_the_thread(
    node: Publishing, maps: MapPublishers, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', fail)
        maps.publish('live_map', 0, GRID, CELLS)
    assert node.sent == []
    maps.publish('live_map', 0, Grid(0.1, 0, 0, 3, 1), np.zeros((1, 3), np.float32))
    maps.worker.ask(lambda: None)
    assert [message.info.height for _, message in node.sent] == [1]


def test_map_that_comes_during_a_failure_is_published(node: Publishing, maps: MapPublishers) -> None:
    newer = Grid(0.1, 0, 0, 3, 1), np.zeros((1, 3), np.float32)

    def fail(*arguments: Any) -> None:
        # only once: the newer map comes while this one is made
        patch.undo()
        maps.publish('live_map', 0, *newer)
        raise MemoryError

    patch = pytest.MonkeyPatch()
    patch.setattr(maps, '_message', fail)
    maps.publish('live_map', 0, GRID, CELLS)
    maps.worker.ask(lambda: None)
    maps.worker.ask(lambda: None)
    assert [message.info.height for _, message in node.sent] == [1]
    maps.publish('live_map', 0, GRID, CELLS)
    maps.worker.ask(lambda: None)
    assert [message.info.height for _, message in node.sent] == [1, GRID.height]
