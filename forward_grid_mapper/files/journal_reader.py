"""Reads a journal file of any origin, also while a node writes it.

The file is not trusted: it must have the tables of a journal and no others, so that no view or trigger runs; the work
and the length of each value are bounded by the size of the file; and all contents pass the checks of `journal_format`.
Damage costs only the damaged part, or all that follows it.

The node locks its file, and keeps the latest readings in the log beside it (`-wal`). So a reader copies both, and reads
the copies. It never writes into the journal's folder, and maps no file into memory, so that truncation of the file is
an error and not a signal.
"""

from __future__ import annotations

import errno
import os
import sqlite3
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

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

APPLICATION_AT = 68
"""Offset of the application id in the header of an SQLite database."""

PAGES_AT = 28
"""Offset of the number of pages in that header."""

LOG_HEAD = 32
"""Bytes of the header of the log. They change each time the log begins again."""

TRIES = 20
"""Most attempts to get a consistent copy; the log begins again about once a minute."""

MOST_ROWS = 1 << 40
"""Largest row number: a reading per microsecond for twelve days."""

STEPS = 10_000
"""Steps of SQLite's virtual machine between two checks of their number."""

LEAST_BYTES = 64 << 20
"""Bytes of contents that are allowed for a file of any size."""

MOST_PACKED = 64
"""Most bytes of contents for each byte on the disk: file systems compress, and files have holes."""

LEAST_STEPS = 1_000_000
"""Steps that are allowed for a file of any size; a hundredth of a second."""

STEPS_A_BYTE = 4
"""Steps that are allowed for each byte of the file: a row needs about 15, and has 10 bytes or more."""

INTERRUPTED = 'interrupted'
"""SQLite's message if these steps are exceeded."""

MOST_FILES = 50
"""Most files that continue each other; each one but the last could not be read when the next one began."""

MOST_MEMORY = 256 << 20
"""Most memory of SQLite, bytes, for Python 3.10, which cannot bound the length of a value; a hundred times its need."""


def is_journal(path: Path) -> bool:
    """Return whether a file is a journal, by its first bytes.

    Raises
    ------
    OSError
        If it cannot be read, or is not a regular file.
    """
    head = _head(path, APPLICATION_AT + 4)
    ours = head.startswith(SQLITE) and head[APPLICATION_AT:] == APPLICATION.to_bytes(4, 'big')
    return ours or head.startswith(journal_previous.MAGIC)


def log_of(path: Path) -> Path:
    """Return the log beside a journal file, where SQLite keeps the latest rows."""
    return path.with_name(path.name + '-wal')


def read(path: Path, contents: Contents, newer: tuple[str, ...] = ()) -> Iterator[Readings]:
    """Yield the readings of a journal file, about `journal_format.CHUNK` at a time, and fill `contents`.

    Those of the files that it continues come first. `newer` has the names of the files that continue this one.

    Raises
    ------
    BagError
        If the file cannot be read, or is not a journal.
    """
    try:
        if _head(path, len(journal_previous.MAGIC)) == journal_previous.MAGIC:
            yield from journal_previous.read(path, contents)
            return
        with _for_reading(path) as (database, size):
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


def extent(path: Path) -> int:
    """Return how many bytes of contents a journal and its log may have.

    Raises
    ------
    OSError
        If the file does not exist, or one of the two is not a regular file: SQLite would wait for a pipe.
    """
    found = [path.stat()]
    with suppress(FileNotFoundError):
        found.append(log_of(path).stat())
    if not all(stat.S_ISREG(status.st_mode) for status in found):
        raise OSError(errno.EINVAL, 'it is not a regular file')
    return sum(min(status.st_size, LEAST_BYTES + MOST_PACKED * 512 * status.st_blocks) for status in found)


def connect(path: Path, options: str, size: int) -> sqlite3.Connection:
    """Open a database with unknown contents; `size` bytes bound the work until `unbounded` is called."""
    # a path of any bytes; SQLite unquotes it
    name = f'file:{quote(os.fsencode(path.absolute()))}?{options}'
    database = sqlite3.connect(name, uri=True, timeout=0.0, isolation_level=None, check_same_thread=False)
    left = [LEAST_STEPS + STEPS_A_BYTE * size]

    def step() -> bool:
        left[0] -= STEPS
        return left[0] < 0

    try:
        database.set_progress_handler(step, STEPS)
        if sys.version_info >= (3, 11):
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
        else:
            database.execute(f'PRAGMA hard_heap_limit={MOST_MEMORY}')
        # exclusive: without shared memory, which others could truncate
        for pragma in (
            *('mmap_size=0', 'trusted_schema=OFF', 'cell_size_check=ON', 'temp_store=MEMORY'),
            'locking_mode=EXCLUSIVE',
        ):
            database.execute(f'PRAGMA {pragma}')
    except BaseException:
        database.close()
        raise
    return database


