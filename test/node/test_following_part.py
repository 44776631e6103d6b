"""Following in the node: one piece of work at a time, and no results of a follower that was replaced."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest
from stand_ins import PlainNode

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.node.background import Inbox
from forward_grid_mapper.node.following import Following

READING = Readings.from_columns(names=('sonar',), x=0.0, y=0.0, yaw=0.0, z=[1.0], z_max=4.0, half_angle=0.2)
POSES = np.arange(2), np.zeros((2, 3))
HERE, THERE = Pose2(0.0, 0.0, 0.0), Pose2(1.0, 0.0, 0.0)


class PlainFollower:
    """Stand-in for a follower that waits for the test."""

    def __init__(self, obstacle: str = '') -> None:
        self.obstacle, self.windows, self.places, self.kept = obstacle, 0, 2, False
        self.correction: Any = object()
        self.go_on, self.begun, self.cancelled = threading.Event(), threading.Event(), False
        self.seen: list[tuple[Readings, Odometry]] = []
        self.error: BaseException | None = None

    def follow(self, readings: Readings, odometry: Odometry) -> None:
        self.seen.append((readings, odometry))
        self.begun.set()
        assert self.go_on.wait(60.0)
        if self.cancelled:
            raise Cancelled('given up')
        if self.error is not None:
            raise self.error
        self.windows += 1

    def cancel(self) -> None:
        self.cancelled = True


class Driving:
    """The executor, and the corrections it received."""

    def __init__(self) -> None:
        self.node, self.corrections = PlainNode(), list[Any]()
        self.part = Following(self.node, Inbox(self.node), self.corrections.append)

    def begin(self, follower: PlainFollower | None, at_once: bool = True) -> Any:
        if at_once and follower is not None:
            follower.go_on.set()
        self.part.begin(follower)  # type: ignore[arg-type]
        return follower

    def offer(self, at: Pose2) -> None:
        self.part.offer(at, lambda: (READING, POSES))

    def settle(self) -> None:
        self.part.worker.ask(lambda: None)
        self.node.turn()


@pytest.fixture
def driving() -> Driving:
    return Driving()


def test_readings_are_followed_when_the_robot_has_moved(driving: Driving) -> None:
    driving.offer(HERE)
    assert driving.part.obstacle == '' and driving.part.values() == {}
    follower = driving.begin(PlainFollower())
    for at in (HERE, HERE, THERE, THERE, HERE):
        driving.offer(at)
        driving.settle()
    assert follower.windows == 3
    readings, odometry = follower.seen[0]
    assert readings is READING and odometry.stamp is POSES[0] and odometry.pose is POSES[1]
    assert driving.corrections == 3 * [follower.correction]
    assert driving.part.values() == {'followed since the latest run': '3 windows, 2 places recognised'}
    follower.kept = True
    assert 'the last correction is kept' in driving.part.values()['followed since the latest run']
    assert driving.node.warned == []


def test_noise_of_a_robot_that_stands_is_not_followed(driving: Driving) -> None:
    """Otherwise each pose of a robot at its dock would make the thread look at the drive again."""
    follower, rng = driving.begin(PlainFollower()), np.random.default_rng(0)
    for noise in rng.normal(0.0, 1e-4, (20, 3)):
        driving.offer(Pose2(*noise.tolist()))
        driving.settle()
    assert follower.windows == 1
    # a turn counts as well, by the shorter way
    for yaw, count in ((0.02, 2), (math.tau + 0.02, 2), (math.tau - 0.02, 3)):
        driving.offer(Pose2(0.0, 0.0, yaw))
        driving.settle()
        assert follower.windows == count


def test_one_piece_of_work_at_a_time(driving: Driving) -> None:
    follower = driving.begin(PlainFollower(), at_once=False)
    driving.offer(HERE)
    assert follower.begun.wait(60.0)
    driving.offer(THERE)
    assert driving.part.worker.waiting == 1
    follower.go_on.set()
    driving.part.worker.ask(lambda: None)
    driving.offer(THERE)
    assert len(follower.seen) == 1, 'the executor has not taken the first one yet'
    driving.node.turn()
    driving.offer(THERE)
    driving.settle()
    assert len(follower.seen) == 2


@pytest.mark.parametrize(('error', 'why'), [(MemoryError(), 'there is not enough memory'), (KeyError('odd'), 'odd')])
def test_error_ends_following_and_is_reported(driving: Driving, error: BaseException, why: str) -> None:
    follower = driving.begin(PlainFollower())
    follower.error = error
    driving.offer(HERE)
    driving.settle()
    assert why in driving.part.obstacle
    assert 'is no longer followed' in driving.node.warned[-1] and why in driving.node.warned[-1]
    assert 'until the next run_em' in driving.node.warned[-1]
    assert f'; ended: {driving.part.obstacle}' in driving.part.values()['followed since the latest run']
    follower.error = None
    driving.offer(THERE)
    driving.settle()
    assert len(follower.seen) == 1
    # the next run brings another follower, which begins at the current pose
    other = driving.begin(PlainFollower())
    assert driving.part.obstacle == '' and follower.cancelled
    driving.offer(HERE)
    driving.settle()
    assert other.windows == 1


def test_failed_copy_of_the_drive_is_retried(driving: Driving) -> None:
    follower = driving.begin(PlainFollower())

    def fails() -> Any:
        raise MemoryError

    with pytest.raises(MemoryError):
        driving.part.offer(HERE, fails)
    driving.offer(HERE)
    driving.settle()
    assert follower.windows == 1


def test_obstacle_at_the_begin_is_reported_at_once(driving: Driving) -> None:
    driving.begin(PlainFollower('the clock jumped'))
    assert 'the clock jumped' in driving.node.warned[0]
    driving.offer(HERE)
    assert driving.part.worker.waiting == 0


@pytest.mark.parametrize('when', ['idle', 'working', 'done'])
def test_following_is_ended_from_outside(driving: Driving, when: str) -> None:
    follower = driving.begin(PlainFollower(), at_once=when != 'working')
    driving.offer(HERE)
    assert follower.begun.wait(60.0)
    if when == 'idle':
        driving.settle()
    elif when == 'done':
        driving.part.worker.ask(lambda: None)
    for _ in range(2):
        driving.part.end('the clock jumped back')
    follower.go_on.set()
    driving.settle()
    driving.offer(THERE)
    driving.settle()
    assert len(follower.seen) == 1 and len(driving.corrections) == (when == 'idle')
    assert [text.rpartition(': ')[2] for text in driving.node.warned] == ['the clock jumped back']
    assert '; ended: the clock jumped back' in driving.part.values()['followed since the latest run']
    other = driving.begin(PlainFollower())
    driving.offer(HERE)
    driving.settle()
    assert other.windows == 1 and driving.corrections[-1] is other.correction
    driving.begin(None)
    driving.part.end('there is none')
    assert len(driving.node.warned) == 1


@pytest.mark.parametrize('end', ['another', 'none', 'cancel'])
def test_results_of_a_replaced_follower_are_dropped(driving: Driving, end: str) -> None:
    before, other = driving.begin(PlainFollower(), at_once=False), PlainFollower()
    driving.offer(HERE)
    assert before.begun.wait(60.0)
    if end == 'cancel':
        driving.part.cancel()
    else:
        driving.begin(other if end == 'another' else None)
    before.go_on.set()
    driving.settle()
    assert before.cancelled and driving.corrections == [] and driving.node.warned == []
    if end == 'another':
        driving.offer(HERE)
        driving.settle()
        assert driving.corrections == [other.correction]
    else:
        assert driving.part.follower is None


def test_result_just_before_the_replacement_is_dropped(driving: Driving) -> None:
    before = driving.begin(PlainFollower())
    driving.offer(HERE)
    driving.part.worker.ask(lambda: None)
    other = driving.begin(PlainFollower(), at_once=False)
    driving.offer(THERE)
    assert other.begun.wait(60.0)
    driving.node.turn()
    assert before.windows == 1 and driving.corrections == []
    # the new one is still working
    driving.offer(HERE)
    assert driving.part.worker.waiting == 1
    other.go_on.set()
    driving.settle()
    assert driving.corrections == [other.correction]


def test_closing_cancels_and_waits(driving: Driving) -> None:
    follower = driving.begin(PlainFollower(), at_once=False)
    driving.offer(HERE)
    assert follower.begun.wait(60.0)
    closing = threading.Thread(target=driving.part.close, args=(60.0,))
    closing.start()
    closing.join(0.05)
    assert closing.is_alive()
    follower.go_on.set()
    closing.join(60.0)
    assert not closing.is_alive() and follower.cancelled and driving.part.follower is None
