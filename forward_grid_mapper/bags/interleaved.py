"""Files of a split bag whose log times overlap, as one source.

Two recorders that write into one folder have such files, and a recorder with several topics at the ends of its files.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection, Iterator, Sequence

from .source import Channel, RawMessage, Source, close_all, one_line


class Interleaved:
    """Several sources whose messages are read by log time; each is opened for reading when its start is reached.

    Parameters
    ----------
    sources : sequence of Source
        With known spans.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = sorted(sources, key=_begin)
        self._damage: str | None = None
        # keys are unique only within a file
        self._keys: list[dict[int, int]] = []
        self.channels: list[Channel] = []
        for source in self._sources:
            first = len(self.channels)
            self._keys.append({c.key: first + k for k, c in enumerate(source.channels)})
            self.channels += [c._replace(key=first + k) for k, c in enumerate(source.channels)]
        self.span: tuple[int, int] | None = _begin(self._sources[0]), max(map(_end, self._sources))

    @property
    def damage(self) -> str | None:
        """The reasons why not everything could be read, as far as known."""
        reasons = [self._damage, *(source.damage for source in self._sources)]
        return '; '.join(dict.fromkeys(filter(None, reasons))) or None

    @damage.setter
    def damage(self, damage: str | None) -> None:
        self._damage = damage

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time; of equal times, those of the earlier file first."""
        waiting = deque(range(len(self._sources)))
        # time of the next message, number of the file, that message, and the messages after it
        heap: list[tuple[int, int, RawMessage, Iterator[RawMessage]]] = []
        while waiting or heap:
            while waiting and (not heap or _begin(self._sources[waiting[0]]) <= heap[0][0]):
                number = waiting.popleft()
                rest = self._messages_of(number, keys)
                if (first := next(rest, None)) is not None:
                    heapq.heappush(heap, (first[1], number, first, rest))
            if not heap:
                continue
            _, number, message, rest = heap[0]
            yield message
            if (following := next(rest, None)) is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (following[1], number, following, rest))

    def close(self) -> None:
        """Release the files."""
        close_all(self._sources)

    def _messages_of(self, number: int, keys: Collection[int]) -> Iterator[RawMessage]:
        source, names = self._sources[number], self._keys[number]
        wanted = {own for own, key in names.items() if key in keys}
        if not wanted:
            return
        try:
            for key, time, data in source.messages(wanted):
                yield names[key], time, data
        except Exception as error:  # of many classes; the other files may be undamaged
            source.damage = source.damage or one_line(error)


def interleaved(sources: Sequence[Source]) -> list[Source]:
    """Return the sources in their order, with one in place of consecutive ones whose log times overlap."""
    groups: list[list[Source]] = []
    for source in sources:
        known = groups and source.span is not None and all(other.span is not None for other in groups[-1])
        if known and _begin(source) <= max(map(_end, groups[-1])):
            groups[-1].append(source)
        else:
            groups.append([source])
    return [group[0] if len(group) == 1 else Interleaved(group) for group in groups]


def _begin(source: Source) -> int:
    assert source.span is not None
    return source.span[0]


def _end(source: Source) -> int:
    assert source.span is not None
    return source.span[1]
