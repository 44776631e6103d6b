"""The online map in the background: publishing, its rate, and commands for a map that was replaced."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled, InputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.node import online
from forward_grid_mapper.node.online import OnlineSnapshot, OnlineWorker

GRID = Grid(0.1, 0, 0, 3, 2)
QUICK = Parameters.from_flat({'publish_rate': 50.0})


def readings(count: int) -> Readings:
    z = np.ones(count)
    return Readings.from_columns(names=('sonar',), x=0.0, y=0.0, yaw=0.0, z=z, z_max=4.0, half_angle=0.2)


class PlainMap:
    """Stand-in for an online map, with what its worker needs: counts readings, and raises errors set by the test."""

    made: list[PlainMap]
    error: BaseException | None
    late: BaseException | None = None

    def __init__(self, parameters: Parameters) -> None:
        self.parameters, self.count, self.adopted, self.cancelled = parameters, 0, 0, False
        self.dismantled = False
        self.made.append(self)

    def _raise(self) -> None:
        if self.cancelled:
            raise Cancelled('given up')
        if self.error is not None:
            raise self.error

    def __len__(self) -> int:
        return self.count

    def add(self, new: Readings) -> None:
        self._raise()
        self.count += len(new)
        if self.late is not None:
            raise self.late

    @property
    def taken(self) -> int:
        return self.count

    def adopt(self, grid: Grid, searched: np.ndarray) -> None:
        self._raise()
        self.adopted += 1

    def maps(self) -> tuple[Grid, np.ndarray, np.ndarray]:
        self._raise()
        grid = GRID if self.count or self.adopted else Grid(0.1, 0, 0, 0, 0)
        return grid, np.full(grid.shape, self.count, np.int8), np.zeros(grid.shape, np.float32)

    def searched(self) -> tuple[Grid, np.ndarray]:
        return GRID, np.full(GRID.shape, 7, np.int8)

    def cancel(self) -> None:
        self.cancelled = True

    def dismantle(self) -> None:
        self.dismantled = True


class Node:
    """The thread that owns a worker, and the snapshots it received."""

    def __init__(self, parameters: Parameters = QUICK) -> None:
        self.shown: list[OnlineSnapshot] = []
        self.logged: list[str] = []
        self.prepared = threading.Event()
        self.worker = OnlineWorker(parameters, self.shown.append, self.logged.append, self.prepared.set)

    def settle(self) -> None:
        self.worker.worker.ask(lambda: None)

    def tick(self) -> None:
        """Call `tick` when it is time to publish."""
        while (left := self.worker._next - time.monotonic()) > 0:
            assert left < 1.0
            time.sleep(left)
        self.worker.tick()

    def publish(self) -> None:
        """Call `tick` when it is time, and wait until the map is published."""
        self.tick()
        self.settle()

    def hold(self) -> Callable[[], None]:
        """Keep the worker busy until the returned function is called."""
        begun, go_on = threading.Event(), threading.Event()

        def work() -> None:
            begun.set()
            assert go_on.wait(60.0)

        self.worker.worker.put(work)
        assert begun.wait(60.0)
        return go_on.set


@pytest.fixture
def maps(monkeypatch: pytest.MonkeyPatch) -> type[PlainMap]:
    kind = type('Map', (PlainMap,), {'made': [], 'error': None})
    monkeypatch.setattr(online, 'OnlineMap', kind)
    return kind


@pytest.fixture
def node(maps: type[PlainMap]) -> Iterator[Node]:
    made = Node()
    yield made
    made.worker.close(10.0)


def test_readings_are_added_and_published(node: Node, maps: type[PlainMap]) -> None:
    assert node.prepared.wait(60.0)
    assert (node.worker.epoch, node.worker.kept, node.worker.so_far()) == (0, 0, None)
    node.worker.tick()
    node.settle()
    assert node.shown == [], 'nothing has changed'
    node.worker.offer(readings(3))
    node.worker.offer(readings(3), lambda placed: placed.select(slice(0, 2)))
    node.settle()
    assert maps.made[0].count == node.worker.kept == 5
    node.publish()
    (snapshot,) = node.shown
    assert (snapshot.epoch, snapshot.grid) == (0, GRID)
    assert snapshot.ml[0, 0] == 5 and snapshot.uncertainty.dtype == np.float32
    grid, searched = node.worker.so_far()
    assert grid == GRID and searched[0, 0] == 7
    node.publish()
    assert len(node.shown) == 1, 'nothing has changed since'
    node.worker.show()
    node.publish()
    assert len(node.shown) == 2


def test_map_is_published_at_the_rate_and_not_twice_at_once(maps: type[PlainMap]) -> None:
    node = Node(Parameters.from_flat({'publish_rate': 0.1}))
    for _ in range(3):
        node.worker.offer(readings(1))
        node.settle()
        node.worker.tick()
        node.settle()
    assert len(node.shown) == 1
    assert 5.0 < node.worker._next - time.monotonic() <= 10.0
    # a new rate is used at once
    node.worker.change(QUICK)
    node.worker.tick()
    node.settle()
    assert len(node.shown) == 2
    go_on = node.hold()
    for _ in range(3):
        node.worker.show()
        node.tick()
    go_on()
    node.settle()
    assert len(node.shown) == 3
    node.publish()
    assert len(node.shown) == 4, 'the change that came meanwhile'
    node.worker.close(10.0)


def test_restart_drops_readings_for_the_earlier_map(node: Node, maps: type[PlainMap]) -> None:
    node.worker.offer(readings(3))
    node.publish()
    go_on = node.hold()
    node.worker.offer(readings(4))
    node.worker.show()
    node.tick()
    node.worker.adopt(SimpleNamespace(grid=GRID, searched=np.zeros(GRID.shape, np.int8)))
    shown = len(node.shown)
    other = Parameters.from_flat({'p_hit': 0.6, 'publish_rate': 50.0})
    node.worker.restart(other, lambda: readings(2))
    assert (node.worker.epoch, node.worker.kept, node.worker.so_far()) == (2, 0, None)
    go_on()
    node.settle()
    first, second = maps.made
    assert (first.count, first.adopted, first.cancelled, first.dismantled) == (3, 0, True, True)
    assert (second.count, second.parameters, second.cancelled) == (2, other, False)
    assert len(node.shown) == shown
    node.publish()
    assert node.shown[-1].epoch == 2 and node.shown[-1].ml[0, 0] == 2
    node.worker.restart(QUICK)
    node.worker.show()
    node.publish()
    assert len(node.shown) == shown + 1, "an empty map is nobody's"


def test_run_does_not_start_from_a_map_replaced_at_that_moment(node: Node, maps: type[PlainMap]) -> None:
    worker = node.worker

    class Epoch(int):
        """Lets the map be replaced while the worker compares its epoch with that of a snapshot."""

        def __eq__(self, other: Any) -> bool:
            threading.Thread(target=restart).start()
            given_up.wait(0.3)
            return int(self) == int(other)

        def __ne__(self, other: Any) -> bool:
            return not self == other

        __hash__ = int.__hash__

    given_up = threading.Event()

    def restart() -> None:
        worker.restart(QUICK)
        given_up.set()

    worker.offer(readings(3))
    worker.show()
    worker.epoch = Epoch(0)
    node.publish()
    assert given_up.wait(10.0)
    assert worker.epoch == 1 and worker.so_far() is None


def test_online_map_continues_from_the_map_of_em(node: Node, maps: type[PlainMap]) -> None:
    searched = np.ones(GRID.shape, np.int8)
    node.worker.offer(readings(3))
    go_on = node.hold()
    node.worker.show()
    node.tick()
    node.worker.adopt(SimpleNamespace(grid=GRID, searched=searched))
    found = node.worker.so_far()
    assert node.worker.epoch == 1 and found is not None and found[1] is searched
    go_on()
    node.settle()
    assert node.shown == [], 'a snapshot of the map before EM is out of date'
    node.publish()
    assert maps.made[0].adopted == 1 and node.shown[0].epoch == 1


def test_cancelling_gives_no_error(node: Node, maps: type[PlainMap]) -> None:
    node.worker.offer(readings(1))
    node.settle()
    maps.made[0].cancelled = True
    node.worker.offer(readings(1))
    node.worker.adopt(SimpleNamespace(grid=GRID, searched=np.zeros(GRID.shape, np.int8)))
    node.publish()
    assert node.shown == [] and node.logged == [] and node.worker.worker.trouble == ''
    maps.made[0].cancelled = False
    node.worker.show()
    node.publish()
    assert len(node.shown) == 1


@pytest.mark.parametrize(
    ('error', 'why'), [(MemoryError(), 'there is not enough memory'), (InputError('max_cells'), 'max_cells')]
)
def test_readings_that_could_not_be_added_are_reported_until_restart(
    node: Node, maps: type[PlainMap], error: BaseException, why: str
) -> None:
    maps.error = error
    node.worker.offer(readings(4))
    node.settle()
    expected = f'4 readings cannot be added to the online map: {why}'
    assert node.logged == [f'online map: {expected}']
    maps.error = None
    node.worker.offer(readings(2))
    node.publish()
    assert node.worker.worker.trouble == expected and node.worker.kept == 2
    assert len(node.shown) == 1
    node.worker.restart(QUICK)
    assert node.worker.worker.trouble == ''


def test_added_readings_are_not_reported_as_missing(node: Node, maps: type[PlainMap]) -> None:
    maps.late = MemoryError()
    node.worker.offer(readings(3))
    node.settle()
    expected = 'online map: the search will continue with the next readings: there is not enough memory'
    assert node.logged == [expected]
    assert node.worker.worker.trouble == '' and node.worker.kept == 3


def test_failed_map_is_published_later_without_new_readings(node: Node, maps: type[PlainMap]) -> None:
    node.worker.offer(readings(1))
    node.settle()
    maps.error = MemoryError()
    node.publish()
    assert node.shown == [] and node.worker.worker.trouble == 'there is not enough memory'
    maps.error = None
    node.publish()
    assert len(node.shown) == 1


def test_closing_cancels_the_map(node: Node, maps: type[PlainMap]) -> None:
    node.settle()
    node.worker.close(10.0)
    assert maps.made[0].cancelled
    node.worker.offer(readings(1))
    assert maps.made[0].count == 0 and node.worker.worker.waiting == 0
