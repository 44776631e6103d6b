"""The service run_em and calls that wait for it: each gets one response, and the maps of the latest run are kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the services are those of rclpy')

from em_robot import BEFORE, GRID, PROGRESS, SO_FAR, EmRobot

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.node import consistency_check, em_service


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., EmRobot]]:
    robots: list[EmRobot] = []

    def begin(**options: Any) -> EmRobot:
        robots.append(EmRobot(monkeypatch, **options))
        return robots[-1]

    yield begin
    for robot in robots:
        robot.em.close(10.0)


@pytest.fixture
def robot(make: Callable[..., EmRobot]) -> EmRobot:
    return make()


@pytest.fixture
def held(robot: EmRobot) -> EmRobot:
    """Searches wait until the test lets them continue."""
    robot.held = True
    return robot


def test_maps_are_published_and_kept_and_the_call_succeeds(robot: EmRobot) -> None:
    robot.warnings, robot.trajectory.words = ['ranges are copies'], 'trajectory refined'
    assert (robot.em.last_run, robot.em.accepted_at_run, robot.em.maps) == ('none yet', 0, None)
    answer = robot.run_em()
    robot.settle()
    ((success, message),) = answer.sent
    assert (
        success
        and message.startswith('5 readings in ')
        and message.endswith(' s; trajectory refined; WARNING: ranges are copies')
    )
    (ml, uncertainty) = robot.published
    assert ml[:3] == ('ml_map', 3, GRID) and ml[3][0, 0] == 5
    assert uncertainty[:3] == ('uncertainty_map', 3, GRID) and uncertainty[3].dtype == np.float32
    em = robot.em
    assert em.maps is not None and em.accepted_at_run == 5 and em.wrong_input == ['ranges are copies']
    assert em.last_run == '5 readings in 1.75 s; trajectory refined'
    assert em.sensors._table == {'sonar': 'health'}
    assert 'EM: ranges are copies' in robot.node.warned and f'EM: {em.last_run}' in robot.node.warned
    assert robot.trajectory.adopted == [] and robot.waited == ['EM']
    assert robot.searches[0].start is None


def test_run_uses_thinned_readings_accepted_at_its_start(make: Callable[..., EmRobot]) -> None:
    robot = make(count=40, max_readings=38)
    robot.held = True
    robot.run_em()
    robot.accept(2)
    robot.begun().go_on.set()
    robot.settle()
    assert robot.searches[0].count == 38 and robot.em.accepted_at_run == 40


def test_readings_received_during_compilation_are_mapped(robot: EmRobot) -> None:
    robot.compiled.clear()
    answer = robot.run_em()
    robot.until(lambda: robot.waited)
    run = robot.em.current
    assert run is not None and run.uses_all_readings()
    robot.accept(3)
    assert run.uses_all_readings(), 'it will look at them'
    robot.compiled.add('EM')
    robot.settle()
    assert answer.sent[0][1].startswith('8 readings') and robot.em.accepted_at_run == 8


def test_readings_received_during_compilation_of_refinement_are_mapped(make: Callable[..., EmRobot]) -> None:
    robot = make(refine_poses=True)
    robot.compiled.discard('trajectory')
    answer = robot.run_em()
    robot.until(lambda: 'trajectory' in robot.waited)
    robot.accept(3)
    robot.compiled.add('trajectory')
    robot.settle()
    assert answer.sent[0][1].startswith('8 readings') and robot.em.accepted_at_run == 8


def test_compilation_time_is_reported_separately(robot: EmRobot) -> None:
    robot.compiled.clear()
    answer, begin = robot.run_em(), time.monotonic()
    robot.until(lambda: time.monotonic() - begin > 0.6)
    robot.compiled.add('EM')
    robot.settle()
    message, spent = answer.sent[0][1], time.monotonic() - begin
    assert message.endswith(' s of compiling kernels, as at the first start')
    assert float(message.split(' in ')[1].split()[0]) < spent - 0.5
    quick = robot.run_em()
    robot.settle()
    assert 'compiled' not in quick.sent[0][1]


def test_run_with_refine_poses_waits_for_its_kernels(make: Callable[..., EmRobot]) -> None:
    robot = make(refine_poses=True)
    robot.run_em()
    robot.settle()
    assert robot.waited == ['EM', 'trajectory']


def test_second_call_during_a_run_fails(held: EmRobot) -> None:
    first, second = held.run_em(), held.run_em()
    ((success, message),) = second.sent
    assert (
        not success
        and message.startswith('EM is already running (')
        and message.endswith('call run_em again when it has ended')
    )
    held.begun().go_on.set()
    held.settle()
    assert first.sent[0][0] and len(held.searches) == 1


def test_automatic_run_needs_readings_and_no_other_run(make: Callable[..., EmRobot]) -> None:
    assert not make(count=0).em.run_by_itself()
    robot = make()
    robot.held = True
    assert robot.em.run_by_itself()
    assert not robot.em.run_by_itself()
    robot.begun().go_on.set()
    robot.settle()
    assert robot.em.maps is not None


def test_call_joins_an_automatic_run_with_all_readings(held: EmRobot) -> None:
    held.em.run_by_itself()
    held.begun()
    answer = held.run_em()
    assert answer.sent == [] and held.em.current is not None and not held.em.current.by_itself
    assert not held.run_em().sent[0][0], 'somebody has asked for it by now'
    held.searches[0].go_on.set()
    held.settle()
    assert answer.sent[0][0] and len(held.searches) == 1


@pytest.mark.parametrize('why', ['readings', 'parameters'])
def test_outdated_automatic_run_is_replaced_by_a_call(held: EmRobot, why: str) -> None:
    held.em.run_by_itself()
    informed: list[str] = []
    held.node.info = informed.append  # type: ignore[method-assign]
    held.begun()
    waiting = held.wait_for_maps()
    if why == 'readings':
        held.accept(2)
    else:
        held.parameters = Parameters.from_flat({'p_hit': 0.6})
    answer = held.run_em()
    assert held.searches[0].cancelled and answer.sent == []
    held.until(lambda: len(held.searches) == 2)
    assert held.em.last_run == 'the run that the node began by itself (refine_every) was replaced by run_em'
    # that is no fault
    assert [text for text in informed if 'replaced by run_em' in text] and not held.node.warned
    assert waiting == [], 'it waits for the other run'
    held.begun().go_on.set()
    held.settle()
    assert answer.sent[0][0]
    (outcome,) = waiting
    assert outcome.maps is held.em.maps is not None
    assert held.em.accepted_at_run == (7 if why == 'readings' else 5)


def test_calls_fail_if_the_run_cannot_begin(held: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    held.em.run_by_itself()
    held.begun()
    held.accept(1)

    def fails(*arguments: Any) -> Any:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(held.trajectory, 'mapper', fails)
        answer = held.run_em()
        later = held.wait_for_maps()
        held.until(lambda: held.em.current is None)
    assert answer.sent == [(False, 'EM cannot begin: there is not enough memory')]
    assert [outcome.message for outcome in later] == ['EM cannot begin: there is not enough memory']
    held.held = False
    assert held.run_em().sent == [] and held.em.current is not None


def test_cancel_responds_when_the_run_has_ended(held: EmRobot) -> None:
    ((success, message),) = held.cancel_em().sent
    assert (success, message) == (False, 'EM is not running: there is nothing to cancel')
    answer = held.run_em()
    held.begun()
    cancelled = held.cancel_em()
    assert cancelled.sent == []
    waiting = held.wait_for_maps()
    assert waiting[0].maps is None and 'EM is being cancelled' in waiting[0].message
    held.settle()
    assert answer.sent == [(False, 'EM was cancelled by cancel_em')]
    ((success, message),) = cancelled.sent
    assert success and message.startswith('EM was cancelled by cancel_em (after ')
    assert held.em.maps is None and 'EM was cancelled by cancel_em' in held.node.warned
    assert held.published == [], 'nothing was shown meanwhile'


def test_cancel_after_the_end_of_the_search_fails(held: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = held.run_em()
    search = held.begun()
    monkeypatch.setattr(search, 'cancel', search.go_on.set)
    cancelled = held.cancel_em()
    held.settle()
    assert answer.sent[0][0] and held.em.maps is not None
    assert cancelled.sent == [(False, 'EM ended before it could be cancelled; its maps are published')]


def test_call_that_replaces_a_run_fails_if_it_is_cancelled(held: EmRobot) -> None:
    held.em.run_by_itself()
    held.begun()
    held.accept(1)
    answer, later = held.run_em(), held.wait_for_maps()
    assert answer.sent == [] and later == []
    cancelled = held.cancel_em()
    assert answer.sent == [(False, 'EM was cancelled by cancel_em')]
    assert later[0].message == 'EM was cancelled by cancel_em'
    held.settle()
    assert cancelled.sent[0][0] and len(held.searches) == 1


def test_reset_deletes_the_maps_and_cancels_the_run(held: EmRobot) -> None:
    held.run_em()
    held.begun().go_on.set()
    held.settle()
    held.em.wrong_input = ['odd']
    held.em.run_by_itself()
    held.begun()
    held.accept(1)
    answer = held.run_em()
    held.publishers.generation += 1
    held.em.reset()
    assert answer.sent == [(False, 'EM was cancelled by reset')]
    em = held.em
    assert (em.maps, em.found_trajectory, em.wrong_input, em.last_run) == (None, None, [], 'none since the reset')
    assert em.sensors._table == {}
    held.settle()
    assert em.last_run == 'EM was cancelled by reset' and em.maps is None and len(held.searches) == 2


def test_maps_of_a_run_before_a_reset_are_not_kept(held: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = held.run_em()
    search = held.begun()
    monkeypatch.setattr(search, 'cancel', search.go_on.set)
    held.publishers.generation += 1
    held.em.reset()
    held.settle()
    assert answer.sent == [(False, 'EM was cancelled by reset')] and held.em.maps is None
    assert all(generation == 3 for _, generation, *_ in held.published), 'publishers drop what is of before'


def test_caller_gets_existing_maps_or_waits_for_the_run(held: EmRobot) -> None:
    first = held.wait_for_maps()
    second = held.wait_for_maps()
    held.begun().go_on.set()
    held.settle()
    assert len(held.searches) == 1
    (one,), (two,) = first, second
    assert one.maps is two.maps is held.em.maps is not None
    (again,) = held.wait_for_maps()
    assert again.maps is held.em.maps and len(held.searches) == 1


def test_failing_run_restores_the_earlier_map(make: Callable[..., EmRobot]) -> None:
    robot = make(publish_rate=50.0)
    robot.held, robot.error = True, MemoryError()
    answer = robot.run_em()
    search = robot.begun()
    run = robot.em.current
    assert run is not None and search.watch is not None
    while not run.map_shown:
        search.watch('search', PROGRESS)
    search.go_on.set()
    robot.settle()
    assert not answer.sent[0][0] and 'memory' in answer.sent[0][1] and robot.em.last_run == answer.sent[0][1]
    assert robot.published[0] == ('ml_map', 3, *SO_FAR)
    assert robot.published[-1] == ('ml_map', 3, *BEFORE)


def test_cancelled_run_restores_the_earlier_map_also_after_a_run_was_replaced(
    make: Callable[..., EmRobot],
) -> None:
    # the end of a replaced run is logged with another severity than that of a cancelled one
    robot = make(publish_rate=50.0)
    robot.held = True
    robot.em.run_by_itself()
    robot.begun()
    robot.accept(1)
    robot.run_em()
    robot.until(lambda: len(robot.searches) == 2)
    robot.begun().go_on.set()
    robot.settle()

    def last_map() -> Any:
        return [given[2:] for given in robot.published if given[0] == 'ml_map'][-1]

    robot.publishers.ml_map = shown = last_map()
    answer = robot.run_em()
    search, run = robot.begun(), robot.em.current
    assert run is not None and search.watch is not None
    while not run.map_shown:
        search.watch('search', PROGRESS)
    robot.cancel_em()
    robot.settle()
    assert answer.sent == [(False, 'EM was cancelled by cancel_em')]
    assert last_map() == shown != SO_FAR


def test_run_begins_while_an_earlier_one_is_being_checked(held: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, checking = threading.Event(), threading.Event()

    def slow(*given: Any) -> list[str]:
        checking.set()
        assert go_on.wait(60.0)
        return ['stamps are late']

    monkeypatch.setattr(consistency_check, 'consistency_warnings', slow)
    held.run_em()
    held.begun().go_on.set()
    held.until(checking.is_set)
    held.until(lambda: held.em.current is None)
    answer = held.run_em()
    held.begun()
    cancelled = held.cancel_em()
    held.until(lambda: cancelled.sent)
    assert answer.sent == [(False, 'EM was cancelled by cancel_em')] and held.em.wrong_input == []
    go_on.set()
    held.settle()
    assert held.em.wrong_input == ['stamps are late']


def test_intermediate_map_is_published_at_publish_rate(make: Callable[..., EmRobot]) -> None:
    robot = make(publish_rate=20.0)
    robot.held = True
    robot.run_em()
    search, run = robot.begun(), robot.em.current
    assert run is not None
    # other work on the machine may have delayed the search
    run.begin = time.monotonic()
    search.watch('search', PROGRESS)
    assert robot.published == [], 'it has just begun'
    begin = time.monotonic()
    while len(robot.published) < 4:
        search.watch('search', PROGRESS)
    assert 0.15 <= time.monotonic() - begin < 10.0
    assert any('3 nats' in text or 'iteration 1' in text for text in robot.node.warned)
    # no map if the search has none, nor while it is being cancelled
    robot.so_far = None
    end = time.monotonic() + 0.12
    while time.monotonic() < end:
        search.watch('search', PROGRESS)
    assert len(robot.published) == 4
    robot.so_far = SO_FAR
    robot.cancel_em()
    robot.settle()
    assert len([1 for name, *_ in robot.published if name == 'ml_map']) == 5, 'the map of before'


def test_long_stage_without_a_map_is_logged_repeatedly(held: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    held.run_em()
    search, run = held.begun(), held.em.current
    assert run is not None
    held.node.warned.clear()
    search.watch('trajectory', None)
    assert held.node.warned == []
    now = time.monotonic()
    for seconds, lines in ((9.9, 0), (10.1, 1), (15.0, 1), (20.0, 1), (20.2, 2)):
        monkeypatch.setattr(em_service.time, 'monotonic', lambda seconds=seconds: run.begin + seconds)
        search.watch('trajectory', None)
        assert len(held.node.warned) == lines, seconds
    monkeypatch.setattr(em_service.time, 'monotonic', lambda: now)
    monkeypatch.undo()
    assert all('trajectory of 5 readings' in text for text in held.node.warned) and held.published == []


def test_maps_are_published_after_their_trajectory_is_adopted(robot: EmRobot) -> None:
    robot.trajectory.in_map_frame = True
    robot.held = True
    robot.run_em()
    search = robot.begun()
    search.go_on.set()
    # the executor adopts the trajectory before the maps are published
    robot.until(lambda: robot.trajectory.adopted)
    robot.settle()
    assert robot.trajectory.adopted == [(None, 5)]
    assert [name for name, *_ in robot.published] == ['ml_map', 'uncertainty_map']
    # a trajectory of before a reset is not adopted
    robot.run_em()
    search = robot.begun()
    search.cancel = search.go_on.set  # type: ignore[method-assign]
    robot.publishers.generation += 1
    robot.em.reset()
    robot.settle()
    assert len(robot.trajectory.adopted) == 1 and len(robot.published) == 2


def test_run_gives_the_refiner_the_drive_and_newer_readings(held: EmRobot) -> None:
    held.run_em()
    held.begun()
    held.accept(4)
    ((drive, now),) = held.trajectory.asked
    assert len(drive().readings) == 5
    found: list[Any] = []
    held.em.worker.worker.put(lambda: None)

    thread = threading.Thread(target=lambda: found.append(now()))
    thread.start()
    held.until(lambda: found)
    thread.join(60.0)
    assert len(found[0].readings) == 9 and found[0].odometry.pose.shape == (0, 3)
    held.searches[0].go_on.set()
    held.settle()


def online_map(start: Any) -> Any:
    calls: list[Any] = []
    return SimpleNamespace(so_far=lambda: start, adopt=calls.append, show=lambda: calls.append('show'), calls=calls)


def test_run_starts_from_the_online_map_and_updates_it(robot: EmRobot) -> None:
    robot.em.online = online = online_map('the map so far')
    robot.run_em()
    robot.settle()
    assert robot.searches[0].start == 'the map so far' and online.calls == [robot.em.maps]
    # not along another trajectory, since the online map is at the poses of odometry
    robot.trajectory.correction = object()
    robot.error = MemoryError()
    robot.run_em()
    robot.settle()
    assert robot.searches[1].start is None and online.calls[1:] == ['show']


def test_contradictions_are_checked_after_the_response_and_logged(robot: EmRobot) -> None:
    robot.warnings, robot.contradictions = ['copies'], ['stamps are late', 'mirrored']
    robot.run_em()
    robot.settle()
    assert robot.checked == [(5, {'sonar': (0.1, 0.0, 0.0)})]
    assert robot.em.wrong_input == ['copies', 'stamps are late', 'mirrored']
    assert robot.node.warned[-2:] == ['EM: stamps are late', 'EM: mirrored']


def test_contradictions_of_deleted_maps_are_not_logged(robot: EmRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    def reset_meanwhile(*given: Any) -> list[str]:
        robot.inbox.put(robot.em.reset)
        return ['mirrored']

    monkeypatch.setattr(consistency_check, 'consistency_warnings', reset_meanwhile)
    robot.run_em()
    robot.settle()
    assert robot.em.maps is None and robot.em.wrong_input == []
    assert 'EM: mirrored' not in robot.node.warned


def test_halves_that_contradict_each_other_give_a_warning(robot: EmRobot) -> None:
    robot.halves = 0.06
    for values, corrected, words in (
        ({}, None, 'jumps (refine_poses corrects this)'),
        ({'refine_poses': True}, None, 'jumps (no better trajectory was found)'),
        ({'refine_poses': True}, object(), ''),
    ):
        robot.parameters, robot.trajectory.correction = Parameters.from_flat(values), corrected
        robot.run_em()
        robot.settle()
        assert len(robot.em.wrong_input) == bool(words) and all(words in text for text in robot.em.wrong_input)


def test_jump_of_odometry_is_named_in_the_response(robot: EmRobot) -> None:
    for k in range(40):
        # 5 cm each, and 4.2 m to the left after 19 of them
        robot.associator.add_odometry(
            OdometryMessage(k * 50_000_000, 'odom', 'base', Pose2(0.05 * k, 4.2 * (k > 19), 0.0))
        )
    answer = robot.run_em()
    robot.settle()
    assert 'WARNING: odometry jumps once, by 4.2 m after 1 m of driving' in answer.sent[0][1]
    # the report has it as well
    assert len(robot.em.drive_faults) == 1 and robot.em.drive_faults == robot.em.wrong_input
    robot.em.reset()
    assert not robot.em.drive_faults


def test_wrong_stamps_of_sensors_are_named_in_the_response(robot: EmRobot) -> None:
    robot.em.clock_notes = lambda: ['the stamps of sonar are 2.5 s behind']
    answer = robot.run_em()
    robot.settle()
    assert 'WARNING: the stamps of sonar are 2.5 s behind' in answer.sent[0][1]


def test_rejected_readings_are_named_in_the_response(robot: EmRobot) -> None:
    robot.associator.received = 100
    robot.associator.rejected['pose_jump'] = 90
    answer = robot.run_em()
    robot.settle()
    assert 'WARNING: 90 of 100 readings were rejected as pose_jump' in answer.sent[0][1]
    # diagnostics have those of the last seconds
    assert not robot.em.wrong_input


def test_faults_of_the_messages_are_named_in_the_response(robot: EmRobot) -> None:
    for k in range(100):
        robot.associator.add_range(RangeMessage(k + 1, f'sonar_{k % 4}', 10.0 + k, 0.1, 4.0, 0.3))
    answer = robot.run_em()
    robot.settle()
    assert 'WARNING: 100 of 100 examined ranges are larger than max_range (4 m)' in answer.sent[0][1]


def test_two_sources_of_odometry_are_named_in_the_response(robot: EmRobot) -> None:
    for k in range(40):
        robot.associator.add_odometry(
            OdometryMessage(k * 50_000_000, 'odom', 'base', Pose2(0.05 * k, 50.0 * (k % 2), 0.0))
        )
    answer = robot.run_em()
    robot.settle()
    assert 'WARNING: poses jump back and forth, by 50.00 m in 39 of 39 steps; do two nodes' in answer.sent[0][1]


def test_answer_names_odometry_that_was_rejected(robot: EmRobot) -> None:
    robot.associator.odometry_received = 100
    robot.associator.odometry_rejected.update(other_frame=50, bad_pose=1)
    answer = robot.run_em()
    robot.settle()
    message = answer.sent[0][1]
    assert 'WARNING: 50 of 100 odometry messages were rejected: the frame_id or child_frame_id is not' in message
    # a few of a long drive are no fault of the map
    assert 'quaternion' not in message


def test_consistency_is_checked_again_when_the_readings_have_doubled(robot: EmRobot) -> None:
    robot.contradictions = ['stamps are late']

    def checks() -> int:
        robot.node.warned.clear()
        robot.run_em()
        robot.settle()
        assert robot.em.wrong_input == ['stamps are late']
        return len(robot.checked)

    assert checks() == 1
    robot.accept(4)
    assert checks() == 1 and 'EM: stamps are late' not in robot.node.warned
    robot.accept(1)
    assert checks() == 2
    robot.parameters = Parameters.from_flat({'threads': 1})
    assert checks() == 3
    robot.em.extrinsics = lambda: {'sonar': Pose2(0.2, 0.0, 0.0)}
    assert checks() == 4
    robot.trajectory.correction = object()
    assert checks() == 5
    robot.em.reset()
    assert checks() == 6


def test_closing_cancels_the_run(held: EmRobot) -> None:
    held.run_em()
    search = held.begun()
    held.em.close(10.0)
    assert search.cancelled


@pytest.mark.parametrize(
    ('received', 'rejected', 'expected'),
    [
        (0, {}, 'no Range message has been received on /sonar, /left since'),
        (7, {}, '7 readings have been received, and wait for their poses'),
        (1, {}, '1 reading has been received, and waits for its pose'),
        (9, {'nan_range': 2, 'below_min_range': 7}, '7 of 9 readings were rejected as below_min_range: the range is'),
    ],
)
def test_run_without_readings_fails_with_reason(
    make: Callable[..., EmRobot], received: int, rejected: dict[str, int], expected: str
) -> None:
    robot = make(count=0)
    robot.em.range_topics = ['/sonar', '/left']
    robot.error = InputError('there is no reading to map')
    robot.associator.received, robot.associator.odometry_received = received, 5
    robot.associator.rejected.update(rejected)
    answer = robot.run_em()
    robot.settle()
    ((success, message),) = answer.sent
    assert not success and message.startswith('there is nothing to map: ') and expected in message


@pytest.mark.parametrize('waiting', [False, True])
def test_run_without_odometry_fails_with_that_reason(make: Callable[..., EmRobot], waiting: bool) -> None:
    for came, refused, expected in (
        (0, {}, 'no Odometry message has been received on /wheels since the start or reset'),
        (8, {'long_frame_id': 3, 'bad_pose': 5}, 'all 8 odometry messages were rejected as bad_pose: the pose is not'),
        (
            9,
            {'bad_pose': 5},
            '9 readings have been received, and wait'
            if waiting
            else '6 of 9 readings were rejected as no_odometry: odometry, or its transform',
        ),
    ):
        robot = make(count=0)
        robot.em.odom_topic = '/wheels'
        robot.error = InputError('there is no reading to map')
        robot.associator.received, robot.associator.odometry_received = 9, came
        robot.associator.rejected.update({} if waiting else {'no_odometry': 6})
        robot.associator.odometry_rejected.update(refused)
        answer = robot.run_em()
        robot.settle()
        ((success, message),) = answer.sent
        assert not success and message.startswith(f'there is nothing to map: {expected}')


def test_odometry_waiting_for_a_localiser_is_named_as_the_reason(make: Callable[..., EmRobot]) -> None:
    lack = 'TF has no transform from map (map_frame) to odom'
    for came, rejected, expected in (
        (0, {'no_odometry': 9}, lack),
        (0, {}, lack),
        (0, {'nan_range': 9}, '9 of 9 readings were rejected as nan_range'),
        (5, {'no_odometry': 9}, '9 of 9 readings were rejected as no_odometry'),
    ):
        robot = make(count=0)
        robot.em.odom_topic, robot.em.no_map_frame = '/odom', lambda: lack
        robot.error = InputError('there is no reading to map')
        robot.associator.received, robot.associator.odometry_received = 9, came
        robot.associator.rejected.update(rejected)
        answer = robot.run_em()
        robot.settle()
        ((_, message),) = answer.sent
        assert message.startswith(f'there is nothing to map: {expected}')


def test_call_that_waits_for_kernels_is_logged(robot: EmRobot) -> None:
    line = 'run_em waits for the compilation of kernels, as at the first start'
    robot.compiled.clear()
    robot.run_em()
    assert robot.node.warned == [line]
    # a rejected call does not wait
    assert robot.run_em().sent[0][1].startswith('EM is already running')
    assert robot.node.warned == [line]
    robot.compiled.add('EM')
    robot.settle()
    robot.run_em()
    robot.settle()
    assert robot.node.warned.count(line) == 1
