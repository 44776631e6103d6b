"""The node with `refine_poses`: what it finds is what the offline tool finds, and everybody is told of it."""

from __future__ import annotations

import json
import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

import drift_samples
from drift_samples import QuickRefiner, bend, bent_drive, in_turn, write_parameters
from geometry_msgs.msg import PoseWithCovarianceStamped
from inside import Inside
from nav_msgs.msg import Path as PathMessage
from robot import LATCHED
from sensor_msgs.msg import MultiDOFJointState

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.simulate import write_recording
from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.node import refining, trajectory

OK, WARN = b'\x00', b'\x01'


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> type[QuickRefiner]:
    """A refiner that is done at once; `quick.accepts = False` makes it refuse."""
    refiner = type('Quick', (QuickRefiner,), {})
    monkeypatch.setattr(refining, 'Refiner', refiner)
    return refiner


def same_maps(one: Path, other: Path) -> None:
    a, b = (read_npz(folder / 'maps.npz') for folder in (one, other))
    assert a.grid == b.grid
    for name in ('live', 'ml', 'uncertainty'):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name


def folder_of(answer: Any) -> Path:
    return Path(answer.message.split(', ')[0]).parent


# over DDS, with the refiner itself


def test_the_maps_of_a_bent_drive_are_those_of_the_offline_tool(
    start: Callable[..., Any], robot: Any, tmp_path: Path
) -> None:
    recording = bent_drive()
    bag = write_recording(tmp_path, recording)
    file = write_parameters(
        tmp_path / 'parameters.yaml', recording, refine_poses=True, save_directory=str(tmp_path / 'saved')
    )
    start('--params-file', str(file))
    robot.listen()
    robot.meet()
    robot.play(in_turn(recording), 1000.0)
    for key, sent in (('readings accepted', recording.ranges), ('odometry received', recording.odometry)):
        robot.until(lambda key=key, sent=sent: int(robot.diagnostics['readings'][key]) == len(sent), what=key)
    status = robot.until(lambda: robot.diagnostics.get('trajectory'))
    assert 'until run_em is called' in status['message']
    answer = robot.call('run_em', seconds=300.0)
    assert answer.success, answer.message
    assert re.search(r'trajectory refined: odometry was off by 0\.\d\d m', answer.message), answer.message
    assert (
        process_bag.main([str(bag), '-o', str(tmp_path / 'maps'), '--params', str(file), '--refine-poses', '-q']) == 0
    )
    saved = folder_of(robot.call('save_maps', seconds=120.0))
    same_maps(saved, tmp_path / 'maps')
    for name in ('trajectory.tum', 'odometry.tum'):
        assert (saved / name).read_bytes() == (tmp_path / 'maps' / name).read_bytes()
    reports = [json.loads((folder / 'report.json').read_text()) for folder in (saved, tmp_path / 'maps')]
    node, offline = (report['input']['trajectory'] for report in reports)
    # what the drive tells of its wheels for certain is asked offline alone
    asked = {'told', 'odometry', 'calibrated'}
    assert offline.keys() - node.keys() == {'told', 'calibrated'}
    assert {k: v for k, v in node.items() if k not in asked} == {k: v for k, v in offline.items() if k not in asked}
    assert reports[0]['input']['trajectory']['refined']
    assert (reports[0]['input']['odom_frame'], reports[0]['input']['map_frame']) == ('odom', 'map')
    assert {name: robot.maps[name][-1].header.frame_id for name in robot.maps} == dict.fromkeys(robot.maps, 'map')
    # whoever comes late gets the path, and without TF the pose
    paths: list[PathMessage] = []
    poses: list[PoseWithCovarianceStamped] = []
    robot.node.create_subscription(PathMessage, f'{robot.name}/path', paths.append, LATCHED)
    robot.node.create_subscription(PoseWithCovarianceStamped, f'{robot.name}/pose', poses.append, 10)
    robot.until(lambda: paths and paths[-1].poses)
    way = np.loadtxt(saved / 'trajectory.tum')
    assert paths[-1].header.frame_id == 'map'
    last = paths[-1].poses[-1].pose.position
    assert (last.x, last.y) == pytest.approx(tuple(way[-1, 1:3]), abs=1e-5)
    robot.send(recording.odometry[-1]._replace(stamp=recording.odometry[-1].stamp + 10**8))
    robot.until(lambda: poses)
    there = poses[-1].pose.pose.position
    assert (there.x, there.y) == pytest.approx(tuple(way[-1, 1:3]), abs=1e-5)
    status = robot.until(
        lambda: 'places recognised' in robot.diagnostics['trajectory'] and robot.diagnostics['trajectory']
    )
    assert status['level'] == OK
    assert 'trajectory refined' in status['message']


