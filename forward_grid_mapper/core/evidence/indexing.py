"""Indexing of new readings: their terms independent of the map, the memory for their pairs, and their tiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.parameter_groups import ModelParameters
from ..common.readings import Floats, Readings
from ..runtime.jit import kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import cone_of
from ..sensor.density import causes_of
from .pairs import WORDS_PER_BAND_PAIR, WORDS_PER_RUN
from .state import READING_STATE, State
from .tile_index import SHIFT, insert

FREE_PAIRS, BAND_PAIRS, LARGEST_CONE, ALLOCATED_WORDS, UNSTORED_READINGS, UNUSED_WORDS = range(6)
"""Indices of totals: pairs in free zones and in bands, cells of the largest cone, words allocated to readings, readings
that are not stored, and allocated words that are no longer used."""


@kernel
def insert_readings(s: State, limits: tuple[int, int, int], totals: Any) -> int:
    """Count the pairs of readings, and insert readings into tiles; return the reading at which there was no free chunk.

    Parameters
    ----------
    limits
        The first reading, the last one plus one, and the words that stored pairs may take.
    totals : int64, shape (6,)
        Added to.
    """
    begin, end, words = limits
    cones, lattice, tiles, seen, before = s.cones, s.lattice, s.tiles, s.maps.seen, s.normals.before
    for t in range(begin, end):
        reading, times = cones[t], s.reading_states[t].multiplicity
        cone = cone_of(reading)
        bottom, end_row = rows_of(cone, lattice.height)
        across = min(2 * int(cone.reach) + 3, lattice.width)
        most = (((end_row - bottom) >> SHIFT) + 2) * ((across >> SHIFT) + 2)
        if s.stop[0] or tiles.used[0] + most > len(tiles.chunks):
            return t
        count, free, band = 0, 0, 0
        for row in range(bottom, end_row):
            runs = runs_of(cone, row, lattice.width)
            for left, right in ((runs.first, runs.last), (runs.first2, runs.last2)):
                if left > right:
                    continue
                insert(tiles, row, left, right, t)
                inner, outer = max(left, runs.inner), min(right, runs.outer)
                inside = max(outer - inner + 1, 0)
                count += inside > 0
                if s.normals.cos2_limit > 0.0 and inside > 0:
                    # a cell that is left out may divide a run
                    count += before[row, outer + 1] - before[row, inner]
                for c in range(np.uint64(row * lattice.width + left), np.uint64(row * lattice.width + right + 1)):
                    seen[c] += times
                free += inside
                band += right - left + 1 - inside
        reading_state = s.reading_states[t]
        size = WORDS_PER_RUN * count + WORDS_PER_BAND_PAIR * band
        reading_state.at = totals[ALLOCATED_WORDS]
        reading_state.room = size
        reading_state.stored = totals[ALLOCATED_WORDS] + size <= words
        if reading_state.stored:
            totals[ALLOCATED_WORDS] += size
        else:
            totals[UNSTORED_READINGS] += 1
        totals[FREE_PAIRS] += free
        totals[BAND_PAIRS] += band
        totals[LARGEST_CONE] = max(totals[LARGEST_CONE], free + band)
    return end


def reading_state_table(
    readings: Readings, sigma: Floats, model: ModelParameters, resolution: float
) -> NDArray[np.void]:
    """Return records of `READING_STATE` with the terms independent of the map, shape (N,); arguments of `causes_of`."""
    reading_states = np.zeros(len(readings), READING_STATE)
    causes = causes_of(readings, sigma, model, resolution)
    reading_states['floor'] = causes.random + causes.lost
    reading_states['max_range'] = causes.max_range
    reading_states['multiplicity'] = 1
    return reading_states
