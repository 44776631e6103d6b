"""Automatic refinement while the robot drives (`refine_every`), and the growing path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from drift_samples import bend
from inside import Inside
from refined_robot import begin, odometry_of

from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.node import distance, trajectory

OK, WARN = b'\x00', b'\x01'


def test_node_refines_after_the_distance_of_refine_every(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, 'LEAST_EVERY', 0.1)
    robot = inside(refine_poses=True, refine_every=0.1).start()
    node = robot.node
    begin(robot)
    robot.drive(1, 59)
    robot.until(lambda: node.trajectory.distance.driven > 0.05)
    assert node.em.current is None and node.em.maps is None, 'it has not driven far enough'
    robot.drive(60, 80)
    robot.until(lambda: node.em.maps is not None and node.em.current is None)
    assert node.trajectory.correction is not None
    assert len(node.em.maps.readings) <= 140
    assert 'trajectory refined' in node.em.last_run
    first = node.em.maps
    robot.drive(140, 20)
    robot.until(lambda: node.trajectory.distance._newest[1].x > 0.158)
    assert node.em.maps is first and node.em.current is None
    robot.drive(160, 120)
    robot.until(lambda: node.em.maps is not first and node.em.current is None)
    # a service call restarts the distance
    assert robot.call(node.em.run_em)[0]
    assert node.trajectory.distance.driven - node.trajectory._driven_at_run < 0.05


def test_node_refines_soon_after_a_jump(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, 'AFTER_JUMP', 0.1)
    robot = inside(refine_poses=True, refine_every=50.0).start()
    node = robot.node
    begin(robot)
    robot.drive(1, 149)
    robot.until(lambda: node.trajectory.distance.driven > 0.14)
    assert node.em.current is None and node.em.maps is None
    # from 0.15 m to 5.15 m
    for k in range(150, 300):
        robot.odometry(100.0 + 0.05 * k, 5.0 + 0.001 * k)
        robot.range(100.0 + 0.05 * k)
    robot.until(lambda: node.em.maps is not None and node.em.current is None)
    first = node.em.maps
    robot.until(lambda: node.trajectory.distance._newest[1].x > 5.298)
    assert node.em.maps is first and node.em.current is None, 'once is enough'


def test_noise_of_odometry_at_standstill_is_no_driving(inside: Callable[..., Inside], quick: Any) -> None:
    robot = inside(refine_poses=True, refine_every=1.0).start()
    trajectory, noise = robot.node.trajectory, np.random.default_rng(0).normal(0.0, 0.001, 2000)
    for k, off in enumerate(noise.tolist()):
        robot.odometry(100.0 + 0.05 * k, off)
        trajectory._tick()
    assert trajectory.distance.driven == 0.0 and np.abs(np.diff(noise)).sum() > 2.0
    # a robot that creeps at 2 mm/s drives nevertheless
    for k in range(5000):
        robot.odometry(200.0 + 0.05 * k, 0.0001 * k)
        trajectory._tick()
    assert trajectory.distance.driven == pytest.approx(0.5, abs=0.02)


def test_usual_steps_of_odometry_are_only_looked_up_after_a_long_step(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    sizes: list[int] = []
    find = distance.jumps
    monkeypatch.setattr(distance, 'jumps', lambda odometry: sizes.append(len(odometry.stamp)) or find(odometry))
    for k in range(2000):
        robot.odometry(100.0 + 0.001 * k, 0.0005 * k)
        if k % 50 == 0:
            robot.node.trajectory._tick()
    assert not sizes, 'at 1 kHz, the last minute has 60 000 poses'
    robot.odometry(102.0, 9.0)
    robot.node.trajectory._tick()
    assert sizes == [2001] and robot.node.trajectory.distance.jump is not None


def test_node_does_not_refine_at_each_step(inside: Callable[..., Inside], quick: Any) -> None:
    robot = inside(refine_poses=True, refine_every=1e-9).start()
    begin(robot)
    robot.drive(1, 100)
    robot.until(lambda: robot.node.trajectory.distance.driven > 0.095)
    assert robot.node.em.current is None and robot.node.em.maps is None


@pytest.mark.parametrize('options', [{}, {'refine_every': 0.05}])
def test_node_does_not_refine_without_refine_every(
    inside: Callable[..., Inside], quick: Any, options: dict[str, Any]
) -> None:
    robot = inside(refine_poses=not options, **options).start()
    if not options:
        begin(robot)
    robot.drive(1, 100)
    if not options:
        robot.until(lambda: robot.node.trajectory.distance.driven > 0.095)
    assert robot.node.em.current is None and robot.node.em.maps is None


def test_path_grows_as_the_robot_drives(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, 'PATH_EVERY', 0.02)
    robot = inside(refine_poses=True).start()
    shown: list[Any] = []
    out = robot.node.trajectory._publishers
    assert out is not None
    monkeypatch.setattr(out, 'publish_path', lambda frame, path, stamp: shown.append(path))
    begin(robot)
    robot.drive(1, 99)
    robot.until(lambda: shown and shown[-1].pose[-1, 0] > 0.075)
    assert np.array_equal(shown[-1].pose[:, 1:], 0 * shown[-1].pose[:, 1:]), 'as odometry has it'
    assert robot.call(robot.node.em.run_em)[0]
    bent = odometry_of(robot)
    robot.until(lambda: shown[-1].pose[-1] == pytest.approx(bend(bent).pose[-1]))
    robot.drive(100, 100)
    robot.until(lambda: shown[-1].stamp[-1] > bent.stamp[-1] + 3 * 10**9)
    path = shown[-1]
    assert (np.diff(path.stamp) > 0).all()
    correction = robot.node.trajectory.correction
    later = path.stamp > bent.stamp[-1]
    assert path.pose[~later] == pytest.approx(bend(bent).pose)
    now = odometry_of(robot)
    assert path.pose[later] == pytest.approx(compose(correction.last, now.at(path.stamp[later])), abs=1e-9)
    robot.call(robot.node.reset)
    robot.until(lambda: not len(shown[-1].stamp))
