"""Checks of stamps of odometry: whether they continue, the clock jumped back, or a single stamp was ahead."""

from __future__ import annotations

from .message_types import NANOSECONDS

JUMP = NANOSECONDS
"""A stamp older than the newest by more than this means that the clock jumped back; less is a message out of order."""

GOES_ON, WAS_AHEAD, JUMPED_BACK = 'goes on', 'was ahead', 'jumped back'


def order_of(stamp: int, newest: int | None, before: int | None) -> str:
    """Return how a stamp, nanoseconds, relates to those before it.

    If the clock jumps back, the stamp is before all of them. If it is only before the newest one, and after the one
    before that, the newest one was wrong.

    Parameters
    ----------
    stamp : int
    newest, before : int or None
        The latest stamp so far, and the one before it; None if there is none.

    Returns
    -------
    str
        `GOES_ON`, `WAS_AHEAD` if the newest stamp must be dropped, or `JUMPED_BACK` if all must.
    """
    if newest is None or stamp >= newest - JUMP:
        return GOES_ON
    return WAS_AHEAD if before is not None and before < stamp else JUMPED_BACK


class StampOrder:
    """The two latest stamps of a stream; compares the next one with them."""

    def __init__(self) -> None:
        self._latest: list[int] = []

    def take(self, stamp: int) -> str:
        """Add a stamp, nanoseconds; return its `order_of`."""
        before, newest = [None, None, *self._latest][-2:]
        order = order_of(stamp, newest, before)
        if order != GOES_ON:
            self._latest = [] if order == JUMPED_BACK or before is None else [before]
        self._latest = sorted({*self._latest, stamp})[-2:]
        return order