# inside, with a quick one


def odometry_of(robot: Inside) -> Odometry:
    return Odometry.of(*robot.node.associator.odometry)


def refined(robot: Inside, *, count: int = 200) -> tuple[Inside, Odometry]:
    robot.drive(0, count)
    assert robot.call(robot.node.em.run_em)[0]
    return robot, odometry_of(robot)


def live_of(robot: Inside) -> tuple[Any, np.ndarray]:
    snapshot = robot.node.live.snapshot()
    return snapshot.grid, snapshot.probability


def expected_live(robot: Inside, bent: Odometry | None) -> tuple[Any, np.ndarray]:
    """The live map of all readings, each where it was before `bent`, or as odometry has it."""
    readings = robot.node.associator.readings
    if bent is not None:
        then = bend(bent)
        at = np.clip(readings.stamp, bent.stamp[0], bent.stamp[-1])
        sensors = np.stack([readings.x, readings.y, readings.yaw], 1)
        placed = compose(then.at(at), relative(bent.at(at), sensors))
        readings = drift_samples.replaced_by(readings, placed)
    live = LogOddsMap(Parameters())
    live.add(readings)
    return live.grid, live.probability()


def assert_live(robot: Inside, bent: Odometry | None) -> None:
    robot.node._feed()
    (grid, ours), (expected_grid, theirs) = live_of(robot), expected_live(robot, bent)
    assert grid == expected_grid
    assert np.array_equal(np.isnan(ours), np.isnan(theirs))
    assert np.nanmax(np.abs(ours - theirs)) < 1e-3


def test_the_live_map_and_what_comes_later_are_moved(inside: Callable[..., Inside], quick: Any) -> None:
    robot, bent = refined(inside(refine_poses=True).start())
    assert robot.node.trajectory.correction.moved > 0.9
    assert_live(robot, bent)
    robot.drive(200, 50)
    assert_live(robot, bent)
    # the journal and the buffer keep what odometry said
    assert robot.node.associator.readings.x[-1] == pytest.approx(0.1 + 0.001 * 249)
    # the next run looks at all of it anew
    assert robot.call(robot.node.em.run_em)[0]
    assert_live(robot, odometry_of(robot))


