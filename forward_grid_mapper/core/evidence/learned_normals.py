"""What all readings together say about surface normals, and up to which incidence each surface returns echoes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid, Window
from ..common.parameters import ModelParameters
from ..runtime.cancelling import NEVER
from ..sensor.incidence import count, edges_of, narrowed, no_counts, slots_of, with_own_angles
from ..sensor.surface_normals import SurfaceNormals, gather, normals_of, renewed, touched
from .renewal import near
from .state import State, Work

Summed = Callable[[int, int, Work, NDArray[np.int64]], None]
"""Has several threads do such work for the readings from one to another, and sums up what they find."""

NO_INCIDENCE_LIMIT = 1.5707
"""Radians off the normal from where on no reading exceeds the incidence angle."""


def has_limit(model: ModelParameters) -> bool:
    """Return whether there is an incidence angle at all; without one, normals do not matter."""
    return model.max_incidence_angle < NO_INCIDENCE_LIMIT


def first_normals(
    s: State, end: int, grid: Grid, model: ModelParameters, sums: NDArray[np.int64], summed: Summed
) -> SurfaceNormals:
    """Return the normals that the readings up to `end` say.

    Parameters
    ----------
    s : State
    end : int
    grid : Grid
    model : ModelParameters
    sums : int64, shape (3, cells)
        Filled as by `gather`; must be 0.
    summed : callable
    """

    def gathered(s: State, first: int, last: int, into: NDArray[np.int64]) -> None:
        gather(s.cones, grid.shape, (first, last), into, s.stop)

    summed(0, end, gathered, sums)
    normals, edges = normals_of(sums, grid, model.max_incidence_angle), edges_of(model)
    if edges is None:
        return normals
    whole = 0, grid.height, 0, grid.width
    slots = slots_of(normals, whole)
    counts = no_counts(slots)
    weights = np.ascontiguousarray(s.reading_states['multiplicity'][:end])

    def counted(s: State, first: int, last: int, into: NDArray[np.int64]) -> None:
        count(s.cones, weights, normals, slots, whole, edges, (first, last), into, s.stop)

    summed(0, end, counted, counts)
    return narrowed(normals, counts, slots, edges, grid, whole)


def renewed_normals(
    s: State, size: int, grid: Grid, model: ModelParameters, sums: NDArray[np.int64], window: Window
) -> SurfaceNormals:
    """Return the normals as they are with other sums and readings, which change them in a window alone.

    Parameters
    ----------
    s : State
        With the normals before.
    size : int
        Readings that count.
    grid : Grid
    model : ModelParameters
    sums : int64, shape (3, cells)
        Of all these readings.
    window : first row, last one plus one, and columns likewise
    """
    around = touched(window, grid)
    normals, edges = renewed(s.normals, sums, grid, around), edges_of(model)
    if edges is None:
        return normals
    readings = np.flatnonzero(near(s.cones[:size], around))
    weights = s.reading_states['multiplicity'][readings]
    with_own_angles(normals, s.cones[readings], weights, grid, window, edges)
    # around the window nothing changed
    outside = np.ones(grid.shape, np.bool_)
    outside[window[0] : window[1], window[2] : window[3]] = False
    for new, old in ((normals.x, s.normals.x), (normals.y, s.normals.y)):
        np.copyto(new.reshape(grid.shape), old.reshape(grid.shape), where=outside)
    return normals


def keep_bearings(cones: NDArray[np.void], grid: Grid, sums: NDArray[np.int64]) -> None:
    """Add what readings say about normals to `sums`; it cannot fail: on one thread, whatever anyone's `stop` says."""
    gather(cones, grid.shape, (0, len(cones)), sums, NEVER)
