"""Reading a ROS 2 sqlite3 file in the order of its rows, for files whose end or index is damaged."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from .salvage import Scan
from .source import Channel, RawMessage, full_type_name, one_line

MAGIC = b'SQLite format 3\0'


def has_log(file: Path) -> bool:
    """Return whether a write-ahead log with messages lies beside the file."""
    log = file.with_name(file.name + '-wal')
    return log.exists() and log.stat().st_size > 0


def is_cut(file: Path) -> bool:
    """Return whether the file is shorter than its header says; SQLite itself may read missing bytes as zeros."""
    with file.open('rb') as stream:
        page_size, pages = struct.unpack('>16xH10xI', stream.read(32).ljust(32, b'\0'))
    size = file.stat().st_size
    page_size = page_size if page_size > 1 else 65536  # 1 stands for what 16 bits cannot hold
    return size < pages * page_size or size % page_size > 0


class Sqlite3Scan(Scan):
    """Messages of a sqlite3 file up to the first page that is damaged or missing."""

    def _walk(self) -> Iterator[RawMessage]:
        # A recorder that was killed leaves its last messages in the write-ahead log, which 'immutable' would ignore.
        if is_cut(self._path):
            self._note('the file is cut off')
        options = 'mode=ro' if has_log(self._path) else 'mode=ro&immutable=1'
        with closing(sqlite3.connect(f'file:{quote(str(self._path.resolve()))}?{options}', uri=True)) as database:
            # Without this, SQLite refuses a file that is shorter than its header says.
            database.execute('PRAGMA writable_schema=ON')
            try:
                self._topics(database)
                for row in database.execute('SELECT topic_id, timestamp, data FROM messages NOT INDEXED'):
                    if _is_message(row):
                        yield row
                    else:
                        self._note('a row is damaged')
            except (sqlite3.Error, OverflowError) as error:
                self._note(one_line(error))

    def _topics(self, database: sqlite3.Connection) -> None:
        try:
            rows = database.execute('SELECT topic_type, encoding, encoded_message_definition FROM message_definitions')
            definitions = {row[0]: (str(row[1]).removeprefix('ros2'), str(row[2])) for row in rows}
        except sqlite3.Error:  # recorded before Iron, or damaged: there are default definitions
            definitions = {}
        for row in database.execute('SELECT id, name, type, serialization_format FROM topics'):
            key, topic, msgtype, encoding = int(row[0]), *(str(text) for text in row[1:])
            kind, definition = definitions.get(msgtype, ('none', ''))
            self._found[key] = Channel(key, topic, full_type_name(msgtype), encoding, kind, definition, 0)


def _is_message(row: tuple[Any, ...]) -> bool:
    return isinstance(row[0], int) and isinstance(row[1], int) and isinstance(row[2], bytes)
