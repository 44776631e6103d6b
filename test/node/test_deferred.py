"""Service responses that are sent later or at once: each call gets one, with the header of its request."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='services are those of rclpy')

from nav_msgs.srv import GetMap
from rclpy.qos import ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from forward_grid_mapper.node.deferred import CALLS, DeferredService, Reply


class Handle(nullcontext[None]):
    """Stand-in for the handle of a service, which rclpy locks with a context that has no value."""

    def __init__(self, untaken: list[tuple[Any, Any]]) -> None:
        super().__init__()
        self._untaken = untaken

    def service_take_request(self, kind: Any) -> tuple[Any, Any]:
        return self._untaken.pop(0) if self._untaken else (None, None)


class Serving:
    """Stand-in for a node, with what a service needs; `call` processes a request like the executor of rclpy."""

    def __init__(self) -> None:
        self.sent: list[tuple[Any, Any]] = []
        self.untaken: list[tuple[Any, Any]] = []
        self.logged: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.logged.append)

    def create_service(self, kind: Any, name: str, callback: Any, qos_profile: Any) -> Any:
        assert qos_profile.depth >= 2000 and qos_profile.reliability == ReliabilityPolicy.RELIABLE
        self.callback = callback
        self.service = SimpleNamespace(
            send_response=lambda response, header: self.sent.append((response, header)), handle=Handle(self.untaken)
        )
        return self.service

    def call(self, header: str, request: Any = None) -> None:
        self.service.send_response(self.callback(request, Trigger.Response()), header)


def test_responses_are_sent_when_ready_in_any_order() -> None:
    node, replies = Serving(), list[Reply]()
    DeferredService(node, Trigger, 'later', replies.append)
    for header in ('first', 'second'):
        node.call(header)
    assert node.sent == []
    replies[1].send(True, 'done')
    replies[0].send(message='failed')
    assert [(r.success, r.message, header) for r, header in node.sent] == [
        (True, 'done', 'second'),
        (False, 'failed', 'first'),
    ]
    at_once = Serving()
    DeferredService(at_once, Trigger, 'now', lambda reply: reply.send(True, 'at once'))
    at_once.call('third')
    assert [(r.message, header) for r, header in at_once.sent] == [('at once', 'third')]


def test_second_response_to_a_call_is_ignored() -> None:
    node, replies = Serving(), list[Reply]()
    DeferredService(node, Trigger, 'later', replies.append)
    node.call('one')
    replies[0].send(True, 'a')
    replies[0].send(False, 'b')
    assert [r.message for r, _ in node.sent] == ['a']

    def twice(reply: Reply) -> None:
        reply.send(True, 'a')
        reply.send(False, 'b')

    node = Serving()
    DeferredService(node, Trigger, 'now', twice)
    node.call('one')
    assert [r.message for r, _ in node.sent] == ['a']


def test_handler_gets_the_request() -> None:
    node, seen = Serving(), list[bool]()

    def handle(reply: Reply) -> None:
        seen.append(reply.request.data)
        reply.send(success=True)

    DeferredService(node, SetBool, 'pause', handle)
    node.call('one', SetBool.Request(data=True))
    assert seen == [True] and isinstance(node.sent[0][0], SetBool.Response) and node.sent[0][0].success
    assert CALLS.depth > 10, 'what ROS keeps by itself'


def test_failing_handler_responds_with_the_error() -> None:
    def fail(reply: Reply) -> None:
        raise KeyError('odd')

    def fail_late(reply: Reply) -> None:
        reply.send(True, 'done')
        raise MemoryError

    node = Serving()
    DeferredService(node, Trigger, 'fails', fail)
    node.call('one')
    ((response, header),) = node.sent
    assert (response.success, response.message, header) == (False, "it failed: KeyError('odd')", 'one')
    assert "KeyError('odd')" in node.logged[0] and 'Traceback' in node.logged[0]
    # a response type without message gets an empty response
    node = Serving()
    DeferredService(node, GetMap, 'get', fail)
    node.call('two')
    assert node.sent == [(GetMap.Response(), 'two')]
    # a call with a response does not get a second one
    node = Serving()
    DeferredService(node, Trigger, 'late', fail_late)
    node.call('three')
    assert [response.message for response, _ in node.sent] == ['done']
    assert 'there is not enough memory' in node.logged[0]


def test_waiting_calls_fail_when_the_service_ends() -> None:
    node, replies = Serving(), list[Reply]()
    service = DeferredService(node, Trigger, 'later', replies.append)
    for header in ('first', 'second'):
        node.call(header)
    replies[0].send(True, 'done')
    service.end('it ends')
    assert [(r.success, r.message, header) for r, header in node.sent] == [
        (True, 'done', 'first'),
        (False, 'it ends', 'second'),
    ]
    # later responses are dropped
    replies[1].send(True, 'done')
    service.end('it ends')
    assert len(node.sent) == 2 and not service.open


def test_calls_that_nobody_has_taken_fail_when_the_service_ends() -> None:
    node, replies = Serving(), list[Reply]()
    service = DeferredService(node, Trigger, 'later', replies.append)
    node.untaken += [(Trigger.Request(), 'first'), (Trigger.Request(), 'second')]
    service.end('it ends')
    assert [(r.success, r.message, header) for r, header in node.sent] == [
        (False, 'it ends', 'first'),
        (False, 'it ends', 'second'),
    ]
    assert not replies and not service.open


def test_answer_on_its_way_is_sent_before_the_service_ends() -> None:
    node, replies = Serving(), list[Reply]()
    service = DeferredService(node, Trigger, 'later', replies.append)
    node.call('one')
    sending, go_on, send = threading.Event(), threading.Event(), service.transmit

    def slow(response: Any, header: Any) -> None:
        sending.set()
        assert go_on.wait(60.0)
        send(response, header)

    service.transmit = slow  # type: ignore[method-assign]
    worker = threading.Thread(target=replies[0].send, args=(True, 'done'))
    worker.start()
    assert sending.wait(60.0)
    threading.Timer(0.2, go_on.set).start()
    service.end('it ends')
    assert [response.message for response, _ in node.sent] == ['done']
    worker.join()
    assert not service.open
