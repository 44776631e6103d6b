"""A journal: a folder with every accepted reading on disk, so that a node that crashes loses at most a second.

The folder contains `drive_0001.journal`, `drive_0002.journal` and so on, a new file after every reset, and `lock`, by
which only one node at a time can write. While a node writes, SQLite's log (`drive_0001.journal-wal`) is beside its
file. Nothing is ever deleted.

A file that cannot be continued stays as it is. The next one names it, and gets a copy of its readings; until then, they
are read from the old one at each start, see `journal_format`.

A thread commits rows as soon as it receives them; killing the process does not undo this: `synchronous=NORMAL` waits
for the disk only when SQLite moves its log into the file, once in 4 MB. A second thread syncs the log once a second,
so that a power cut loses little more than a second. The node's own thread never waits for the disk.
"""

from __future__ import annotations

import itertools
import json
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ..core.common.errors import BagError, OutputError
from ..core.common.readings import Readings
from .journal_backlog import Backlog, Copied, Everything, Item, StoppedError
from .journal_database import FULL, DriveFile, DriveWriter, FolderLock, LostFileError, next_file, number_of
from .journal_format import DRIVE, OWN, Contents, Insert, encoded, path_rows, reading_rows, with_mounts
from .journal_opening import one_line
from .journal_reader import is_journal, read_earlier
from .output_folder import expanded, output_errors
from .syncing import Syncer

MOST_PENDING = 32 << 20
"""Most bytes that wait for a full or slow disk; half a million readings. Later readings are not in the journal."""

RETRY = 1.0
"""Seconds between attempts to write."""

STEADY = 10.0
"""Seconds without a failed attempt, and with nothing left to write, after which writing works again: on a disk that is
nearly full, some attempts succeed."""

PATIENCE = 10.0
"""Longest time that the start waits for a slow disk in each step, seconds."""

CHECK_PERIOD = 1.0
"""Seconds between two checks that the file still exists, if nothing is written."""


def drives(folder: Path) -> list[Path]:
    """Return the files of a journal, oldest first; empty if the folder is not a journal.

    Raises
    ------
    OSError
        If the folder cannot be searched.
    """
    found = [path for path in folder.iterdir() if DRIVE.fullmatch(path.name)] if folder.is_dir() else []
    return sorted(found, key=number_of)


def drive_file(path: Path) -> Path | None:
    """Return the journal file at `path`: itself, or the newest one of a journal's folder; None if it is neither."""
    try:
        if path.is_dir():
            return next(reversed(drives(path)), None)
        return path if is_journal(path) else None
    except OSError:
        return None


