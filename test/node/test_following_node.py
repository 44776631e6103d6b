"""The node with `refine_poses` and `online`: the transform from map to odom is updated while the robot drives."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from drift_samples import bent_drive, exact_drive, in_turn
from inside import Inside
from refined_robot import HeldRun, odometry_of

from forward_grid_mapper.core.trajectory.following import Follower
from forward_grid_mapper.core.trajectory.outcome import Refinement, replaced
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.node import refining

OK, WARN = b'\x00', b'\x01'


class DriftingDrive:
    """A drive with drift in parts, and a refiner that knows the true poses."""

    def __init__(self) -> None:
        self.recording = bent_drive()
        exact = exact_drive().odometry
        self.true = Odometry.of(np.array([m.stamp for m in exact]), np.array([m.pose for m in exact], np.float64))
        messages = in_turn(self.recording)
        cuts = [0, *(int(part * len(messages)) for part in (0.4, 0.7)), len(messages)]
        self.parts = [messages[begin:end] for begin, end in itertools.pairwise(cuts)]

    def off(self, robot: Inside) -> float:
        """Error in metres of the newest pose of the robot on the map."""
        correction, odometry = robot.node.trajectory.correction, odometry_of(robot)
        path = correction.extended(odometry.stamp, odometry.pose)
        return float(np.hypot(*(path.pose[-1] - self.true.at(path.stamp[-1:])[0])[:2]))


@pytest.fixture(scope='module')
def drifting() -> DriftingDrive:
    return DriftingDrive()


@pytest.fixture
def driving(
    inside: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Inside]:
    """Begin the drive, and run EM after its first part."""

    class Knows:
        def __init__(self, parameters: Any) -> None:
            pass

        def cancel(self) -> None:
            pass

        def run(self, readings: Any, odometry: Odometry, watch: Any) -> Refinement:
            path = Odometry(odometry.stamp, drifting.true.at(odometry.stamp))
            return Refinement(True, 'told', replaced(readings, odometry, path), path, {}, 1.0, 0.2, 3, 0.1)

    monkeypatch.setattr(refining, 'Refiner', Knows)
    mounts = {f'sensors.{frame}.pose': list(map(float, pose)) for frame, pose in drifting.recording.extrinsics}

    def begin(**options: Any) -> Inside:
        robot = inside(**{'refine_poses': True, 'online': True, **mounts, **options}).start()
        robot.hand(drifting.parts[0])
        success, message = robot.call(robot.node.em.run_em)
        assert success, message
        return robot

    return begin


def follow(robot: Inside, least: int = 1) -> Follower:
    """Turn the executor until `least` windows are followed and no work is left."""
    part = robot.node.trajectory.following
    assert part is not None

    def idle() -> bool:
        return not part.worker.waiting and not part._busy

    robot.until(lambda: part.follower is not None and idle())
    # the last offer may have lacked some of the newest messages
    part._seen = None
    robot.until(lambda: (part._seen is not None or part.obstacle) and idle())
    assert part.follower.windows >= least
    follower: Follower = part.follower
    return follower


def test_map_to_odom_is_updated_while_the_robot_drives(
    driving: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    by, follow_on = set(), Follower.follow

    def noted(self: Follower, *arguments: Any) -> bool:
        by.add(threading.get_ident())
        return follow_on(self, *arguments)

    monkeypatch.setattr(Follower, 'follow', noted)
    robot = driving()
    node = robot.node
    base = node.trajectory.correction
    robot.hand(drifting.parts[1])
    follower = follow(robot, 10)
    assert node.trajectory.correction is follower.correction
    assert drifting.off(robot) < 0.35
    kept = np.hypot(*(base.last - node.trajectory.correction.last)[:2])
    assert kept > 0.3, 'the correction has moved on'
    assert node.em.found_trajectory.correction is base, 'what the run found stays'
    values = robot.status('trajectory')
    assert values['followed since the latest run'].startswith(f'{follower.windows} windows')
    assert values['level'] == OK
    robot.hand(drifting.parts[2])
    follow(robot, follower.windows + 5)
    assert drifting.off(robot) < 0.35
    assert by and threading.get_ident() not in by, 'the executor does not do it'
    # later readings are mapped along the followed trajectory
    readings = node.associator.readings
    placed, odometry = node.trajectory.place(readings), odometry_of(robot)
    right = replaced(readings, odometry, Odometry(odometry.stamp, drifting.true.at(odometry.stamp)))
    assert np.hypot(placed.x - right.x, placed.y - right.y).max() < 0.35
    assert not node.live.worker.trouble
    assert not node.trajectory.following.worker.trouble
    # the whole drive is refined again
    assert robot.call(node.em.run_em)[0]
    assert node.trajectory.following.follower is not follower
    assert drifting.off(robot) < 0.1


def test_part_driven_during_a_run_is_followed_at_its_end(
    driving: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = driving()
    before = robot.node.trajectory.following.follower
    held = HeldRun(monkeypatch)
    answer = robot.begin(robot.node.em.run_em)
    robot.until(held.begun.is_set)
    robot.hand(drifting.parts[1])
    follow(robot, 10)
    assert robot.node.trajectory.following.follower is before, 'the one before goes on meanwhile'
    held.go_on.set()
    robot.until(lambda: answer.sent)
    assert answer.sent[0][0], answer.sent
    after = robot.node.trajectory.following.follower
    assert after is not before
    assert after.windows >= 10, 'it is where the robot is as soon as it is in force'
    assert robot.node.trajectory.correction is after.correction
    assert drifting.off(robot) < 0.35


def test_following_needs_online_and_ends_with_a_run_without_refinement(
    driving: Callable[..., Inside], drifting: DriftingDrive
) -> None:
    robot = driving(online=False)
    base = robot.node.trajectory.correction
    assert robot.node.trajectory.following is None
    robot.hand(drifting.parts[1])
    robot.spin(0.3)
    assert robot.node.trajectory.correction is base
    other = driving()
    other.set(refine_poses=False)
    other.hand(drifting.parts[1])
    # the parameter takes effect with the next run
    other.until(lambda: other.node.trajectory.following.follower.windows)
    assert other.call(other.node.em.run_em)[0]
    assert other.node.trajectory.correction is None and other.node.trajectory.following.follower is None


def test_reset_ends_following(
    driving: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = driving()
    begun, go_on = threading.Event(), threading.Event()
    follow_on = Follower.follow

    def waits(self: Follower, *arguments: Any) -> bool:
        begun.set()
        assert go_on.wait(60.0)
        return follow_on(self, *arguments)

    monkeypatch.setattr(Follower, 'follow', waits)
    robot.hand(drifting.parts[1])
    robot.until(begun.is_set)
    assert robot.call(robot.node.reset)[0]
    go_on.set()
    part = robot.node.trajectory.following
    robot.until(lambda: not part.worker.waiting)
    robot.spin(0.1)
    assert part.follower is None
    assert robot.node.trajectory.correction is None
    assert not part.worker.trouble
    assert 'followed since the latest run' not in robot.status('trajectory')


@pytest.mark.parametrize('when', ['driving', 'in a run'])
def test_jump_back_of_the_clock_ends_following_until_a_run_finds_a_trajectory(
    driving: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """Otherwise the follower would take the pose of another time for a jump of odometry, or for the next one."""
    robot = driving()
    node = robot.node
    if when == 'driving':
        robot.hand(drifting.parts[0])
    else:
        held = HeldRun(monkeypatch)
        answer = robot.begin(node.em.run_em)
        robot.until(held.begun.is_set)
        robot.hand(drifting.parts[0])
        held.go_on.set()
        robot.until(lambda: answer.sent)
    assert node.associator.time_jumps == 1
    robot.until(lambda: node.trajectory.following.obstacle)
    status = robot.status('trajectory')
    assert status['level'] == WARN
    assert 'the clock jumped back' in status['message'] and 'call reset' in status['message']
    assert 'ended: the clock jumped back' in status['followed since the latest run']
    # the bag has been played again
    assert robot.call(node.em.run_em)[0]
    assert robot.status('trajectory')['level'] == OK
    assert not node.trajectory.following.obstacle
    robot.hand(drifting.parts[1])
    follow(robot, 10)
    assert drifting.off(robot) < 0.35


def test_following_continues_after_a_pause_and_other_parameters(
    driving: Callable[..., Inside], drifting: DriftingDrive
) -> None:
    robot = driving()
    half = len(drifting.parts[1]) // 2
    request = type('Request', (), {'data': True})()
    robot.call(robot.node.pause, request)
    robot.hand(drifting.parts[1][:half])
    robot.spin(0.2)
    follower = robot.node.trajectory.following.follower
    assert follower.windows == 0, 'windows wait for readings'
    request.data = False
    robot.call(robot.node.pause, request)
    robot.set(p_hit=0.6, publish_rate=5.0)
    robot.hand(drifting.parts[1][half:])
    assert follow(robot, 10) is follower
    assert not follower.obstacle
    assert robot.node.trajectory.correction is follower.correction


def test_node_can_be_closed_while_following(driving: Callable[..., Inside], drifting: DriftingDrive) -> None:
    robot = driving()
    robot.hand(drifting.parts[1])
    part = robot.node.trajectory.following
    robot.until(lambda: part.worker.waiting or part.follower.windows)
    robot.close()
    assert part.worker._thread is None or not part.worker._thread.is_alive()


@pytest.mark.parametrize('when', ['driving', 'in a run'])
def test_error_ends_following_until_the_next_run(
    driving: Callable[..., Inside], drifting: DriftingDrive, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    robot = driving()
    node, warned = robot.node, []
    monkeypatch.setattr(
        node.trajectory.following, '_log', type('Log', (), {'warning': lambda self, text: warned.append(text)})()
    )
    base = node.trajectory.correction
    # the first windows fail, and the run at the end has to examine all that comes after them
    first = len(drifting.parts[1]) // 4

    def fails(self: Follower, *arguments: Any) -> bool:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(Follower, 'follow', fails)
        if when == 'in a run':
            assert robot.call(node.em.run_em)[0], 'the maps are as good without'
            base = node.trajectory.correction
        robot.hand(drifting.parts[1][:first])
        robot.until(lambda: node.trajectory.following.obstacle)
        robot.until(lambda: warned)
        robot.until(lambda: not node.trajectory.following.worker.waiting)
    assert node.trajectory.correction is base
    assert 'there is not enough memory' in warned[0] and 'until the next run_em' in warned[0]
    status = robot.status('trajectory')
    assert status['level'] == WARN
    assert 'ended: there is not enough memory' in status['followed since the latest run']
    # if following fails in a run, the earlier follower may have failed during the run as well
    logged = list(warned)
    assert len(logged) == 1 or (when == 'in a run' and logged == [logged[0]] * 2)
    robot.hand(drifting.parts[1][first : first + 100])
    robot.spin(0.2)
    assert warned == logged
    assert robot.call(node.em.run_em)[0]
    assert not node.trajectory.following.obstacle
    assert robot.status('trajectory')['level'] == OK
