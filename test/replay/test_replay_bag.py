"""`replay_bag` over DDS, received by another process."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from replay_samples import CLOCK, ODOMETRY, RANGE, SENSORS, START, Wire, messages_in, wire, write_bag

from forward_grid_mapper.core.messages.message_types import NANOSECONDS, stamp_of


@pytest.fixture
def dds(domain: int) -> Iterator[Wire]:
    with wire(domain) as made:
        yield made


def stamps_of(messages: list[Any]) -> list[int]:
    return [stamp_of(message.header) for message in messages]


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
def test_all_messages_arrive_unchanged_and_in_order(dds: Wire, tmp_path: Path, kind: str) -> None:
    bag = write_bag(tmp_path, kind)
    listener = dds.listen()
    code, out, err = listener.receive(dds.replay(bag, '--rate', 10))
    assert code == 0, err
    assert '40 Range and 40 Odometry' in out
    assert listener.plain == messages_in(bag)
    for topic in SENSORS:
        stamps = [
            message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec for message in listener.on(topic)
        ]
        assert stamps == sorted(stamps)
    assert all(message.radiation_type == 0 for message in listener.on('/sonar'))


def test_best_effort_listener_receives_all_messages(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, topic=lambda frame: f'/{frame}')
    topics = {'/sonar_0': RANGE, '/sonar_1': RANGE, '/odom': ODOMETRY}
    listener = dds.listen(topics, reliable=False)
    code, _, err = listener.receive(dds.replay(bag, '--rate', 10, '--best-effort'))
    assert code == 0, err
    assert listener.plain == messages_in(bag)
    assert {message.header.frame_id for message in listener.on('/sonar_1')} == {'sonar_1'}


@pytest.mark.slow
def test_all_messages_of_a_real_drive_arrive(dds: Wire, shared: Path) -> None:
    bag = shared / 'data' / 'office_a' / 'bag'
    options = ('--odom-topic', '/odom', '--rate', 60)
    listener = dds.listen({**{f'/sonar_{i}': RANGE for i in range(8)}, '/odom': ODOMETRY})
    code, _, err = listener.receive(dds.replay(bag, *options))
    assert code == 0, err
    assert sorted(map(repr, listener.plain)) == sorted(map(repr, messages_in(bag, '/odom')))


def test_replay_follows_the_stamps_in_real_time(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, count=5, period=1.0)
    arrived = []
    listener = dds.listen(reliable=False)
    replay = dds.replay(bag, '--rate', 4)
    while replay.running:
        count = len(listener.on('/odom'))
        listener.spin(until=lambda count=count: len(listener.on('/odom')) > count or not replay.running)
        arrived.append(time.monotonic())
    # four gaps of a quarter of a second; a busy machine may be slower
    assert 0.8 < arrived[4] - arrived[0] < 4.0
    assert replay.end()[0] == 0


def test_clock_follows_the_bag_and_ticks_between_messages(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, count=5, period=1.0)
    listener = dds.listen({**SENSORS, '/clock': CLOCK})
    code, _, err = listener.receive(dds.replay(bag, '--rate', 4, '--clock', 20))
    assert code == 0, err
    times = [NANOSECONDS * message.clock.sec + message.clock.nanosec for message in listener.on('/clock')]
    assert times == sorted(times)
    last = START + 4 * NANOSECONDS + 1000
    assert times[0] == START
    assert times[-1] == last
    # five ticks in the second between two messages, if the machine is not busy
    assert 14 < len(times) < 45
    assert max(b - a for a, b in pairwise(times)) < 0.95 * NANOSECONDS


@pytest.mark.slow
def test_bag_is_played_the_given_number_of_times(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, count=10)
    listener = dds.listen({**SENSORS, '/clock': CLOCK})
    code, out, err = listener.receive(dds.replay(bag, '--rate', 10, '--loop', 2, '--clock'))
    assert code == 0, err
    assert '20 Range and 20 Odometry' in out
    assert stamps_of(listener.on('/odom')) == 2 * [START + i * NANOSECONDS // 10 for i in range(10)]
    times = [NANOSECONDS * message.clock.sec + message.clock.nanosec for message in listener.on('/clock')]
    assert sum(b < a for a, b in pairwise(times)) == 1


def test_replay_waits_for_subscribers_of_all_topics(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path)
    early = dds.listen({'/sonar': RANGE}, reliable=False)
    replay = dds.replay(bag, '--rate', 20)
    until = time.monotonic() + 2.5
    early.spin(until=lambda: time.monotonic() > until)
    assert not early.got
    late = dds.listen({'/odom': ODOMETRY}, reliable=False)
    late.spin(until=lambda: len(late.got) == 40)
    early.spin(until=lambda: len(early.got) == 40)
    assert replay.end()[0] == 0


def test_replay_without_subscribers_fails_with_the_topics(dds: Wire, tmp_path: Path) -> None:
    code, out, err = dds.replay(write_bag(tmp_path), '--wait', 0.2).end()
    assert (code, out) == (1, '')
    assert 'Traceback' not in err
    assert '/sonar: no node subscribes to sensor_msgs/msg/Range' in err
    assert '/odom: no node subscribes to nav_msgs/msg/Odometry' in err
    assert '--remap' in err


@pytest.mark.slow
def test_replay_with_incompatible_subscribers_fails_with_reason(dds: Wire, tmp_path: Path) -> None:
    listener = dds.listen({'/robot/odom': ODOMETRY, '/sonar': RANGE})
    replay = dds.replay(write_bag(tmp_path), '--wait', 8, '--best-effort')
    code, _, err = listener.receive(replay)
    assert code == 1
    assert '/odom: nav_msgs/msg/Odometry has subscribers on /robot/odom' in err
    assert '/sonar: listener requests reliable' in err


def test_topics_can_be_remapped(dds: Wire, tmp_path: Path) -> None:
    bag = write_bag(tmp_path)
    listener = dds.listen({'/robot/odom': ODOMETRY, '/robot/sonar': RANGE}, reliable=False)
    options = ('--rate', 20, '--remap', 'odom:=/robot/odom', '--ros-args', '-r', '/sonar:=/robot/sonar')
    code, _, err = listener.receive(dds.replay(bag, *options))
    assert code == 0, err
    assert listener.plain == messages_in(bag)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_second_signal_ends_the_replay_normally(dds: Wire, tmp_path: Path, number: signal.Signals) -> None:
    listener = dds.listen()
    replay = dds.replay(write_bag(tmp_path), '--loop')
    listener.spin(until=lambda: len(listener.got) > 4)
    replay.signal(number)
    time.sleep(0.02)
    replay.signal(number)
    code, out, err = replay.end(10)
    assert code == 0, err
    assert out.startswith('stopped after')
    assert 'Traceback' not in err


def test_replay_can_be_stopped_while_it_waits(dds: Wire, tmp_path: Path) -> None:
    replay = dds.replay(write_bag(tmp_path))
    # a subscriber of one topic is not sufficient to begin
    listener = dds.listen({'/sonar': RANGE})
    listener.spin(until=lambda: listener.publisher_of('/odom'))
    replay.signal(signal.SIGINT)
    code, out, err = replay.end()
    assert code == 0, err
    assert 'stopped after 0 Range' in out


def test_replay_without_tf2_warns_of_missing_sensor_poses(dds: Wire, tmp_path: Path) -> None:
    try:
        import tf2_msgs.msg  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip('tf2_msgs is installed')
    code, _, err = dds.replay(write_bag(tmp_path), '--wait', 0, '--rate', 100).end()
    assert code == 0
    assert 'static transforms are not replayed' in err
    assert 'sensors.FRAME.pose' in err


def test_late_subscriber_receives_static_transforms(dds: Wire, tmp_path: Path) -> None:
    pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed')
    replay = dds.replay(write_bag(tmp_path))
    time.sleep(1.0)
    listener = dds.listen({'/tf_static': 'tf2_msgs/msg/TFMessage', **SENSORS}, latched=False)
    late = dds.listen({'/tf_static': 'tf2_msgs/msg/TFMessage'}, latched=True)
    listener.spin(until=lambda: bool(listener.on('/sonar')))
    late.spin(until=lambda: bool(late.got))
    assert {item.child_frame_id for item in late.got[0][1].transforms} == {'sonar_0', 'sonar_1'}
    replay.signal(signal.SIGINT)
    assert replay.end()[0] == 0
