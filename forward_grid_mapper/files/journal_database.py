"""Writes a journal file: created complete, written in transactions, and checked for changes by others.

SQLite locks the file, and keeps the index of its log in its own memory instead of a mapped file
(`locking_mode=EXCLUSIVE`): no other program can make it wait, or truncate a mapped file. Readers use a copy, see
`journal_reader`.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

from ..core.common.errors import BagError, OutputError
from ..core.common.readings import Readings
from .journal_format import APPLICATION, CONTINUES, DRIVE, ROW, TABLES, VERSION, Contents, Insert
from .journal_opening import connect, extent, log_of, one_line, unbounded
from .journal_reader import check, readings

PARTIAL = '.new.journal'
"""Name of a file before it is complete; an old one is overwritten."""

INSERT = {
    'drive': 'INSERT OR REPLACE INTO drive VALUES (?, ?, ?, ?)',
    'whole': 'DELETE FROM drive WHERE number = ?',
    'sensors': 'INSERT OR IGNORE INTO sensors VALUES (?, ?)',
    'path': 'INSERT OR IGNORE INTO path VALUES (?, ?)',
    'readings': 'INSERT OR IGNORE INTO readings VALUES (?, ?)',
}
"""Existing rows are ignored, except that of the drive, so that a commit with unknown outcome can be repeated.

`whole` is no table: it removes the name of the file that is continued.
"""

FULL = 'database or disk is full'
"""SQLite's message for a full disk; the transaction may be repeated with the same connection."""


@dataclass
class DriveFile:
    """A drive and its file.

    Attributes
    ----------
    path : Path
        The file; until it is created, it gets another number if this one is used.
    made : bool
        Whether the file was created.
    gone : bool
        Whether it vanished or was damaged since.
    next : int
        Number of the first reading after the committed ones.
    continues : str
        Name of the file with its earlier readings, as long as these were not copied; '' if there is none.
    head : list of (table, values)
        Rows without which its readings cannot be read, once the drive has ended; a file that is created has them.
    """

    path: Path
    made: bool = False
    gone: bool = False
    next: int = 0
    continues: str = ''
    head: list[Insert] = field(default_factory=list)


class LostFileError(Exception):
    """The file of a drive, or one that it continues, is not what was written to it; the message is the reason.

    It cannot be continued: readings in memory must be written to a new file.
    """

    def __init__(self, drive: DriveFile, why: str) -> None:
        super().__init__(why)
        self.drive = drive


class ClosedError(Exception):
    """The journal was closed by another thread."""


def number_of(path: Path) -> int:
    """Return the number in the name of a journal file."""
    match = DRIVE.fullmatch(path.name)
    return int(match[1]) if match else 0


def next_file(path: Path) -> Path:
    """Return the name of the journal file after `path`."""
    return path.with_name(f'drive_{number_of(path) + 1:04d}.journal')


