"""What sound came to on a free way: sound does not go through walls.

**Mirror images.** Where a beam meets a smooth wall at a slant it goes on mirrored, and what it hears then is mapped in
line with the sensor, behind that wall. So of the echoes that an occupied cell explains, those count that came on a free
way: no occupied cell stands between the sensor and `STANDS_OFF` before the cell. Echoes are weighted by how well their
range agrees. Where less than `LEAST_FREE_WAY` of those around a cell came on a free way, it is a mirror image. What is
really there is unknown.

**Free space.** A free cell must have been passed by a beam, at `LEAST_STRENGTH` of it or more, on a free way: behind
walls nothing is known, whatever went past them at a slant.

All that counts lies within `IMAGE_AROUND` of a cell, but for the readings' own ways: tiles give the same maps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import IMAGE_AROUND, LEAST_FREE_WAY, LEAST_STRENGTH, STANDS_OFF, THROUGH
from ..evidence.evidence import Evidence
from ..evidence.state import State
from ..runtime.cancelling import check
from ..runtime.jit import kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import cone_of

UNIT = 2.0**-20
"""Unit of the counts, which as whole numbers do not depend on their order."""

STEP = 0.5
"""Cells between the points at which the way to a cell is looked at."""


@kernel
def on_free_way(reading: Any, u: float, v: float, until: float, occupied: Any, lattice: Any) -> bool:
    """Return whether no occupied cell stands on the way to (u, v) from the apex of a reading, `until` so many cells."""
    distance = math.sqrt(u * u + v * v)
    at = STEP
    while at < until:
        column = int(math.floor(reading.x + u / distance * at))
        row = int(math.floor(reading.y + v / distance * at))
        if 0 <= row < lattice.height and 0 <= column < lattice.width and occupied[row * lattice.width + column]:
            return False
        at += STEP
    return True


@kernel
def add_echoes(s: State, begin: int, end: int, occupied: Any, stands_off: float, echoes: Any) -> None:
    """Add the echoes of the readings `begin` to `end` that occupied cells explain to `echoes`, int64, shape (2, cells).

    In units of UNIT: those on a free way, and all. `stands_off` is in cells.
    """
    width = s.lattice.width
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading = s.cones[t]
        if reading.z >= reading.z_max:
            continue
        cone = cone_of(reading)
        unit = s.reading_states[t].multiplicity / UNIT
        for row in range(*rows_of(cone, s.lattice.height)):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    c = row * width + column
                    if occupied[c] == 0 or runs.inner <= column <= runs.outer:
                        continue
                    u = column + 0.5 - cone.x
                    distance = math.sqrt(u * u + v * v)
                    error = (distance - reading.z) / reading.sigma
                    if abs(error) >= THROUGH:
                        continue
                    share = int(unit * math.exp(-0.5 * error * error))
                    echoes[1, c] += share
                    if on_free_way(reading, u, v, distance - stands_off, occupied, s.lattice):
                        echoes[0, c] += share


@kernel
def take_out_passed(s: State, end: int, occupied: Any, cells: Any) -> None:
    """Unset those `cells` (bool, shape (cells,)) that one of the first `end` readings passed on a free way."""
    width = s.lattice.width
    for t in range(end):
        if s.stop[0]:
            break
        reading = s.cones[t]
        cone = cone_of(reading)
        through = reading.z - THROUGH * reading.sigma
        sine2 = reading.sine * reading.sine
        for row in range(*rows_of(cone, s.lattice.height)):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    c = row * width + column
                    if not cells[c]:
                        continue
                    u = column + 0.5 - cone.x
                    distance = math.sqrt(u * u + v * v)
                    if distance > through or strength(reading.axis_x, reading.axis_y, sine2, u, v) < LEAST_STRENGTH:
                        continue
                    cells[c] = not on_free_way(reading, u, v, distance - 1.0, occupied, s.lattice)


@kernel
def keep_images(echoes: Any, cells: Any, around: int) -> None:
    """Unset those `cells` (bool, shape (height, width)) that are no mirror images.

    `echoes` are those of `add_echoes`, shape (2, height, width), `around` how many cells on each side count.
    """
    height, width = cells.shape
    for row in range(height):
        for column in range(width):
            if not cells[row, column]:
                continue
            free, total = 0, 0
            for i in range(max(row - around, 0), min(row + around + 1, height)):
                for j in range(max(column - around, 0), min(column + around + 1, width)):
                    free += echoes[0, i, j]
                    total += echoes[1, i, j]
            cells[row, column] = free < LEAST_FREE_WAY * total


def mirror_images(evidence: Evidence, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return those of some cells, shape `grid.shape`, that are mirror images, by the map that the search found."""
    occupied, grid = evidence.state.maps.occupied, evidence.grid
    echoes = np.zeros((2, grid.size), np.int64)

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        add_echoes(s, begin, end, occupied, STANDS_OFF / grid.resolution, own)

    evidence.summed(0, len(evidence), work, echoes)
    images = cells.copy()
    keep_images(echoes.reshape(2, *grid.shape), images, round(IMAGE_AROUND / grid.resolution))
    return images


def not_passed(evidence: Evidence, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return those of some cells, shape `grid.shape`, that no reading passed on a free way."""
    left = cells.ravel().copy()
    # on one thread, since where one reading passed the others are not asked
    take_out_passed(evidence.state, len(evidence), evidence.state.maps.occupied, left)
    check(evidence.state.stop)
    return left.reshape(evidence.grid.shape)
