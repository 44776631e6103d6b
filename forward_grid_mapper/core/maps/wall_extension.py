"""Wall extension: straight walls are extended where they leave the field of view.

If a straight wall ends without a neighbour, no reading contradicts the cells ahead, and these are not known to be free,
the wall is extended by up to `EXTENSION`: it more likely leaves the field of view than ends there.
"""

from __future__ import annotations

import math
from typing import Any

from ..common.constants import MOST_AGAINST_EXTENSION, STRAIGHT_RUN
from ..evidence.neighbourhood import NEIGHBOURS, neighbour, opposite
from ..evidence.state import State
from ..runtime.jit import inlined_kernel, kernel


@inlined_kernel
def _ahead(c: int, k: int, height: int, width: int, n: int) -> int:
    """Return the cell n steps from c in the direction of neighbour k; -1 outside of the grid."""
    for _ in range(n):
        c = neighbour(c, k, height, width) if c >= 0 else -1
    return c


@kernel
def extend(s: State, steps: int, barred: Any, out: Any) -> None:
    """Set in `out` (uint8) the cells by which straight walls are extended; they end before `barred` cells (uint8)."""
    height, width, resolution = s.lattice.height, s.lattice.width, s.lattice.resolution
    run = max(int(math.floor(STRAIGHT_RUN / resolution + 0.5)), 2)
    most = MOST_AGAINST_EXTENSION * resolution
    occupied, evidence, seen = s.maps.occupied, s.maps.evidence, s.maps.seen
    for c in range(len(occupied)):
        if not occupied[c]:
            continue
        for k in range(NEIGHBOURS):
            straight = True
            for n in range(1, run):
                o = _ahead(c, opposite(k), height, width, n)
                straight = straight and o >= 0 and occupied[o] == 1
            # an end of a wall has no neighbour ahead, nor diagonally ahead
            for turn in (k, (k + 1) & 7, (k + 7) & 7):
                o = neighbour(c, turn, height, width)
                straight = straight and (o < 0 or occupied[o] == 0)
            if straight:
                for n in range(1, steps + 1):
                    o = _ahead(c, k, height, width, n)
                    if o < 0 or occupied[o] or not seen[o] or barred[o] or evidence[o] * s.model.nats < -most:
                        break
                    out[o] = 1
