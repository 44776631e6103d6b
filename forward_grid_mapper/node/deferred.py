"""Services that answer later, from any thread, while the executor goes on with other work."""

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
"""Calls and answers that may wait at once; of more than ROS's own 10 some would never be answered."""


class Reply:
    """The answer that a client waits for."""

    def __init__(self, service: DeferredService, request: Any) -> None:
        self.request = request
        self._service = service
        self._lock = threading.Lock()
        self._header: Any = None
        self._response: Any = None

    def send(self, *arguments: Any, **fields: Any) -> None:
        """Answer with the fields of the response, in order or by name, once; a client that has gone is no error."""
        kind = self._service.kind.Response
        names = kind.get_fields_and_field_types()
        response = kind(**dict(zip(names, arguments, strict=False)), **fields)
        with self._lock:
            if self._response is not None:
                return
            self._response, header = response, self._header
        self._service.open.discard(self)
        if header is not None:
            self._service.transmit(response, header)

    def fail(self, why: str) -> None:
        """Answer that the call failed, in words where the response has room for them."""
        names = self._service.kind.Response.get_fields_and_field_types()
        self.send(**{name: value for name, value in (('success', False), ('message', why)) if name in names})

    def arrived(self, header: Any) -> None:
        """Learn whom to answer, which the executor knows only after the handler returned."""
        with self._lock:
            self._header, response = header, self._response
        if response is not None:
            self._service.transmit(response, header)


def answered(handler: Callable[[Reply], None], reply: Reply, log: Callable[[str], object]) -> None:
    """Call a handler; if it fails, the client is told, who would wait for ever, and so is the log."""
    try:
        handler(reply)
    except Exception as error:
        why = reason(error)
        log(f'a call failed: {why}; {traceback.format_exc()}')
        reply.fail(f'it failed: {why}')


class DeferredService:
    """A service whose handler is given a `Reply` to answer with, now or later.

    An `async` handler would do the same with rclpy's own means, but its executor then spins at full load until the
    answer is there.

    Attributes
    ----------
    open : set of Reply
        Those that nobody has answered yet.
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
        """Tell those who still wait that there will be no answer, and why."""
        for reply in list(self.open):
            reply.fail(why)

    def transmit(self, response: Any, header: Any) -> None:
        """Send a response to the client; any thread."""
        self._transmit(response, header)
