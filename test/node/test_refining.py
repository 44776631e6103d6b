"""The node with `refine_poses` and a quick refiner: what is moved after a trajectory is accepted or rejected."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from drift_samples import QuickRefiner
from inside import Inside
from refined_robot import HeldRun, assert_live, live_of, odometry_of, refined

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory import keeping
from forward_grid_mapper.core.trajectory.holding_out import Gain
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.node import refining

OK, WARN = b'\x00', b'\x01'


def test_live_map_and_later_readings_are_moved(inside: Callable[..., Inside], quick: Any) -> None:
    robot, bent = refined(inside(refine_poses=True).start())
    assert robot.node.trajectory.correction.moved > 0.9
    assert_live(robot, bent)
    robot.drive(200, 50)
    assert_live(robot, bent)
    # the journal and the buffer keep the poses of odometry
    assert robot.node.associator.readings.x[-1] == pytest.approx(0.1 + 0.001 * 249)
    # the next run uses all of it again
    assert robot.call(robot.node.em.run_em)[0]
    assert_live(robot, odometry_of(robot))


def test_values_of_the_wheels_that_nobody_tested_are_no_result(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are estimated with the trajectory, with a prior, and may have the wrong sign."""
    run = QuickRefiner.run
    monkeypatch.setattr(
        QuickRefiner, 'run', lambda *given: replace(run(*given), calibration={'turn_scale': -0.05, 'scale': 0.01})
    )
    robot, _ = refined(inside(refine_poses=True).start())
    trajectory = robot.node.trajectory
    assert 'trajectory refined' in trajectory.outcome() and 'measured' not in trajectory.outcome()
    (status,) = trajectory.statuses('mapper')
    wheels = {each.key: each.value for each in status.values}['wheels']
    assert wheels.startswith(
        'distances are measured 1.0 % too short; turns are measured 5.3 % too large; the drive may'
    )


