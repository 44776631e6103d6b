"""The lifecycle of the node: a manager starts and ends it as in Nav2; without one, it starts by itself."""

from __future__ import annotations

import gc
import itertools
import re
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')
pytest.importorskip('lifecycle_msgs', reason='the tests of the lifecycle need lifecycle_msgs')

import rclpy
import yaml
from builtin_interfaces.msg import Time
from em_robot import some_readings
from fault_samples import circle
from inside import Answer, Inside
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle.node import TransitionCallbackReturn
from rclpy.parameter import Parameter
from robot import LATCHED, MAPS, Robot, environment
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Range
from std_srvs.srv import Trigger
from test_mapper_node import RELIABLE

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.core.common.parameters import find
from forward_grid_mapper.core.messages import reading_buffer
from forward_grid_mapper.node import managed, mapper_node
from forward_grid_mapper.node.intake import Intake
from forward_grid_mapper.node.kernels import Kernels

OPTIONS = (*RELIABLE, '-p', 'sensors.sonar.pose:=[0.0, 0.0, 0.0]')
WAITING = (*OPTIONS, '-p', 'autostart:=false')
PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'nav2.md'
UNMANAGED = """
import sys
sys.modules['rclpy.lifecycle'] = None
from forward_grid_mapper.node import main
sys.exit(main.main(sys.argv[1:]))
"""


class Manager:
    """Calls the services that the lifecycle manager of Nav2 calls, with its default time-outs."""

    SECONDS = 5.0

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def change(self, transition: int) -> bool:
        request = Transition(id=transition)
        return bool(self._robot.call('change_state', ChangeState, self.SECONDS, transition=request).success)

    def state(self) -> int:
        return int(self._robot.call('get_state', GetState, self.SECONDS).current_state.id)

    def start_up(self) -> None:
        assert self.change(Transition.TRANSITION_CONFIGURE)
        assert self.state() == State.PRIMARY_STATE_INACTIVE
        assert self.change(Transition.TRANSITION_ACTIVATE)
        assert self.state() == State.PRIMARY_STATE_ACTIVE


@pytest.fixture
def manager(robot: Robot) -> Manager:
    return Manager(robot)


def published(robot: Robot) -> set[str]:
    # services respond before the graph is known
    robot.until(lambda: ('forward_grid_mapper', '/') in robot.node.get_node_names_and_namespaces())
    return {name for name, _ in robot.node.get_publisher_names_and_types_by_node('forward_grid_mapper', '/')}


def received(robot: Robot) -> int:
    return int(robot.diagnostics['readings']['readings received'])


def later(robot: Robot) -> None:
    """Wait for diagnostics published after this call."""
    robot.diagnostics.clear()
    robot.until(lambda: 'readings' in robot.diagnostics)


def test_invalid_transition_is_rejected_with_a_response(start: Any, robot: Robot, manager: Manager) -> None:
    node = start(*WAITING, ready=False)
    node.wait_for('unconfigured:')
    for transition in (Transition.TRANSITION_ACTIVATE, 99):
        assert not manager.change(transition)
    node.wait_for('a transition was refused:')
    manager.start_up()