class FolderLock:
    """The lock that allows one process at a time to write into a journal's folder."""

    def __init__(self, folder: Path) -> None:
        """Acquire the lock.

        Raises
        ------
        OutputError
            If another process has it.
        OSError
            If the folder cannot be written.
        """
        self._folder = folder
        self._file = self._take()

    def renew(self) -> None:
        """Create the folder and acquire its lock again if they were removed.

        Raises
        ------
        OutputError
            If another process has acquired it meanwhile.
        OSError
            If the folder cannot be created or written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            if os.path.samestat((self._folder / 'lock').stat(), os.fstat(self._file)):
                return
        taken = self._take()
        os.close(self._file)
        self._file = taken

    def release(self) -> None:
        """Release the lock."""
        os.close(self._file)

    def _take(self) -> int:
        file = os.open(self._folder / 'lock', os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException as error:
            os.close(file)
            if isinstance(error, BlockingIOError):
                raise OutputError(
                    f'{self._folder} is in use by another node; set a different journal for each'
                ) from None
            raise
        return file


class DriveWriter:
    """Writes rows into the file of a drive, and checks that the file is unchanged by others.

    For one thread at a time, except that any thread may call `end`.

    Attributes
    ----------
    drive : DriveFile or None
        The drive whose file is open.
    """

    def __init__(self, lock: FolderLock) -> None:
        self._lock = lock
        self.drive: DriveFile | None = None
        self._database: sqlite3.Connection | None = None
        self._size = 0
        self._files: dict[Path, os.stat_result] = {}
        self._forsaken: list[sqlite3.Connection] = []
        # held while the file is opened or closed, so that it cannot be opened after `end`
        self._opening = threading.Lock()
        self._ended = False

    def resume(self, drive: DriveFile) -> bool:
        """Open a file of an earlier run to continue it; return whether all of it is valid.

        Raises
        ------
        OutputError
            If another program has it open.
        """
        if drive.path.with_name(drive.path.name + '-journal').exists():
            # SQLite would apply any log, also one of another program
            return False
        try:
            self._connect(drive)
            contents = Contents()
            for _ in self.readings(contents):
                pass
            drive.next, drive.continues = contents.next, contents.continues
            if not contents.harm and self._database is not None:
                return True
        except sqlite3.OperationalError as error:
            if 'locked' in str(error):
                self.close()
                raise OutputError(f'{drive.path} is open in another program; close that first') from error
        except (sqlite3.Error, MemoryError, OSError, BagError, LostFileError, ClosedError):
            # its fault is found when it is read again
            pass
        self.close()
        return False

    def readings(self, contents: Contents, earlier: Callable[[], Iterable[Readings]] = tuple) -> Iterator[Readings]:
        """Yield the readings of the open file as `journal_reader.readings` does; none after `end`."""
        database = self._database
        if database is not None:
            yield from readings(database, self._size, contents, earlier)

    def write(self, drive: DriveFile, rows: Iterable[Insert], following: int) -> Path:
        """Commit rows to the file of a drive, which is created if needed; return SQLite's log, which contains them.

        Parameters
        ----------
        drive : DriveFile
        rows : iterable of (table, values)
        following : int
            Number of the first reading after them.

        Raises
        ------
        LostFileError
            If the file is not what was written to it.
        sqlite3.Error, OSError, OutputError
            If nothing can be written at the moment; no row was written.
        """
        try:
            self._open(drive)
            self._check()
            assert self._database is not None
            self._database.execute('BEGIN IMMEDIATE')
            for table, values in rows:
                self._database.execute(INSERT[table], values)
            self._database.execute('COMMIT')
            drive.next = max(drive.next, following)
            self._remember()
        except sqlite3.Error as error:
            if FULL not in str(error) or not self._rolled_back():
                # opened again at the next attempt, and compared with the committed rows
                self.close()
            if drive.made and (type(error) is sqlite3.DatabaseError or 'readonly' in str(error)):
                raise LostFileError(drive, one_line(error)) from error
            raise
        except BaseException:
            self.close()
            raise
        return log_of(drive.path)

    def empty_log(self) -> None:
        """Move the rows of the log into the file and truncate it, if possible: it keeps the size of a large commit."""
        if self._database is not None:
            with suppress(sqlite3.Error):
                self._database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
            # the next check finds a file that vanished
            with suppress(LostFileError):
                self._remember()

    def check_file(self) -> None:
        """Check that the open file and its log exist, and are not shorter than they were.

        Raises
        ------
        LostFileError
            If they are not.
        OSError
            If this cannot be checked.
        """
        try:
            self._check()
        except LostFileError:
            self.close()
            raise

    def end(self) -> None:
        """Close the file for ever, also if another thread opens or reads it."""
        with self._opening:
            self._ended = True
            self._close()

    def close(self) -> None:
        """Close the file; SQLite then moves its log into it."""
        with self._opening:
            self._close()

    def _close(self) -> None:
        database, files = self._database, self._files
        self.drive, self._database, self._files = None, None, {}
        if database is None:
            return
        for path, before in files.items():
            with suppress(OSError):
                if not os.path.samestat(before, path.stat()):
                    # SQLite would delete the log by its name, even if it now belongs to another file
                    self._forsaken.append(database)
                    return
        with suppress(sqlite3.Error):
            database.close()

    def _open(self, drive: DriveFile) -> None:
        if self._database is None or self.drive is not drive:
            self.close()
            if not drive.made:
                self._make(drive)
            if not drive.path.exists():
                raise LostFileError(drive, 'it was deleted or moved')
            try:
                self._connect(drive)
            except BagError as error:
                raise LostFileError(drive, str(error)) from error
            if self._next() < drive.next:
                raise LostFileError(drive, 'it contains less than was written to it')
        assert self._database is not None
        unbounded(self._database)

    def _connect(self, drive: DriveFile) -> None:
        with self._opening:
            if self._ended:
                raise ClosedError('the journal was closed')
            self._size = extent(drive.path)
            database = connect(drive.path, 'mode=rw', self._size)
            try:
                database.execute('PRAGMA synchronous=NORMAL')
                check(database, drive.path)
            except BaseException:
                database.close()
                raise
            self._database, self.drive = database, drive
            self._remember()

    def _next(self) -> int:
        """Return the number of the first reading after those in the file."""
        assert self._database is not None
        query = 'SELECT number, length(rows) FROM readings ORDER BY number DESC LIMIT 1'
        number, size = self._database.execute(query).fetchone() or (0, 0)
        return int(number) + int(size or 0) // ROW.itemsize

    def _rolled_back(self) -> bool:
        """Roll back a failed transaction; return whether the connection can still be used."""
        if self._database is None:
            return False
        with suppress(sqlite3.Error):
            if self._database.in_transaction:
                self._database.execute('ROLLBACK')
            return True
        return False

    def _make(self, drive: DriveFile) -> None:
        """Create the file of a drive under a hidden name, so that a file with the final name is always complete."""
        self._lock.renew()
        partial = [drive.path.with_name(PARTIAL + suffix) for suffix in ('', '-wal', '-journal')]
        for path in partial:
            path.unlink(missing_ok=True)
        with closing(connect(partial[0], 'mode=rwc', 0)) as database:
            database.execute('BEGIN IMMEDIATE')
            for sql in TABLES.values():
                database.execute(sql)
            if drive.continues:
                values = (CONTINUES, None, None, drive.continues.encode())
                database.execute(INSERT['drive'], values)
            for table, values in drive.head:
                database.execute(INSERT[table], values)
            database.execute(f'PRAGMA application_id={APPLICATION}')
            database.execute(f'PRAGMA user_version={VERSION}')
            database.execute('COMMIT')
            # stored in the file, for all connections that open it later
            database.execute('PRAGMA journal_mode=WAL')
        if any(path.exists() for path in partial[1:]):
            raise OSError(errno.EIO, 'a new file could not be completed')
        while os.path.lexists(drive.path):
            drive.path = next_file(drive.path)
        partial[0].rename(drive.path)
        drive.made = True

    def _remember(self) -> None:
        """Note identity and size of the open file and its log."""
        assert self.drive is not None
        path = self.drive.path
        try:
            self._files = {path: path.stat()}
            with suppress(FileNotFoundError):
                # it exists from the first transaction on
                self._files[log_of(path)] = log_of(path).stat()
        except FileNotFoundError:
            raise LostFileError(self.drive, f'{path.name} was deleted or moved') from None

    def _check(self) -> None:
        for path, before in self._files.items():
            assert self.drive is not None
            try:
                now = path.stat()
            except FileNotFoundError:
                raise LostFileError(self.drive, f'{path.name} was deleted or moved') from None
            if not os.path.samestat(before, now):
                raise LostFileError(self.drive, f'{path.name} was replaced by another file')
            if now.st_size < before.st_size:
                raise LostFileError(self.drive, f'{path.name} was truncated')