def test_readings_received_during_refinement_are_not_lost(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    robot.drive(0, 100)
    bent, held = odometry_of(robot), HeldRun(monkeypatch)
    answer = robot.begin(robot.node.em.run_em)
    robot.until(held.begun.is_set)
    robot.drive(100, 80)
    assert_live(robot, None)
    held.go_on.set()
    robot.until(lambda: answer.sent)
    assert answer.sent[0][0]
    assert_live(robot, bent)


@pytest.mark.parametrize('at_run_time', [False, True])
def test_maps_along_another_trajectory_are_not_shown_before_it_is_current(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch, at_run_time: bool
) -> None:
    """Their coordinates are those of a transform that is published only after the run."""
    robot = inside(publish_rate=50.0, refine_poses=not at_run_time).start()
    node, shown = robot.node, list[tuple[bool, bool]]()
    if at_run_time:
        robot.set(refine_poses=True)
    watch, publish = node.em.worker._watch, node.maps.publish

    def always(run: Any) -> None:
        run.begin, node.em._watched = 0.0, 0.0
        watch(run)

    def recorded(name: str, *rest: Any) -> None:
        if name == 'ml_map':
            shown.append((node.em.current.progress is None, node.trajectory.correction is None))
        publish(name, *rest)

    monkeypatch.setattr(node.em.worker, '_watch', always)
    monkeypatch.setattr(node.maps, 'publish', recorded)
    refined(robot)
    # only the final map, after the correction is in force
    assert len(shown) == 1 and not shown[0][1]
    quick.accepts = False
    shown.clear()
    robot.set(refine_poses=False)
    assert robot.call(node.em.run_em)[0]
    assert len(shown) == 1 and shown[0][1]
    # along odometry, maps are shown while they are made
    shown.clear()
    assert robot.call(node.em.run_em)[0]
    assert len(shown) > 1


def test_maps_are_saved_along_the_trajectory_of_the_live_map(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, bent = refined(inside().start())
    node, go_on = robot.node, threading.Event()
    judge = node.em.worker._judge

    def held(*given: Any) -> None:
        assert go_on.wait(60.0)
        judge(*given)

    monkeypatch.setattr(node.em.worker, '_judge', held)
    robot.set(refine_poses=True)
    answer = robot.begin(node.em.run_em)
    robot.until(lambda: node.trajectory.correction is not None)
    assert_live(robot, bent)
    saved = robot.begin(node.saver.save_maps)
    robot.spin(0.2)
    assert not saved.sent
    go_on.set()
    robot.until(lambda: answer.sent and saved.sent)
    folder = Path(saved.sent[0][1].split(', ')[0]).parent
    data = json.loads((folder / 'report.json').read_text())
    assert data['input']['map_frame'] == 'map' and data['input']['trajectory']['refined']
    assert (folder / 'trajectory.tum').exists()


def test_live_map_is_published_with_the_transform(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next turn of `publish_rate` is 100 s later."""
    robot = inside(refine_poses=True, publish_rate=0.01).start()
    node, along = robot.node, list[bool]()
    publish = node.maps.publish

    def recorded(name: str, *rest: Any) -> None:
        if name == 'live_map':
            along.append(node.trajectory.correction is not None)
        publish(name, *rest)

    monkeypatch.setattr(node.maps, 'publish', recorded)
    refined(robot)
    robot.until(lambda: any(along), 30.0)
    assert node.maps.latest['live_map'].header.frame_id == 'map'


def test_rejected_trajectory_keeps_the_poses_of_odometry(inside: Callable[..., Inside], quick: Any) -> None:
    plain = inside().start()
    plain.drive(0, 150)
    assert plain.call(plain.node.em.run_em)[0]
    quick.accepts = False
    robot, _ = refined(inside(refine_poses=True).start(), count=150)
    assert robot.node.trajectory.correction is None
    for name in ('ml', 'uncertainty', 'live'):
        ours, theirs = (getattr(each.node.em.maps, name) for each in (robot, plain))
        assert np.array_equal(ours, theirs, equal_nan=True)
    assert np.array_equal(live_of(robot)[1], live_of(plain)[1], equal_nan=True)
    assert 'odometry is used as the trajectory: the test says so' in robot.node.em.last_run
    assert 'the test says so' in robot.status('trajectory')['message']
    assert 'rajectory' not in plain.node.em.last_run


def test_rejected_trajectory_keeps_the_earlier_one(inside: Callable[..., Inside], quick: Any) -> None:
    robot, bent = refined(inside(refine_poses=True).start())
    quick.accepts = False
    for first in (200, 220):
        robot.drive(first, 20)
        answer = robot.call(robot.node.em.run_em)
        assert answer[0]
        assert 'trajectory of the previous run kept' in answer[1] and 'the test says so' in answer[1]
        assert robot.node.trajectory.correction.end == odometry_of(robot).stamp[-1], 'it goes on to the end'
        assert_live(robot, bent)
    status = robot.status('trajectory')
    assert 'kept' in status['message'] and 'the test says so' in status['message']
    assert status['places recognised'] == '3', 'of the run that found it'
    assert robot.call(robot.node.saver.save_maps)[0]
    # the trajectory of a later run replaces it
    quick.accepts = True
    assert robot.call(robot.node.em.run_em)[0]
    assert 'kept' not in robot.node.em.last_run
    assert_live(robot, odometry_of(robot))


def test_node_returns_to_odometry_if_it_is_better(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    quick.accepts = False
    monkeypatch.setattr(keeping, '_gain_of_odometry', lambda *arguments: Gain(0.1, 0.04))
    robot.drive(200, 20)
    answer = robot.call(robot.node.em.run_em)
    assert robot.node.trajectory.correction is None
    assert_live(robot, None)
    assert (
        'odometry is used as the trajectory: the test says so; '
        'and it predicts the readings better than the trajectory of the previous run' in answer[1]
    )


def test_jump_of_odometry_gives_a_warning_until_the_next_run(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    node = robot.node
    robot.until(lambda: node.trajectory.distance._newest is not None)
    assert robot.status('trajectory')['level'] == OK
    robot.odometry(111.0, 9.0)
    robot.odometry(111.05, 9.0)
    robot.until(lambda: robot.status('trajectory')['level'] == WARN)
    message = robot.status('trajectory')['message']
    assert 'trajectory refined' in message and 'odometry jumped by 8.8 m' in message
    assert 'run_em' in message and 'reset' in message
    assert node.trajectory.distance.driven < 1.0, 'nobody drove that'
    robot.range(111.02)
    robot.until(lambda: not node.intake.busy)
    assert robot.call(node.em.run_em)[0]
    assert robot.status('trajectory')['level'] == OK
    robot.odometry(112.0, 0.0)
    robot.until(lambda: robot.status('trajectory')['level'] == WARN)
    robot.call(node.reset)
    assert robot.status('trajectory')['level'] == OK


def test_jump_with_rare_odometry_is_detected_by_the_last_minute(inside: Callable[..., Inside]) -> None:
    robot = inside(refine_poses=True).start()
    trajectory, x = robot.node.trajectory, 0.0
    # a robot that drives at 0.6 m/s, and sometimes at 1.2 m/s
    for k in range(40):
        x += 0.54 if k % 8 else 1.08
        robot.odometry(100.0 + 0.9 * k, x)
        robot.until(lambda x=x: trajectory.distance._newest is not None and trajectory.distance._newest[1].x == x)
    driven = x - 1.08
    assert trajectory.distance.jump is None and trajectory.distance.driven == pytest.approx(driven)
    for k, step in enumerate((0.54, 2.5), 40):
        x += step
        robot.odometry(100.0 + 0.9 * k, x)
        robot.until(lambda x=x: trajectory.distance._newest[1].x == x)
    assert 'odometry jumped by 2.5 m' in robot.status('trajectory')['message']
    assert trajectory.distance.driven == pytest.approx(driven + 0.54), (
        'nobody drove that, and the way before counts once'
    )
    # as after a run that has examined it
    trajectory.distance.jump = None
    robot.odometry(100.0 + 0.9 * 42, x + 0.54)
    robot.until(lambda: trajectory.distance._newest[1].x == x + 0.54)
    assert trajectory.distance.jump is None and trajectory.distance.driven == pytest.approx(driven + 1.08)


def test_part_that_could_not_be_placed_gives_a_warning(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = quick.run

    def unplaced(*arguments: Any) -> Any:
        return replace(run(*arguments), jumps='odometry jumps, and it is not known', unplaced=True)

    monkeypatch.setattr(quick, 'run', unplaced)
    robot, _ = refined(inside(refine_poses=True).start())
    status = robot.status('trajectory')
    assert status['level'] == WARN and 'odometry jumps, and it is not known' in status['message']
    assert 'odometry jumps, and it is not known' in robot.node.em.last_run
    saved = Path(robot.call(robot.node.saver.save_maps)[1].split(', ')[0]).parent
    assert 'odometry jumps, and it is not known' in (saved / 'report.txt').read_text().replace('\n', ' ')


def test_refine_poses_can_be_changed_between_runs(inside: Callable[..., Inside], quick: Any) -> None:
    robot, bent = refined(inside().start())
    node = robot.node
    assert node.trajectory.frame == 'odom'
    robot.set(refine_poses=True)
    assert node.trajectory.frame == 'odom', 'the maps are not in the map frame yet'
    assert robot.call(node.em.run_em)[0]
    assert_live(robot, bent)
    robot.until(lambda: {m.header.frame_id for m in published(robot).values()} == {'map'})
    robot.set(refine_poses=False)
    robot.drive(200, 20)
    assert_live(robot, bent)
    assert robot.call(node.em.run_em)[0]
    assert_live(robot, None)
    robot.until(lambda: {m.header.frame_id for m in published(robot).values()} == {'odom'})
    assert node.em.last_run.count('rajectory') == 0


def published(robot: Inside) -> dict[str, Any]:
    robot.node.publish_live()
    return robot.node.maps.latest


def test_reset_deletes_the_trajectory(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    robot.call(robot.node.reset)
    assert robot.node.trajectory.correction is None
    assert robot.node.trajectory.found_trajectory is None
    assert robot.status('trajectory')['poses of odometry kept'] == '0', 'of the drive before'
    robot.drive(200, 30)
    assert_live(robot, None)
    assert 'until run_em' in robot.status('trajectory')['message']
    # the drive is the one since the reset
    assert len(odometry_of(robot).stamp) <= 32
    assert robot.node.associator.record.newest is not None


@pytest.mark.parametrize(('cores', 'given', 'expected'), [(1, 0, 1), (2, 0, 1), (8, 0, 7), (8, 8, 8), (8, 2, 2)])
def test_refinement_leaves_a_core_for_messages_unless_threads_are_given(
    monkeypatch: pytest.MonkeyPatch, cores: int, given: int, expected: int
) -> None:
    monkeypatch.setattr(refining, 'cores', lambda: cores)
    assert refining.leaving_a_core(Parameters.from_flat({'threads': given})).search.threads == expected


def test_reset_and_cancel_end_a_refinement(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    begun, cancelled = threading.Event(), threading.Event()

    class Slow(QuickRefiner):
        def cancel(self) -> None:
            cancelled.set()

        def run(self, *arguments: Any) -> Any:
            begun.set()
            assert cancelled.wait(60.0)
            raise Cancelled('cancelled')

    monkeypatch.setattr(refining, 'Refiner', Slow)
    robot = inside(refine_poses=True).start()
    for end in (lambda: robot.call(robot.node.reset), robot.node.em.worker.cancel):
        robot.drive(len(robot.node.associator.buffer), 60)
        begun.clear()
        cancelled.clear()
        answer = robot.begin(robot.node.em.run_em)
        robot.until(begun.is_set)
        end()
        robot.until(lambda answer=answer: answer.sent)
        assert not answer.sent[0][0]
        assert 'cancelled' in answer.sent[0][1]
        assert robot.node.trajectory.correction is None
        assert robot.node.trajectory.found_trajectory is None
    assert_live(robot, None)


def test_progress_of_the_refinement_is_in_the_diagnostics(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    robot.drive(0, 60)
    waits, go_on = threading.Event(), threading.Event()
    run = quick.run

    def slow(self: Any, readings: Any, odometry: Any, watch: Any) -> Any:
        watch('first pass', 0.4)
        waits.set()
        assert go_on.wait(60.0)
        return run(self, readings, odometry, watch)

    monkeypatch.setattr(quick, 'run', slow)
    answer = robot.begin(robot.node.em.run_em)
    robot.until(waits.is_set)
    assert 'trajectory (first pass, 40%)' in robot.status('EM')['message']
    go_on.set()
    robot.until(lambda: answer.sent)


def test_online_map_moves_with_the_trajectory(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True, online=True, publish_rate=50.0).start())
    node = robot.node
    robot.drive(200, 30)
    robot.until(lambda: node.online is not None and not node.online.worker.waiting and not node.maps.worker.waiting)
    grid = node.online._map.grid
    live = live_of(robot)[0]
    assert grid.union(live) == live, 'both are along the new trajectory'
    assert not node.online.worker.trouble


def odometry_of_runs(quick: Any, monkeypatch: pytest.MonkeyPatch) -> list[Odometry]:
    """Return a list to which each later run of the refiner appends the odometry that it is given."""
    seen: list[Odometry] = []
    run = quick.run

    def look(self: Any, readings: Any, odometry: Odometry, watch: Any) -> Any:
        seen.append(odometry)
        return run(self, readings, odometry, watch)

    monkeypatch.setattr(quick, 'run', look)
    return seen


def driven_before(inside: Callable[..., Inside], journal: Path) -> tuple[dict[str, Any], Odometry]:
    """Drive a node with a journal, and close it; return its options and its odometry."""
    options = {'refine_poses': True, 'journal': str(journal)}
    robot = inside(**options).start()
    robot.drive(0, 150)
    before = odometry_of(robot)
    robot.close()
    return options, before


def test_odometry_is_recovered_from_the_journal_after_a_restart(
    inside: Callable[..., Inside], quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, before = driven_before(inside, tmp_path / 'journal')
    seen = odometry_of_runs(quick, monkeypatch)
    robot = inside(**options).start()
    assert len(robot.node.associator.buffer) == 150
    assert robot.call(robot.node.em.run_em)[0]
    robot.drive(150, 50)
    assert robot.call(robot.node.em.run_em)[0]
    for odometry, count in zip(seen, (150, 200), strict=True):
        assert len(odometry.stamp) == count
        assert np.array_equal(odometry.stamp[:150], before.stamp)
        assert odometry.pose[:150] == pytest.approx(before.pose, abs=1e-9)
    assert robot.node.trajectory.correction is not None
    assert_live(robot, seen[-1])


@pytest.mark.parametrize('moved', [True, False])
def test_odometry_is_recovered_with_the_poses_of_sensors_in_the_journal(
    inside: Callable[..., Inside], quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: bool
) -> None:
    """After the restart the sensor is elsewhere on the robot, or has sent nothing yet, so that TF was not asked."""
    options, before = driven_before(inside, tmp_path / 'journal')
    seen = odometry_of_runs(quick, monkeypatch)
    robot = inside(**options, **{'sensors.sonar.pose': [0.5, 0.2, 0.4]}).start()
    if not moved:
        robot.node._extrinsics._given.clear()
    assert robot.call(robot.node.em.run_em)[0]
    assert np.array_equal(seen[0].stamp, before.stamp)
    assert seen[0].pose == pytest.approx(before.pose, abs=1e-9)


@pytest.mark.parametrize(
    ('back', 'looped', 'kept'), [(4.0, False, 0), (10.0, False, 0), (20.0, False, 250), (7.45, True, 250)]
)
def test_odometry_after_the_clock_jumped_back_is_only_that_of_its_readings(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch, back: float, looped: bool, kept: int
) -> None:
    """Readings from before may have stamps that odometry reaches a second time, elsewhere."""
    robot = inside(refine_poses=True).start()
    # 2 m in 7.5 s
    for k in range(150):
        robot.odometry(100.0 + 0.05 * k, k / 75.0)
        robot.range(100.0 + 0.05 * k)
    first = 107.45 - back
    for k in range(250):
        # the robot drives on, or the bag is played again
        robot.odometry(first + 0.05 * k, (0.0 if looped else 2.0) + k / 75.0)
        robot.range(first + 0.05 * k)
    robot.until(lambda: not robot.node.intake.busy)
    assert robot.node.associator.time_jumps == 1 and len(robot.node.associator.buffer) == 400
    seen = odometry_of_runs(quick, monkeypatch)
    robot.call(robot.node.em.run_em)
    first_kept = seen[0].stamp[0] * 1e-9
    if kept:
        assert len(seen[0].stamp) == kept and first_kept == pytest.approx(first)
    else:
        assert first_kept > 107.45, 'the refinement then says that there are readings without odometry'


def test_jump_back_of_the_clock_gives_a_warning_until_reset(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    trajectory = robot.node.trajectory
    assert robot.status('trajectory')['level'] == OK
    for k in range(20):
        robot.odometry(80.0 + 0.05 * k, 3.0)
        robot.range(80.0 + 0.05 * k)
    robot.until(lambda: not robot.node.intake.busy)
    quick.accepts = False
    for _ in range(2):
        status = robot.status('trajectory')
        assert status['level'] == WARN
        assert 'the clock jumped back' in status['message'] and 'call reset' in status['message']
        answer = robot.call(robot.node.em.run_em)
        assert answer[0] and 'the test says so' in answer[1]
        assert 'previous run' not in answer[1], 'it was not compared, as its odometry is gone'
    assert trajectory.correction is None
    robot.call(robot.node.reset)
    assert robot.status('trajectory')['level'] == OK


def test_second_drive_after_a_reset_may_have_earlier_stamps(inside: Callable[..., Inside], quick: Any) -> None:
    """As when another bag is played: nothing of the second drive is lost, and a second reset would lose it."""
    robot, _ = refined(inside(refine_poses=True).start())
    robot.call(robot.node.reset)
    quick.accepts = False
    for k in range(60):
        robot.odometry(20.0 + 0.05 * k, k / 75.0)
        robot.range(20.0 + 0.05 * k)
    robot.until(lambda: not robot.node.intake.busy)
    assert robot.call(robot.node.em.run_em)[0]
    status = robot.status('trajectory')
    assert status['level'] == OK and 'jumped back' not in status['message']
    assert robot.node.trajectory.distance.jump is None


def test_clock_that_is_behind_the_journal_has_jumped_back(
    inside: Callable[..., Inside], quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a simulation that began again: its odometry has not placed the readings of the journal."""
    options = {'refine_poses': True, 'journal': str(tmp_path / 'journal')}
    robot = inside(**options).start()
    robot.drive(0, 150)
    robot.close()
    robot = inside(**options).start()
    for k in range(200):
        robot.odometry(98.0 + 0.05 * k, 2.0 + 0.001 * k)
        robot.range(98.0 + 0.05 * k)
    robot.until(lambda: not robot.node.intake.busy)
    assert len(robot.node.associator.buffer) == 350 and robot.node.associator.time_jumps == 1
    seen = odometry_of_runs(quick, monkeypatch)
    assert robot.call(robot.node.em.run_em)[0]
    assert seen[0].stamp[0] * 1e-9 > 107.4, 'poses that did not place the readings of these times are not used'


def test_odometry_in_frame_map_is_not_refined_with_reason(inside: Callable[..., Inside], quick: Any) -> None:
    robot = inside(refine_poses=True, map_frame='odom').start()
    robot.drive(0, 60)
    assert robot.call(robot.node.em.run_em)[0]
    assert robot.node.trajectory.correction is None
    assert robot.node.trajectory.frame == 'odom'
    assert 'set map_frame to another name' in robot.node.em.last_run
    status = robot.status('trajectory')
    assert status['level'] == WARN
    assert 'REP 105' in status['message']


def test_transform_begins_with_the_first_run_if_refine_poses_is_set_later(
    inside: Callable[..., Inside], quick: Any
) -> None:
    robot = inside().start()
    robot.drive(0, 60)
    robot.set(refine_poses=True)
    nothing = 'none: the maps are in the frame of odometry'
    assert robot.status('trajectory')['transform'] == nothing
    assert robot.call(robot.node.em.run_em)[0]
    assert robot.node.trajectory.frame == 'map'
    assert robot.status('trajectory')['transform'] != nothing


def test_refine_poses_cannot_change_the_source_of_the_transform(inside: Callable[..., Inside]) -> None:
    robot = inside(refine_poses=True, map_frame='building').start()
    robot.drive(0, 10)
    assert robot.node.trajectory.frame == 'building'
    with pytest.raises(AssertionError, match='restart the node'):
        robot.set(refine_poses=False)
    robot.set(refine_poses=True, p_hit=0.6)
