"""The flip of a single cell, in the M-step: finds the readings that observe it, and evaluates them again.

The gains of flipping the other cells, which `updates` derives, stay up to date.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import cone_of
from ..sensor.surface_normals import exceeds_incidence_angle
from .neighbourhood import note_flip
from .pairs import WORDS_PER_RUN, Lattice, Pairs
from .state import BLOCK_SHIFT, State
from .tile_index import CHUNK, SHIFT
from .updates import add_difference, evaluate, pairs_with_logs

EDGE = 1e-6
"""Within this distance of the edge of a cone, cells, the exact arithmetic of the cone decides whether a cell is in
it."""


@inlined_kernel
def _zone(reading: Any, lattice: Lattice, row: int, column: int) -> int:
    """Return 2 if a cell is in the free zone of a cone, 1 if in its band, 0 if in neither."""
    du, dv = column + 0.5 - reading.x, row + 0.5 - reading.y
    along = du * reading.axis_x + dv * reading.axis_y
    across = abs(dv * reading.axis_x - du * reading.axis_y)
    outside = across * reading.cosine - along * reading.sine
    if (outside > EDGE and across > 0.7072) or along > reading.reach + 1.5:
        return 0
    away = du * du + dv * dv
    if outside < -EDGE:
        if away > (reading.reach + EDGE) ** 2:
            return 0
        if reading.free > EDGE and away < (reading.free - EDGE) ** 2:
            return 2
        if away < (reading.reach - EDGE) ** 2 and (reading.free < 0.0 or away > (reading.free + EDGE) ** 2):
            return 1
    # a cell at the edge, or one that only the axis crosses
    cone = cone_of(reading)
    runs = runs_of(cone, row, lattice.width)
    bottom, top = rows_of(cone, lattice.height)
    if not bottom <= row < top or not (runs.first <= column <= runs.last or runs.first2 <= column <= runs.last2):
        return 0
    return 2 if runs.inner <= column <= runs.outer else 1


@kernel
def find_observing(s: State, c: int) -> int:
    """List the readings that observe cell c in `observing`; return their number."""
    row, column = c // s.lattice.width, c % s.lattice.width
    tile = (row >> SHIFT) * s.tiles.across + (column >> SHIFT)
    chunk, end = s.tiles.head[tile], s.tiles.fill[tile]
    n = 0
    while chunk >= 0:
        for k in range(end):
            t = s.tiles.chunks[chunk, k]
            reading = s.cones[t]
            zone = _zone(reading, s.lattice, row, column)
            if zone and s.normals.cos2_limit > 0.0 and s.normals.known[c]:
                slanted = exceeds_incidence_angle(
                    s.normals, reading, c, column + 0.5 - reading.x, row + 0.5 - reading.y
                )
                zone = 0 if slanted else zone
            if zone:
                s.observing[n, 0] = t
                s.observing[n, 1] = zone - 1
                n += 1
        chunk, end = s.tiles.chunks[chunk, CHUNK], CHUNK
    return n


@inlined_kernel
def _touch_around(s: State, c: int) -> None:
    """Mark the blocks of the cells whose prior depends on cell c: up to two rows and columns away."""
    row, column = c // s.lattice.width, c % s.lattice.width
    left, right = max(column - 2, 0), min(column + 2, s.lattice.width - 1)
    for other in range(max(row - 2, 0), min(row + 2, s.lattice.height - 1) + 1):
        s.maps.touched[(other * s.lattice.width + left) >> BLOCK_SHIFT] = 1
        s.maps.touched[(other * s.lattice.width + right) >> BLOCK_SHIFT] = 1


@inlined_kernel
def _touch_cone(reading_state: Any, pairs: Pairs, at: int, touched: Any) -> None:
    """Mark the blocks of the cells of a reading."""
    shift, cell = np.uint64(BLOCK_SHIFT), np.uint64(at + WORDS_PER_RUN * reading_state.runs)
    for k in range(np.uint64(at), cell, np.uint64(WORDS_PER_RUN)):
        first, last = np.uint64(pairs.cell[k]), np.uint64(pairs.cell[k + np.uint64(1)])
        for block in range(first >> shift, (last >> shift) + np.uint64(1)):
            touched[block] = 1
    for k in range(np.uint64(reading_state.bands)):
        touched[np.uint64(pairs.cell[cell + k]) >> shift] = 1


@kernel
def flip(s: State, c: int) -> None:
    """Flip cell c and update the evidence of all cells."""
    n = find_observing(s, c)
    maps = s.maps
    own = 0
    for i in range(n):
        if s.observing[i, 1]:
            reading_state = s.reading_states[s.observing[i, 0]]
            own += reading_state.multiplicity * (reading_state.release - reading_state.occupy)
    # for readings with the cell in the free zone, its ratio changes between that of a free and of an occupied cell
    maps.evidence[c] += -own if maps.occupied[c] else own
    maps.occupied[c] ^= 1
    note_flip(maps.pattern, c, s.lattice.height, s.lattice.width)
    _touch_around(s, c)
    step = 1 if maps.occupied[c] else -1
    s.clock[0] += 1
    for i in range(n):
        t: Any = np.int64(s.observing[i, 0])
        # logs that are not stored must be computed for the map before the flip
        maps.occupied[c] ^= 1
        pairs, at = pairs_with_logs(s, t)
        maps.occupied[c] ^= 1
        reading_state = s.reading_states[t]
        if s.observing[i, 1]:
            reading_state.blocking += step
            reading_state.through = s.model.mixture_weight * (1.0 - s.model.p_hit) ** reading_state.blocking
        evaluate(s.model, reading_state, maps.occupied, pairs, at, s.workspace)
        add_difference(reading_state, pairs, at, maps, s.workspace.new)
        _touch_cone(reading_state, pairs, at, maps.touched)
        reading_state.changed = s.clock[0]
