"""Opens a journal file of any origin as a database, also while a node writes it.

The file is not trusted: the work of SQLite and the length of each value are bounded by the size of the file.

The node locks its file, and keeps the latest readings in the log beside it (`-wal`). So a reader copies both, and opens
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
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from ..core.common.errors import BagError
from .journal_format import LONGEST

PAGES_AT = 28
"""Offset of the number of pages in that header."""

LOG_HEAD = 32
"""Bytes of the header of the log. They change each time the log begins again."""

TRIES = 20
"""Most attempts to get a consistent copy; the log begins again about once a minute."""

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

MOST_MEMORY = 256 << 20
"""Most memory of SQLite, bytes, for Python 3.10, which cannot bound the length of a value; a hundred times its need."""


def log_of(path: Path) -> Path:
    """Return the log beside a journal file, where SQLite keeps the latest rows."""
    return path.with_name(path.name + '-wal')


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


def one_line(error: BaseException) -> str:
    """Return the message of SQLite in one line."""
    text = ' '.join(str(error).split()) or type(error).__name__
    return 'it is damaged: reading it takes more steps than it has bytes' if text == INTERRUPTED else text


@contextmanager
def open_for_reading(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open a journal without writing beside it; yields the connection and the number of bytes."""
    log = log_of(path)
    with tempfile.TemporaryDirectory(prefix='journal_') as folder:
        for _ in range(TRIES):
            head = _log_head(log)
            cut = _is_cut_off(path)
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


def _is_cut_off(path: Path) -> bool:
    """Return whether a database is shorter than its header states; SQLite refuses to read such a file."""
    head = head_of(path, PAGES_AT + 4).ljust(PAGES_AT + 4, b'\0')
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


def head_of(path: Path, count: int) -> bytes:
    """Return the first bytes of a file, at most `count`."""
    with opened(path) as file:
        return os.pread(file, count, 0)


def _log_head(log: Path) -> bytes:
    try:
        return head_of(log, LOG_HEAD)
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
