"""The schedule of tiles: each is searched once, and again after changes of another tile within its box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..common.grid import Grid


class Schedule:
    """The stale tiles, which were not searched yet, or whose box has changed since.

    Attributes
    ----------
    stale : set of int
    """

    def __init__(self, boxes: Mapping[int, Grid], stale: Iterable[int] | None = None) -> None:
        """Begin with the boxes of all tiles that have readings; by default all of them are stale."""
        # as arrays: each search is compared with all boxes, of which a large map has thousands
        self._numbers = np.fromiter(boxes, np.int64, len(boxes))
        corners = [(box.column, box.row, box.width, box.height) for box in boxes.values()]
        self._left, self._bottom, wide, high = np.array(corners, np.int64).reshape(-1, 4).T
        self._right, self._top = self._left + wide, self._bottom + high
        self.stale = set(boxes if stale is None else stale)

    def stale_of(self, colour: Sequence[int]) -> list[int]:
        """Return the stale tiles of a colour."""
        return [number for number in colour if number in self.stale]

    def searched(self, number: int, changed: Grid | None) -> None:
        """Record that a tile was searched; `changed` is the part of the lattice that its search changed, or None."""
        self.stale.discard(number)
        if changed is None:
            return
        right, top = changed.column + changed.width, changed.row + changed.height
        wide = np.minimum(self._right, right) > np.maximum(self._left, changed.column)
        high = np.minimum(self._top, top) > np.maximum(self._bottom, changed.row)
        self.stale |= {k for k in self._numbers[wide & high].tolist() if k != number}
