"""TF from other nodes over DDS, with stand-ins for tf2_ros and tf2_msgs: missing transforms are reported."""

from __future__ import annotations

import gc
import math
import sys
import weakref
from collections.abc import Callable, Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

import rclpy
from geometry_msgs.msg import Transform
from inside import Inside
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle.node import TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import MultiDOFJointState

from forward_grid_mapper.node import frames, graph_check, intake

VOLATILE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
WARN = b'\x01'


class TransformError(Exception):
    """The base of tf2's exceptions."""


class Buffer:
    """Stand-in for `tf2_ros.Buffer`; each transform is the pose of the sensor on the robot."""

    def __init__(self, cache_time: Any = None, node: Any = None) -> None:
        self.cache_time = cache_time
        self.listener: Any = None
        self.transform: Any = None

    def clear(self) -> None:
        """Keep static transforms."""

    def set_transform_static(self, transform: Any, authority: str) -> None:
        self.transform = transform

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        if self.transform is None or source != 'tower':
            raise TransformError(source)
        return SimpleNamespace(transform=self.transform)


class Listener:
    """Stand-in for `tf2_ros.TransformListener`: its subscriptions end with it, in a group of their own."""

    def __init__(
        self, buffer: Any, node: Any, *, spin_thread: bool = False, qos: Any = None, static_qos: Any = None
    ) -> None:
        assert not spin_thread
        self.buffer, self.node, self.group = buffer, node, ReentrantCallbackGroup()
        volatile = qos or QoSProfile(depth=100, durability=DurabilityPolicy.VOLATILE)
        latched = static_qos or QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.tf_sub, self.tf_static_sub = (
            node.create_subscription(
                MultiDOFJointState, topic, lambda message: None, quality, callback_group=self.group
            )
            for topic, quality in (('/tf', volatile), ('/tf_static', latched))
        )

    def __del__(self) -> None:
        self.node.destroy_subscription(self.tf_sub)
        self.node.destroy_subscription(self.tf_static_sub)


