"""Which tiles have to be searched: all of them once, and again those that see what has changed in another one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ..common.grid import Grid
from .tiling import common_part


class Schedule:
    """The tiles that are stale: they were not searched yet, or their surroundings have changed since.

    Attributes
    ----------
    stale : set of int
    """

    def __init__(self, boxes: Mapping[int, Grid], stale: Iterable[int] | None = None) -> None:
        """Begin with the boxes of all tiles that have readings; by default all of them are stale."""
        self._boxes = dict(boxes)
        self.stale = set(self._boxes if stale is None else stale)

    def of(self, colour: Sequence[int]) -> list[int]:
        """Return the stale tiles of a colour."""
        return [number for number in colour if number in self.stale]

    def searched(self, number: int, changed: Grid | None) -> None:
        """Note that a tile was searched, and the part of the lattice in which its search changed anything."""
        self.stale.discard(number)
        if changed is None:
            return
        self.stale |= {k for k, box in self._boxes.items() if k != number and common_part(changed, box).size}
