"""The parts of the node from inside: nothing blocks the executor for long, and all calls get responses."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from inside import Inside

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.messages import reading_buffer
from forward_grid_mapper.core.messages.reading_buffer import ReadingBuffer
from forward_grid_mapper.core.online_map import OnlineMap
from forward_grid_mapper.core.trajectory.following import Follower
from forward_grid_mapper.files.journal_format import Contents
from forward_grid_mapper.files.journal_reader import read
from forward_grid_mapper.node import consistency_check, em, main, map_publishers, saver
from forward_grid_mapper.node.intake import AT_ONCE
from forward_grid_mapper.node.mapper_node import MapperNode
from forward_grid_mapper.node.run_input import RunInput

OK, WARN = b'\x00', b'\x01'

LONG_WORK: tuple[tuple[Any, str], ...] = (
    *((LogOddsMap, name) for name in ('add', 'probability', 'log_odds')),
    *((OnlineMap, name) for name in ('add', 'maps', 'searched', 'adopt', 'dismantle')),
    *((Mapper, name) for name in ('run', 'so_far')),
    *((reading_buffer, name) for name in ('kept', 'bounded')),
    *((em, name) for name in ('sensor_health', 'input_warnings', 'map_grid')),
    (consistency_check, 'consistency_warnings'),
    (Follower, 'follow'),
    (map_publishers, 'grid_message'),
    (saver, 'write_results'),
)
"""Functions whose time grows with the number of readings or the size of the map."""


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of long work that was done by the thread of the test, which turns the executor."""
    found: list[str] = []
    executor = threading.get_ident()

    def watch(owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            if threading.get_ident() == executor:
                found.append(name)
            return original(*arguments, **options)

        monkeypatch.setattr(owner, name, counted)

    for owner, name in LONG_WORK:
        watch(owner, name)
    return found


def test_executor_does_no_long_work(inside: Callable[..., Inside], watched: list[str], tmp_path: Path) -> None:
    options = {'online': True, 'max_readings': 400, 'journal': str(tmp_path / 'journal'), 'publish_rate': 50.0}
    for _ in range(2):
        robot = inside(**options)
        node = robot.node
        robot.node.start()
        # the empty maps of the start have one cell each
        watched.clear()
        robot.until(lambda node=node: node.mapping)
        robot.drive(len(node.associator.buffer), 1000)
        robot.until(lambda node=node: node.associator.buffer.stored < 460)
        robot.until(lambda node=node: node.maps.latest['ml_map'].info.width)
        assert robot.call(node.em.run_em)[0]
        assert robot.call(node.saver.save_maps)[0]
        robot.set(p_hit=0.6, publish_rate=40.0)
        robot.status('readings')
        node.publish_live()
        robot.call(lambda answer, node=node: node.maps._get('live_map', answer))
        held = len(node.associator.buffer)
        robot.close()
    assert held == 2000
    assert watched == []
    robot = inside(**options).start()
    watched.clear()
    robot.call(robot.node.reset)
    assert watched == []


def test_contradictory_poses_are_reported_after_the_response(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: list[Any] = []
    go_on = threading.Event()

    def contradiction(readings: Readings, extrinsics: Any, parameters: Any) -> list[str]:
        checked.append((len(readings), dict(extrinsics)))
        assert go_on.wait(60.0)
        return ['stamps are late']

    monkeypatch.setattr(consistency_check, 'consistency_warnings', contradiction)
    robot = inside().start()
    node = robot.node
    robot.drive(0, 60)
    assert robot.call(node.em.run_em)[0]
    robot.until(lambda: checked)
    assert checked == [(len(node.associator.buffer), {'sonar': (0.1, 0.0, 0.4)})]
    assert 'stamps are late' not in node.em.wrong_input
    go_on.set()
    robot.until(lambda: 'stamps are late' in node.em.wrong_input)
    assert 'stamps are late' in str(robot.status('readings'))
    # results for deleted maps are dropped
    go_on.clear()
    robot.drive(60, 200)
    assert robot.call(node.em.run_em)[0]
    robot.until(lambda: len(checked) == 2)
    robot.call(node.reset)
    go_on.set()
    robot.until(lambda: not node.em.check_worker.waiting)
    robot.executor.spin_once(timeout_sec=0.01)
    assert node.em.wrong_input == []


def test_em_maps_readings_received_during_compilation(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside().start()
    node = robot.node
    compiled = threading.Event()
    monkeypatch.setattr(node.kernels, 'has', lambda name: False)
    monkeypatch.setattr(node.em.worker, '_prepare', lambda stop: compiled.wait(60.0))
    robot.drive(0, 20)
    answers: list[Any] = []
    node.em.run_em(SimpleNamespace(send=lambda *answer: answers.append(answer)))
    robot.drive(20, 30)
    compiled.set()
    robot.until(lambda: answers)
    assert answers[0][0]
    assert answers[0][1].startswith('50 readings')
    assert node.em.accepted_at_run == 50


def test_em_fails_if_newer_readings_do_not_fit_into_memory(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside().start()
    node = robot.node
    robot.drive(0, 20)
    monkeypatch.setattr(node.kernels, 'has', lambda name: False)
    taken, take = iter([True]), RunInput._take

    def once(data: RunInput) -> Any:
        if next(taken, False):
            return take(data)
        raise MemoryError

    monkeypatch.setattr(RunInput, '_take', once)
    success, message = robot.call(node.em.run_em)
    assert not success and 'does not fit into the memory' in message


def test_call_that_fails_after_the_start_does_not_block_others(inside: Callable[..., Inside]) -> None:
    robot = inside()
    robot.node.start()
    responses: list[Any] = []

    def fail(reply: Any) -> None:
        raise KeyError('odd')

    reply = SimpleNamespace(fail=responses.append, send=lambda *fields: responses.append(fields[0]))
    for handler in (fail, robot.node.reset):
        robot.node._answer_when_ready(handler, reply)
    robot.until(lambda: len(responses) == 2)
    assert responses == ["it failed: KeyError('odd')", True]


def test_services_do_not_wait_for_the_online_map(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The online map is busy with readings for very long."""
    busy, go_on = threading.Event(), threading.Event()
    add = OnlineMap.add

    def slow(self: OnlineMap, readings: Readings) -> None:
        if len(readings) < 24:
            busy.set()
            assert go_on.wait(200.0)
        add(self, readings)

    robot = inside(online=True).start()
    monkeypatch.setattr(OnlineMap, 'add', slow)
    robot.drive(0, 20)
    robot.until(busy.is_set)
    node = robot.node
    assert robot.call(node.em.run_em)[0]
    robot.set(p_hit=0.6, p_lost=0.3)
    assert robot.call(node.saver.save_maps)[0]
    assert robot.call(node.reset)[0]
    robot.drive(20, 5)
    assert robot.call(node.em.run_em)[1].startswith('5 readings')
    go_on.set()
    robot.until(lambda: node.maps.latest['ml_map'].info.width > 1)


def test_waiting_messages_are_processed_in_portions(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    node = robot.node
    for k in range(3000):
        robot.range(100.0 + 0.001 * k)
    assert node.associator.waiting == 3000
    robot.odometry(99.0)
    robot.odometry(99.9)
    robot.odometry(100.5)
    robot.odometry(101.0)
    turns = 0
    while node.intake.busy:
        before = len(node.associator.buffer)
        node.intake.work()
        assert len(node.associator.buffer) - before <= 2 * AT_ONCE
        turns += 1
    assert turns >= 1000 // AT_ONCE - 2
    assert len(node.associator.buffer) == 1001


def test_messages_received_while_the_journal_is_read_wait(inside: Callable[..., Inside]) -> None:
    robot = inside()
    robot.node.start()
    assert not robot.node.mapping
    for k in range(50):
        robot.odometry(100.0 + 0.05 * k)
        robot.range(100.0 + 0.05 * k)
    readings = robot.status('readings')
    assert (readings['readings received'], readings['readings waiting for a pose']) == ('50', '50')
    early: list[Any] = []
    for handler in (robot.node.em.run_em, robot.node.saver.save_maps):
        robot.node._answer_when_ready(handler, SimpleNamespace(send=lambda *fields: early.append(fields)))
    robot.until(lambda: len(robot.node.associator.buffer) == 50)
    # the first call runs EM, the second one waits for its maps
    robot.until(lambda: len(early) == 2)
    assert all(fields[0] for fields in early)


def test_lost_messages_are_counted_and_reported(inside: Callable[..., Inside], tmp_path: Path) -> None:
    robot = inside(range_reliability='reliable').start()
    robot.drive(0, 50)
    assert robot.status('readings')['level'] == OK
    for k in range(50, 60):
        robot.odometry(100.0 + 0.05 * k)
        robot.range(100.0 + 0.05 * k, number=1000 + k)
    robot.until(lambda: not robot.node.intake.busy)
    readings = robot.status('readings')
    assert readings['readings lost in the middleware (estimated)'] == str(1050 - 50 - 1)
    assert readings['level'] == WARN
    assert '999 Range and 0 odometry messages so far were lost' in readings['message']
    saved = robot.call(robot.node.saver.save_maps)[1]
    folder = Path(saved.split(', ')[0]).parent
    report = json.loads((folder / 'report.json').read_text())
    counts = report['counts']
    assert counts['lost'] == 999
    assert counts['received'] == counts['accepted'] + counts['waiting'] + sum(counts['rejected'].values()) == 60
    assert any('999 Range' in warning for warning in report['warnings'])
    assert '999 before they were received (estimated)' in (folder / 'report.txt').read_text()
    assert robot.call(robot.node.reset)[0]
    assert robot.status('readings')['readings lost in the middleware (estimated)'] == '0'


def test_readings_received_just_before_a_reset_are_in_the_journal(
    inside: Callable[..., Inside], tmp_path: Path
) -> None:
    """The journal is written by a timer, and keeps what a reset deletes."""
    robot = inside(journal=str(tmp_path / 'journal')).start()
    robot.drive(0, 20)
    # without a turn of the executor
    for k in range(20, 25):
        robot.odometry(100.0 + 0.05 * k)
        robot.range(100.0 + 0.05 * k)
    assert robot.begin(robot.node.reset).sent[0][0]
    robot.close()
    kept = read(tmp_path / 'journal' / 'drive_0001.journal', Contents())
    assert sum(map(len, kept)) == 25


def test_parameters_of_the_association_change_at_run_time(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    node = robot.node
    robot.set(pose_timeout=7.0, sigma=0.5, max_jump=3.0)
    assert node._map_frame.timeout == 7.0
    robot.drive(0, 20)
    wide = robot.call(lambda answer: node.maps._get('live_map', answer))[0].info.width
    assert robot.call(node.reset)[0]
    robot.set(sigma=0.05)
    robot.drive(20, 20)
    narrow = robot.call(lambda answer: node.maps._get('live_map', answer))[0].info.width
    assert wide > narrow + 5
    robot.odometry(200.0, 9.9)
    robot.range(200.0)
    assert node.associator.rejected['far_from_map'] == 1


def test_higher_publish_rate_is_used_at_once(inside: Callable[..., Inside]) -> None:
    robot = inside(publish_rate=0.01).start()
    robot.drive(0, 20)
    assert robot.node.maps.latest['live_map'].info.width == 0
    robot.set(publish_rate=20.0)
    robot.until(lambda: robot.node.maps.latest['live_map'].info.width, 20.0)


def test_warning_at_nine_tenths_of_max_readings(inside: Callable[..., Inside]) -> None:
    robot = inside(max_readings=100).start()
    robot.drive(0, 89)
    assert robot.status('readings')['level'] == OK
    robot.drive(89, 3)
    readings = robot.status('readings')
    assert readings['level'] == WARN
    assert (
        '92 readings, and max_readings is 100: beyond it, the oldest are removed where readings are densest'
        in readings['message']
    )
    robot.drive(92, 8)
    assert robot.status('readings')['level'] == WARN, 'one more, and the first is removed'
    robot.drive(100, 22)
    assert robot.status('readings')['readings kept to map from'] == '100 of at most 100'


def test_share_of_rejected_readings_is_reported_with_reason(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    robot.drive(0, 20)
    robot.status('readings')
    robot.drive(20, 15)
    for k in range(5):
        robot.range(101.0, value=0.01 + 0.001 * k)
    readings = robot.status('readings')
    assert readings['level'] == WARN
    assert '5 of 20 readings were rejected in the last second, most of them as below_min_range' in readings['message']
    robot.drive(35, 15)
    assert '5 of 55 readings were rejected' in robot.status('readings')['message'], 'still many of ten seconds'
    robot.drive(50, 100)
    assert robot.status('readings')['level'] == OK


def test_report_warns_of_many_rejected_readings(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    robot.drive(0, 20)
    for k in range(10):
        robot.range(100.5, value=0.01 + 0.001 * k)
    saved = robot.call(robot.node.saver.save_maps)[1]
    warnings = json.loads((Path(saved.split(', ')[0]).parent / 'report.json').read_text())['warnings']
    assert any(each.startswith('10 of 30 readings were rejected as below_min_range') for each in warnings)


def test_sensor_with_nearly_all_readings_rejected_is_named(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    robot.drive(0, 300)
    for k in range(40):
        robot.range(100.0 + 0.05 * k, value=0.0, frame='left')
    warning = 'nearly all readings of left were rejected as below_min_range: '
    assert warning in robot.status('readings')['message']
    saved = robot.call(robot.node.saver.save_maps)[1]
    warnings = json.loads((Path(saved.split(', ')[0]).parent / 'report.json').read_text())['warnings']
    assert any(each.startswith(warning) for each in warnings)


class Gate:
    """Blocks a function until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> None:
        self.reached, self.open = threading.Event(), threading.Event()
        self.inside = self.most = 0
        self._lock = threading.Lock()
        self._original = getattr(owner, name)
        monkeypatch.setattr(owner, name, self._pass)

    def _pass(self, *arguments: Any, **options: Any) -> Any:
        with self._lock:
            self.inside += 1
            self.most = max(self.most, self.inside)
        self.reached.set()
        assert self.open.wait(200.0)
        try:
            return self._original(*arguments, **options)
        finally:
            with self._lock:
                self.inside -= 1


def test_two_calls_of_save_maps_are_done_one_after_the_other(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside().start()
    robot.drive(0, 20)
    assert robot.call(robot.node.em.run_em)[0]
    gate = Gate(monkeypatch, saver, 'write_results')
    answers: list[tuple[Any, ...]] = []
    for _ in range(3):
        robot.node.saver.save_maps(SimpleNamespace(send=lambda *fields: answers.append(fields)))
    robot.until(gate.reached.is_set)
    for _ in range(50):
        robot.executor.spin_once(timeout_sec=0.01)
    gate.open.set()
    robot.until(lambda: len(answers) == 3)
    assert gate.most == 1
    folders = {Path(message.split(', ')[0]).parent for success, message in answers if success}
    assert len(folders) == 3


def test_maps_of_a_run_before_a_reset_are_never_published(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search is done when reset is called, and can no longer be cancelled."""
    robot = inside(publish_rate=50.0).start()
    node = robot.node
    robot.drive(0, 20)
    shown: list[int] = []
    publish = node.maps._out['ml_map'].publish
    monkeypatch.setattr(
        node.maps._out['ml_map'], 'publish', lambda message: (shown.append(message.info.width), publish(message))
    )
    gate = Gate(monkeypatch, em, 'sensor_health')
    answers: list[tuple[Any, ...]] = []
    node.em.run_em(SimpleNamespace(send=lambda *fields: answers.append(fields)))
    waiting: list[tuple[Any, ...]] = []
    node.saver.save_maps(SimpleNamespace(send=lambda *fields: waiting.append(fields)))
    robot.until(gate.reached.is_set)
    robot.until(lambda: shown)
    assert robot.call(node.reset)[0]
    second: list[tuple[Any, ...]] = []
    node.em.run_em(SimpleNamespace(send=lambda *fields: second.append(fields)))
    assert not second[0][0] and 'being cancelled' in second[0][1]
    gate.open.set()
    robot.until(lambda: answers and waiting)
    assert answers == [(False, 'EM was cancelled by reset')]
    assert waiting == [(False, 'there is no map to save: EM was cancelled by reset')]
    node.maps.worker.ask(lambda: None)
    assert shown[-1] == 1
    assert node.em.maps is None
    assert robot.status('EM')['last run'] == 'EM was cancelled by reset'


def test_late_map_from_before_a_reset_is_dropped(inside: Callable[..., Inside]) -> None:
    robot = inside().start()
    node = robot.node
    robot.drive(0, 5)
    snapshot = node.live.snapshot()
    assert robot.call(node.reset)[0]
    node.feed.show_live(snapshot)
    node.maps.publish('ml_map', 0, snapshot.grid, np.zeros(snapshot.grid.shape, np.int8))
    node.maps.worker.ask(lambda: None)
    assert [message.info.width for message in node.maps.latest.values()] == [1, 1, 1]


def test_journal_is_closed_normally(inside: Callable[..., Inside], tmp_path: Path) -> None:
    folder = tmp_path / 'journal'
    robot = inside(journal=str(folder)).start()
    robot.drive(0, 30)
    robot.node.close()
    assert not list(folder.glob('*-wal'))
    with contextlib.closing(sqlite3.connect(folder / 'drive_0001.journal')) as database:
        assert database.execute('select count(*) from readings').fetchone()[0] > 0
    again = inside(journal=str(folder)).start()
    assert len(again.node.associator.buffer) == 30


def test_failing_worker_is_in_the_diagnostics_and_mapping_continues(
    inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = inside(online=True).start()
    node = robot.node
    add = OnlineMap.add

    def fail(self: OnlineMap, readings: Readings) -> None:
        raise MemoryError

    monkeypatch.setattr(OnlineMap, 'add', fail)
    robot.drive(0, 20)
    robot.until(lambda: node.online.worker.trouble)
    background = robot.status('background')
    assert background['level'] == WARN
    assert 'readings cannot be added to the online map: there is not enough memory' in background['message']
    monkeypatch.setattr(OnlineMap, 'add', add)
    assert robot.call(node.em.run_em)[0]
    robot.drive(20, 20)
    assert robot.call(node.reset)[0]
    assert robot.status('background')['level'] == OK


def test_thinning_without_memory_is_retried(inside: Callable[..., Inside], monkeypatch: pytest.MonkeyPatch) -> None:
    robot = inside(max_readings=80).start()
    original = reading_buffer.kept

    def fail(*arguments: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(reading_buffer, 'kept', fail)
    robot.drive(0, 91)
    robot.until(lambda: any(worker.trouble for worker in robot.node.workers))
    robot.until(lambda: not robot.node.associator.buffer._is_thinning)
    monkeypatch.setattr(reading_buffer, 'kept', original)
    robot.drive(91, 40)
    robot.until(lambda: robot.node.associator.buffer.stored < 100)
    assert len(robot.node.associator.buffer) == 131
    assert robot.status('background')['level'] == OK


def test_failing_callback_is_logged_and_the_node_continues() -> None:
    logged: list[str] = []
    turns = iter([ValueError('odd'), KeyError('odd too'), main._Stop()])

    class Executor:
        context = SimpleNamespace(ok=lambda: True)

        def spin(self) -> None:
            raise next(turns)

    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(error=logged.append))
    with pytest.raises(main._Stop):
        main._spin(Executor(), node)
    assert len(logged) == 1
    assert 'ValueError: odd' in logged[0] and 'mapping continues' in logged[0]


def test_buffer_of_the_node_is_thinned_in_the_background(inside: Callable[..., Inside]) -> None:
    """The live map still contains all readings."""
    robot = inside(max_readings=100).start()
    node = robot.node
    assert isinstance(node.associator.buffer, ReadingBuffer) and node.associator.buffer.run_in_background is not None
    robot.drive(0, 400)
    robot.until(lambda: node.associator.buffer.stored < 120)
    everything = LogOddsMap(node.parameters)
    lone = inside(max_readings=0).start()
    lone.drive(0, 400)
    everything.add(lone.node.associator.readings)
    node.feed.feed()
    found = node.live.snapshot()
    assert found.grid == everything.grid
    assert np.array_equal(found.probability, everything.probability(), equal_nan=True)


def test_reset_empties_the_published_maps_before_work_on_new_ones_begins() -> None:
    """Late subscribers get no forgotten map, and a run that is still going on belongs to the maps before."""
    done: list[str] = []

    def noting(*names: str) -> Any:
        return SimpleNamespace(**{name.partition(' ')[2]: partial(done.append, name) for name in names})

    journal = SimpleNamespace(take=partial(done.append, 'journal take'), reset=lambda: '; they are kept')
    associator = SimpleNamespace(buffer=range(7), clear=lambda parameters: done.append('readings clear'))
    node: Any = SimpleNamespace(
        parameters=None,
        journal=journal,
        associator=associator,
        _extrinsics=noting('poses forget'),
        intake=noting('intake forget'),
        trajectory=noting('trajectory begin'),
        maps=noting('maps clear'),
        em=noting('em reset'),
        feed=noting('feed reset'),
    )
    answers: list[tuple[bool, str]] = []
    reply: Any = SimpleNamespace(send=lambda *answer: answers.append(answer))
    MapperNode.reset(node, reply)
    assert answers == [(True, '7 readings and all maps were deleted; they are kept')]
    assert done[:2] == ['journal take', 'readings clear']
    assert set(done[2:5]) == {'poses forget', 'intake forget', 'trajectory begin'}
    assert done[5] == 'maps clear' and set(done[6:]) == {'em reset', 'feed reset'}
