"""The schedule of tiles: each is searched once, and again after changes of another tile within its box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ..common.grid import Grid
from .tiling import common_part


class Schedule:
    """The stale tiles, which were not searched yet, or whose box has changed since.

    Attributes
    ----------
    stale : set of int
    """

    def __init__(self, boxes: Mapping[int, Grid], stale: Iterable[int] | None = None) -> None:
        """Begin with the boxes of all tiles that have readings; by default all of them are stale."""
        self._boxes = dict(boxes)
        self.stale = set(self._boxes if stale is None else stale)

    def stale_of(self, colour: Sequence[int]) -> list[int]:
        """Return the stale tiles of a colour."""
        return [number for number in colour if number in self.stale]

    def searched(self, number: int, changed: Grid | None) -> None:
        """Record that a tile was searched; `changed` is the part of the lattice that its search changed, or None."""
        self.stale.discard(number)
        if changed is None:
            return
        self.stale |= {k for k, box in self._boxes.items() if k != number and common_part(changed, box).size}
