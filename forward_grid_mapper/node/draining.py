"""Callbacks of subscriptions that take several messages at once.

rclpy's executor takes one message of a subscription for each of its waits, and a wait costs more than the message. So a
topic with many messages falls behind others with few, although there is time for all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle

AT_ONCE = 50
"""Most messages of one call, so that other topics and services get their turn."""

LONGEST = 0.005
"""Seconds after which a call takes no further messages."""


class Draining:
    """A callback that receives the message it is called with, and then those that wait behind it.

    Attributes
    ----------
    subscription : rclpy.subscription.Subscription or None
        That of this callback, to be set when it exists. Without it, or if its handle cannot give messages, each call
        receives one message.
    """

    def __init__(self, receive: Callable[[Any, dict[str, Any]], object]) -> None:
        self._receive = receive
        self.subscription: Any = None

    def __call__(self, message: Any, info: dict[str, Any]) -> None:
        """Receive a message, and the waiting ones."""
        end = time.monotonic() + LONGEST
        self._receive(message, info)
        # what the executor uses itself, but not documented
        handle: Any = getattr(self.subscription, 'handle', None)
        if not hasattr(handle, 'take_message'):
            return
        for _ in range(AT_ONCE - 1):
            if time.monotonic() > end:
                return
            try:
                with handle:
                    taken = handle.take_message(self.subscription.msg_type, self.subscription.raw)
            except InvalidHandle:
                # it was destroyed meanwhile
                return
            if taken is None:
                return
            self._receive(*taken)
