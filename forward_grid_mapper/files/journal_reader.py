"""Reads a journal file of any origin, also while a node writes it.

The file is not trusted (see also `journal_opening`): it must have the tables of a journal and no others, so that no
view or trigger runs, and all contents pass the checks of `journal_format`. Damage costs only the damaged part, or all
that follows it.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import BagError
from ..core.common.readings import Readings
from . import journal_previous
from .journal_format import (
    APPLICATION,
    CONTINUES,
    LONGEST,
    ROW,
    SQLITE,
    TABLES,
    VERSION,
    Contents,
    in_chunks,
)
from .journal_opening import INTERRUPTED, head_of, one_line, open_for_reading

APPLICATION_AT = 68
"""Offset of the application id in the header of an SQLite database."""

MOST_ROWS = 1 << 40
"""Largest row number: a reading per microsecond for twelve days."""

MOST_FILES = 50
"""Most files that continue each other; each one but the last could not be read when the next one began."""


def is_journal(path: Path) -> bool:
    """Return whether a file is a journal, by its first bytes.

    Raises
    ------
    OSError
        If it cannot be read, or is not a regular file.
    """
    head = head_of(path, APPLICATION_AT + 4)
    ours = head.startswith(SQLITE) and head[APPLICATION_AT:] == APPLICATION.to_bytes(4, 'big')
    return ours or head.startswith(journal_previous.MAGIC)


def read(path: Path, contents: Contents, newer: tuple[str, ...] = ()) -> Iterator[Readings]:
    """Yield the readings of a journal file, about `journal_format.CHUNK` at a time, and fill `contents`.

    Those of the files that it continues come first. `newer` has the names of the files that continue this one.

    Raises
    ------
    BagError
        If the file cannot be read, or is not a journal.
    """
    try:
        if head_of(path, len(journal_previous.MAGIC)) == journal_previous.MAGIC:
            yield from journal_previous.read(path, contents)
            return
        with open_for_reading(path) as (database, size):
            check(database, path)
            yield from readings(database, size, contents, lambda: read_earlier(path, contents, newer))
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror or error}') from error
    except (sqlite3.Error, MemoryError) as error:
        raise BagError(f'{path} cannot be read: {one_line(error)}') from error


def read_earlier(path: Path, contents: Contents, newer: tuple[str, ...] = ()) -> Iterator[Readings]:
    """Yield the readings of the file that `path` continues, and add what it has to the contents of `path`.

    If it cannot be read, `contents.unread` is the reason.
    """
    source = path.with_name(contents.continues)
    earlier, newer = Contents(), (*newer, path.name)
    try:
        if contents.continues in newer or len(newer) > MOST_FILES:
            raise BagError(f'{path.name} is one of too many files that continue each other')
        yield from read(source, earlier, newer)
    except BagError as error:
        if os.path.lexists(source):
            earlier.unread = str(error)
        else:
            earlier.fault(f'it was removed, so {path.name} lacks its readings')
    contents.put_before(earlier)


def check(database: sqlite3.Connection, path: Path) -> None:
    """Check that a database has the tables of a journal, and nothing else.

    Raises
    ------
    BagError
        If it is not a journal, or has another version.
    sqlite3.Error
        If it is damaged, or locked by another program.
    """
    application = database.execute('PRAGMA application_id').fetchone()[0]
    version = database.execute('PRAGMA user_version').fetchone()[0]
    if application != APPLICATION or version < 1:
        raise BagError(f'{path} is not a journal')
    if version != VERSION:
        raise BagError(f'{path} was written by another version of this program (format {version}, not {VERSION})')
    query = 'SELECT type, name, tbl_name, sql FROM sqlite_master LIMIT ?'
    found = set(database.execute(query, (len(TABLES) + 1,)).fetchall())
    if found != {('table', name, name, sql) for name, sql in TABLES.items()}:
        raise BagError(f'{path} has other tables than a journal, so it is not read')


def readings(
    database: sqlite3.Connection, size: int, contents: Contents, earlier: Callable[[], Iterable[Readings]] = tuple
) -> Iterator[Readings]:
    """Yield the readings of a database that passed `check`, and fill `contents`.

    `earlier` gives the readings of the file that this one continues; it is called if there is one, and without it they
    are left out. A part that cannot be read is noted in `contents`, and nothing after it is read.
    """
    table = _Table(database, size)
    try:
        for number, map_frame, base_frame, text in table.rows('drive', 'map_frame', 'base_frame', 'parameters'):
            if number == CONTINUES:
                contents.set_continued(text)
            else:
                contents.set_frames(map_frame, base_frame)
                contents.set_parameters(text)
        for number, name in table.rows('sensors', 'name'):
            contents.add_sensor(number, name)
        for number, points in table.rows('path', 'points'):
            contents.add_path(points)
            contents.next_points = number + 1
    except (sqlite3.Error, MemoryError, _DamagedError) as error:
        _note(contents, f'its data other than readings cannot be read: {one_line(error)}', error)
    if contents.continues:
        yield from earlier()
    yield from in_chunks(_blocks(table, contents), contents)


def _blocks(table: _Table, contents: Contents) -> Iterator[NDArray[np.void]]:
    try:
        for number, data in table.rows('readings', 'rows'):
            if number < contents.next:
                raise _DamagedError('some of its readings are duplicates')
            if not isinstance(data, bytes) or not data or len(data) % ROW.itemsize:
                contents.fault('some of its blocks contain no readings')
                contents.next = number + 1
                continue
            rows = np.frombuffer(data, ROW)
            contents.next = number + len(rows)
            yield rows
    except (sqlite3.Error, MemoryError, _DamagedError) as error:
        _note(contents, f'it cannot be read to its end: {one_line(error)}', error)


def _note(contents: Contents, fault: str, error: Exception) -> None:
    contents.fault(fault)
    # SQLite reports damage by the class above that of these
    if isinstance(error, (sqlite3.OperationalError, MemoryError)) and INTERRUPTED not in str(error):
        contents.unread = fault


class _DamagedError(Exception):
    """A node cannot have written the contents of the database."""


class _Table:
    """Reads tables of a database row by row, up to as many bytes as the file has: damaged rows may overlap."""

    def __init__(self, database: sqlite3.Connection, size: int) -> None:
        self._database = database
        self._left = size

    def rows(self, table: str, *columns: str) -> Iterator[tuple[Any, ...]]:
        """Yield the key of each row in ascending order, and its values; None for values that a journal cannot have.

        Raises
        ------
        sqlite3.Error, _DamagedError
            If the table is damaged.
        """
        # typeof and length read only the header of a row, so that a value of gigabytes is never loaded
        values = ', '.join(f"CASE WHEN typeof({c})='blob' AND length({c})<={LONGEST} THEN {c} END" for c in columns)
        last = -1
        with closing(self._database.execute(f'SELECT number, {values} FROM {table} ORDER BY number')) as cursor:
            for row in cursor:
                # if branches of a damaged tree share leaves, reading would never end
                if not last < row[0] < MOST_ROWS:
                    raise _DamagedError('its rows are out of order')
                last = row[0]
                self._left -= sum(len(value) for value in row[1:] if value is not None)
                if self._left < 0:
                    raise _DamagedError('its rows contain more than the file')
                yield row
