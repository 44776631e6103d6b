"""What the command lines share: errors without tracebacks, and progress once work takes longer than a second."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

from ..core.errors import MapperError
from ..core.search import Progress

PATIENCE = 1.0
"""Seconds of work before progress is shown."""


def run(command: str, body: Callable[[], int | None]) -> int:
    """Run a command's body; return its exit code, with errors told in one line."""
    try:
        return body() or 0
    except MapperError as error:
        print(f'{command}: error: {error}', file=sys.stderr)
        return 1
    except BrokenPipeError:
        # the reader of our output went away, as `head` does
        sys.stderr.close()
        return 1
    except KeyboardInterrupt:
        print(f'{command}: cancelled; nothing was written', file=sys.stderr)
        return 130


class Ticker:
    """Shows on stderr what goes on, in one line that is rewritten; silent for the first second.

    Used as a context manager. A thread keeps the clock running, since a stage may compile kernels without reporting.
    """

    def __init__(self, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._quiet = quiet
        self._text = ''
        self._shown = ''
        self._begin = time.monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Ticker:
        self._begin = time.monotonic()
        if not self._quiet:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        if not self._quiet:
            self._thread.join()
        if self._shown and self._stream.isatty():
            print('\r\033[K', end='', file=self._stream, flush=True)

    def say(self, text: str) -> None:
        """Set what is going on."""
        self._text = text

    def reading(self, done: int, total: int) -> None:
        """Report messages read, for `Bag.messages`."""
        self.say(f'reading: {done:,} of {total:,} messages')

    def mapping(self, stage: str, progress: Progress | None) -> None:
        """Report a stage of mapping or a sweep of the search, for `Mapper.run`."""
        if progress is None:
            self.say(f'{stage} (the first run compiles its kernels, which takes half a minute once)')
        else:
            self.say(f'{stage}: sweep {progress.sweeps}, {progress.flips:,} flips, {progress.gain:,.0f} nats gained')

    def _watch(self) -> None:
        on_screen = self._stream.isatty()
        while not self._done.wait(0.2 if on_screen else 1.0):
            seconds = time.monotonic() - self._begin
            if seconds < PATIENCE or not self._text:
                continue
            if on_screen:
                self._shown = self._text
                print(f'\r\033[K{seconds:4.0f} s  {self._text}', end='', file=self._stream, flush=True)
            elif self._text != self._shown:
                # a log file gets a line a change, at most one a second
                self._shown = self._text
                print(f'{seconds:4.0f} s  {self._text}', file=self._stream, flush=True)
