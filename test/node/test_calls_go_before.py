"""A call of run_em replaces a run that the node began by itself, unless that run has all readings and parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from inside import Answer, Inside
from refined_robot import HeldRun

from forward_grid_mapper.core.mapping import Mapper


class Begun:
    """A node that has begun EM by itself with `count` readings; `runs` has the number of readings of each run."""

    def __init__(self, inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch, count: int = 100) -> None:
        self.runs: list[int] = []
        run = Mapper.run

        def counts(mapper: Mapper, readings: Any, *rest: Any) -> Any:
            self.runs.append(len(readings))
            return run(mapper, readings, *rest)

        # kernels are compiled before
        self.robot = inside(refine_poses=True).start()
        monkeypatch.setattr(Mapper, 'run', counts)
        self.held = HeldRun(monkeypatch)
        self.robot.drive(0, count)
        assert self.em.run_by_itself()
        self.robot.until(self.held.begun.is_set)

    @property
    def em(self) -> Any:
        return self.robot.node.em

    def end(self, *answers: Answer) -> None:
        """Let runs continue, and turn the executor until all calls have responses."""
        self.held.go_on.set()
        self.robot.until(lambda: all(answer.sent for answer in answers) and self.em.current is None)
        assert all(len(answer.sent) == 1 for answer in answers)


@pytest.fixture
def begun(inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch) -> Begun:
    return Begun(inside, monkeypatch)


def test_call_joins_a_run_without_newer_readings(begun: Begun) -> None:
    answer = begun.robot.begin(begun.em.run_em)
    refused = begun.robot.begin(begun.em.run_em)
    assert 'EM is already running' in refused.sent[0][1], 'the one who called has asked for this run'
    begun.end(answer)
    success, message = answer.sent[0]
    assert success and message.startswith('100 readings')
    assert begun.runs == [100]


def test_call_replaces_a_run_without_the_newest_readings(begun: Begun) -> None:
    begun.robot.drive(100, 50)
    answer = begun.robot.begin(begun.em.run_em)
    assert not answer.sent
    refused = begun.robot.begin(begun.em.run_em)
    assert not refused.sent[0][0]
    begun.end(answer)
    success, message = answer.sent[0]
    assert success and message.startswith('150 readings'), message
    assert begun.runs == [100, 150]
    assert 'trajectory refined' in begun.em.last_run


def test_call_replaces_a_run_with_old_parameters(begun: Begun) -> None:
    begun.robot.set(p_hit=0.6)
    answer = begun.robot.begin(begun.em.run_em)
    begun.end(answer)
    assert answer.sent[0][0] and begun.runs == [100, 100]
    assert begun.em.maps.parameters.model.p_hit == 0.6


def test_save_maps_waits_for_the_maps_of_the_new_run(begun: Begun) -> None:
    outcomes: list[Any] = []
    begun.em.when_there_are_maps(outcomes.append)
    begun.robot.drive(100, 50)
    answer = begun.robot.begin(begun.em.run_em)
    begun.em.when_there_are_maps(outcomes.append)
    begun.end(answer)
    assert answer.sent[0][0]
    assert [len(outcome.maps.readings) for outcome in outcomes] == [150, 150]


@pytest.mark.parametrize('ends', ['cancel_em', 'reset'])
def test_call_that_replaces_a_run_fails_if_it_is_cancelled(begun: Begun, ends: str) -> None:
    begun.robot.drive(100, 50)
    answer = begun.robot.begin(begun.em.run_em)
    end = begun.robot.begin(begun.em.cancel if ends == 'cancel_em' else begun.robot.node.reset)
    begun.robot.until(lambda: answer.sent)
    assert answer.sent == [(False, f'EM was cancelled by {ends}')]
    begun.end(answer, end)
    assert end.sent[0][0]
    assert begun.runs == [100]
    assert begun.em.maps is None


def test_call_after_cancelling_waits_and_runs(begun: Begun) -> None:
    cancelled = begun.robot.begin(begun.em.cancel)
    answer = begun.robot.begin(begun.em.run_em)
    begun.end(answer, cancelled)
    assert cancelled.sent[0][0] and 'cancelled by cancel_em' in cancelled.sent[0][1]
    assert answer.sent[0][0] and begun.runs == [100, 100]


def test_requested_run_is_not_replaced(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    held = HeldRun(monkeypatch)
    robot.drive(0, 60)
    first = robot.begin(robot.node.em.run_em)
    robot.until(held.begun.is_set)
    robot.drive(60, 20)
    second = robot.begin(robot.node.em.run_em)
    assert 'EM is already running' in second.sent[0][1]
    assert not robot.node.em.run_by_itself()
    held.go_on.set()
    robot.until(lambda: first.sent)
    assert first.sent[0][0] and first.sent[0][1].startswith('60 readings')
