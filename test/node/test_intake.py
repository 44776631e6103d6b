"""Messages on their way to the associator: waiting, portions, and counts."""

from __future__ import annotations

import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the intake takes messages of ROS')

from nav_msgs.msg import Odometry
from rclpy.event_handler import UnsupportedEventTypeError
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Range
from stand_ins import Taking

from forward_grid_mapper.node import draining
from forward_grid_mapper.node import intake as module
from forward_grid_mapper.node.frames import MapFrame, Transforms
from forward_grid_mapper.node.intake import AT_ONCE, QUEUE
from forward_grid_mapper.node.losses import LOSS_WARNING


def test_messages_before_the_begin_wait_and_are_processed_in_order() -> None:
    robot = Taking()
    for k in range(30):
        robot.odometry(100.0 + 0.05 * k, 0.001 * k)
        robot.range(100.0 + 0.05 * k)
    assert (robot.intake.received, robot.intake.waiting, len(robot.associator.buffer)) == (30, 30, 0)
    assert robot.intake.busy and robot.node.turn() == 0
    robot.intake.work()
    assert robot.intake.received == robot.intake.waiting == 30
    robot.intake.begin()
    robot.node.turn()
    assert robot.account() == (30, 30, 0, 0)
    assert robot.associator.readings.x == pytest.approx([0.1 + 0.001 * k for k in range(30)])
    assert not robot.intake.busy
    # from here on, messages are processed as they come
    robot.odometry(102.0)
    robot.range(102.0)
    assert robot.account() == (31, 31, 0, 0)
    assert len(robot.published) == 31


def test_one_turn_processes_a_portion_of_the_messages() -> None:
    robot = Taking()
    for k in range(3 * AT_ONCE):
        robot.odometry(100.0 + 0.01 * k)
    robot.intake.begin()
    left = []
    while robot.intake.busy:
        robot.intake.work()
        left.append(3 * AT_ONCE - robot.associator.odometry_received)
    assert left == [2 * AT_ONCE, AT_ONCE, 0]


def test_one_turn_places_a_portion_of_the_readings() -> None:
    robot = Taking(at_once=10)
    robot.intake.begin()
    robot.odometry(99.0)
    for k in range(1000):
        robot.range(99.5 + 0.001 * k)
    robot.odometry(100.0)
    robot.odometry(101.0)
    # behind: new messages wait until the others are placed
    robot.range(101.0)
    assert robot.intake.busy and robot.intake.waiting > 900
    before = len(robot.associator.buffer)
    robot.intake.work()
    assert AT_ONCE <= len(robot.associator.buffer) - before <= AT_ONCE + 10
    robot.node.turn()
    assert robot.account() == (1001, 1001, 0, 0)


def test_too_many_waiting_messages_before_the_begin_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'MOST_WAITING', 5)
    robot = Taking()
    for k in range(8):
        robot.odometry(100.0 + k)
        robot.range(100.0 + k, 'front' if k < 6 else 'left')
    assert (robot.intake.received, robot.intake.waiting) == (8, 5)
    assert robot.intake.odometry_lost == 3
    robot.intake.begin()
    robot.node.turn()
    assert robot.account()[0] == 8
    assert robot.associator.rejected['too_many_waiting'] == 3
    rejected = {frame: counts['too_many_waiting'] for frame, counts in robot.associator.rejected_by_frame.items()}
    assert rejected == {'front': 1, 'left': 2}
    assert robot.associator.odometry_received == 5


def test_odometry_that_is_not_kept_adds_to_what_the_middleware_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'MOST_WAITING', 2)
    robot = Taking()
    for number in (1, 2, 5, 6):
        robot.odometry(100.0 + number, number=number)
    assert robot.intake.odometry_lost == 2 + 2


def test_too_many_waiting_messages_behind_others_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Taking(at_once=1)
    robot.intake.begin()
    robot.odometry(99.4)
    for k in range(20):
        robot.range(99.5 + 0.001 * k)
    robot.odometry(100.2)
    assert robot.associator.behind
    monkeypatch.setattr(module, 'MOST_WAITING', 4)
    for k in range(6):
        robot.range(100.0 + 0.01 * k)
    assert robot.associator.rejected['too_many_waiting'] == 2
    robot.node.turn()
    assert robot.account() == (26, 24, 0, 2)