def test_readings_that_come_while_it_runs_are_not_lost(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    robot.drive(0, 100)
    bent, begun, go_on = odometry_of(robot), threading.Event(), threading.Event()
    run = Mapper.run

    def waits(*arguments: Any) -> Any:
        begun.set()
        assert go_on.wait(60.0)
        return run(*arguments)

    monkeypatch.setattr(Mapper, 'run', waits)
    answer = robot.begin(robot.node.em.run_em)
    robot.until(begun.is_set)
    robot.drive(100, 80)
    assert_live(robot, None)
    go_on.set()
    robot.until(lambda: answer.sent)
    assert answer.sent[0][0]
    assert_live(robot, bent)


def test_a_refusal_leaves_everything_as_odometry_has_it(inside: Callable[..., Inside], quick: Any) -> None:
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
    assert 'as odometry gives it: the test says so' in robot.node.em.last_run
    assert 'the test says so' in robot.status('trajectory')['message']
    assert 'rajectory' not in plain.node.em.last_run


def test_a_refusal_after_a_trajectory_goes_back_to_odometry(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    quick.accepts = False
    robot.drive(200, 20)
    assert robot.call(robot.node.em.run_em)[0]
    assert robot.node.trajectory.correction is None
    assert_live(robot, None)


def test_it_can_be_switched_on_and_off_between_runs(inside: Callable[..., Inside], quick: Any) -> None:
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


def test_reset_forgets_the_trajectory(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True).start())
    robot.call(robot.node.reset)
    assert robot.node.trajectory.correction is None
    assert robot.node.trajectory.found is None
    assert robot.status('trajectory')['poses of odometry kept'] == '0', 'of the drive before'
    robot.drive(200, 30)
    assert_live(robot, None)
    assert 'until run_em' in robot.status('trajectory')['message']
    # the drive is the one that began with the reset
    assert len(odometry_of(robot).stamp) <= 32
    assert robot.node.associator.record.newest is not None


def test_reset_and_cancelling_end_a_refinement(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert robot.node.trajectory.found is None
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


def test_the_online_map_goes_along(inside: Callable[..., Inside], quick: Any) -> None:
    robot, _ = refined(inside(refine_poses=True, online=True, publish_rate=50.0).start())
    node = robot.node
    robot.drive(200, 30)
    robot.until(lambda: node.online is not None and not node.online.worker.waiting and not node.maps.worker.waiting)
    grid = node.online._map.grid
    live = live_of(robot)[0]
    assert grid.union(live) == live, 'both are along the new trajectory'
    assert not node.online.worker.trouble


def test_after_a_restart_the_journal_tells_the_odometry(
    inside: Callable[..., Inside], quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {'refine_poses': True, 'journal': str(tmp_path / 'journal')}
    robot = inside(**options).start()
    robot.drive(0, 150)
    before = odometry_of(robot)
    robot.close()
    seen: list[Odometry] = []
    run = quick.run

    def look(self: Any, readings: Any, odometry: Odometry, watch: Any) -> Any:
        seen.append(odometry)
        return run(self, readings, odometry, watch)

    monkeypatch.setattr(quick, 'run', look)
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


def test_odometry_in_frame_map_is_left_alone_in_words(inside: Callable[..., Inside], quick: Any) -> None:
    robot = inside(refine_poses=True, map_frame='odom').start()
    robot.drive(0, 60)
    assert robot.call(robot.node.em.run_em)[0]
    assert robot.node.trajectory.correction is None
    assert robot.node.trajectory.frame == 'odom'
    assert 'set map_frame to another name' in robot.node.em.last_run
    status = robot.status('trajectory')
    assert status['level'] == WARN
    assert 'REP 105' in status['message']


def test_who_gives_the_transform_does_not_change_while_the_node_runs(inside: Callable[..., Inside]) -> None:
    robot = inside(refine_poses=True, map_frame='building').start()
    robot.drive(0, 10)
    assert robot.node.trajectory.frame == 'building'
    with pytest.raises(AssertionError, match='restart the node'):
        robot.set(refine_poses=False)
    robot.set(refine_poses=True, p_hit=0.6)


def begin(robot: Inside) -> None:
    """Have the node see where the robot begins to drive."""
    robot.drive(0, 1)
    robot.until(lambda: robot.node.trajectory._at is not None)


def test_it_refines_by_itself_after_some_way(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, 'LEAST_EVERY', 0.1)
    robot = inside(refine_poses=True, refine_every=0.1).start()
    node = robot.node
    begin(robot)
    robot.drive(1, 59)
    robot.until(lambda: node.trajectory.driven > 0.05)
    assert node.em.current is None and node.em.maps is None, 'it has not driven far enough'
    robot.drive(60, 80)
    robot.until(lambda: node.em.maps is not None and node.em.current is None)
    assert node.trajectory.correction is not None
    assert len(node.em.maps.readings) <= 140
    assert 'trajectory refined' in node.em.last_run
    first = node.em.maps
    robot.drive(140, 20)
    robot.until(lambda: node.trajectory._at.x > 0.158)
    assert node.em.maps is first and node.em.current is None
    robot.drive(160, 120)
    robot.until(lambda: node.em.maps is not first and node.em.current is None)
    # a service call begins the way anew
    assert robot.call(node.em.run_em)[0]
    assert node.trajectory.driven - node.trajectory._refined_at < 0.05


def test_it_does_not_refine_at_every_step(inside: Callable[..., Inside], quick: Any) -> None:
    robot = inside(refine_poses=True, refine_every=1e-9).start()
    begin(robot)
    robot.drive(1, 100)
    robot.until(lambda: robot.node.trajectory.driven > 0.095)
    assert robot.node.em.current is None and robot.node.em.maps is None


@pytest.mark.parametrize('options', [{}, {'refine_every': 0.05}])
def test_without_being_told_it_does_not(inside: Callable[..., Inside], quick: Any, options: dict[str, Any]) -> None:
    robot = inside(refine_poses=not options, **options).start()
    if not options:
        begin(robot)
    robot.drive(1, 100)
    if not options:
        robot.until(lambda: robot.node.trajectory.driven > 0.095)
    assert robot.node.em.current is None and robot.node.em.maps is None


def test_the_path_grows_as_the_robot_drives(
    inside: Callable[..., Inside], quick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, 'GROWS', 0.02)
    robot = inside(refine_poses=True).start()
    shown: list[Any] = []
    out = robot.node.trajectory._out
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


# the transform


class Broadcaster:
    """Stands in for `tf2_ros.TransformBroadcaster`."""

    sent: list[Any]

    def __init__(self, node: Any, qos: Any = None) -> None:
        type(self).sent = []

    def sendTransform(self, transform: Any) -> None:  # noqa: N802
        self.sent.append(transform)


def stand_in(monkeypatch: pytest.MonkeyPatch, module: str, **names: Any) -> None:
    made = ModuleType(module)
    for name, value in names.items():
        setattr(made, name, value)
    monkeypatch.setitem(sys.modules, module, made)


@pytest.fixture
def tf2_ros(monkeypatch: pytest.MonkeyPatch) -> type[Broadcaster]:
    """What of tf2_ros the node uses; its buffer knows nothing."""

    class Buffer:
        def clear(self) -> None:
            pass

        def lookup_transform(self, target: str, source: str, time: Any, timeout: Any = None) -> Any:
            raise Unknown(source)

    class Unknown(Exception):
        pass

    class TransformListener:
        def __init__(self, buffer: Any, node: Any, *, spin_thread: bool = False) -> None:
            pass

    # a type of message that rclpy knows, with a field `transforms`, as TFMessage has it
    stand_in(monkeypatch, 'tf2_msgs')
    stand_in(monkeypatch, 'tf2_msgs.msg', TFMessage=MultiDOFJointState)
    stand_in(
        monkeypatch,
        'tf2_ros',
        Buffer=Buffer,
        TransformListener=TransformListener,
        TransformException=Unknown,
        TransformBroadcaster=Broadcaster,
    )
    return Broadcaster


def numbers(transform: Any) -> tuple[float, float, float]:
    t = transform.transform
    return t.translation.x, t.translation.y, 2 * np.arctan2(t.rotation.z, t.rotation.w)


def seconds_of(transform: Any) -> float:
    stamp = transform.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def test_the_transform_from_map_to_odom_is_sent(
    inside: Callable[..., Inside], quick: Any, tf2_ros: type[Broadcaster]
) -> None:
    robot = inside(refine_poses=True).start()
    robot.drive(0, 200)
    newest = 100.0 + 0.05 * 199
    robot.until(lambda: tf2_ros.sent and seconds_of(tf2_ros.sent[-1]) > newest)
    first = tf2_ros.sent[-1]
    assert (first.header.frame_id, first.child_frame_id) == ('map', 'odom')
    assert numbers(first) == (0.0, 0.0, 0.0)
    assert seconds_of(first) == pytest.approx(newest + 0.2)
    count = len(tf2_ros.sent)
    for _ in range(20):
        robot.node.trajectory._tick()
    assert len(tf2_ros.sent) == count, 'TF warns of transforms that come twice'
    assert robot.call(robot.node.em.run_em)[0]
    bent = odometry_of(robot)
    robot.until(lambda: len(tf2_ros.sent) > count)
    x, y, yaw = numbers(tf2_ros.sent[-1])
    # odometry had ended: the stamp is a later one all the same
    assert tf2_ros.sent[-1].header.stamp.nanosec == first.header.stamp.nanosec + 1
    was, now = bent.pose[-1], bend(bent).pose[-1]
    assert compose(np.array([x, y, yaw]), was) == pytest.approx(now)
    robot.drive(200, 10)
    robot.until(lambda: tf2_ros.sent[-1].header.stamp.nanosec > first.header.stamp.nanosec + 1)
    assert numbers(tf2_ros.sent[-1]) == pytest.approx((x, y, yaw))
    robot.call(robot.node.reset)
    robot.drive(210, 1)
    robot.until(lambda: numbers(tf2_ros.sent[-1]) == (0.0, 0.0, 0.0))


def test_without_refine_poses_nothing_is_sent(inside: Callable[..., Inside], tf2_ros: type[Broadcaster]) -> None:
    tf2_ros.sent = []
    robot = inside().start()
    robot.drive(0, 20)
    robot.executor.spin_once(timeout_sec=0.1)
    assert tf2_ros.sent == []
    names = {name for name, _ in robot.node.get_publisher_names_and_types_by_node('forward_grid_mapper', '/')}
    assert not names & {'/tf', '/forward_grid_mapper/path', '/forward_grid_mapper/pose'}


def test_with_tf2_msgs_alone_it_goes_there_as_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    class TFMessage:
        def __init__(self, transforms: list[Any]) -> None:
            self.transforms = transforms

    made, sent = [], []
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    stand_in(monkeypatch, 'tf2_msgs')
    stand_in(monkeypatch, 'tf2_msgs.msg', TFMessage=TFMessage)

    class Node:
        def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
            made.append((kind, topic, qos.depth))
            return type('Out', (), {'publish': lambda self, message: sent.append(message)})()

    from forward_grid_mapper.node.pose_publishers import transform_sender

    send = transform_sender(Node())
    assert send is not None
    send('a transform')  # type: ignore[arg-type]
    assert made == [(TFMessage, '/tf', 100)]
    assert sent[0].transforms == ['a transform']


def test_the_path_is_bounded_and_begins_and_ends_with_the_drive() -> None:
    from builtin_interfaces.msg import Time

    from forward_grid_mapper.node.pose_publishers import MOST_POINTS, path_message

    for length, count in ((0.05, 50), (30.0, 4000), (5000.0, 30_000)):
        x = np.linspace(0.0, length, count)
        way = Odometry(np.arange(count) * 10**7, np.stack([x, 0 * x, 0 * x + 0.3], 1))
        path = path_message('/map', way, Time(sec=7))
        assert path.header.frame_id == 'map'
        assert len(path.poses) <= MOST_POINTS
        at = [pose.pose.position.x for pose in path.poses]
        assert (at[0], at[-1]) == (0.0, length)
        assert (np.diff(at) > 0).all()
        assert max(np.diff(at)) < max(0.15, 2 * length / MOST_POINTS)
    assert path_message('map', None, Time()).poses == []
