"""Services that are answered later, from any thread, while the executor does other work."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service import Service

from .background import reason

CALLS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
"""Most calls and answers that may wait; with ROS's default of 10, some of more calls would never be answered."""


class Reply:
    """The answer of a service call."""

    def __init__(self, service: DeferredService, request: Any) -> None:
        self.request = request
        self._service = service
        self._lock = threading.Lock()
        self._header: Any = None
        self._response: Any = None

    def send(self, *arguments: Any, **fields: Any) -> None:
        """Answer once, with the fields of the response in order or by name; a client that has gone is no error."""
        kind = self._service.kind.Response
        names = kind.get_fields_and_field_types()
        response = kind(**dict(zip(names, arguments, strict=False)), **fields)
        with self._lock:
            if self._response is not None:
                return
            self._response = response
            try:
                self._transmit()
            finally:
                # not before, so that `end` waits for this answer: the service is destroyed after it
                self._service.open.discard(self)

    def fail(self, why: str) -> None:
        """Answer that the call failed; the reason is in `message`, if the response has one."""
        names = self._service.kind.Response.get_fields_and_field_types()
        self.send(**{name: value for name, value in (('success', False), ('message', why)) if name in names})

    def arrived(self, header: Any) -> None:
        """Note the client's header, which the executor only has after the handler returned."""
        with self._lock:
            self._header = header
            self._transmit()

    def _transmit(self) -> None:
        if self._header is not None and self._response is not None:
            self._service.transmit(self._response, self._header)


def answered(handler: Callable[[Reply], None], reply: Reply, log: Callable[[str], object]) -> None:
    """Call a handler; if it fails, log the error and answer, since the client would wait for ever."""
    try:
        handler(reply)
    except Exception as error:
        why = reason(error)
        log(f'a call failed: {why}; {traceback.format_exc()}')
        reply.fail(f'it failed: {why}')


class DeferredService:
    """A service whose handler receives a `Reply`, to answer now or later.

    An `async` handler could do the same, but then rclpy's executor spins at full load until it answers.

    Attributes
    ----------
    open : set of Reply
        Calls without an answer so far.
    """

    def __init__(self, node: Node, kind: Any, name: str, handler: Callable[[Reply], None]) -> None:
        self.kind = kind
        self.open: set[Reply] = set()
        self._handler = handler
        self._log = node.get_logger().error
        self._service: Service = node.create_service(kind, name, self._accept, qos_profile=CALLS)
        self._transmit = self._service.send_response
        self._service.send_response = self._send

    def _accept(self, request: Any, response: Any) -> Reply:
        reply = Reply(self, request)
        self.open.add(reply)
        answered(self._handler, reply, self._log)
        return reply

    def _send(self, reply: Reply, header: Any) -> None:
        reply.arrived(header)

    def end(self, why: str) -> None:
        """Answer all calls with a failure and its reason, also those in the middleware; called by the executor.

        The middleware drops the latter when the service is destroyed, and their clients would wait for ever.
        """
        for reply in list(self.open):
            reply.fail(why)
        handle = self._service.handle
        with handle:
            while (header := (taken := handle.service_take_request(self.kind.Request))[1]) is not None:
                reply = Reply(self, taken[0])
                reply.fail(why)
                reply.arrived(header)

    def transmit(self, response: Any, header: Any) -> None:
        """Send a response to the client; may be called from any thread."""
        self._transmit(response, header)