def test_no_messages_give_no_rejections() -> None:
    robot = Taking()
    robot.intake.begin()
    assert robot.account() == (0, 0, 0, 0) and robot.associator.rejected == {}


def test_readings_received_during_a_pause_are_rejected() -> None:
    robot = Taking()
    robot.odometry(99.9)
    robot.range(100.0)
    robot.intake.paused = True
    robot.range(100.1)
    robot.odometry(100.2)
    robot.intake.paused = False
    robot.range(100.2)
    robot.intake.begin()
    robot.node.turn()
    robot.odometry(100.3)
    # also if they waited meanwhile
    assert robot.account() == (3, 2, 0, 1)
    assert robot.associator.rejected['paused'] == 1
    robot.intake.paused = True
    robot.range(100.3)
    robot.odometry(100.4)
    assert robot.associator.rejected['paused'] == 2
    assert robot.associator.odometry_received == 4


def test_reset_of_the_intake_clears_all_counts() -> None:
    robot = Taking()
    robot.range(100.0, number=1)
    robot.range(100.1, number=50)
    robot.odometry(100.0, number=1)
    robot.odometry(100.1, number=8)
    assert (robot.intake.lost, robot.intake.odometry_lost) == (48, 6)
    assert 'sonar' in robot.intake.silence and robot.intake.busy
    robot.intake.forget()
    assert (robot.intake.received, robot.intake.waiting, robot.intake.lost, robot.intake.odometry_lost) == (0, 0, 0, 0)
    assert 'sonar' not in robot.intake.silence and not robot.intake.busy
    assert robot.intake.loss_note() == []


def test_lost_ranges_and_odometry_are_counted_separately() -> None:
    robot = Taking()
    for number in (1, 3):
        robot.range(100.0 + number, number=number)
        robot.odometry(100.0 + number, number=number)
    assert (robot.intake.lost, robot.intake.odometry_lost) == (1, 1)
    assert '1 Range and 1 odometry' in robot.intake.loss_note()[0]


def test_topics_are_subscribed_once_and_unsubscribed() -> None:
    robot = Taking(range_topics=('a', 'b', 'a'), odom_topic='wheels', odom_reliability='reliable')
    intake, node = robot.intake, robot.node
    assert not intake.listening
    intake.subscribe()
    assert intake.listening and set(node.subscribed) == {'a', 'b', 'wheels'}
    assert set(intake.subscriptions) == {'/a', '/b', '/wheels'}
    qualities = {topic: quality for topic, (_, quality) in node.subscribed.items()}
    assert all(quality.depth == QUEUE for quality in qualities.values())
    assert qualities['wheels'].reliability == ReliabilityPolicy.RELIABLE
    assert qualities['a'].reliability == qualities['b'].reliability == ReliabilityPolicy.BEST_EFFORT
    robot.range(100.0, number=7)
    robot.range(100.0, number=90, topic=1)
    robot.odometry(100.0, number=30)
    intake.unsubscribe()
    assert not intake.listening and node.subscribed == {} and intake.subscriptions == {}
    assert 'sonar' not in intake.silence
    intake.subscribe()
    # messages published meanwhile do not count as lost
    robot.range(101.0, number=500)
    robot.range(101.0, number=500, topic=1)
    robot.odometry(101.0, number=500)
    assert intake.lost == intake.odometry_lost == 0


def test_middleware_that_reports_no_losses_is_subscribed_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """rclpy raises for a callback that the middleware does not support, if it is not one of rclpy's own."""
    robot = Taking(range_topics=['left', 'right'])
    create = robot.node.create_subscription

    def without_losses(*arguments: Any, event_callbacks: Any = None) -> str:
        if event_callbacks is not None and event_callbacks.message_lost:
            raise UnsupportedEventTypeError('event type is not supported')
        return create(*arguments)

    monkeypatch.setattr(robot.node, 'create_subscription', without_losses)
    robot.intake.subscribe()
    assert list(robot.node.subscribed) == ['left', 'right', 'odom']
    assert robot.intake.listening


