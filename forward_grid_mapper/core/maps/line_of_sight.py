"""Lines of sight: mirror images and free space behind walls are removed, since sound does not pass walls.

**Mirror images.** A smooth wall reflects a beam that meets it at a slant (specular reflection), and an object met after
that is mapped in the direction of the sensor, behind the wall. So for each occupied cell, echoes that it explains are
counted if they came in line of sight: no occupied cell is between the sensor and `SAME_WALL` before the cell. Echoes
are weighted by how well their range agrees. If less than `LEAST_IN_SIGHT` of the echoes around a cell came in line of
sight, it is a mirror image, and becomes unknown.

**Free space.** A free cell must have been passed by a beam in line of sight, with at least `LEAST_STRENGTH` of the
strength on its axis: behind walls nothing is known, even if sound passed them at a slant.

Everything that matters to a cell lies within `IMAGE_AROUND` of it or on the way of its readings, so tiles give the same
maps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import IMAGE_AROUND, LEAST_IN_SIGHT, LEAST_STRENGTH, SAME_WALL, THROUGH
from ..evidence.evidence import Evidence
from ..evidence.state import State
from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone import rows_of, runs_of, strength
from ..sensor.cone_table import cone_of

ECHO_UNIT = 2.0**-20
"""Unit of the integer counts; integer sums do not depend on their order."""

STEP = 0.5
"""Cells between the points of a line of sight at which the map is tested."""


@inlined_kernel
def in_line_of_sight(reading: Any, u: float, v: float, until: float, occupied: Any, lattice: Any) -> bool:
    """Return whether the first `until` cells from the apex of a reading towards (u, v) are without occupied cells."""
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
def add_echoes(s: State, begin: int, end: int, occupied: Any, same_wall: float, echoes: Any) -> None:
    """Add the echoes of the readings `begin` to `end` to the occupied cells that explain them.

    `echoes` is int64, in units of ECHO_UNIT, shape (2, cells): those in line of sight, and all. `same_wall` is in
    cells.
    """
    width = s.lattice.width
    for t in range(begin, end):
        if s.stop[0]:
            break
        reading = s.cones[t]
        if reading.z >= reading.z_max:
            continue
        cone = cone_of(reading)
        unit = s.reading_states[t].multiplicity / ECHO_UNIT
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
                    if in_line_of_sight(reading, u, v, distance - same_wall, occupied, s.lattice):
                        echoes[0, c] += share


@kernel
def remove_passed(s: State, begin: int, end: int, occupied: Any, cells: Any) -> None:
    """Unset those `cells` (bool, shape (cells,)) that one of the readings `begin` to `end` passed in line of sight.

    Threads may share `cells`, since cells are never set.
    """
    width = s.lattice.width
    for t in range(begin, end):
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
                    if in_line_of_sight(reading, u, v, distance - 1.0, occupied, s.lattice):
                        cells[c] = False


@kernel
def keep_images(echoes: Any, cells: Any, around: int) -> None:
    """Unset those `cells` (bool, shape (height, width)) that are no mirror images.

    `echoes` are those of `add_echoes`, shape (2, height, width); those within `around` cells on each side are summed.
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
            cells[row, column] = free < LEAST_IN_SIGHT * total


def mirror_images(evidence: Evidence, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of some cells are mirror images by the map that the search found, shape `grid.shape`."""
    occupied, grid = evidence.state.maps.occupied, evidence.grid
    echoes = np.zeros((2, grid.size), np.int64)

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        add_echoes(s, begin, end, occupied, SAME_WALL / grid.resolution, own)

    evidence.sum_over_readings(0, len(evidence), work, echoes)
    images = cells.copy()
    keep_images(echoes.reshape(2, *grid.shape), images, round(IMAGE_AROUND / grid.resolution))
    return images


def not_passed(evidence: Evidence, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of some cells no reading passed in line of sight, shape `grid.shape`."""
    remaining = cells.ravel().copy()

    def work(s: State, begin: int, end: int, own: NDArray[np.int64]) -> None:
        # shared by all threads: once a reading passed a cell, the others are skipped
        remove_passed(s, begin, end, s.maps.occupied, remaining)

    evidence.sum_over_readings(0, len(evidence), work, np.zeros(0, np.int64))
    return remaining.reshape(evidence.grid.shape)
