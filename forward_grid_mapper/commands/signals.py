"""Ctrl-C, SIGTERM and SIGHUP, from the first import to the last line: one line and an exit code, never a traceback.

This module imports little, since it is needed before slow imports.
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
"""Seconds after a first signal in which further ones are ignored, so that the clean-up is not interrupted: terminals
and `ros2 launch` send Ctrl-C repeatedly."""

SEND_AGAIN_AFTER = 0.1
"""Seconds before a signal is sent again if its `Interrupted` was lost."""

ENDS_WITH_STDIN = 'FORWARD_GRID_MAPPER_ENDS_WITH_STDIN'
"""Environment variable: with the value 1 the process ends at the end of its standard input, which its parent holds."""


class Interrupted(KeyboardInterrupt):
    """A signal that ends the work.

    Attributes
    ----------
    code : int
        The exit code, 128 plus the signal's number, as in shells.
    left : str
        Description of what remains after the signal, set by the code that leaves it.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.code = 128 + number
        self.left = 'nothing was written'


def cancelled_line(command: str, left: str = 'nothing was written') -> str:
    """Return the message of a command that was ended by a signal."""
    return f'{command}: cancelled; {left}'


def _install(handler: Any) -> dict[signal.Signals, Any]:
    """Set the handler of the signals that are not ignored; return the previous handlers."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    # shells without job control ignore Ctrl-C for background commands, and `nohup` ignores SIGHUP
    replaced = {number: old for number, old in before.items() if old is not signal.SIG_IGN}
    for number in replaced:
        signal.signal(number, handler)
    return replaced


def leave_at_once(command: str) -> None:
    """Let a signal end the process at once, with one line: for imports, before there is anything to clean up.

    Some libraries would ignore a `KeyboardInterrupt` in an import, and others would print a traceback.
    """

    def leave(number: int, frame: FrameType | None) -> NoReturn:
        # after SIGHUP there is no terminal
        with suppress(OSError):
            os.write(2, f'{cancelled_line(command)}\n'.encode())
        os._exit(128 + number)

    _install(leave)


def leave_silently() -> None:
    """Let a signal end the process without a message: for the interpreter's shutdown, after all work was reported."""
    _install(signal.SIG_DFL)


def output_closed() -> bool:
    """Return whether standard output is a pipe, or a socket, whose other end is closed."""
    try:
        output = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):
        return False
    poll = select.poll()
    poll.register(output, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


class Interruptible:
    """Lets a signal raise `Interrupted` in a `with` block, once within `GRACE`; only in the main thread.

    If C code calls Python, as the compiler of kernels does, an exception may be lost, or replaced by another one. Then
    `Interrupted` is raised a little later, or instead of the other one.
    """

    def __init__(self) -> None:
        self._before: dict[signal.Signals, Any] = {}
        self._first = -GRACE
        self._hook = sys.unraisablehook
        self._lost: Interrupted | None = None
        self._again: threading.Timer | None = None

    def __enter__(self) -> Interruptible:
        """Set the handlers."""
        if threading.current_thread() is threading.main_thread():
            self._before = _install(self._raise)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._raise_later
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the previous handlers."""
        if sys.unraisablehook == self._raise_later:
            sys.unraisablehook = self._hook
        if self._again is not None:
            self._again.cancel()
        for number, handler in self._before.items():
            # code that handled the signal in the block may have set it to be ignored
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, handler)
        if self._lost is not None and error is not None and not isinstance(error, Interrupted):
            raise self._lost from None

    def _raise(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now >= self._first + GRACE:
            self._first = now
            raise Interrupted(number)

    def _raise_later(self, lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Interrupted):
            self._hook(lost)
            return
        self._lost, self._first = lost.exc_value, -GRACE
        number = lost.exc_value.code - 128
        self._again = threading.Timer(SEND_AGAIN_AFTER, os.kill, (os.getpid(), number))
        self._again.daemon = True
        self._again.start()


def end_with_parent() -> None:
    """End this process as by SIGTERM when its parent has ended, if the parent requested it by `ENDS_WITH_STDIN`.

    The parent holds the other end of standard input. The system closes it at any end of the parent, even by SIGKILL, on
    every system with pipes.
    """
    if os.environ.pop(ENDS_WITH_STDIN, '') != '1':
        return

    def watch() -> None:
        try:
            while os.read(0, 4096):
                pass
        except OSError:
            # there is no standard input
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(128 + signal.SIGTERM)

    # threads inherit the mask; signals are for threads with handlers
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    threading.Thread(target=watch, daemon=True, name='parent').start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