def test_topics_with_the_same_readings_are_named_until_it_forgets() -> None:
    robot = Taking(range_topics=('front', 'front_filtered'))
    robot.intake.subscribe()
    for k in range(40):
        for topic in ('front', 'front_filtered'):
            made = Range(min_range=0.1, max_range=5.0, field_of_view=0.3, range=1.0 + 0.01 * k)
            made.header.frame_id, made.header.stamp.sec = 'sonar', 100 + k
            receive, _ = robot.node.subscribed[topic]
            receive(made, {'source_timestamp': k, 'publication_sequence_number': k + 1})
    assert robot.intake.received == 80
    (text,) = robot.intake.repeated()
    assert text.startswith('front and front_filtered contain the same readings') and text.endswith(
        'range_topics to front'
    )
    assert text in robot.intake.faults() and robot.node.warned == [text]
    robot.intake.forget()
    assert robot.intake.repeated() == []


@pytest.mark.parametrize(
    ('reliability', 'remedy'), [('reliable', 'or the load of the machine'), ('best_effort', 'network')]
)
def test_recent_losses_give_a_warning_and_rare_log_lines(
    monkeypatch: pytest.MonkeyPatch, reliability: str, remedy: str
) -> None:
    now = 1000.0
    monkeypatch.setattr(time, 'monotonic', lambda: now)
    robot = Taking(range_reliability=reliability)
    assert robot.intake.faults() == [] and robot.intake.loss_note() == []
    robot.range(100.0, number=1)
    robot.range(100.1, number=4)
    robot.odometry(100.0, number=1)
    robot.odometry(100.1, number=7)
    (fault,) = robot.intake.faults()
    assert '2 Range and 5 odometry messages so far were lost' in fault and remedy in fault
    assert robot.node.warned == [fault]
    assert '2 Range and 5 odometry messages were lost' in robot.intake.loss_note()[0]
    # further losses are in the diagnostics, and in the log only after some time
    now += LOSS_WARNING / 2
    robot.range(100.2, number=6)
    assert '3 Range' in robot.intake.faults()[0] and len(robot.node.warned) == 1
    now += LOSS_WARNING / 2 + 0.1
    assert '3 Range' in robot.intake.faults()[0] and len(robot.node.warned) == 2
    now += LOSS_WARNING
    assert robot.intake.faults() == [] and robot.intake.loss_note()
    assert len(robot.node.warned) == 2
    # losses after a reset are logged, though they are fewer than those before
    now += 1.0
    robot.intake.forget()
    robot.range(101.0, number=8)
    assert '1 Range and 0 odometry' in robot.intake.faults()[0] and len(robot.node.warned) == 3


def test_jump_back_of_time_gives_a_warning() -> None:
    robot = Taking()
    robot.intake.begin()
    robot.odometry(100.0)
    robot.range(100.5)
    robot.odometry(100.1)
    assert robot.node.warned == []
    robot.odometry(50.0)
    assert len(robot.node.warned) == 1 and 'the clock jumped back' in robot.node.warned[0]
    assert robot.account() == (1, 0, 0, 1)
    robot.range(50.1)
    robot.odometry(50.2)
    assert robot.account() == (2, 1, 0, 1)


def test_jump_back_with_which_a_drive_begins_gives_no_warning() -> None:
    robot = Taking()
    robot.intake.begin()
    robot.odometry(100.0)
    # as the service reset does
    robot.associator.clear()
    robot.intake.forget()
    robot.odometry(50.0)
    assert robot.node.warned == [] and robot.associator.time_jumps == 1


def test_odometry_that_waited_for_a_transform_is_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """It comes before other waiting messages."""
    robot = Taking()
    robot.intake.begin()
    waited: list[Any] = []
    taken: list[float] = []

    def convert(message: Any) -> list[Any]:
        waited.append(message)
        return waited[:] if len(waited) == 4 else []

    def convert_now(message: Any) -> list[Any]:
        return [message]

    monkeypatch.setattr(robot.intake._map_frame, 'convert', convert)
    add = robot.associator.add_odometry
    monkeypatch.setattr(robot.associator, 'add_odometry', lambda m, sent: (taken.append(m.stamp / 1e9), add(m, sent)))
    for k in range(4):
        robot.odometry(100.0 + k)
    assert taken == [100.0]
    monkeypatch.setattr(robot.intake._map_frame, 'convert', convert_now)
    robot.odometry(104.0)
    assert robot.node.turn() and taken == [100.0, 101.0, 102.0, 103.0, 104.0]


