"""EM with its services, without a middleware; the test controls how long each search takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stand_ins import SONAR, PlainNode

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.search.search import Progress
from forward_grid_mapper.node import consistency_check, em, em_service
from forward_grid_mapper.node.background import Inbox
from forward_grid_mapper.node.em import Outcome
from forward_grid_mapper.node.em_service import EmService

GRID = Grid(0.1, 0, 0, 3, 2)
SO_FAR = Grid(0.1, 0, 0, 1, 2), np.zeros((2, 1), np.int8)
BEFORE = Grid(0.1, 0, 0, 9, 9), np.zeros((9, 9), np.int8)
PROGRESS = Progress(1, 2, 3, 4.0)


def some_readings(count: int, first: int = 0) -> Readings:
    numbers = np.arange(first, first + count)
    z = np.ones(count)
    return Readings.from_columns(
        names=('sonar',), x=0.01 * numbers, y=0.0, yaw=0.0, z=z, z_max=4.0, half_angle=0.2, stamp=numbers
    )


class Answer:
    """The responses to a caller."""

    def __init__(self) -> None:
        self.sent: list[tuple[bool, str]] = []

    def send(self, success: bool, message: str) -> None:
        self.sent.append((success, message))


class Search:
    """Stand-in for a mapper: a search that waits for the test, and then returns maps of its readings."""

    def __init__(self, robot: EmRobot) -> None:
        self.begun, self.go_on, self.cancelled = threading.Event(), threading.Event(), False
        self.robot, self.start, self.error = robot, None, robot.error
        self.count, self.watch = -1, None
        robot.searches.append(self)
        if not robot.held:
            self.go_on.set()

    def run(self, readings: Readings, watch: Any, start: Any) -> Any:
        self.count, self.start, self.watch = len(readings), start, watch
        self.begun.set()
        assert self.go_on.wait(60.0)
        if self.cancelled:
            raise Cancelled('cancelled')
        if self.error is not None:
            raise self.error
        return SimpleNamespace(
            readings=readings,
            grid=GRID,
            ml=np.full(GRID.shape, len(readings) % 100, np.int8),
            uncertainty=np.zeros(GRID.shape, np.float32),
            parameters=self.robot.parameters,
            statistics={'seconds': {'search': 1.25, 'evidence': 0.5}},
        )

    def cancel(self) -> None:
        self.cancelled = True
        self.go_on.set()

    def so_far(self) -> Any:
        return self.robot.so_far


class PlainTrajectory:
    """Stand-in for a trajectory, with what EM needs of it."""

    def __init__(self, robot: EmRobot) -> None:
        self.robot, self.in_map_frame, self.correction, self.words = robot, False, None, ''
        self.found_trajectory = None
        self.adopted: list[tuple[Any, int]] = []
        self.asked: list[tuple[Callable[[], Any], Callable[[], Any]]] = []

    def mapper(self, parameters: Parameters, drive: Any, now: Any) -> Search:
        self.asked.append((drive, now))
        return Search(self.robot)

    def adopt(self, found: Any, count: int) -> None:
        self.adopted.append((found, count))

    def outcome(self) -> str:
        return self.words


class EmRobot:
    """The executor, the parts that EM uses, and their inputs.

    Attributes
    ----------
    searches : list of Search
    All searches in order; each waits for the test while `held`.
    published : list of (name, generation, grid, values)
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, count: int = 5, **values: Any) -> None:
        self.node, self.parameters = PlainNode(), Parameters.from_flat(values)
        self.inbox = Inbox(self.node)
        self.associator = PoseAssociator(lambda base, frame, stamp: SONAR, self.parameters)
        self.accept(count)
        self.searches: list[Search] = []
        self.held, self.error, self.so_far = False, None, SO_FAR
        self.published: list[tuple[str, int, Any, Any]] = []
        self.publishers: Any = SimpleNamespace(
            generation=3, ml_map=BEFORE, publish=lambda *given: self.published.append(given)
        )
        self.compiled: set[str] = {'EM', 'trajectory'}
        self.waited: list[str] = []
        self.kernels: Any = SimpleNamespace(has=self.compiled.__contains__, wait=self._wait)
        self.trajectory: Any = PlainTrajectory(self)
        self.warnings, self.contradictions = list[str](), list[str]()
        self.halves: float | None = None
        monkeypatch.setattr(em, 'map_grid', lambda readings, parameters: GRID)
        monkeypatch.setattr(em, 'sensor_health', lambda maps: {'sonar': 'health'})
        monkeypatch.setattr(em, 'input_warnings', lambda readings: list(self.warnings))
        monkeypatch.setattr(em_service, 'quality_warning', lambda maps, warned: '')
        monkeypatch.setattr(
            em_service, 'summary', lambda maps, seconds, warned: f'{len(maps.readings)} readings in {seconds:.2f} s'
        )
        self.checked: list[tuple[int, Any]] = []
        monkeypatch.setattr(consistency_check, 'consistency_warnings', self._check)
        monkeypatch.setattr(consistency_check, 'contradiction_of_halves', lambda maps: self.halves)
        self.em = EmService(
            lambda: self.parameters,
            self.associator,
            self.trajectory,
            self.publishers,
            self.inbox,
            self.kernels,
            self.node,
        )
        self.em.extrinsics = lambda: {'sonar': Pose2(0.1, 0.0, 0.0)}

    def _wait(self, name: str, stop: Callable[[], bool]) -> None:
        self.waited.append(name)
        while name not in self.compiled:
            if stop():
                raise Cancelled('cancelled')
            time.sleep(0.001)

    def _check(self, readings: Readings, extrinsics: Any, parameters: Parameters) -> list[str]:
        self.checked.append((len(readings), dict(extrinsics)))
        return list(self.contradictions)

    def accept(self, count: int) -> None:
        self.associator.restore(some_readings(count, len(self.associator.buffer)))

    def until(self, condition: Callable[[], Any]) -> None:
        """Turn the executor until the condition holds."""
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end
            self.node.turn()
            time.sleep(0.001)

    def settle(self) -> None:
        """Turn the executor until EM and its workers are idle."""
        em = self.em
        self.until(lambda: em.current is None and not em.worker.worker.waiting and not em.check_worker.waiting)
        self.node.turn()

    def run_em(self) -> Answer:
        answer = Answer()
        self.em.run_em(answer)  # type: ignore[arg-type]
        return answer

    def cancel_em(self) -> Answer:
        answer = Answer()
        self.em.cancel(answer)  # type: ignore[arg-type]
        return answer

    def wait_for_maps(self) -> list[Outcome]:
        outcomes: list[Outcome] = []
        self.em.when_there_are_maps(outcomes.append)
        return outcomes

    def begun(self) -> Search:
        """Wait until the newest search has begun."""
        search = self.searches[-1]
        self.until(search.begun.is_set)
        return search