def test_manager_starts_pauses_and_ends_the_node(start: Any, robot: Robot, manager: Manager) -> None:
    node = start(*WAITING, ready=False)
    node.wait_for('unconfigured:')
    assert manager.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert not any(name.endswith('_map') for name in published(robot))
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    # maps and services exist, and messages are not received
    robot.until(lambda: {f'/forward_grid_mapper/{name}' for name in MAPS} <= published(robot))
    robot.until(lambda: robot.diagnostics.get('readings', {}).get('message') == 'inactive: nothing is received')
    assert robot.range_out.get_subscription_count() == 0
    node.wait_for('EM kernels are ready')
    node.wait_for('ready: the live map is updated with the readings; activate the node to receive them')
    assert 'no Range message has been received on /sonar' in robot.call('run_em').message
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    robot.meet()
    robot.play(circle(0, 300))
    assert robot.call('run_em').success
    wide = robot.get_map('ml_map').info.width
    assert wide > 1
    # messages sent while the node is inactive are neither received nor lost, and the maps stay
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    robot.until(lambda: robot.range_out.get_subscription_count() == 0)
    for message in circle(300, 300):
        robot.send(message)
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    robot.meet()
    robot.play(circle(600, 300))
    readings = robot.diagnostics['readings']
    assert received(robot) == robot.sent
    assert readings['readings lost in the middleware (estimated)'] == '0'
    assert robot.get_map('ml_map').info.width == wide
    # clean up removes everything, and configure makes it again, empty
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    assert manager.change(Transition.TRANSITION_CLEANUP)
    assert manager.state() == State.PRIMARY_STATE_UNCONFIGURED
    robot.until(lambda: not any(name.endswith('_map') for name in published(robot)))
    for _ in range(2):
        manager.start_up()
        robot.meet()
        later(robot)
        assert received(robot) == 0
        robot.sent = 0
        robot.play(circle(0, 200))
        assert robot.call('run_em').success
        assert robot.get_map('ml_map').info.width > 1
        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        assert manager.change(Transition.TRANSITION_CLEANUP)
    assert manager.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert manager.state() == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0
    assert 'Traceback' not in node.output


def test_node_activates_itself(start: Any, robot: Robot, manager: Manager) -> None:
    node = start(*OPTIONS)
    assert manager.state() == State.PRIMARY_STATE_ACTIVE
    robot.meet()
    robot.play(circle(0, 200))
    # shutdown during work
    robot.ask('run_em')
    assert manager.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert manager.state() == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0


def test_failed_configuration_is_reported(start: Any, robot: Robot, manager: Manager) -> None:
    node = start(*WAITING, '-p', 'odom_topic:=sonar', ready=False)
    node.wait_for('unconfigured:')
    for _ in range(2):
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state() == State.PRIMARY_STATE_UNCONFIGURED
    node.wait_for('/sonar cannot be a topic of both Range and odometry', 10.0)
    assert not any(name.endswith('_map') for name in published(robot))
    assert 'Traceback' not in node.output
    assert node.stop() == 0


def test_each_configuration_restores_the_journal(start: Any, robot: Robot, manager: Manager, tmp_path: Path) -> None:
    node = start(*WAITING, '-p', f'journal:={tmp_path}/journal', ready=False)
    node.wait_for('unconfigured:')
    manager.start_up()
    robot.meet()
    robot.play(circle(0, 200))
    accepted = robot.diagnostics['readings']['readings accepted']
    assert int(accepted) > 100
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    assert manager.change(Transition.TRANSITION_CLEANUP)
    manager.start_up()
    later(robot)
    robot.until(lambda: robot.diagnostics['readings']['readings accepted'] == accepted, what='they are back')
    robot.node.create_subscription(type(robot.get_map('live_map')), '/forward_grid_mapper/live_map', print, LATCHED)
    robot.until(lambda: robot.get_map('live_map').info.width > 1)


@pytest.mark.parametrize('autostart', ['true', 'false'])
def test_node_without_lifecycle_msgs_starts_itself_or_ends(domain: int, tmp_path: Path, autostart: str) -> None:
    log = tmp_path / 'node.log'
    command = [sys.executable, '-c', UNMANAGED, '--ros-args', *OPTIONS, '-p', f'autostart:={autostart}']
    with log.open('w') as file:
        process = subprocess.Popen(command, env=environment(domain), stdout=file, stderr=subprocess.STDOUT)
    try:
        if autostart == 'false':
            assert process.wait(60.0) == 1
            assert 'without lifecycle_msgs nothing else can start the node' in log.read_text()
            return
        while 'ready:' not in log.read_text():
            assert process.poll() is None, log.read_text()
        process.terminate()
        assert process.wait(20.0) == 0
    finally:
        process.kill()


