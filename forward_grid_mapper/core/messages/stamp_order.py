"""Whether the stamps of odometry go on, the clock jumped back, or a single stamp was ahead of the others."""

from __future__ import annotations

from .message_types import NANOSECONDS

JUMP = NANOSECONDS
"""A stamp older than the newest by more than this means that the clock jumped back, not that messages overtook."""

GOES_ON, WAS_AHEAD, JUMPED_BACK = 'goes on', 'was ahead', 'jumped back'


def order_of(stamp: int, newest: int | None, before: int | None) -> str:
    """Return what a stamp says of those that came before it, nanoseconds.

    A clock that jumps back leaves the poses before it behind as well. Where a stamp is behind the newest one alone, and
    follows those before that, the newest one was wrong.

    Parameters
    ----------
    stamp : int
    newest, before : int or None
        The latest stamp so far, and the one before it; None while there is none.

    Returns
    -------
    str
        `GOES_ON`, `WAS_AHEAD` if the newest stamp is to be forgotten, or `JUMPED_BACK` if all are.
    """
    if newest is None or stamp >= newest - JUMP:
        return GOES_ON
    return WAS_AHEAD if before is not None and before < stamp else JUMPED_BACK


class StampOrder:
    """The two latest stamps of a stream, and what the next one says of them."""

    def __init__(self) -> None:
        self._latest: list[int] = []

    def take(self, stamp: int) -> str:
        """Take a stamp, nanoseconds; return what `order_of` says of it."""
        before, newest = [None, None, *self._latest][-2:]
        order = order_of(stamp, newest, before)
        if order != GOES_ON:
            self._latest = [] if order == JUMPED_BACK or before is None else [before]
        self._latest = sorted({*self._latest, stamp})[-2:]
        return order
