"""The published transform from map to odom, and the published path."""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from drift_samples import bend
from geometry_msgs.msg import TransformStamped
from inside import Inside
from refined_robot import odometry_of
from sensor_msgs.msg import MultiDOFJointState

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2
from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.node import graph_check, pose_publishers, trajectory
from forward_grid_mapper.node.pose_publishers import REPEAT

OK, WARN = b'\x00', b'\x01'


class Broadcaster:
    """Stand-in for `tf2_ros.TransformBroadcaster`."""

    sent: list[Any]
    newest: Any
    """The newest transform from map to odom in all buffers; None without one."""

    def __init__(self, node: Any, qos: Any = None) -> None:
        type(self).sent, type(self).newest = [], None

    def sendTransform(self, transform: Any) -> None:  # noqa: N802
        self.sent.append(transform)


def stand_in(monkeypatch: pytest.MonkeyPatch, module: str, **names: Any) -> None:
    made = ModuleType(module)
    for name, value in names.items():
        setattr(made, name, value)
    monkeypatch.setitem(sys.modules, module, made)


@pytest.fixture
def tf2_ros(monkeypatch: pytest.MonkeyPatch) -> type[Broadcaster]:
    """Stand-in for the parts of tf2_ros that the node uses; its buffer has no transforms but `Broadcaster.newest`."""

    class Buffer:
        def __init__(self, cache_time: Any = None, node: Any = None) -> None:
            pass

        def clear(self) -> None:
            pass

        def lookup_transform(self, target: str, source: str, time: Any, timeout: Any = None) -> Any:
            if Broadcaster.newest is None or (target, source) != ('map', 'odom') or time.nanoseconds:
                raise Unknown(source)
            return Broadcaster.newest

    class Unknown(Exception):
        pass

    class TransformListener:
        def __init__(self, buffer: Any, node: Any, *, spin_thread: bool = False, qos: Any = None) -> None:
            pass

    # a message type that rclpy knows, with a field `transforms` as in TFMessage
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


def test_transform_from_map_to_odom_is_published(
    inside: Callable[..., Inside], quick: Any, tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_publishers, 'REPEAT', math.inf)
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
    # odometry had ended: the stamp is still a later one
    assert tf2_ros.sent[-1].header.stamp.nanosec == first.header.stamp.nanosec + 1
    was, now = bent.pose[-1], bend(bent).pose[-1]
    assert compose(np.array([x, y, yaw]), was) == pytest.approx(now)
    robot.drive(200, 10)
    robot.until(lambda: tf2_ros.sent[-1].header.stamp.nanosec > first.header.stamp.nanosec + 1)
    assert numbers(tf2_ros.sent[-1]) == pytest.approx((x, y, yaw))
    robot.call(robot.node.reset)
    robot.drive(210, 1)
    robot.until(lambda: numbers(tf2_ros.sent[-1]) == (0.0, 0.0, 0.0))


@pytest.mark.parametrize('frame', ['', '/'])
def test_no_transform_without_a_name_of_the_odometry_frame(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster], frame: str
) -> None:
    robot = inside(refine_poses=True)
    robot.node.start()
    robot.until(lambda: robot.node.mapping)
    trajectory = robot.node.trajectory
    assert robot.status('trajectory')['transform'] == 'on TF'
    robot.node.associator.add_odometry(OdometryMessage(NANOSECONDS, frame, 'base_link', Pose2(0.0, 0.0, 0.0)))
    trajectory._tick()
    assert tf2_ros.sent == []
    assert robot.status('trajectory')['transform'] == 'none: odometry has no frame_id'