class Journal:
    """A journal open for writing. Its methods return at once; a thread does the work.

    Attributes
    ----------
    contents : Contents
        Contents of the file when it was opened, once `restore` is exhausted.
    trouble : str
        The reason why nothing can be written at the moment; '' if none.
    notice : str
        The last fault of a file that was repaired; '' if none.
    noticed : float
        Its time, by `time.monotonic`.
    lost : int
        Number of readings of the drive that will never be in the journal.
    parameters : dict
        Parameters of the node that are not the defaults, to be stored in the file.
    """

    def __init__(self, folder: Path | str, warn: Callable[[str], object]) -> None:
        """Lock the folder of a journal; call `restore` before anything else.

        Raises
        ------
        OutputError
            If another process has locked it, or the folder is a file, or cannot be made or written.
        """
        self.folder = expanded(folder).absolute()
        if os.path.lexists(self.folder) and not self.folder.is_dir():
            inside = f': give {self.folder.parent}' if DRIVE.fullmatch(self.folder.name) else ''
            raise OutputError(f'{self.folder} is a file, but a journal is a folder{inside}')
        self._warn = warn
        self.trouble = self.notice = ''
        self.noticed = 0.0
        self.lost = 0
        self.contents = Contents()
        self.parameters: dict[str, Any] = {}
        self._backlog = Backlog()
        self._last_failed = 0.0
        self._wake = threading.Condition()
        self._closing = False
        self._syncer: Syncer | None = None
        self._thread: threading.Thread | None = None
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = FolderLock(self.folder)
            try:
                found = drives(self.folder)
            except BaseException:
                self._lock.release()
                raise
        self._writer = DriveWriter(self._lock)
        self._source = found[-1] if found else None
        self._drive = DriveFile(self._source or self.folder / 'drive_0001.journal', made=bool(found))
        self._numbers: dict[str, int] = {}
        self._stated: tuple[Any, ...] = ()
        self._next = self._next_points = self._copied = 0

    @property
    def path(self) -> Path:
        """The file of the current drive."""
        return self._drive.path

    @property
    def gone(self) -> bool:
        """Whether the file vanished or was damaged, so that `renew` must write the readings in memory to a new one."""
        return self._drive.gone

    @property
    def unwritten(self) -> int:
        """Number of readings that wait to be written."""
        return self._backlog.readings

    def restore(self) -> Iterator[Readings]:
        """Yield the readings of the current drive, and begin to accept new ones.

        A file that is damaged, or has the previous format, is not changed: a new one continues it, into which its
        readings are copied in the background.

        Raises
        ------
        OutputError
            If another program has the file open.
        """
        source, contents = self._source, self.contents
        if source is not None and self._writer.resume(self._drive):
            yield from self._writer.readings(contents, self._earlier)
            # it was valid a moment ago
            self._drive.gone = bool(contents.harm)
            self._numbers = {name: number for number, name in contents.sensors.items()}
            self._stated = (contents.map_frame, contents.base_frame, contents.parameters)
            self._next, self._next_points = contents.next, contents.next_points
            if contents.continues:
                self._next, self._next_points = max(self._next, OWN), max(self._next_points, OWN)
            self._work_in_background()
        else:
            if self._closing:
                # a file that was closed meanwhile seems to be damaged
                return
            if source is not None:
                contents.continues = source.name
                self._drive = DriveFile(next_file(source), continues=source.name)
                self._next = self._next_points = OWN
            self._work_in_background()
            # the file must exist before the first reading
            self._queue((), 0, 0)
            self._wait_for(lambda: self._drive.made)
            if source is not None:
                yield from self._earlier()
        if contents.continues and not self._drive.gone and not self._closing:
            self._copy_earlier()

    def _earlier(self) -> Iterator[Readings]:
        """Yield the readings of the file that the current one continues."""
        for readings in read_earlier(self.path, self.contents):
            self._copied += len(readings)
            yield readings

    def _copy_earlier(self) -> None:
        """Copy these readings in the background; if some cannot be read now, a later start does."""
        contents, path = self.contents, self.path
        files = list(contents.earlier_files(path))
        for file, earlier in files:
            for text in filter(None, (earlier.note, earlier.harm)):
                self._notice(f'{file}: {text}; the journal continues in {path.name}')
        names = [name for _, earlier in files for name in earlier.sensors.values()]
        # until the node states its own; the file may have none
        self.parameters, self._stated = with_mounts(contents.parameters, contents.mounts), ()
        self._put_rows(self._head(names, (contents.map_frame, contents.base_frame)), 0)
        if contents.unread:
            self._notice(
                f'{contents.unread}; the journal continues in {path.name}, and each start tries again until the file '
                'is removed'
            )
        else:
            if not self._copied:
                # perhaps it was removed before, so it need not stay
                self._drive.continues = ''
            rows = Copied(path, contents.continues, dict(self._numbers), self._copied, lambda: self._closing)
            self._queue(rows, self._copied, 0)

    def put(self, readings: Readings | None, frames: tuple[str, str], path: Iterable[tuple[float, float]] = ()) -> None:
        """Append readings, new points of the robot's path, and the map and base frame if they are new."""
        count = 0 if readings is None else len(readings)
        if self._backlog.bytes > MOST_PENDING:
            if not self.lost:
                self._warn(
                    f'journal {self.path}: too many readings wait to be written; new readings are lost from now on'
                )
            self.lost += count
            return
        rows = self._head(() if readings is None else readings.sensor_names, frames)
        points = list(path_rows(list(path), self._next_points))
        self._next_points += len(points)
        rows += points
        if readings is not None:
            rows += reading_rows(readings, self._numbers, self._next)
        self._next += count
        self._put_rows(rows, count)

    def begin_drive(self) -> None:
        """Continue in a new file; the old one is kept, or the current one continues if nothing was written yet."""
        self.lost = 0
        if any(self._stated) or self._next:
            self._begin()

    def renew(self, readings: Readings, frames: tuple[str, str], path: Iterable[tuple[float, float]]) -> None:
        """Continue in a new file, which begins with all readings in memory, since the current one is `gone`."""
        # readings that could not be read are not in memory
        self._begin(self._drive.continues if self.contents.unread and not self._copied else '')
        # also those that could not be written before
        self.lost = 0
        head = self._head(readings.sensor_names, frames)
        points, first = list(path), self._next
        self._next, self._next_points = first + len(readings), first + len(points)
        self._queue(Everything(head, readings, dict(self._numbers), points, first), len(readings), 0)

    def close(self, seconds: float = 2.0) -> None:
        """Write the remaining rows if this takes at most this many seconds, and unlock the folder."""
        with self._wake:
            self._closing = True
            self._wake.notify_all()
            thread, syncer = self._thread, self._syncer
        if thread is None or syncer is None:
            self._unlock()
            return
        # it unlocks the folder, now or when the disk has finished
        thread.join(seconds)
        if not thread.is_alive():
            syncer.close(seconds)

    def _begin(self, continues: str = '') -> None:
        """Begin a new drive with its file, which may continue an earlier one."""
        with self._wake:
            if self._drive.gone:
                # rows for a file that will not return
                self._backlog.drop(self._drive)
            self._drive.head = self._names()
            self._drive = DriveFile(next_file(self._drive.path), continues=continues)
        self._numbers, self._stated = {}, ()
        self._next = self._next_points = OWN if continues else 0
        self._queue((), 0, 0)

    def _head(self, names: Iterable[str], frames: tuple[str, str]) -> list[Insert]:
        """Return the rows that must precede those of readings of these sensors."""
        rows: list[Insert] = []
        stated = (*frames, self.parameters)
        if stated != self._stated:
            self._stated = stated
            rows.append(_drive_row(*stated))
        for name in names:
            if name not in self._numbers:
                self._numbers[name] = max(self._numbers.values(), default=-1) + 1
                rows.append(('sensors', (self._numbers[name], encoded(name))))
        return rows

    def _names(self) -> list[Insert]:
        """Return all rows that must precede the readings of the drive."""
        rows = [_drive_row(*self._stated)] if self._stated else []
        return [*rows, *(('sensors', (number, encoded(name))) for name, number in self._numbers.items())]

    def _put_rows(self, rows: list[Insert], readings: int) -> None:
        if rows:
            self._queue(rows, readings, sum(len(values[-1]) for _, values in rows))

    def _queue(self, rows: Iterable[Insert], readings: int, size: int) -> None:
        # `OWN` is no number of a reading yet
        written = 0 if self._next == OWN else self._next
        with self._wake:
            self._backlog.append(Item(self._drive, rows, readings, size, written))
            self._wake.notify_all()

    # in the background

    def _work_in_background(self) -> None:
        with self._wake:
            # a journal that was closed during `restore` must not write, since another one may use the folder by now
            if not self._closing:
                syncer = self._syncer = Syncer(self._warn)
                self._thread = threading.Thread(target=self._work, args=(syncer,), name='journal', daemon=True)
                self._thread.start()

    def _wait_for(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition on the thread's progress, unless the thread has trouble."""
        with self._wake:
            self._wake.wait_for(lambda: condition() or self.trouble or self._closing, PATIENCE)

    def _unlock(self) -> None:
        """Unlock the folder."""
        self._writer.end()
        self._lock.release()

    def _work(self, syncer: Syncer) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closing or self._backlog.due, CHECK_PERIOD)
                items = self._backlog.batch()
                if not items and self._closing:
                    break
            try:
                self._check_continued()
                if items:
                    self._write(items)
                else:
                    self._writer.check_file()
                    self._end_trouble()
            except LostFileError as error:
                self._give_up_file(error.drive, str(error))
            except Exception as error:
                # of any class: the thread must not end silently
                if (
                    not self._try_less_at_once(items)
                    and not self._leave_copy_to_next_start(items, error)
                    and self._report_failure(error)
                ):
                    break
        self._unlock()
        syncer.close(0.0)

    def _write(self, items: list[Item]) -> None:
        rows = itertools.chain.from_iterable(item.rows for item in items)
        log = self._writer.write(items[0].drive, rows, items[-1].following)
        assert self._syncer is not None
        self._syncer.changed(log)
        if isinstance(items[0].rows, Copied):
            items[0].drive.continues = ''
            self._writer.empty_log()
        with self._wake:
            self._backlog.written(items)
            self._wake.notify_all()

    def _check_continued(self) -> None:
        """Raise an error if readings in memory are no longer in a file, since the file with them was removed."""
        drive = self._drive
        only_there = self._copied and drive.continues and not drive.gone
        if only_there and not os.path.lexists(drive.path.with_name(drive.continues)):
            raise LostFileError(drive, f'{drive.continues}, which it continues, was removed')

    def _end_trouble(self) -> None:
        """End the trouble if nothing has failed for a while."""
        with self._wake:
            if self.trouble and not self._backlog and time.monotonic() >= self._last_failed + STEADY:
                self._warn(f'journal {self.path}: writing works again')
                self.trouble = ''

    def _give_up_file(self, drive: DriveFile, why: str) -> None:
        """Write no more to a file that vanished or was damaged, and have a new one made.

        For the current drive, `renew` makes it: only the node has the readings that were in the old one.
        """
        self._notice(f'journal {drive.path}: {why}; the readings in memory are written to a new file')
        with self._wake:
            if drive is self._drive:
                drive.gone = True
            else:
                # an earlier drive: its remaining rows go to a new file, which begins with `head`
                drive.path, drive.made, drive.next = next_file(drive.path), False, 0

    def _try_less_at_once(self, items: list[Item]) -> bool:
        """Return whether to try again at once with less."""
        with self._wake:
            return bool(items) and self._backlog.halve(items)

    def _leave_copy_to_next_start(self, items: list[Item], error: Exception) -> bool:
        """Leave a failed copy to the next start, so that new readings do not wait for it; return whether it was one."""
        rows = items[0].rows if items else None
        if not isinstance(rows, Copied):
            return False
        self._writer.empty_log()
        if not isinstance(error, StoppedError):
            self._notice(
                f'journal {rows.path}: the readings of {rows.continues} cannot be copied: {_words(error)}; the next '
                'start tries it again, so keep both files'
            )
        with self._wake:
            self._backlog.written(items)
            self._wake.notify_all()
        return True

    def _report_failure(self, error: Exception) -> bool:
        """Report a failed write, and wait before the next attempt; return whether to give up."""
        trouble = _words(error)
        if trouble != self.trouble:
            self._warn(f'journal {self.path} cannot be written: {trouble}; mapping continues without it')
        with self._wake:
            self.trouble, self._last_failed = trouble, time.monotonic()
            self._wake.notify_all()
            self._wake.wait_for(lambda: self._closing, RETRY)
            return self._closing

    def _notice(self, text: str) -> None:
        self.notice, self.noticed = text, time.monotonic()
        self._warn(text)


def _drive_row(map_frame: str, base_frame: str, parameters: dict[str, Any]) -> Insert:
    return 'drive', (0, encoded(map_frame), encoded(base_frame), json.dumps(parameters).encode())


def _words(error: Exception) -> str:
    if isinstance(error, sqlite3.Error):
        text = one_line(error)
        return 'No space left on device' if FULL in text else text
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error) if isinstance(error, (OutputError, BagError)) else repr(error)
