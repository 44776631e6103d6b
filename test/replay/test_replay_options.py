"""Options of `replay_bag`, and errors before it publishes."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from replay_samples import ODOMETRY, RANGE, START, write_bag

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import replay_bag
from forward_grid_mapper.core.common.errors import MapperError, ParameterError
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.replay import publishers as publishing
from forward_grid_mapper.replay import stop_signal
from forward_grid_mapper.replay.publishers import renamed
from forward_grid_mapper.replay.stop_signal import StopSignal

TOPICS = {'/sonar': RANGE, 'odom': ODOMETRY}


@pytest.mark.parametrize(
    ('options', 'named'),
    [
        (['--rate', '0'], '--rate'),
        (['--rate', 'fast'], '--rate'),
        (['--rate', 'nan'], '--rate'),
        (['--clock', '-1'], '--clock'),
        (['--wait', 'inf'], '--wait'),
        (['--loop', '0'], '--loop'),
        (['--reliable', '--best-effort'], '--best-effort'),
    ],
)
def test_wrong_option_is_rejected_by_name(capsys: pytest.CaptureFixture[str], options: list[str], named: str) -> None:
    with pytest.raises(SystemExit) as leaving:
        replay_bag.main(['bag', *options])
    assert leaving.value.code == 2
    assert named in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize('option', ['--loop', '--clock'])
def test_bag_taken_as_the_value_of_an_option_is_reported(capsys: pytest.CaptureFixture[str], option: str) -> None:
    with pytest.raises(SystemExit):
        replay_bag.main([option, 'drive'])
    assert 'the bag goes before the options' in capsys.readouterr().err


def test_missing_bag_is_reported(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert replay_bag.main([str(tmp_path / 'none')]) == 1
    assert 'does not exist' in capsys.readouterr().err


def test_several_odometry_topics_require_a_choice(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_range('/sonar', RangeMessage(START, 'sonar_0', 1.0, 0.1, 5.0, 0.25))
        for topic in ('/odom', '/wheels'):
            writer.write_odometry(topic, OdometryMessage(START, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0)))
    assert replay_bag.main([str(tmp_path / 'bag')]) == 1
    err = capsys.readouterr().err
    assert '--odom-topic' in err
    assert '/wheels' in err


def test_missing_ros_is_reported_with_a_remedy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    assert replay_bag.main([str(write_bag(tmp_path))]) == 1
    err = capsys.readouterr().err
    assert "pip install 'forward_grid_mapper[ros]'" in err
    assert 'Traceback' not in err


def test_topics_keep_their_names_with_a_leading_slash() -> None:
    assert renamed(TOPICS, []) == {'/sonar': '/sonar', 'odom': '/odom'}


def test_topics_are_remapped_with_or_without_slash() -> None:
    assert renamed(TOPICS, ['sonar:=a/b', '/odom:=/c']) == {'/sonar': '/a/b', 'odom': '/c'}


@pytest.mark.parametrize(
    ('remap', 'reported'),
    [
        ('/sonar', 'OLD:=NEW'),
        (':=/sonar', 'OLD:=NEW'),
        ('/sonar:=', 'OLD:=NEW'),
        ('/other:=/sonar', '/odom, /sonar'),
        ('/sonar:=/odom', 'two types'),
    ],
)
def test_wrong_remapping_is_reported(remap: str, reported: str) -> None:
    with pytest.raises(ParameterError, match=reported):
        renamed(TOPICS, [remap])


def test_ros_arguments_are_split_as_in_ros() -> None:
    given = ['bag', '--ros-args', '-r', 'a:=b', '--', '--rate', '2', '--ros-args', '--log-level', 'debug']
    own, ros = replay_bag.split_ros_arguments(given)
    assert own == ['bag', '--rate', '2']
    assert ros == ['--ros-args', '-r', 'a:=b', '--', '--ros-args', '--log-level', 'debug']


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_a_wait_at_once_and_a_second_one_has_no_effect(number: signal.Signals) -> None:
    before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)}
    try:
        with StopSignal() as stop:
            assert not stop.wait(0.01)
            threading.Timer(0.1, signal.raise_signal, [number]).start()
            begin = time.monotonic()
            assert stop.wait(20.0)
            assert time.monotonic() - begin < 5.0
            signal.raise_signal(signal.SIGINT)
            assert stop.is_set()
        signal.raise_signal(number)
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def terminated_soon() -> Iterator[None]:
    """Send SIGTERM to this process in a moment; the block must handle it."""
    before = {number: signal.getsignal(number) for number in stop_signal.SIGNALS}
    timer = threading.Timer(0.3, signal.raise_signal, [signal.SIGTERM])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize('seconds', [1e10, 1e300, math.inf])
def test_signal_ends_a_wait_of_any_length(seconds: float) -> None:
    with terminated_soon(), StopSignal() as stop:
        assert stop.wait(seconds)


def test_long_wait_ends_at_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_signal, 'AT_ONCE', 0.01)
    begin = time.monotonic()
    with StopSignal() as stop:
        assert not stop.wait(0.1)
    assert time.monotonic() - begin >= 0.1


@pytest.mark.parametrize('rate', ['1e-20', '5e-324'])
def test_replay_at_a_very_low_rate_waits_until_it_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: str
) -> None:
    monkeypatch.setattr(replay_bag, 'Publishers', Publishers)
    monkeypatch.setattr(replay_bag, 'message_class', lambda msgtype: object)
    bag = str(with_joint(tmp_path))
    with terminated_soon():
        assert replay_bag.main([bag, '--wait', '0', '-q', '--rate', rate]) == 0
    assert [topic for topic, _ in Publishers.published] == ['/odom', '/tf']


def test_replay_under_nohup_survives_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignal() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.wait(0.1)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signal_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopSignal() as stop:
        assert signal.getsignal(signal.SIGINT) != before
        assert not stop.is_set()
    assert signal.getsignal(signal.SIGINT) == before


class Publishers:
    """Records what the command publishes, without ROS."""

    added: ClassVar[dict[str, tuple[str, bool, int]]] = {}
    published: ClassVar[list[tuple[str, Any]]] = []

    def __init__(self, *arguments: Any) -> None:
        self.added.clear()
        self.published.clear()

    def __enter__(self) -> Publishers:
        return self

    def __exit__(self, *arguments: object) -> None:
        pass

    def add(self, topic: str, msgtype: str, latched: bool = False, depth: int = 0) -> None:
        self.added[topic] = msgtype, latched, depth

    def publish(self, topic: str, source: Any) -> None:
        self.published.append((topic, source))

    def finish(self) -> None:
        pass


class TransformWriter(BagWriter):
    """Writes transforms to any topic."""

    def write_transform(self, topic: str, child: str, pose: Pose2, stamp: int) -> None:
        posed, kind = self._pose(pose), 'geometry_msgs/msg/TransformStamped'
        offset = self._make('geometry_msgs/msg/Vector3', x=pose.x, y=pose.y, z=0.0)
        transform = self._make('geometry_msgs/msg/Transform', translation=offset, rotation=posed.orientation)
        item = self._make(
            kind, header=self._header(topic, stamp, 'base_link'), child_frame_id=child, transform=transform
        )
        self._write(topic, 'tf2_msgs/msg/TFMessage', self._make('tf2_msgs/msg/TFMessage', transforms=[item]), stamp)


def with_joint(folder: Path) -> Path:
    """A bag of a sensor on a joint, whose transform is on /tf."""
    with TransformWriter(folder / 'bag') as writer:
        for k in range(4):
            stamp = START + k * 1_000_000
            writer.write_odometry('/odom', OdometryMessage(stamp, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0)))
            writer.write_transform('/tf', 'servo', Pose2(0.1, 0.0, 0.1 * k), stamp + 1)
            writer.write_range('/sonar', RangeMessage(stamp + 2, 'servo', 1.0, 0.125, 5.0, 0.25))
    return folder / 'bag'


def test_moving_transforms_are_replayed_between_the_readings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_bag, 'Publishers', Publishers)
    monkeypatch.setattr(replay_bag, 'message_class', lambda msgtype: object)
    options = ['--wait', '0', '-q', '--best-effort', '--remap', '/tf:=/robot/tf']
    assert replay_bag.main([str(with_joint(tmp_path)), *options]) == 0
    assert Publishers.added['/robot/tf'] == ('tf2_msgs/msg/TFMessage', False, replay_bag.TF_DEPTH)
    assert [topic for topic, _ in Publishers.published] == ['/odom', '/robot/tf', '/sonar'] * 4
    assert [m.transforms[0].child_frame_id for topic, m in Publishers.published if topic == '/robot/tf'] == [
        'servo'
    ] * 4


def test_transforms_are_reliable_and_wait_for_no_subscribers() -> None:
    qos = pytest.importorskip('rclpy.qos', reason='rclpy is not installed')
    made: list[Any] = []
    publishers: Any = publishing.Publishers([], False, StopSignal())
    publishers._node = SimpleNamespace(create_publisher=lambda kind, topic, quality: made.append(quality))
    publishers.add('/tf', 'geometry_msgs/msg/TransformStamped', depth=100)
    (quality,) = made
    assert (quality.reliability, quality.durability) == (qos.ReliabilityPolicy.RELIABLE, qos.DurabilityPolicy.VOLATILE)
    assert (quality.history, quality.depth) == (qos.HistoryPolicy.KEEP_LAST, 100)


def test_missing_tf2_gives_a_warning_about_moving_transforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(msgtype: str) -> type:
        raise MapperError('No module named tf2_msgs')

    monkeypatch.setattr(replay_bag, 'Publishers', Publishers)
    monkeypatch.setattr(replay_bag, 'message_class', missing)
    bag = str(with_joint(tmp_path))
    assert replay_bag.main([bag, '--wait', '0']) == 0
    assert '/tf is not replayed (No module named tf2_msgs)' in capsys.readouterr().err
    assert [topic for topic, _ in Publishers.published] == ['/odom', '/sonar'] * 4
    assert replay_bag.main([bag, '--wait', '0', '-q']) == 0
    assert not capsys.readouterr().err
