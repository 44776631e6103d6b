"""Renewal of surface normals: finding the readings whose pairs change, and making their pairs again.

A pair is left out if the reading exceeds the incidence angle of the cell. With more readings, normals change, and so do
pairs. The old terms of a reading are subtracted from the evidence, which is exact in fixed point; then its pairs are
made with the new normals, and its new terms are added.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid, Window
from ..runtime.jit import kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import cone_of
from ..sensor.surface_normals import SurfaceNormals, exceeds_incidence_angle
from .indexing import ALLOCATED_WORDS, UNSTORED_READINGS, UNUSED_WORDS
from .pairs import WORDS_PER_BAND_PAIR, WORDS_PER_RUN, make
from .state import State
from .tile_index import CHUNK, SHIFT
from .updates import evaluate_and_add, subtract


def box_of(cones: NDArray[np.void], grid: Grid) -> Window | None:
    """Return a window that contains all cells of cones; None if there is none on the grid."""
    if not len(cones):
        return None
    far = float(cones['reach'].max()) + 1.0
    bottom, top = float(cones['y'].min()) - far, float(cones['y'].max()) + far
    left, right = float(cones['x'].min()) - far, float(cones['x'].max()) + far
    window = (
        max(math.floor(bottom), 0),
        min(math.floor(top) + 1, grid.height),
        max(math.floor(left), 0),
        min(math.floor(right) + 1, grid.width),
    )
    return window if window[0] < window[1] and window[2] < window[3] else None


def near(cones: NDArray[np.void], window: Window) -> NDArray[np.bool_]:
    """Return which cones may reach into a window, shape (N,)."""
    bottom, top, left, right = window
    far = cones['reach'] + 1.0
    beside = np.maximum(left - cones['x'], cones['x'] - right) < far
    out: NDArray[np.bool_] = beside & (np.maximum(bottom - cones['y'], cones['y'] - top) < far)
    return out


@kernel
def _mark_cells(old: SurfaceNormals, new: SurfaceNormals, window: Window, width: int, differ: Any) -> None:
    """Set the cells of a window whose normals differ in `differ`, uint8, shape (height, width)."""
    for row in range(window[0], window[1]):
        for column in range(window[2], window[3]):
            c = row * width + column
            turned = new.x[c] != old.x[c] or new.y[c] != old.y[c]
            if new.known[c] != old.known[c] or (new.known[c] and turned):
                differ[row, column] = 1


@kernel
def _changes(s: State, new: SurfaceNormals, t: int, window: Window, differ: Any) -> bool:
    """Return whether the incidence angle of reading t is exceeded at other cells among `differ` than before."""
    reading = s.cones[t]
    cone = cone_of(reading)
    bottom, top = rows_of(cone, s.lattice.height)
    for row in range(max(bottom, window[0]), min(top, window[1])):
        runs = runs_of(cone, row, s.lattice.width)
        v = row + 0.5 - cone.y
        for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
            for column in range(max(first, window[2]), min(last + 1, window[3])):
                if differ[row, column]:
                    u, cell = column + 0.5 - cone.x, row * s.lattice.width + column
                    if exceeds_incidence_angle(s.normals, reading, cell, u, v) != exceeds_incidence_angle(
                        new, reading, cell, u, v
                    ):
                        return True
    return False


@kernel
def find_changed(s: State, new: SurfaceNormals, window: Window, differ: Any, changed: Any) -> None:
    """Set `changed` (uint8, shape (N,), all 0) for the readings whose pairs change with the normals `new`.

    Parameters
    ----------
    window
        Where the normals may differ: first row, last one plus one, and columns likewise.
    differ : uint8, shape (height, width)
        Workspace, all 0.
    """
    height, width = s.lattice.height, s.lattice.width
    _mark_cells(s.normals, new, window, width, differ)
    tiles = s.tiles
    for up in range(window[0] >> SHIFT, ((window[1] - 1) >> SHIFT) + 1):
        for across in range(window[2] >> SHIFT, ((window[3] - 1) >> SHIFT) + 1):
            some = False
            for row in range(up << SHIFT, min((up + 1) << SHIFT, height)):
                for column in range(across << SHIFT, min((across + 1) << SHIFT, width)):
                    some = some or differ[row, column] != 0
            if not some:
                continue
            tile = up * tiles.across + across
            chunk, end = tiles.head[tile], tiles.fill[tile]
            while chunk >= 0:
                for k in range(end):
                    t = tiles.chunks[chunk, k]
                    if changed[t] == 0:
                        changed[t] = 1 if _changes(s, new, t, window, differ) else 2
                chunk, end = tiles.chunks[chunk, CHUNK], CHUNK
    for t in range(len(changed)):
        changed[t] &= 1


@kernel
def _move(reading_state: Any, size: int, words: int, totals: Any) -> None:
    """Give a reading `size` words behind all others; if they would exceed `words` in total, it is not stored."""
    totals[UNUSED_WORDS] += reading_state.room
    reading_state.stored = totals[ALLOCATED_WORDS] + size <= words
    if reading_state.stored:
        reading_state.at, reading_state.room = totals[ALLOCATED_WORDS], size
        totals[ALLOCATED_WORDS] += size
    else:
        totals[UNSTORED_READINGS] += 1


@kernel
def renew(s: State, new: SurfaceNormals, readings: Any, limits: tuple[int, int], totals: Any) -> int:
    """Make the pairs of some readings with the normals `new`; return the index of the first that needs more memory.

    Parameters
    ----------
    readings : int64
        Indices of the readings.
    limits
        The index into `readings` to begin with, and the words that stored pairs may take.
    totals : int64
        Those of the evidence.
    """
    workspace, words = s.workspace, limits[1]
    # always of the same type, so that callees are compiled once
    start: Any = np.int64(0)
    for i in range(limits[0], len(readings)):
        t = readings[i]
        reading_state = s.reading_states[t]
        if reading_state.stored:
            runs, bands = make(s.cones, s.lattice, new, t, workspace.pairs, start, workspace)
            size = WORDS_PER_RUN * runs + WORDS_PER_BAND_PAIR * bands
            if size > reading_state.room and len(s.pairs.cell) < totals[ALLOCATED_WORDS] + size <= words:
                return i
            subtract(s, t)
            if size > reading_state.room:
                _move(reading_state, size, words, totals)
        else:
            subtract(s, t)
            runs, bands = make(s.cones, s.lattice, new, t, workspace.pairs, start, workspace)
        reading_state.runs, reading_state.bands = runs, bands
        pairs, at = workspace.pairs, start
        if reading_state.stored:
            pairs, at = s.pairs, reading_state.at
            for k in range(WORDS_PER_RUN * runs + 2 * bands):
                pairs.cell[at + k] = workspace.pairs.cell[k]
        evaluate_and_add(s, t, pairs, at)
    return len(readings)
