"""Common parts of command lines: errors without tracebacks, and progress for work longer than a second."""

from __future__ import annotations

import argparse
import errno
import io
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TextIO

from .. import __version__
from ..core.common.errors import MapperError
from ..core.common.words import printable
from ..core.runtime.compiling import compiling
from ..core.search.search import Progress
from .signals import Interrupted, Interruptible, cancelled_line

COMPILES = '(compiling kernels; this takes one to three minutes and is done once)'

PATIENCE = 1.0
"""Seconds of work before progress is shown."""

LONG = 10.0
"""Seconds of work after which warnings of its input are shown: the result may not be worth the wait."""

ON_SCREEN, IN_LOG = 0.2, 1.0
"""Seconds between two updates of the line of progress, on a terminal and elsewhere."""


def run(
    parser: argparse.ArgumentParser, body: Callable[[argparse.Namespace], int], arguments: Sequence[str] | None
) -> int:
    """Run a command's body with its options; return its exit code, with errors reported in one line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a path may have characters that the terminal cannot show
        sys.stdout.reconfigure(errors='backslashreplace')
    parser.add_argument('--version', action='version', version=f'%(prog)s of forward_grid_mapper {__version__}')
    try:
        try:
            with Interruptible():
                return body(parser.parse_args(arguments))
        finally:
            # errors of the output can still be reported here
            sys.stdout.flush()
    except MapperError as error:
        problem = str(error)
    except MemoryError:
        problem = 'there is not enough memory for a map of this size; raise resolution, or lower max_cells or max_range'
    except BrokenPipeError:
        # the reader of the output has ended, as `head` does
        _output_works()
        return 1
    except OSError as error:
        # the work handles errors of its own files; others are those of the output or the working directory
        problem = _in_words(error) if _output_works() else f'standard output: {error.strerror or error}'
    except Interrupted as cancelled:
        # after SIGHUP there is no terminal
        with suppress(OSError):
            print(cancelled_line(parser.prog, cancelled.left), file=sys.stderr)
        return cancelled.code
    except KeyboardInterrupt:
        print(cancelled_line(parser.prog), file=sys.stderr)
        return 130
    print(f'{parser.prog}: error: {printable(str(problem))}', file=sys.stderr)
    return 1


def _output_works() -> bool:
    """Return whether standard output accepts text; if not, close it, so that Python does not fail again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):
            sys.stdout.close()
        return False
    return True


def _in_words(error: OSError) -> str:
    """Return an error in words; without a file name, it concerns the working directory or standard output."""
    if error.filename is None:
        try:
            Path.cwd()
        except OSError:
            return 'the working directory does not exist any more; change to one that does'
        # without a buffer (PYTHONUNBUFFERED) the text is lost, and the next flush finds no error
        if error.errno == errno.ENOSPC:
            return f'standard output: {error.strerror}'
        return str(error)
    return f'{error.filename}: {error.strerror}'


class Ticker:
    """Shows progress on stderr, in one line that is rewritten; silent for the first second.

    Used as a context manager. A thread updates the time, since a stage may compile kernels without reports. If it is
    quiet, it only reports the compilation of kernels, once.

    tqdm cannot do this: its bars need a total, which a search does not have, they stop while nothing is reported, and
    in a pipe they write a carriage return instead of a line.
    """

    def __init__(self, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._quiet = quiet
        self._text = ''
        self._compiles = False
        self._shown = ''
        self._warnings: list[str] = []
        self._begin = time.monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Ticker:
        self._begin = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()
        if self._shown and self._stream.isatty():
            print('\r\033[K', end='', file=self._stream, flush=True)

    def say(self, text: str) -> None:
        """Set the description of the current work."""
        self._text = text
        if not self._quiet:
            self._compiles = False

    def warn(self, warnings: Sequence[str]) -> None:
        """Set warnings of the input; they are shown if the work is long, otherwise only in the report."""
        self._warnings = list(warnings)

    def reading(self, done: int, total: int) -> None:
        """Report messages read, for `Bag.messages`."""
        self.say(f'reading: {done:,} of {total:,} messages')

    def refining(self, stage: str, part: float) -> None:
        """Report a stage of refining the trajectory, for `Refiner.run`."""
        self.say(f'trajectory: {stage}, {part:.0%}' if part else f'trajectory: {stage}')

    def mapping(self, stage: str, progress: Progress | None) -> None:
        """Report a stage of mapping or an iteration of the search, for `Mapper.run`."""
        if progress is None:
            self.say(stage)
        else:
            self.say(
                f'{stage}: iteration {progress.iterations}, {progress.flips:,} flips, {progress.gain:,.0f} nats gained'
            )

    def _watch(self) -> None:
        on_screen = self._stream.isatty()
        while not self._done.wait(ON_SCREEN if on_screen else IN_LOG):
            seconds = time.monotonic() - self._begin
            if self._quiet:
                self._note_compilation(seconds)
                continue
            if seconds < PATIENCE or not self._text:
                continue
            if seconds >= LONG and self._warnings:
                before = '\r\033[K' if on_screen else ''
                print(
                    *(f'{before}warning: {printable(text)}' for text in self._warnings),
                    sep='\n',
                    file=self._stream,
                    flush=True,
                )
                self._warnings = []
            # the note on compilation is shown until the next stage, so that the line does not flicker
            self._compiles = self._compiles or compiling()
            text = f'{self._text} {COMPILES}' if self._compiles else self._text
            if on_screen:
                self._shown = text
                line = shortened(f'{seconds:4.0f} s  {text}', self._columns() - 1)
                print(f'\r\033[K{line}', end='', file=self._stream, flush=True)
            elif text != self._shown:
                # a log file gets a line for each change, at most one a second
                self._shown = text
                print(f'{seconds:4.0f} s  {text}', file=self._stream, flush=True)

    def _note_compilation(self, seconds: float) -> None:
        """Print once, in a line that is not overwritten, why the first run takes so long."""
        if seconds >= PATIENCE and not self._compiles and compiling():
            self._compiles = True
            print(COMPILES.strip('()'), file=self._stream, flush=True)

    def _columns(self) -> int:
        """Return the current width of the terminal."""
        try:
            columns = os.get_terminal_size(self._stream.fileno()).columns
        except (OSError, ValueError, AttributeError):
            columns = 0
        return columns or shutil.get_terminal_size().columns


def shortened(line: str, width: int) -> str:
    """Return a line of at most `width` characters: a wrapped line cannot be rewritten."""
    return line if len(line) <= width else line[: max(width - 3, 0)] + '...'[: max(width, 0)]
