"""Base class of the scanners that read a damaged file from front to back, without its index."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from .bounds import Budget
from .source import Channel, RawMessage


class Scan(ABC):
    """Reads a file from front to back; a subclass implements the format.

    The first pass, in the constructor, finds the channels and counts their messages. Files without an index are not
    in the order of time, so `messages` keeps the requested messages in memory and sorts them.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._budget = Budget(0)
        self._found: dict[int, Channel] = {}
        self.damage: str | None = None
        self.span: tuple[int, int] | None = None
        counts = self._count()
        self.channels = [c._replace(total=counts[c.key]) for c in self._found.values()]

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time."""
        yield from sorted((raw for raw in self._pass() if raw[0] in keys), key=lambda raw: raw[1])

    def _count(self) -> Counter[int]:
        """Return the number of messages by channel; the pass over the file notes channels and damage."""
        return Counter(key for key, _, _ in self._pass())

    def close(self) -> None:  # noqa: B027 (for any scan, not for its subclass to fill in)
        """Do nothing: no file is open between passes."""

    def _pass(self) -> Iterator[RawMessage]:
        self._budget = Budget(self._path.stat().st_size)
        return self._walk()

    @abstractmethod
    def _walk(self) -> Iterator[RawMessage]:
        """Yield every message that can be read, in the file's order; note channels and damage."""

    def _note(self, damage: str) -> None:
        self.damage = self.damage or damage