@pytest.fixture(autouse=True)
def tf2(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins; MultiDOFJointState has a field `transforms`, like TFMessage."""
    modules = {name: ModuleType(name) for name in ('tf2_ros', 'tf2_msgs', 'tf2_msgs.msg')}
    given: dict[str, Any] = {
        'Buffer': Buffer,
        'TransformListener': Listener,
        'TransformException': TransformError,
    }
    for name, value in given.items():
        setattr(modules['tf2_ros'], name, value)
    modules['tf2_msgs.msg'].TFMessage = MultiDOFJointState  # type: ignore[attr-defined]
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(graph_check, 'GRAPH_PERIOD', 0.05)
    monkeypatch.setattr(frames, 'NO_TRANSFORM_FOR', 0.2)
    monkeypatch.setattr(frames, 'LOOK_UP_AGAIN_AFTER', 0.0)


@pytest.fixture
def player(domain: int) -> Iterator[Callable[[], Any]]:
    """A node that publishes static transforms like a bag without quality of service."""
    context = rclpy.Context()
    made: list[Any] = []

    def begin(quality: QoSProfile = VOLATILE) -> Any:
        rclpy.init(context=context, domain_id=domain)
        made.append(rclpy.create_node('player', context=context))
        return made[0].create_publisher(MultiDOFJointState, '/tf_static', quality)

    yield begin
    for node in made:
        node.destroy_node()
    if context.ok():
        rclpy.shutdown(context=context)


def begun(inside: Callable[..., Inside], **parameters: Any) -> Inside:
    robot = inside(**{'sensors.sonar.pose': [0.1, 0.0, 0.4], **parameters})
    return robot.start()


def from_tower(robot: Inside, first: int, count: int) -> None:
    for k in range(first, first + count):
        robot.odometry(100.0 + 0.5 * k)
        robot.range(100.0 + 0.5 * k, frame='tower')
    robot.until(lambda: not robot.node.intake.busy)


def test_volatile_static_transforms_are_received(inside: Callable[..., Inside], player: Callable[..., Any]) -> None:
    robot = begun(inside)
    publisher = player()
    robot.until(publisher.get_subscription_count)
    pose = Transform()
    pose.translation.x, pose.rotation.w = 0.3, 1.0
    publisher.publish(MultiDOFJointState(transforms=[pose]))
    robot.until(lambda: robot.node._extrinsics('base_link', 'tower', 1) == (0.3, 0.0, 0.0))
    from_tower(robot, 0, 5)
    assert len(robot.node.associator.buffer) == 5
    assert 'volatile' not in robot.status('readings')['message']


def test_clean_up_ends_the_listener_and_configure_makes_another(inside: Callable[..., Inside]) -> None:
    """The subscriptions are destroyed by the clean-up, and once more by the listener when it is collected."""
    robot = begun(inside)
    node = robot.node

    def of_transforms() -> list[str]:
        return sorted(each.topic_name for each in node.subscriptions if each.msg_type is MultiDOFJointState)

    for _ in range(2):
        assert of_transforms() == ['/tf', '/tf_static', '/tf_static']
        listener = weakref.ref(node._extrinsics._transforms._buffer.listener)
        assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        robot.spin(0.1)
        gc.collect()
        assert listener() is None and of_transforms() == []
        robot.start()


def test_transforms_wait_for_the_node_as_long_as_readings_do(inside: Callable[..., Inside]) -> None:
    robot = inside()
    robot.node.start()
    buffer: Any = robot.node._extrinsics._transforms._buffer
    assert buffer.cache_time.nanoseconds == frames.CACHE_SECONDS * 10**9
    of_tf = buffer.listener.tf_sub.qos_profile
    assert (of_tf.depth, of_tf.durability) == (intake.QUEUE, DurabilityPolicy.VOLATILE)
    assert of_tf.reliability == ReliabilityPolicy.RELIABLE


def test_static_transforms_published_too_early_are_reported(
    inside: Callable[..., Inside], player: Callable[..., Any]
) -> None:
    robot = begun(inside, pose_timeout=0.1, max_pose_gap=0.6)
    player()
    robot.until(lambda: robot.node.count_publishers('/tf_static'))
    assert 'volatile' not in robot.status('readings')['message']
    end = robot.node.associator
    k = 0
    while not end.unknown_frames:
        from_tower(robot, k, 5)
        robot.spin(0.3)
        k += 5
    readings = robot.status('readings')
    assert readings['level'] == WARN
    assert (
        'player publishes /tf_static as volatile: messages sent before this node subscribed are lost'
        in (readings['message'])
    )


def test_best_effort_static_transforms_are_reported(inside: Callable[..., Inside], player: Callable[..., Any]) -> None:
    robot = begun(inside)
    player(QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    robot.until(lambda: 'no message is received; set its publisher' in robot.status('readings')['message'])


def test_missing_transform_of_the_map_frame_is_reported(inside: Callable[..., Inside]) -> None:
    robot = begun(inside, map_frame='map')
    k = 0

    def message() -> str:
        nonlocal k
        k += 1
        robot.odometry(100.0 + 0.1 * k)
        return str(robot.status('readings')['message'])

    robot.until(lambda: 'TF has no transform from map (map_frame) to odom' in message())
    assert 'no odometry' not in message()


def test_simulated_time_without_a_clock_is_reported(inside: Callable[..., Inside]) -> None:
    robot = begun(inside, use_sim_time=True)
    robot.until(lambda: 'use_sim_time is true, but no node publishes /clock' in robot.status('readings')['message'])
    from rosgraph_msgs.msg import Clock

    publisher = robot.node.create_publisher(Clock, '/clock', 10)
    robot.until(lambda: 'no node has published on /clock' in robot.status('readings')['message'])
    now = Clock()
    now.clock.sec = 5

    def gone() -> bool:
        publisher.publish(now)
        return '/clock' not in robot.status('readings')['message']

    robot.until(gone)


def test_readings_of_inclined_and_steep_sensors(inside: Callable[..., Inside]) -> None:
    robot = begun(inside)
    pose = Transform()
    buffer: Any = robot.node._extrinsics._transforms._buffer
    for pitch in (math.radians(30.0), math.radians(80.0)):
        pose.rotation.y, pose.rotation.w = math.sin(pitch / 2), math.cos(pitch / 2)
        buffer.set_transform_static(pose, '')
        from_tower(robot, len(robot.node.associator.buffer), 3)
    assert robot.node.associator.readings.z.tolist() == pytest.approx([2.0 * math.cos(math.radians(30.0))] * 3)
    readings = robot.status('readings')
    assert readings['rejected: steep_sensor'] == '3'
    assert readings['frames without a pose'] == ''


def test_sensor_whose_transform_was_corrected_is_fixed_after_a_reset(inside: Callable[..., Inside]) -> None:
    robot = begun(inside)
    buffer: Any = robot.node._extrinsics._transforms._buffer
    for k, x in enumerate((1.0, 0.1)):
        pose = Transform()
        pose.translation.x = x
        buffer.set_transform_static(pose, '')
        from_tower(robot, 3 * k, 3)
    assert robot.node._account().source['extrinsics'] == {}, 'it may be on a joint'
    assert robot.call(robot.node.reset)[0]
    from_tower(robot, 6, 3)
    assert robot.node._account().source['extrinsics'] == {'tower': (0.1, 0.0, 0.0)}


class Log:
    """A logger that keeps its lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.info = self.warning = self.error = self.lines.append

    def count(self, text: str) -> int:
        return sum(text in line for line in self.lines)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Callable[[Inside], Log]:
    def watch(robot: Inside) -> Log:
        made = Log()
        monkeypatch.setattr(robot.node, 'get_logger', lambda: made)
        return made

    return watch


def test_sensor_without_pose_is_logged_once_and_its_pose_once(
    inside: Callable[..., Inside], log: Callable[[Inside], Log]
) -> None:
    robot = begun(inside, pose_timeout=0.1, max_pose_gap=0.6)
    lines, node = log(robot), robot.node
    k = 0
    while not node.associator.unknown_frames:
        from_tower(robot, k, 5)
        robot.spin(0.3)
        k += 5
    for _ in range(3):
        robot.status('readings')
    assert lines.count('no pose on the robot for sensor tower') == 1
    buffer: Any = node._extrinsics._transforms._buffer
    pose = Transform()
    pose.rotation.w = 1.0
    buffer.set_transform_static(pose, '')
    from_tower(robot, k, 5)
    for _ in range(3):
        assert robot.status('readings')['frames without a pose'] == ''
    assert lines.count('sensor tower now has a pose on the robot') == 1
    # a reset forgets unknown frames, which is not a new pose
    node.associator.unknown_frames.add('tower')
    robot.status('readings')
    robot.call(node.reset)
    robot.status('readings')
    assert lines.count('now has a pose on the robot') == 1


def test_missing_map_frame_is_logged_once_and_its_end_once(
    inside: Callable[..., Inside], log: Callable[[Inside], Log]
) -> None:
    robot = begun(inside, map_frame='map')
    lines, frame, k = log(robot), robot.node._map_frame, 0

    def drive() -> None:
        nonlocal k
        k += 1
        robot.odometry(100.0 + 0.1 * k)

    robot.until(lambda: (drive(), frame.fault())[1])
    for _ in range(3):
        robot.status('readings')
    assert lines.count('readings are not mapped: TF has no transform from map (map_frame) to odom') == 1
    # a pause of the robot does not mean that the transform exists
    robot.until(lambda: not frame.fault())
    robot.status('readings')
    assert lines.count('the transform to map_frame is available') == 0
    pose = Transform()
    pose.rotation.w = 1.0
    frame._transforms._buffer.lookup_transform = lambda *names: SimpleNamespace(transform=pose)
    drive()
    for _ in range(3):
        robot.status('readings')
    assert lines.count('the transform to map_frame is available') == 1


def receive_from(robot: Inside, pose: Transform) -> None:
    """Receive readings of the tower with this pose in TF, and report them several times."""
    buffer: Any = robot.node._extrinsics._transforms._buffer
    buffer.set_transform_static(pose, '')
    from_tower(robot, 0, 5)
    for _ in range(3):
        robot.status('readings')


def test_sensor_pose_in_millimetres_is_logged_once(inside: Callable[..., Inside], log: Callable[[Inside], Log]) -> None:
    robot = begun(inside)
    lines = log(robot)
    pose = Transform()
    pose.translation.x, pose.rotation.w = 150.0, 1.0
    receive_from(robot, pose)
    assert lines.count('transforms put tower up to 150 m away from the middle of the robot') == 1


def test_steep_sensor_is_logged_once(inside: Callable[..., Inside], log: Callable[[Inside], Log]) -> None:
    robot = begun(inside)
    lines = log(robot)
    pose = Transform()
    pose.rotation.y, pose.rotation.w = math.sin(0.75), math.cos(0.75)
    receive_from(robot, pose)
    assert lines.count('readings of tower are rejected: the sensor points up or down') == 1