def mapping(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> tuple[Inside, list[float]]:
    """A node that maps, and the clock of the machine, set by the test."""
    clock = [1000.0]
    monkeypatch.setattr(pose_publishers.time, 'monotonic', lambda: clock[0])
    robot = inside(refine_poses=True)
    robot.node.start()
    robot.until(lambda: robot.node.mapping)
    return robot, clock


def test_transform_is_repeated_without_new_odometry(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For late subscribers; each has another stamp, since TF warns of equal ones, but not a later time."""
    robot, clock = mapping(inside, monkeypatch)
    robot.odometry(100.0)
    tick, sent = robot.node.trajectory._tick, tf2_ros.sent
    for k in range(4):
        for _ in range(5):
            tick()
        assert len(sent) == 1 + k
        clock[0] += REPEAT
    stamps = [transform.header.stamp.sec * 10**9 + transform.header.stamp.nanosec for transform in sent]
    assert stamps == [100_200_000_000 + k for k in range(4)]
    assert all(numbers(transform) == (0.0, 0.0, 0.0) for transform in sent)
    # an inactive node repeats nothing, and publishes only new transforms
    robot.node.deactivate()
    tick()
    assert len(sent) == 4
    robot.odometry(100.1)
    tick()
    assert seconds_of(sent[-1]) == pytest.approx(100.3) and len(sent) == 5


def test_transform_after_a_reset_is_later_than_all_before(
    inside: Callable[..., Inside], quick: Any, tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    """TF ignores stamps that it has, and would keep the correction of the drive before."""
    monkeypatch.setattr(pose_publishers, 'REPEAT', 0.0)
    robot = inside(refine_poses=True).start()
    robot.drive(0, 200)
    assert robot.call(robot.node.em.run_em)[0]
    robot.until(lambda: numbers(tf2_ros.sent[-1]) != (0.0, 0.0, 0.0))
    for _ in range(3):
        robot.node.trajectory._tick()
    before = len(tf2_ros.sent)
    assert robot.call(robot.node.reset)[0]
    robot.node.trajectory._tick()
    stamps = [transform.header.stamp.sec * NANOSECONDS + transform.header.stamp.nanosec for transform in tf2_ros.sent]
    assert numbers(tf2_ros.sent[-1]) == (0.0, 0.0, 0.0) and min(stamps[before:]) > max(stamps[:before])


def test_other_publisher_of_the_transform_is_a_fault(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph_check, 'GRAPH_PERIOD', 0.0)
    robot, _ = mapping(inside, monkeypatch)
    fault = 'another node publishes the transform from map to odom as well'
    robot.drive(0, 40)
    for seconds in (100.0, 101.0, 101.0):
        robot.odometry(seconds)
        robot.node.trajectory._tick()
        for newest in (None, tf2_ros.sent[-1]):
            tf2_ros.newest = newest
            assert fault not in robot.status('readings')['message']
    for other in (0, 101_700_000_000):
        tf2_ros.newest = copy.deepcopy(tf2_ros.sent[-1])
        tf2_ros.newest.header.stamp.sec, tf2_ros.newest.header.stamp.nanosec = divmod(other, NANOSECONDS)
        assert (fault in robot.status('readings')['message']) == (other > 0), 'the first may be the last of a node'
    assert fault not in robot.status('readings')['message'], 'it may be the last of a node that has ended'
    tf2_ros.newest = TransformStamped()
    assert fault in robot.status('readings')['message']
    assert robot.status('readings')['level'] == WARN
    # an inactive node leaves the transform to others
    robot.node.deactivate()
    assert fault not in robot.status('readings')['message']


def test_other_publisher_is_no_fault_without_refinement(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph_check, 'GRAPH_PERIOD', 0.0)
    robot = inside().start()
    robot.drive(0, 40)
    tf2_ros.newest = TransformStamped()
    assert 'another node' not in robot.status('readings')['message']


def test_one_stamp_from_the_future_is_not_published_to_tf(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, clock = mapping(inside, monkeypatch)
    tick, sent = robot.node.trajectory._tick, tf2_ros.sent
    path: list[Any] = []
    monkeypatch.setattr(robot.node.trajectory._publishers, 'publish_path', lambda frame, made, stamp: path.append(made))
    for k in range(100):
        robot.odometry(100.0 + 0.1 * k + (1e8 if k == 50 else 0.0), 0.05 * k)
        tick()
    assert max(map(seconds_of, sent)) < 111.0
    assert len(sent) == 99
    assert robot.node.trajectory.distance.driven == pytest.approx(4.95)
    # on a busy machine, a path is still in work when the next one is due
    behind = trajectory.PATH_EVERY / 0.05
    robot.until(lambda: tick() or (path and len(path[-1].stamp) > 98 - behind))
    assert path[-1].stamp[0] == 100 * 10**9 and len(path[-1].stamp) < 100
    # if it lasts, it is used, and taken back if it was wrong
    robot.odometry(1000.0, 5.0)
    tick()
    assert seconds_of(sent[-1]) < 111.0
    clock[0] += trajectory.LASTING + 0.1
    tick()
    assert seconds_of(sent[-1]) == pytest.approx(1000.2)
    robot.odometry(110.0, 5.0)
    tick()
    assert seconds_of(sent[-1]) == pytest.approx(110.2)


def test_transform_after_a_jump_back_is_that_of_its_stamp(
    inside: Callable[..., Inside], quick: Any, tf2_ros: type[Broadcaster]
) -> None:
    """For example a looped bag, or a restarted simulation."""
    robot = inside(refine_poses=True).start()
    robot.drive(0, 200)
    assert robot.call(robot.node.em.run_em)[0]
    correction = robot.node.trajectory.correction
    assert correction is not None
    robot.until(lambda: tf2_ros.sent)
    for seconds, of in ((50.0, 100.0), (103.0, 103.0), (120.0, 110.0)):
        robot.odometry(seconds, 0.5)
        robot.until(lambda seconds=seconds: seconds_of(tf2_ros.sent[-1]) == pytest.approx(seconds + 0.2))
        odometry, path = (
            each.at(np.array([round(of * 1e9)]))[0] for each in (correction.odometry, correction.trajectory)
        )
        x, y, yaw = numbers(tf2_ros.sent[-1])
        # between two poses, both are interpolated
        assert compose(np.array([x, y, yaw]), odometry) == pytest.approx(path, abs=0.01)
    assert robot.node.associator.time_jumps == 1


def test_path_begins_with_the_drive_after_a_jump_back(
    inside: Callable[..., Inside], quick: Any, tf2_ros: type[Broadcaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(refine_poses=True).start()
    robot.drive(0, 50)
    robot.call(robot.node.reset)
    shown: list[Any] = []
    monkeypatch.setattr(
        robot.node.trajectory._publishers, 'publish_path', lambda frame, path, stamp: shown.append(path)
    )
    for k in range(20):
        robot.odometry(20.0 + 0.1 * k, 0.1 * k)
        robot.node.trajectory._tick()
    robot.until(lambda: shown and len(shown[-1].stamp))
    assert shown[-1].stamp[0] == 20 * 10**9
    # a reset without a later jump begins another drive
    robot.call(robot.node.reset)
    for k in range(20, 40):
        robot.odometry(20.0 + 0.1 * k, 0.1 * k)
        robot.node.trajectory._tick()
    robot.until(lambda: len(shown[-1].stamp) and shown[-1].stamp[0] > 21.9e9)
    assert shown[-1].stamp[0] == 22 * 10**9


def test_without_refine_poses_no_transform_is_published(
    inside: Callable[..., Inside], tf2_ros: type[Broadcaster]
) -> None:
    tf2_ros.sent = []
    robot = inside().start()
    robot.drive(0, 20)
    robot.executor.spin_once(timeout_sec=0.1)
    assert tf2_ros.sent == []
    names = {name for name, _ in robot.node.get_publisher_names_and_types_by_node('forward_grid_mapper', '/')}
    assert not names & {'/tf', '/forward_grid_mapper/path', '/forward_grid_mapper/pose'}


def test_transform_is_published_with_tf2_msgs_only(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_latest_possible_stamp_is_published(inside: Callable[..., Inside], tf2_ros: type[Broadcaster]) -> None:
    publishers = pose_publishers.PosePublishers(inside().node)
    latest = (2**31 - 1) * NANOSECONDS + NANOSECONDS - 1
    for _ in range(2):
        publishers.send(('map', 'odom'), np.array([0.1, 0.0, 0.0]), (latest, Pose2(1.0, 0.0, 0.0)))
        publishers._due = 0.0
    stamps = [transform.header.stamp for transform in tf2_ros.sent]
    assert [(stamp.sec, stamp.nanosec) for stamp in stamps] == [divmod(latest, NANOSECONDS)] * 2


def test_path_is_bounded_and_covers_the_drive() -> None:
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
