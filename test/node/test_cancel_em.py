"""The service cancel_em ends EM, responds to all callers, and keeps readings and earlier maps."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from inside import Inside

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.search.search import Progress
from forward_grid_mapper.node import em

SO_FAR = Grid(0.1, 0, 0, 3, 3)


class Endless:
    """Make EM run until it is cancelled, with a map of three by three cells meanwhile."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.running = threading.Event()

        def run(mapper: Mapper, readings: Any, watch: Any, start: Any) -> None:
            pause = threading.Event()
            while not mapper._stop[0]:
                watch('search', Progress(1, 2, 3, 4.0))
                self.running.set()
                pause.wait(0.01)
            raise Cancelled('the work was cancelled; nothing was changed')

        monkeypatch.setattr(em.Mapper, 'run', run)
        monkeypatch.setattr(em.Mapper, 'so_far', lambda mapper: (SO_FAR, np.ones(SO_FAR.shape, np.int8)))


def responses_of(handler: Callable[[Any], None]) -> list[tuple[Any, ...]]:
    """Call a service and return the list that receives its response."""
    answers: list[tuple[Any, ...]] = []
    handler(SimpleNamespace(send=lambda *fields: answers.append(fields)))
    return answers


def width(robot: Inside) -> int:
    robot.node.maps.worker.ask(lambda: None)
    return int(robot.node.maps.latest['ml_map'].info.width)


@pytest.mark.parametrize('online', [False, True])
def test_cancel_ends_em_and_restores_the_earlier_map(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch, online: bool
) -> None:
    robot = inside(publish_rate=50.0, online=online).start()
    node = robot.node
    robot.drive(0, 30)
    assert robot.call(node.em.run_em)[0]
    # the map of EM, or the online map that continues from it
    robot.until(lambda: width(robot) > 3)
    wide, maps, before = width(robot), node.em.maps, node.maps.latest['ml_map'].data
    with monkeypatch.context() as patch:
        endless = Endless(patch)
        first = responses_of(node.em.run_em)
        robot.until(lambda: endless.running.is_set() and width(robot) == 3)
        # both callers that wait for the end get a response
        answers = [responses_of(node.em.cancel), responses_of(node.em.cancel)]
        robot.until(lambda: first and all(answers))
    assert first == [(False, 'EM was cancelled by cancel_em')]
    for ((success, message),) in answers:
        assert success
        assert message.startswith('EM was cancelled by cancel_em (after ')
        assert message.endswith('readings and earlier maps are kept')
    robot.until(lambda: width(robot) == wide)
    assert node.maps.latest['ml_map'].data == before
    assert node.em.maps is maps
    assert len(node.associator.buffer) == 30
    assert robot.status('EM')['last run'] == 'EM was cancelled by cancel_em'
    assert robot.call(node.em.run_em)[0]


def test_cancel_without_an_earlier_map_publishes_an_empty_one(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(publish_rate=50.0).start()
    node = robot.node
    robot.drive(0, 5)
    endless = Endless(monkeypatch)
    saved = responses_of(node.saver.save_maps)
    robot.until(lambda: endless.running.is_set() and width(robot) == 3)
    assert robot.call(node.em.cancel)[0]
    robot.until(lambda: saved)
    assert saved == [(False, 'there is no map to save: EM was cancelled by cancel_em')]
    assert width(robot) == 1


def test_reset_is_named_as_the_cause_of_the_cancellation(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside().start()
    node = robot.node
    robot.drive(0, 5)
    endless = Endless(monkeypatch)
    first = responses_of(node.em.run_em)
    robot.until(endless.running.is_set)
    before = responses_of(node.em.cancel)
    reset = responses_of(node.reset)
    after = responses_of(node.em.cancel)
    robot.until(lambda: first and before and reset and after)
    assert first == [(False, 'EM was cancelled by reset')]
    for ((success, message),) in (before, after):
        assert success
        assert message.startswith('EM was cancelled by reset (after ')
        # nothing is kept
        assert message.endswith('readings and earlier maps were deleted')


def test_cancel_without_a_run_fails(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    assert robot.call(robot.node.em.cancel) == (False, 'EM is not running: there is nothing to cancel')


def test_cancel_after_the_search_keeps_its_maps(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    robot = inside().start()
    node = robot.node
    robot.drive(0, 30)
    found, go_on = threading.Event(), threading.Event()
    judge = em.sensor_health

    def slow(maps: Any) -> Any:
        found.set()
        assert go_on.wait(60.0)
        return judge(maps)

    monkeypatch.setattr(em, 'sensor_health', slow)
    first = responses_of(node.em.run_em)
    robot.until(found.is_set)
    cancelled = responses_of(node.em.cancel)
    go_on.set()
    robot.until(lambda: first and cancelled)
    assert first[0][0] and node.em.maps is not None
    assert cancelled == [(False, 'EM ended before it could be cancelled; its maps are published')]


def test_failing_em_restores_the_earlier_map(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    robot = inside(publish_rate=50.0).start()
    node = robot.node
    robot.drive(0, 30)
    assert robot.call(node.em.run_em)[0]
    wide = width(robot)

    def run(mapper: Mapper, readings: Any, watch: Any, start: Any) -> None:
        # the map is shown at publish_rate
        while width(robot) != 3:
            watch('search', Progress(1, 2, 3, 4.0))
        raise MemoryError

    monkeypatch.setattr(em.Mapper, 'run', run)
    monkeypatch.setattr(em.Mapper, 'so_far', lambda mapper: (SO_FAR, np.ones(SO_FAR.shape, np.int8)))
    first = responses_of(node.em.run_em)
    robot.until(lambda: first)
    assert not first[0][0] and 'memory' in first[0][1]
    assert width(robot) == wide
