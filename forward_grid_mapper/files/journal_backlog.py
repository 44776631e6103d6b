"""Rows that wait for the file of a journal, and how many of them are committed at once."""

from __future__ import annotations

import errno
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..core.common.errors import BagError
from ..core.common.readings import Readings
from .journal_database import DriveFile
from .journal_format import CONTINUES, ROW, Contents, Insert, path_rows, reading_rows
from .journal_reader import read_earlier

BATCH = 4 << 20
"""Most bytes of one commit, unless one item has more."""

SPARE = 1 << 16
"""Bytes that must be free beside those of the readings that are copied."""

MOST_ITEMS = 1 << 16
"""Most items of one commit."""


class Item(NamedTuple):
    """Rows that wait for the file of a drive.

    `readings` and `size` are their numbers of readings and bytes, `following` is the number of the next reading.
    """

    drive: DriveFile
    rows: Iterable[Insert]
    readings: int
    size: int
    following: int


@dataclass(frozen=True)
class Everything:
    """The rows of a whole drive, made by the writing thread, since this may take long and the node cannot wait."""

    head: list[Insert]
    readings: Readings
    numbers: Mapping[str, int]
    path: list[tuple[float, float]]
    first: int

    def __iter__(self) -> Iterator[Insert]:
        yield from self.head
        yield from path_rows(self.path, self.first)
        yield from reading_rows(self.readings, self.numbers, self.first)


class StoppedError(Exception):
    """A copy was stopped, since the journal is closed."""


@dataclass(frozen=True)
class Copied:
    """The rows of the file that the file at `path` continues.

    They are committed together or not at all, so that no reading is missing or stored twice if the node is killed.

    Attributes
    ----------
    path : Path
    continues : str
        Name of the file with the rows, in the same folder.
    numbers : mapping of str to int
        Numbers of the sensors by name.
    count : int
        Number of readings that were read from it before.
    stopped : callable
        Returns whether to give up.
    """

    path: Path
    continues: str
    numbers: Mapping[str, int]
    count: int
    stopped: Callable[[], bool]

    def __iter__(self) -> Iterator[Insert]:
        """Yield the rows.

        Raises
        ------
        BagError, OSError, StoppedError
            If not all of them can be read, do not fit on the disk, or the copy is to be given up.
        """
        # SQLite writes them into its log first; a disk that is filled for a moment is full for other programs as well
        if shutil.disk_usage(self.path.parent).free < 2 * self.count * ROW.itemsize + SPARE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        contents, number = Contents(continues=self.continues), 0
        for readings in read_earlier(self.path, contents):
            if self.stopped():
                raise StoppedError
            yield from reading_rows(readings, self.numbers, number)
            number += len(readings)
        if contents.unread or number != self.count:
            raise BagError(contents.unread or f'{self.continues} has changed')
        yield from path_rows(contents.path, 0)
        yield 'whole', (CONTINUES,)


class Backlog:
    """A queue of items; not for several threads at once.

    Attributes
    ----------
    bytes, readings : int
        Of all items.
    """

    def __init__(self) -> None:
        self._items: deque[Item] = deque()
        self._most = MOST_ITEMS
        self.bytes = self.readings = 0

    def __len__(self) -> int:
        return len(self._items)

    @property
    def due(self) -> bool:
        """Whether there is an item, and its file is there."""
        return bool(self._items) and not self._items[0].drive.gone

    def append(self, item: Item) -> None:
        """Add an item at the end."""
        self._items.append(item)
        self.bytes += item.size
        self.readings += item.readings

    def drop(self, drive: DriveFile) -> None:
        """Remove the items of a drive."""
        items, self._items = self._items, deque()
        self.bytes = self.readings = 0
        for item in items:
            if item.drive is not drive:
                self.append(item)

    def batch(self) -> list[Item]:
        """Return the items of the next commit: the first ones, of one drive; none if they are not due."""
        items: list[Item] = []
        size = 0
        for item in self._items if self.due else ():
            size += item.size
            if items and (item.drive is not items[0].drive or size > BATCH or len(items) >= self._most):
                break
            # a copy that fails must not take others with it
            if items and any(isinstance(each.rows, Copied) for each in (items[0], item)):
                break
            items.append(item)
        return items

    def written(self, items: list[Item]) -> None:
        """Remove the items of a commit; the next one may be larger."""
        for item in items:
            self._items.popleft()
            self.bytes -= item.size
            self.readings -= item.readings
        self._most = min(2 * self._most, MOST_ITEMS)

    def halve(self, items: list[Item]) -> bool:
        """Make the next commit smaller, since that of `items` failed; return whether this is possible.

        So as many rows as fit are written to a nearly full disk.
        """
        self._most = max(len(items) // 2, 1)
        return len(items) > 1