def unbounded(database: sqlite3.Connection) -> None:
    """Remove the bound of a connection, since its file is known to be a journal."""
    database.set_progress_handler(None, 0)


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


def one_line(error: BaseException) -> str:
    """Return the message of SQLite in one line."""
    text = ' '.join(str(error).split()) or type(error).__name__
    return 'it is damaged: reading it takes more steps than it has bytes' if text == INTERRUPTED else text


@contextmanager
def _for_reading(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open a journal without writing beside it; yields the connection and the number of bytes."""
    log = log_of(path)
    with tempfile.TemporaryDirectory(prefix='journal_') as folder:
        for _ in range(TRIES):
            head = _log_head(log)
            cut = _pages_cut_off(path)
            if not head and not cut:
                before, size = path.stat(), extent(path)
                with closing(connect(path, 'mode=ro&immutable=1', size)) as database:
                    yield database, size
                after = path.stat()
                if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
                    raise BagError(f'{path} was written while it was read; read it again')
                return
            copy = Path(folder) / 'copy'
            size = _copy(path, copy) + (_copy(log, log_of(copy)) if head else 0)
            if cut:
                with copy.open('r+b') as file:
                    # SQLite then counts the pages by itself
                    file.seek(PAGES_AT)
                    file.write(bytes(4))
            # Rows that SQLite moved from the log into the file meanwhile are also in the copy of the log, unless the
            # log began again.
            if head == _log_head(log) == _log_head(log_of(copy)):
                with closing(connect(copy, 'mode=rw', size)) as database:
                    yield database, size
                return
    raise BagError(f'{path} changes too fast to be read; stop the node that writes it')


def _pages_cut_off(path: Path) -> bool:
    """Return whether a database is shorter than its header states; SQLite refuses to read such a file."""
    head = _head(path, PAGES_AT + 4).ljust(PAGES_AT + 4, b'\0')
    size, pages = int.from_bytes(head[16:18], 'big'), int.from_bytes(head[PAGES_AT:], 'big')
    # 1 means 65536, which does not fit into 16 bits
    return path.stat().st_size < pages * (size if size > 1 else 1 << 16)


@contextmanager
def opened(path: Path) -> Iterator[int]:
    """Open a regular file for reading and yield its descriptor; a pipe is an error instead of a wait.

    Raises
    ------
    OSError
    """
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            raise OSError(errno.EINVAL, 'it is not a regular file')
        yield file
    finally:
        os.close(file)


def _head(path: Path, count: int) -> bytes:
    with opened(path) as file:
        return os.pread(file, count, 0)


def _log_head(log: Path) -> bytes:
    try:
        return _head(log, LOG_HEAD)
    except FileNotFoundError:
        return b''


def _copy(source: Path, target: Path) -> int:
    """Copy a file without its holes; return the number of bytes copied.

    Raises
    ------
    BagError
        If there is no space.
    OSError
    """
    copied = at = 0
    try:
        with opened(source) as file, target.open('wb') as out:
            end = os.fstat(file).st_size
            out.truncate(end)
            while at < end:
                at = os.lseek(file, at, os.SEEK_DATA)
                hole = os.lseek(file, at, os.SEEK_HOLE)
                os.lseek(out.fileno(), at, os.SEEK_SET)
                while at < hole:
                    sent = os.sendfile(out.fileno(), file, at, hole - at)
                    if not sent:
                        # it was truncated meanwhile
                        return copied
                    at, copied = at + sent, copied + sent
    except OSError as error:
        if error.errno == errno.ENXIO:
            # only a hole remains
            return copied
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise BagError(
                f'{source} is being written, and {target.parent.parent} has no space for a copy of it, which is '
                'needed for reading; free some space, or set TMPDIR to another folder'
            ) from error
        raise
    return copied
