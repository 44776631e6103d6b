"""Callbacks that take all waiting messages of a subscription, within bounds."""

from __future__ import annotations

import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Range

from forward_grid_mapper.node.draining import AT_ONCE, LONGEST, Draining


class Queue:
    """The handle of a subscription, with waiting messages."""

    def __init__(self, *messages: Any) -> None:
        self.waiting, self.asked, self.valid = deque(messages), [], True

    def __enter__(self) -> None:
        if not self.valid:
            raise InvalidHandle

    def __exit__(self, *_: object) -> None:
        pass

    def take_message(self, kind: type, raw: bool) -> Any:
        self.asked.append((kind, raw))
        return (self.waiting.popleft(), {'of': 'queue'}) if self.waiting else None


def draining(queue: Any) -> tuple[Draining, list[Any]]:
    received: list[Any] = []
    made = Draining(lambda message, info: received.append((message, info['of'])))
    made.subscription = SimpleNamespace(handle=queue, msg_type=Range, raw=False)
    return made, received


def test_waiting_messages_are_received_in_order_with_their_info() -> None:
    queue = Queue(2, 3)
    callback, received = draining(queue)
    callback(1, {'of': 'executor'})
    assert received == [(1, 'executor'), (2, 'queue'), (3, 'queue')]
    assert set(queue.asked) == {(Range, False)}


def test_number_of_messages_and_time_of_a_call_are_bounded(clock: Any) -> None:
    queue = Queue(*range(1, 3 * AT_ONCE))
    callback, received = draining(queue)
    callback(0, {'of': 'executor'})
    assert [number for number, _ in received] == list(range(AT_ONCE))
    slow: list[int] = []

    def receive(message: int, info: Any) -> None:
        slow.append(message)
        clock.now += 0.4 * LONGEST

    callback = Draining(receive)
    callback.subscription = SimpleNamespace(handle=queue, msg_type=Range, raw=False)
    callback(0, {'of': 'executor'})
    assert len(slow) == 3


@pytest.mark.parametrize('subscription', [None, 'sonar', SimpleNamespace(handle=object())])
def test_one_message_is_received_if_the_handle_gives_none(subscription: Any) -> None:
    callback, received = draining(Queue())
    callback.subscription = subscription
    callback(1, {'of': 'executor'})
    assert received == [(1, 'executor')]


def test_destroyed_subscription_gives_no_further_messages() -> None:
    queue = Queue(2, 3)
    queue.valid = False
    callback, received = draining(queue)
    callback(1, {'of': 'executor'})
    assert received == [(1, 'executor')]


def test_executor_of_rclpy_receives_a_queue_in_one_turn(domain: int) -> None:
    """With the infos that rclpy gives, so that losses and delays are counted as for single messages."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('draining', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        received: list[tuple[float, dict[str, Any]]] = []
        callback = Draining(lambda message, info: received.append((message.range, info)))
        callback.subscription = node.create_subscription(Range, 'sonar', callback, QoSProfile(depth=100))
        out = node.create_publisher(Range, 'sonar', QoSProfile(depth=100))
        while not out.get_subscription_count():
            executor.spin_once(timeout_sec=0.01)
        for k in range(20):
            out.publish(Range(range=float(k)))
        time.sleep(0.5)
        for _ in range(20):
            executor.spin_once(timeout_sec=0.1)
            if received:
                break
        assert len(received) > 1
        while len(received) < 20:
            executor.spin_once(timeout_sec=0.1)
        assert [value for value, _ in received] == list(range(20))
        assert {tuple(info) for _, info in received} == {tuple(received[0][1])}
        sent = [info['source_timestamp'] for _, info in received]
        assert sent == sorted(sent) and sent[0] > 0
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