def test_documented_parameters_of_the_lifecycle_manager() -> None:
    """As `nav2_lifecycle_manager` declares them: autostart, node_names, bond_timeout and others."""
    blocks = re.findall(r'```yaml\n(.*?)```', PAGE.read_text(encoding='utf-8'), re.DOTALL)
    (given,) = (made for made in map(yaml.safe_load, blocks) if 'lifecycle_manager_mapper' in made)
    values = given['lifecycle_manager_mapper']['ros__parameters']
    assert values == {
        'autostart': True,
        'node_names': ['forward_grid_mapper'],
        # the node sends no heartbeat (bond), so the manager must not wait for one
        'bond_timeout': 0.0,
    }
    assert isinstance(values['bond_timeout'], float)
    # only one of the two may start the node
    assert 'autostart:=false' in PAGE.read_text(encoding='utf-8')
    assert find('autostart').default is True


def sockets() -> int:
    found = 0
    for descriptor in Path('/proc/self/fd').iterdir():
        with suppress(OSError):
            found += str(descriptor.readlink()).startswith('socket:')
    return found


def test_clean_up_leaves_no_readings_or_threads(inside: Callable[..., Inside]) -> None:
    others = {*threading.enumerate()}
    robot = inside()
    node = robot.node
    for _ in range(2):
        robot.start()
        robot.until(lambda: not Kernels.at_work)
        parts = [weakref.ref(part) for part in (node.associator, node.associator.buffer, node.live, node.em, node.maps)]
        assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        # let the executor update its list of waitables
        robot.spin(0.1)
        gc.collect()
        assert [part() for part in parts] == [None] * len(parts)
        robot.until(lambda: {*threading.enumerate()} <= others)