class Localiser:
    """TF of a localiser that starts late; like the buffer of tf2, it deletes all transforms on `clear`."""

    def __init__(self) -> None:
        self.begin, self.end, self.cleared = 1 << 62, 0, 0

    def clear(self) -> None:
        self.cleared += 1
        self.begin, self.end = 1 << 62, 0

    def publish(self, stamp: int) -> None:
        self.begin, self.end = min(self.begin, stamp), max(self.end, stamp)

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        if not self.begin <= time.nanoseconds <= self.end:
            raise ExtrapolationException
        rotation, translation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0), SimpleNamespace(x=5.0, y=0.0)
        return SimpleNamespace(transform=SimpleNamespace(rotation=rotation, translation=translation))


class ExtrapolationException(Exception):
    """Raised by tf2 for times without transform."""


def test_odometry_that_waited_for_the_map_frame_is_no_jump() -> None:
    tf = Localiser()
    robot = Taking(map_frame=MapFrame('map', Transforms(tf, ExtrapolationException), 2.0))
    robot.intake.begin()
    # the localiser starts after 1.5 s, while hundreds of messages wait, and its newest transform is 1 s ahead
    for k in range(600):
        robot.odometry(100.0 + 0.01 * k, 0.01 * k)
        if k % 10 == 5:
            robot.range(100.0 + 0.01 * k)
        if k >= 150 and k % 10 == 0:
            tf.publish(round((101.0 + 0.01 * k) * 1e9))
        robot.node.turn()
    assert tf.cleared == 0
    assert robot.associator.map_frame == 'map'
    # odometry of the first 2.5 s has no transform, or none before it
    assert robot.associator.rejected.total() <= 26
    assert len(robot.associator.buffer) >= 34
    assert robot.associator.readings.x.min() > 5.0


def test_odometry_that_waits_for_the_map_frame_is_forgotten_at_a_reset() -> None:
    tf = Localiser()
    frame = MapFrame('map', Transforms(tf, ExtrapolationException), 2.0)
    robot = Taking(map_frame=frame)
    robot.intake.begin()
    for k in range(30):
        robot.odometry(100.0 + 0.1 * k)
    assert frame.dropped == 9
    robot.intake.forget()
    assert frame.dropped == 0
    # the localiser begins, and also has the transforms of the time before the reset
    tf.publish(round(100e9))
    tf.publish(round(110e9))
    robot.odometry(103.0)
    robot.node.turn()
    assert robot.associator.odometry_received == 1


def test_failed_subscription_removes_all_subscriptions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the readings of the others would come twice after a retry."""
    robot = Taking()
    create, failing = robot.node.create_subscription, ['/odom', 'odom']

    def broken(kind: Any, topic: str, *arguments: Any, **options: Any) -> str:
        if topic in failing:
            raise RuntimeError('no more memory')
        return create(kind, topic, *arguments, **options)

    monkeypatch.setattr(robot.node, 'create_subscription', broken)
    with pytest.raises(RuntimeError, match='no more memory'):
        robot.intake.subscribe()
    assert robot.node.subscribed == {} and robot.intake.subscriptions == {}
    assert not robot.intake.listening
    failing.clear()
    robot.intake.subscribe()
    assert len(robot.node.subscribed) == 2 and robot.intake.listening


def test_waiting_messages_of_a_topic_are_received_in_one_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draining, 'LONGEST', 60.0)
    robot = Taking()
    waiting = deque(range(1, 5))

    class Handle:
        def __enter__(self) -> None:
            pass

        def __exit__(self, *_: object) -> None:
            pass

        def take_message(self, kind: type, raw: bool) -> Any:
            return (kind(), {'source_timestamp': waiting.popleft()}) if waiting else None

    create = robot.node.create_subscription

    def subscribe(kind: Any, *arguments: Any, **options: Any) -> Any:
        create(kind, *arguments, **options)
        return SimpleNamespace(handle=Handle(), msg_type=kind, raw=False)

    monkeypatch.setattr(robot.node, 'create_subscription', subscribe)
    robot.intake.subscribe()
    for topic, came in (('sonar', lambda: robot.intake.received), ('odom', lambda: robot.intake.odometry_arrived)):
        waiting.extend(range(4 - len(waiting)))
        kind = {'sonar': Range, 'odom': Odometry}[topic]
        robot.node.subscribed[topic][0](kind(), {'source_timestamp': 0})
        assert came() == 5 and not waiting
