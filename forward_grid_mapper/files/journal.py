"""A journal: a folder that holds every accepted reading on disk, so that a node that dies loses at most a second.

The folder holds `drive_0001.journal`, `drive_0002.journal` and so on, a new one after every reset, and `lock`, by which
one node at a time writes. Nothing is ever deleted. A thread writes at once what it is given, which no kill of the
process undoes; another asks the disk once a second to keep it (fdatasync), so that a power cut loses little more.
"""

from __future__ import annotations

import fcntl
import os
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from ..core.common.errors import BagError, OutputError
from ..core.common.readings import Readings
from .journal_format import MAGIC, Contents, frames_block, name_block, path_block, read, readings_block
from .output_folder import output_errors
from .syncing import Syncer

_DRIVE = re.compile(r'drive_(\d{4,9})\.journal')

MOST_PENDING = 32 << 20
"""Bytes that wait for a disk that is full or slow; half a million readings. What comes then is not in the journal."""

RETRY = 1.0
"""Seconds after which a write that failed is tried again."""


def drives(folder: Path) -> list[Path]:
    """Return the files of a journal, oldest first; empty if the folder is none.

    Raises
    ------
    OSError
        If the folder cannot be searched.
    """
    found = [path for path in folder.iterdir() if _DRIVE.fullmatch(path.name)] if folder.is_dir() else []
    return sorted(found, key=_number)


def drive_file(path: Path) -> Path | None:
    """Return the journal file that `path` names: itself, or the newest of a journal's folder; None if it is neither."""
    try:
        if path.is_dir():
            return next(reversed(drives(path)), None)
        with path.open('rb') as file:
            return path if file.read(len(MAGIC)) == MAGIC else None
    except OSError:
        return None


class _Item(NamedTuple):
    """What the writer is to do: append `data`, which holds `readings`, or go on in the file `begin`."""

    data: bytes
    readings: int
    begin: Path | None = None


class Journal:
    """A journal that is open for writing. Its methods return at once; a thread does the work.

    Attributes
    ----------
    path : Path
        The file of the drive that goes on.
    contents : Contents
        What it held when it was opened, once `restore` was exhausted.
    trouble : str
        Why nothing can be written at the moment; empty if all is well.
    lost : int
        Readings that will never be in the journal.
    """

    def __init__(self, folder: Path | str, warn: Callable[[str], object]) -> None:
        """Open the newest drive of a journal, or begin one; call `restore` before anything else.

        Raises
        ------
        OutputError
            If another process has it open, or the folder cannot be made or written.
        """
        self.folder = Path(folder).expanduser().absolute()
        self._warn = warn
        self.trouble = ''
        self.lost = 0
        self.contents = Contents()
        self._numbers: dict[str, int] = {}
        self._frames = ('', '')
        self._pending: deque[_Item] = deque()
        self._bytes = self._unwritten = 0
        self._wake = threading.Condition()
        self._closing = False
        self._syncer: Syncer | None = None
        self._thread: threading.Thread | None = None
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.folder / 'lock', os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                self._take_lock()
                found = drives(self.folder)
                self.path = found[-1] if found else self.folder / 'drive_0001.journal'
                self._file = _open(self.path)
            except BaseException:
                os.close(self._lock)
                raise
        self._end = 0

    def _take_lock(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f'{self.folder} is the journal of another node that runs; give each its own') from None

    def restore(self) -> Iterator[Readings]:
        """Yield the readings of the drive that goes on, cut off a torn end, and begin to take more.

        Raises
        ------
        OutputError
            If the file is none of a journal, or cannot be read.
        """
        try:
            yield from read(self.path, self.contents)
        except BagError as error:
            raise OutputError(f'{error}; move it away, or give another journal') from error
        if self.contents.harm:
            self._warn(f'journal {self.path}: {self.contents.harm}')
        self._end = self.contents.end
        self._numbers = {name: number for number, name in self.contents.names.items()}
        self._frames = (self.contents.map_frame, self.contents.base_frame)
        with output_errors(self.path):
            os.ftruncate(self._file, self._end)
        self._syncer = Syncer(self._warn)
        self._thread = threading.Thread(target=self._work, name='journal', daemon=True)
        self._thread.start()

    @property
    def unwritten(self) -> int:
        """Readings that wait to be written."""
        return self._unwritten

    def put(self, readings: Readings, frames: tuple[str, str], path: Iterable[tuple[float, float]] = ()) -> None:
        """Append readings, new points of the robot's path, and the map and base frame if they are new."""
        if self._bytes > MOST_PENDING:
            if not self.lost:
                self._warn(f'journal {self.path}: too much waits to be written; readings are lost from here on')
            self.lost += len(readings)
            return
        data = []
        if frames != self._frames:
            self._frames = frames
            data.append(frames_block(*frames))
        for name in readings.sensor_names:
            if name not in self._numbers:
                self._numbers[name] = max(self._numbers.values(), default=-1) + 1
                data.append(name_block(self._numbers[name], name))
        points = list(path)
        if points:
            data.append(path_block(points))
        if len(readings):
            data.append(readings_block(readings, self._numbers))
        if data:
            self._queue(_Item(b''.join(data), len(readings)))

    def begin_drive(self) -> None:
        """Go on in a new file; the old one is kept. Nothing happens if nothing was written yet."""
        if not self._end and not self._pending:
            return
        self.path = self.folder / f'drive_{_number(self.path) + 1:04d}.journal'
        self._numbers, self._frames = {}, ('', '')
        self._queue(_Item(b'', 0, self.path))

    def close(self, seconds: float = 2.0) -> None:
        """Write what is left, as far as that goes in so many seconds, and let go of the folder."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(seconds)
            if self._thread.is_alive():
                # the lock goes with the process
                return
        if self._syncer is not None:
            self._syncer.close(seconds)
        os.close(self._file)
        os.close(self._lock)

    def _queue(self, item: _Item) -> None:
        with self._wake:
            self._pending.append(item)
            self._bytes += len(item.data)
            self._unwritten += item.readings
            self._wake.notify()

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._pending or self._closing)
                if not self._pending:
                    return
                item = self._pending[0]
            try:
                self._do(item)
                self._done(item)
            except OSError as error:
                if self._failed(error):
                    return

    def _done(self, item: _Item) -> None:
        with self._wake:
            self._pending.popleft()
            self._bytes -= len(item.data)
            self._unwritten -= item.readings
        if self.trouble:
            self._warn(f'journal {self.path}: writing works again')
            self.trouble = ''

    def _failed(self, error: OSError) -> bool:
        """Report a write that failed, and wait before the next try; return whether to give up."""
        trouble = error.strerror or str(error)
        if trouble != self.trouble:
            self._warn(f'journal {self.path} cannot be written: {trouble}; mapping goes on without it')
        self.trouble = trouble
        with self._wake:
            self._wake.wait_for(lambda: self._closing, RETRY)
            return self._closing

    def _do(self, item: _Item) -> None:
        if item.begin is not None:
            opened = _open(item.begin)
            if self._syncer is not None:
                self._syncer.closed(self._file)
            os.close(self._file)
            self._file, self._end = opened, 0
            return
        data = item.data if self._end else MAGIC + item.data
        done = 0
        try:
            while done < len(data):
                done += os.pwrite(self._file, data[done:], self._end + done)
        except OSError:
            # half a block would hide what comes after it
            os.ftruncate(self._file, self._end)
            raise
        self._end += len(data)
        if self._syncer is not None:
            self._syncer.changed(self._file)


def _open(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)


def _number(path: Path) -> int:
    match = _DRIVE.fullmatch(path.name)
    return int(match[1]) if match else 0
