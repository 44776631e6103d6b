"""What parts of the node need of rclpy, in plain Python: no middleware, and the test says when what is called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Guard:
    """A guard condition: `turn` of the node calls what it guards."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback, self.triggered = callback, False

    def trigger(self) -> None:
        self.triggered = True


class PlainNode:
    """As much of a node as a part of ours asks for.

    Attributes
    ----------
    warned : list of str
        What the log was told.
    publishers : int
        How many publish any topic.
    subscribed : dict of topic → (callback, QoSProfile)
    """

    def __init__(self) -> None:
        self.warned: list[str] = []
        self.publishers = 1
        self.subscribed: dict[str, tuple[Callable[..., None], Any]] = {}
        self._guards: list[Guard] = []

    def get_logger(self) -> Any:
        return self

    def warning(self, text: str) -> None:
        self.warned.append(text)

    error = info = warning

    def create_guard_condition(self, callback: Callable[[], None]) -> Guard:
        made = Guard(callback)
        self._guards.append(made)
        return made

    def turn(self) -> int:
        """Call what was triggered, again and again; return how often."""
        turns = 0
        while triggered := [guard for guard in self._guards if guard.triggered]:
            for guard in triggered:
                guard.triggered = False
                guard.callback()
            turns += 1
        return turns

    def count_publishers(self, topic: str) -> int:
        return self.publishers

    def resolve_topic_name(self, name: str) -> str:
        return name if name.startswith('/') else f'/{name}'

    def create_subscription(self, kind: Any, topic: str, callback: Any, quality: Any, **options: Any) -> str:
        self.subscribed[topic] = callback, quality
        return topic

    def destroy_subscription(self, topic: str) -> None:
        del self.subscribed[topic]
