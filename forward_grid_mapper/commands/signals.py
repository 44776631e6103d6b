"""Ctrl-C, SIGTERM and SIGHUP, from the first import to the last line: one line and an exit code, never a traceback.

This module imports little, since it is to be ready before anything that takes long to import.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

GRACE = 5.0
"""Seconds after a first signal in which further ones are ignored, so that nothing interrupts the clean-up: a terminal
and `ros2 launch` send Ctrl-C more than once."""

AGAIN = 0.1
"""Seconds until a signal is sent once more whose `Cancelled` got lost."""

ENDS_WITH_STDIN = 'FORWARD_GRID_MAPPER_ENDS_WITH_STDIN'
"""Environment variable: with the value 1 the process ends when its standard input does, which its parent holds open."""


class Cancelled(KeyboardInterrupt):
    """A signal that ends the work.

    Attributes
    ----------
    code : int
        The exit code, 128 plus the signal's number as shells have it.
    left : str
        What was left behind; whoever leaves something says so here.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.code = 128 + number
        self.left = 'nothing was written'


def cancelled_line(command: str, left: str = 'nothing was written') -> str:
    """Return the line about a command that a signal ended."""
    return f'{command}: cancelled; {left}'


def _install(handler: Any) -> dict[signal.Signals, Any]:
    """Set the handler of the signals that are not ignored; return the handlers before."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    # a shell without job control lets background commands ignore Ctrl-C, and `nohup` does the like
    replaced = {number: old for number, old in before.items() if old is not signal.SIG_IGN}
    for number in replaced:
        signal.signal(number, handler)
    return replaced


def leave_at_once(command: str) -> None:
    """Let a signal end the process at once, with one line: for imports, while there is nothing to clean up.

    A `KeyboardInterrupt` in an import would be swallowed by some libraries, and shown with a traceback by others.
    """

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        # with SIGHUP the terminal is gone
        with suppress(OSError):
            os.write(2, f'{cancelled_line(command)}\n'.encode())
        os._exit(128 + number)

    _install(leave)


def leave_silently() -> None:
    """Let a signal end the process without a word: for the interpreter's own end, when all is done and reported."""
    _install(signal.SIG_DFL)


def nobody_reads() -> bool:
    """Return whether standard output is a pipe, or a socket, whose other end is closed."""
    try:
        output = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):
        return False
    poll = select.poll()
    poll.register(output, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


class Interruptible:
    """Lets a signal raise `Cancelled` in a `with` block, once within `GRACE`; for the main thread, elsewhere idle.

    Where C code calls Python, as the compiler of kernels does, an exception gets lost, or makes that code raise another
    one. Then `Cancelled` is raised a little later, or takes the place of the other.
    """

    def __init__(self) -> None:
        self._before: dict[signal.Signals, Any] = {}
        self._first = -GRACE
        self._hook = sys.unraisablehook
        self._lost: Cancelled | None = None
        self._again: threading.Timer | None = None

    def __enter__(self) -> Interruptible:
        """Begin to take signals."""
        if threading.current_thread() is threading.main_thread():
            self._before = _install(self._raise)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._raise_later
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave signals to who had them before."""
        if sys.unraisablehook == self._raise_later:
            sys.unraisablehook = self._hook
        if self._again is not None:
            self._again.cancel()
        for number, handler in self._before.items():
            # what took the signal in the block may have silenced it for good
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, handler)
        if self._lost is not None and error is not None and not isinstance(error, Cancelled):
            raise self._lost from None

    def _raise(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now >= self._first + GRACE:
            self._first = now
            raise Cancelled(number)

    def _raise_later(self, lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Cancelled):
            self._hook(lost)
            return
        self._lost, self._first = lost.exc_value, -GRACE
        number = lost.exc_value.code - 128
        self._again = threading.Timer(AGAIN, os.kill, (os.getpid(), number))
        self._again.daemon = True
        self._again.start()


def end_with_parent() -> None:
    """End this process as by SIGTERM when its parent has ended, if the parent asked for it by `ENDS_WITH_STDIN`.

    The parent holds the other end of standard input. The system closes it whatever ends the parent, SIGKILL included,
    on every system with pipes.
    """
    if os.environ.pop(ENDS_WITH_STDIN, '') != '1':
        return

    def watch() -> None:
        try:
            while os.read(0, 4096):
                pass
        except OSError:
            # no standard input at all: nobody holds the other end
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(128 + signal.SIGTERM)

    # a thread inherits the mask; signals are for the threads that know what to do
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    threading.Thread(target=watch, daemon=True, name='parent').start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
