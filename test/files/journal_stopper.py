"""Continue journals as the node does, each in a child that is killed at a line of the code.

Each line of standard input is `FOLDER LINE`: the child starts with the journal in FOLDER, writes new readings, and is
killed at line number LINE of those that the modules of the journal execute; 0: never. The answer is the exit code, 0
after a kill as well, and the number of lines that were executed, 0 after a kill. Reading number n has n as its x. The
file `FOLDER.accepted` has the number of readings at the last moment when all of them were written.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from journal_samples import made, opened, until, written

from forward_grid_mapper.files import journal_format

MODULES = str(Path(journal_format.__file__).parent / 'journal')
"""Start of the paths of the modules of the journal."""

NEW = 20
"""Readings that each run adds, ten at a time."""


class Stopper:
    """Counts the executed lines of all threads, and kills the process at one of them."""

    def __init__(self, last: int) -> None:
        self._counter = itertools.count(1)
        self._last = last
        self.count = 0

    def trace(self, frame: FrameType, event: str, argument: Any) -> Callable[..., Any] | None:
        if not frame.f_code.co_filename.startswith(MODULES):
            return None
        if event == 'line':
            self.count = next(self._counter)
            if self.count == self._last:
                os.kill(os.getpid(), signal.SIGKILL)
        return self.trace


def run(folder: Path, last: int) -> int:
    """Start with a journal, write new readings, and end; return the number of executed lines."""
    # several transfers of readings
    journal_format.CHUNK = 100
    stopper = Stopper(last)
    threading.settrace(stopper.trace)
    sys.settrace(stopper.trace)
    journal, chunks = opened(folder)
    count = sum(map(len, chunks))
    until(lambda: not journal.unwritten)
    for first in range(count, count + NEW, 10):
        written(journal, made(first, 10))
        folder.with_name(f'{folder.name}.accepted').write_text(str(first + 10))
    journal.close()
    sys.settrace(None)
    return stopper.count


def main() -> None:
    for line in sys.stdin:
        folder, last = line.rstrip('\n').rsplit(' ', 1)
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            code = 1
            try:
                os.write(writing, str(run(Path(folder), int(last))).encode())
                code = 0
            except BaseException:
                sys.excepthook(*sys.exc_info())
            finally:
                os._exit(code)
        os.close(writing)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        count = os.read(reading, 100).decode() if ended == 0 else '0'
        os.close(reading)
        print(ended if ended not in (0, -signal.SIGKILL) else 0, count, flush=True)


if __name__ == '__main__':
    main()
