"""Options of `replay_bag`, and errors before it publishes."""

from __future__ import annotations

import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from replay_samples import ODOMETRY, RANGE, START, write_bag

from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.commands import replay_bag
from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
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


def test_signal_ends_a_wait_at_once_and_a_second_one_has_no_effect() -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        with StopSignal() as stop:
            assert not stop.wait(0.01)
            threading.Timer(0.1, signal.raise_signal, [signal.SIGTERM]).start()
            begin = time.monotonic()
            assert stop.wait(20.0)
            assert time.monotonic() - begin < 5.0
            signal.raise_signal(signal.SIGINT)
            assert stop.is_set()
        signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_signal_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopSignal() as stop:
        assert signal.getsignal(signal.SIGINT) != before
        assert not stop.is_set()
    assert signal.getsignal(signal.SIGINT) == before
