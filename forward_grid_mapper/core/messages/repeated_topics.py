"""Topics that contain the same readings: a topic of a sensor and its filtered copy, or a copy under another name.

The evidence of such readings counts twice. Readings have no topic, so messages are compared.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

from .message_batch import Ranges

MOST_COMPARED = 20_000
"""Messages that are compared, from the start of the drive on."""

LEAST_PAIRS = 30
"""Fewest pairs of ranges for a warning."""

COPY_TOLERANCE = 0.05
"""Metres by which a filtered range differs from the measured one at most in half of the cases: filters remove outliers.
Ranges of two sensors in different directions are rarely so similar."""

MOST_NAMED = 4
"""Most frames that are named as examples."""


class RepeatedTopics:
    """Counts messages on different topics with the same frame and stamp, and warns if most ranges are the same."""

    def __init__(self) -> None:
        self._left = MOST_COMPARED
        self._first: dict[tuple[str, int], tuple[str, float]] = {}
        self._seen: Counter[str] = Counter()
        # all pairs of messages, those with an echo, and those with nearly the same range, by both topics
        self._pairs: Counter[tuple[str, str]] = Counter()
        self._echoes: Counter[tuple[str, str]] = Counter()
        self._same: Counter[tuple[str, str]] = Counter()
        self._frames: dict[tuple[str, str], dict[str, None]] = {}

    def add(self, topic: str, frame: str, stamp: int, metres: float) -> None:
        """Compare a message with the first one of its frame and stamp."""
        if not self._left:
            return
        self._left -= 1
        self._seen[topic] += 1
        other, measured = self._first.setdefault((frame, stamp), (topic, metres))
        if other != topic and stamp:
            both = other, topic
            self._pairs[both] += 1
            self._frames.setdefault(both, {})[frame] = None
            if math.isfinite(metres) or math.isfinite(measured):
                self._echoes[both] += 1
                self._same[both] += abs(metres - measured) <= COPY_TOLERANCE
        if not self._left:
            self._first.clear()

    def add_batch(self, topic: str, ranges: Ranges) -> None:
        """Compare the messages of a topic."""
        if self._left:
            columns = (column[: self._left].tolist() for column in (ranges.frame, ranges.stamp, ranges.range))
            for frame, stamp, metres in zip(*columns, strict=True):
                self.add(topic, ranges.frames[frame], stamp, metres)

    def notes(self, topics: Sequence[str], remedy: Callable[[Sequence[str]], str]) -> list[str]:
        """Return warnings about copies among these topics; `remedy` describes how to select others."""
        found = [both for both, count in self._pairs.items() if self._are_copies(both, count)]
        copies = {max(both, key=_derived) for both in found}
        kept = remedy([topic for topic in topics if topic not in copies])
        texts = []
        for both in found:
            one, other = sorted(both, key=_derived)
            frames = list(self._frames[both])
            more = f' and {len(frames) - MOST_NAMED} more' if len(frames) > MOST_NAMED else ''
            texts.append(
                f'{one} and {other} contain the same readings (frame {", ".join(frames[:MOST_NAMED])}{more}: equal '
                f'stamps, nearly equal ranges), and their evidence counts twice; is {other} a filtered copy? {kept}'
            )
        return texts

    def _are_copies(self, both: tuple[str, str], count: int) -> bool:
        echoes = self._echoes[both]
        fewer = min(self._seen[topic] for topic in both)
        return echoes >= LEAST_PAIRS and 2 * self._same[both] >= echoes and 2 * count >= fewer


def _derived(topic: str) -> tuple[bool, int, str]:
    """Return a key that sorts a topic before those that are made from it, by their names."""
    return 'filter' in topic.lower(), len(topic), topic
