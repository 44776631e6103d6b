"""Reads a ROS 2 sqlite3 file: an undamaged one by time, a damaged one from both ends to the first damaged page.

SQL can hide endless work in what looks like a table, so only plain tables are read, and the steps of SQLite's virtual
machine in each pass are bounded by the size of the file.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..core.common.errors import BagError
from .salvage import Scan
from .source import Channel, Damage, RawMessage, full_type_name, one_line

MAGIC = b'SQLite format 3\0'

STEPS, STEPS_A_BYTE = 2_000_000, 2
"""Steps of SQLite's virtual machine in one pass, and further ones for every byte of the file: sorting and reading a
row needs about 40, and it has at least 60 bytes. A small file takes half a second."""

STEPS_A_CALL = 10_000
"""Steps between two checks of their number."""

LARGEST_MESSAGE = 128 << 20
"""Most bytes of a message; a longer one counts as damaged, and is not loaded."""

MOST_TOPICS = 10_000
"""Most topics of a file; further ones are not read."""

_TABLES = ('messages', 'topics', 'message_definitions')
_COLUMNS = f"topic_id, timestamp, CASE WHEN typeof(data) = 'blob' AND length(data) <= {LARGEST_MESSAGE} THEN data END"
_ROW = f'SELECT {_COLUMNS} FROM messages NOT INDEXED'
_NUMBERED_ROW = f'SELECT {_COLUMNS}, rowid FROM messages NOT INDEXED'


def has_log(file: Path) -> bool:
    """Return whether there is a write-ahead log with messages beside the file."""
    log = file.with_name(file.name + '-wal')
    return log.is_file() and log.stat().st_size > 0


def _may_index_log(file: Path) -> bool:
    """Return whether SQLite finds its index of the log, a file beside the log, or can create it."""
    return file.with_name(file.name + '-shm').exists() or os.access(file.parent, os.W_OK)


def is_cut(file: Path) -> bool:
    """Return whether the file is shorter than its header states; SQLite itself may read missing bytes as zeros."""
    with file.open('rb') as stream:
        page_size, pages = struct.unpack('>16xH10xI', stream.read(32).ljust(32, b'\0'))
    size = file.stat().st_size
    page_size = page_size if page_size > 1 else 65536  # 1 means 65536, which does not fit into 16 bits
    return size < pages * page_size or size % page_size > 0


class Sqlite3Scan(Scan):
    """Messages of a sqlite3 file; of a damaged one those before the first damaged page and those after the last one.

    Of a file that is cut off, those before the first missing page.
    """

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time."""
        if self.damage is None:
            try:
                with closing(self._connect()) as database:
                    chosen = ', '.join(str(key) for key in sorted(keys))
                    for row in database.execute(f'{_ROW} WHERE topic_id IN ({chosen}) ORDER BY timestamp, rowid'):
                        if _is_message(row):
                            yield row
                        else:
                            self._note('a row is damaged')
                    return
            except (sqlite3.Error, OverflowError, Damage) as error:
                # it sorts before it yields the first row, so that no message was yielded yet
                self._note(_reason(error))
        yield from super().messages(keys)

    def _count(self) -> Counter[int]:
        """Return the number of messages by channel, without loading their contents if the file is undamaged."""
        if is_cut(self._path):
            self._note('the file is cut off')
        else:
            try:
                with closing(self._connect()) as database:
                    self._topics(database)
                    columns = 'topic_id, count(*), min(timestamp), max(timestamp)'
                    query = f'SELECT {columns} FROM messages NOT INDEXED GROUP BY topic_id'
                    rows = database.execute(query).fetchall()
                    if rows and all(isinstance(time, int) for row in rows for time in row[2:]):
                        self.span = min(row[2] for row in rows), max(row[3] for row in rows)
                    return Counter({row[0]: row[1] for row in rows})
            except (sqlite3.Error, OverflowError, Damage) as error:
                self._note(_reason(error))
        return super()._count()

    def _walk(self) -> Iterator[RawMessage]:
        last = -(1 << 63)
        try:
            with closing(self._connect()) as database:
                self._topics(database)
                for row in database.execute(f'{_NUMBERED_ROW} ORDER BY rowid'):
                    last = row[3]
                    yield from self._checked(row)
        except (sqlite3.Error, OverflowError, Damage) as error:
            self._note(_reason(error))
            # an OperationalError is no damaged page, and at the end of a file that is cut off are no messages
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError):
                yield from () if is_cut(self._path) else self._from_the_end(last)

    def _from_the_end(self, first: int) -> Iterator[RawMessage]:
        """Yield the messages after the row `first` from the last one on, up to a damaged page."""
        with suppress(sqlite3.Error, OverflowError, Damage), closing(self._connect()) as database:
            for *row, _ in database.execute(f'{_NUMBERED_ROW} WHERE rowid > ? ORDER BY rowid DESC', (first,)):
                yield from self._checked(row)

    def _checked(self, row: Sequence[Any]) -> Iterator[RawMessage]:
        if _is_message(row):
            yield row[0], row[1], row[2]
        else:
            self._note('a row is damaged')

    def _connect(self) -> sqlite3.Connection:
        """Open the file for reading.

        Raises
        ------
        Damage
            If a table's name belongs to something other than a plain table.
        BagError
            If messages are in a write-ahead log that cannot be read in its folder.
        """
        # A recorder that was killed leaves its last messages in the write-ahead log, which 'immutable' would ignore.
        options = 'mode=ro' if has_log(self._path) else 'mode=ro&immutable=1'
        if has_log(self._path) and not _may_index_log(self._path):
            raise BagError(
                f'{self._path} has messages in a log next to it, {self._path.name}-wal, which can only be read in a '
                'writable folder; copy the bag to one, with all its files.'
            )
        # a path of any bytes; SQLite unquotes it
        database = sqlite3.connect(f'file:{quote(os.fsencode(self._path.resolve()))}?{options}', uri=True)
        try:
            # Without this, SQLite refuses a file that is shorter than its header states.
            database.execute('PRAGMA writable_schema=ON')
            left = STEPS + STEPS_A_BYTE * self._path.stat().st_size

            def spent() -> bool:
                nonlocal left
                left -= STEPS_A_CALL
                return left < 0

            database.set_progress_handler(spent, STEPS_A_CALL)
            _refuse_what_is_no_table(database)
        except BaseException:
            database.close()
            raise
        return database

    def _topics(self, database: sqlite3.Connection) -> None:
        try:
            rows = database.execute('SELECT topic_type, encoding, encoded_message_definition FROM message_definitions')
            definitions = {row[0]: (str(row[1]).removeprefix('ros2'), str(row[2])) for row in rows}
        except sqlite3.Error:  # recorded before Iron, or damaged: default definitions are used
            definitions = {}
        found = database.execute(f'SELECT id, name, type, serialization_format FROM topics LIMIT {MOST_TOPICS}')
        for row in found:
            key, topic, msgtype, encoding = int(row[0]), *(str(text) for text in row[1:])
            kind, definition = definitions.get(msgtype, ('none', ''))
            self._found[key] = Channel(key, topic, full_type_name(msgtype), encoding, kind, definition, 0)


def _refuse_what_is_no_table(database: sqlite3.Connection) -> None:
    places = ', '.join('?' * len(_TABLES))
    found = database.execute(f'SELECT name, type, rootpage FROM sqlite_master WHERE lower(name) IN ({places})', _TABLES)
    for name, kind, page in found.fetchall():
        # a virtual table has no page of its own
        if kind != 'table' or not page:
            raise Damage(
                f'{str(name)[:40]!r} is a {str(kind)[:20] if kind != "table" else "virtual table"}, not a table'
            )
        quoted = str(name).replace('"', '""')
        columns = database.execute(f'PRAGMA table_xinfo("{quoted}")').fetchall()
        if computed := [str(row[1])[:40] for row in columns if row[6]]:
            raise Damage(f'the column {computed[0]!r} of {name!r} is computed, not stored')


def _reason(error: BaseException) -> str:
    if isinstance(error, sqlite3.OperationalError) and 'interrupted' in str(error):
        return 'reading it takes more work than an intact file of its size'
    return one_line(error)


def _is_message(row: Sequence[Any]) -> bool:
    return isinstance(row[0], int) and isinstance(row[1], int) and isinstance(row[2], bytes)