def test_clean_up_during_thinning_is_no_failure(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    robot = inside(max_readings=80).start()
    readings, begun, go = robot.node._readings_worker, threading.Event(), threading.Event()
    original = reading_buffer.kept

    def slow(*arguments: Any) -> Any:
        begun.set()
        assert go.wait(60.0)
        return original(*arguments)

    monkeypatch.setattr(reading_buffer, 'kept', slow)
    robot.drive(0, 91)
    robot.until(begun.is_set)
    assert robot.node.trigger_deactivate() == robot.node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    go.set()
    readings.close(60.0)
    assert readings.trouble == ''


@pytest.fixture
def peer(inside: Callable[..., Inside]) -> Iterator[Callable[[Inside], Any]]:
    """Make another node in the context of a node."""
    made = []

    def beside(robot: Inside) -> Any:
        made.append(rclpy.create_node('peer', context=robot.context))
        robot.executor.add_node(made[-1])
        return made[-1]

    yield beside
    for node in made:
        node.destroy_node()


def test_simulated_time_set_at_run_time_stays_after_a_clean_up(
    inside: Callable[..., Inside], peer: Callable[[Inside], Any]
) -> None:
    robot = inside()
    robot.node.start()
    out = peer(robot).create_publisher(Clock, '/clock', 10)

    def comes(seconds: int) -> bool:
        out.publish(Clock(clock=Time(sec=seconds)))
        return bool(robot.node.get_clock().now().nanoseconds == seconds * 10**9)

    robot.set(use_sim_time=True)
    robot.until(lambda: comes(100), 20.0)
    node = robot.node
    for turn in (node.trigger_deactivate, node.trigger_cleanup, node.trigger_configure, node.trigger_activate):
        assert turn() == TransitionCallbackReturn.SUCCESS
    robot.until(lambda: comes(200), 20.0)


def test_read_only_parameters_can_be_set_between_cleanup_and_configure(inside: Callable[..., Inside]) -> None:
    robot = inside(**{'sensors.removed.pose': [0.9, 0.0, 0.0]})
    node = robot.node
    node.start()
    changes = {
        'resolution': 0.2,
        'range_topics': ['left', 'right'],
        'sensors.sonar.pose': [0.5, 0.0, 0.0],
        # no such parameter was given at the start
        'sensors.further.pose': [0.7, 0.0, 0.0],
    }
    for name, value in changes.items():
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful and f'{name} is read-only while the node is configured' in result.reason
    assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    robot.set(**changes)
    for name in ('sensors.sonar.pose', 'sensors.third.pose'):
        (result,) = node.set_parameters([Parameter(name, value=[0.5, 0.0])])
        assert not result.successful, 'that is no pose'
    assert not node.has_parameter('sensors.third.pose')
    (result,) = node.set_parameters([Parameter('p_hitt', value=0.5)])
    assert not result.successful and 'did you mean p_hit?' in result.reason
    # one given at the start, and one set later
    for name in ('sensors.removed.pose', 'sensors.fourth.pose'):
        (result,) = node.set_parameters([Parameter(name, value=[0.5, 0.0, 0.0])])
        assert result.successful
        (result,) = node.set_parameters([Parameter(name)])
        assert result.successful and not node.has_parameter(name)
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert sorted(topic for topic in node.intake.subscriptions if topic != '/odom') == ['/left', '/right']
    robot.until(lambda: node.mapping)
    robot.odometry(100.0)
    robot.range(100.0)
    robot.range(100.0, frame='further')
    robot.range(100.0, frame='removed')
    assert node.associator.readings.x == pytest.approx([0.5, 0.7])
    assert node.live.grid.resolution == 0.2


@pytest.mark.parametrize(
    ('end', 'why'),
    [
        ('trigger_cleanup', 'the node is being cleaned up'),
        ('trigger_shutdown', 'the node is being shut down'),
    ],
)
def test_end_of_a_configuration_responds_to_waiting_calls(
    inside: Callable[..., Inside], peer: Callable[[Inside], Any], end: str, why: str
) -> None:
    robot = inside().start()
    node = robot.node

    def hold(stop: Callable[[], bool]) -> None:
        while not stop():
            threading.Event().wait(0.02)

    node.em.worker._prepare = hold
    other = peer(robot)
    calls = []
    for name in ('run_em', 'save_maps'):
        client = other.create_client(Trigger, f'/forward_grid_mapper/{name}')
        robot.until(client.service_is_ready, 20.0)
        calls.append(client.call_async(Trigger.Request()))
    robot.until(lambda: node.em.current and len(node.em.current.callers) == 2, 20.0)
    assert node.trigger_deactivate() == getattr(node, end)() == TransitionCallbackReturn.SUCCESS
    robot.until(lambda: all(call.done() for call in calls), 20.0)
    for call in calls:
        assert (call.result().success, call.result().message) == (False, why)


def test_failed_activation_leaves_no_double_subscriptions(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside()
    node = robot.node
    node.start()
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    subscribe, failing = Intake._subscribe, [Odometry]

    def broken(intake: Any, kind: Any, *rest: Any) -> None:
        if kind in failing:
            raise RuntimeError('no more memory')
        subscribe(intake, kind, *rest)

    monkeypatch.setattr(Intake, '_subscribe', broken)
    assert node.trigger_activate() == TransitionCallbackReturn.FAILURE
    failing.clear()
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert sorted(each.topic_name for each in node.subscriptions if each.msg_type in (Range, Odometry)) == [
        '/odom',
        '/sonar',
    ]


def test_repeated_activations_leave_no_extra_entities(inside: Callable[..., Inside]) -> None:
    node = inside().start().node
    before = len(node._created)
    for _ in range(3):
        assert node.trigger_deactivate() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert len(node._created) == before
    assert len([each for each in node.subscriptions if each.msg_type in (Range, Odometry)]) == 2


def test_readings_restored_after_a_clean_up_do_not_reach_new_parts(inside: Callable[..., Inside]) -> None:
    node = inside(max_readings=10).node
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    before = node.associator
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    # before thinning, readings are given to the maps
    assert before.restore(some_readings(30)) == 0
    assert before.buffer.stored < len(before.buffer) == 30


def test_failed_configuration_releases_the_journal(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refused(*arguments: Any) -> Any:
        raise MapperError('two maps on one topic')

    node = inside(journal=str(tmp_path / 'journal')).node
    with monkeypatch.context() as patched:
        patched.setattr(mapper_node, 'MapPublishers', refused)
        assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS


def test_configuration_rejected_by_rcl_leaves_no_parts(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    node = inside(journal=str(tmp_path / 'journal'), online=True, refine_poses=True).node
    others, made = {*threading.enumerate()}, itertools.count()

    def limited(create: Callable[..., Any], most: int) -> Callable[..., Any]:
        def instead(*arguments: Any, **options: Any) -> Any:
            if next(made) == most:
                raise RCLError('no more memory')
            return create(*arguments, **options)

        return instead

    for most in range(40):
        made = itertools.count()
        with monkeypatch.context() as patched:
            for name in ('create_publisher', 'create_service', 'create_timer', 'create_guard_condition'):
                patched.setattr(managed.Base, name, limited(getattr(managed.Base, name), most))
            result = node.trigger_configure()
        if result == TransitionCallbackReturn.SUCCESS:
            break
        assert {*threading.enumerate()} <= others
        assert not node._created
    assert result == TransitionCallbackReturn.SUCCESS and most > 15


def test_clean_up_in_which_parts_fail_ends_the_others(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state must not say that the node can be activated again, since it has no parts any more."""

    def broken(*arguments: Any) -> Any:
        raise RuntimeError('no space left')

    robot = inside()
    node = robot.node
    logged: list[str] = []
    logger = SimpleNamespace(error=logged.append, info=print, warning=print)
    monkeypatch.setattr(mapper_node.MapperNode, 'get_logger', lambda self: logger)
    for _ in range(2):
        robot.start()
        ended: list[int] = []
        node._ends[:0] = [partial(ended.append, 1), broken]
        node._ends += [broken, partial(ended.append, 2)]
        node._calls.insert(0, SimpleNamespace(end=broken))
        node._created.append((broken, None))
        assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert node._state_machine.current_state[1] == 'unconfigured'
        assert ended == [2, 1] and not node._created and not hasattr(node, 'intake')
        assert len(logged) == 4 and all('no space left' in text for text in logged)
        logged.clear()


def test_failed_configuration_in_which_parts_fail_can_be_repeated(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: Any) -> Any:
        raise RuntimeError('no space left')

    node = inside().node
    with monkeypatch.context() as patched:
        patched.setattr(mapper_node.JournalKeeper, 'open', broken)
        patched.setattr(mapper_node.JournalKeeper, 'close', broken)
        assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    assert node._state_machine.current_state[1] == 'unconfigured'
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS


def test_clean_up_while_the_journal_is_read_leaves_no_parts(inside: Callable[..., Inside]) -> None:
    node = inside().node
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    part = weakref.ref(node.em)
    node._answer_when_ready(node.em.run_em, Answer())
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    gc.collect()
    assert part() is None


def test_topic_under_two_names_is_subscribed_once(inside: Callable[..., Inside]) -> None:
    robot = inside(range_topics=['sonar', '/sonar', 'other'])
    robot.start()
    assert sorted(topic for topic in robot.node.intake.subscriptions if topic != '/odom') == ['/other', '/sonar']
    assert robot.node.em.range_topics == ['/sonar', '/other']
    assert len(robot.node.intake.range_losses) == 2


@pytest.mark.skipif(not Path('/proc/self/fd').is_dir(), reason='there is no /proc')
def test_destroyed_node_leaves_no_sockets(inside: Callable[..., Inside]) -> None:
    # the first node of a process opens sockets that all nodes share
    inside().start().close()
    before = sockets()
    inside().start().close()
    assert sockets() <= before
