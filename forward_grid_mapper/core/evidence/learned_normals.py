"""Surface normals from all readings, and the limit of the incidence angle of each surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..common.grid import Grid, Window
from ..common.parameter_groups import ModelParameters
from ..runtime.cancelling import NEVER
from ..sensor.incidence import count, edges_of, limits_of, narrowed, no_counts, slots_of, with_own_angles
from ..sensor.surface_normals import SurfaceNormals, gather, normals_of, renewed, window_of_influence
from .renewal import near
from .state import State, Work

SumOverReadings = Callable[[int, int, Work, NDArray[np.int64]], None]
"""Runs such work on several threads for a range of readings, and sums the results (`Evidence.sum_over_readings`)."""

NO_INCIDENCE_LIMIT = 1.5707
"""Largest incidence angle, radians, from which on there is no limit."""


def has_limit(model: ModelParameters) -> bool:
    """Return whether there is a limit of the incidence angle; without one, normals do not matter."""
    return model.max_incidence_angle < NO_INCIDENCE_LIMIT


def usual_limits(model: ModelParameters) -> list[float]:
    """Return the limits of the incidence angle that a surface of which nothing is known may have, radians.

    They are equally likely. The smallest one is left out: with it, no place would be free that is seen in one direction
    only, as by a robot that turns on the spot.
    """
    limits = limits_of(model).tolist() if has_limit(model) else [model.max_incidence_angle]
    return limits[1:] or limits


def first_normals(
    s: State, end: int, grid: Grid, model: ModelParameters, sums: NDArray[np.int64], sum_over_readings: SumOverReadings
) -> SurfaceNormals:
    """Return the normals from the readings up to `end`.

    Parameters
    ----------
    s : State
    end : int
    grid : Grid
    model : ModelParameters
    sums : int64, shape (3, cells)
        Output of `gather`; must be 0 before.
    sum_over_readings : callable
    """

    def gathered(s: State, first: int, last: int, into: NDArray[np.int64]) -> None:
        gather(s.cones, grid.shape, (first, last), into, s.stop)

    sum_over_readings(0, end, gathered, sums)
    normals, edges = normals_of(sums, grid, model.max_incidence_angle), edges_of(model)
    if edges is None:
        return normals
    whole = 0, grid.height, 0, grid.width
    slots = slots_of(normals, whole)
    counts = no_counts(slots)
    weights = np.ascontiguousarray(s.reading_states['multiplicity'][:end])

    def counted(s: State, first: int, last: int, into: NDArray[np.int64]) -> None:
        count(s.cones, weights, normals, slots, whole, edges, (first, last), into, s.stop)

    sum_over_readings(0, end, counted, counts)
    return narrowed(normals, counts, slots, edges, grid, whole)


def renewed_normals(
    s: State, size: int, grid: Grid, model: ModelParameters, sums: NDArray[np.int64], window: Window
) -> SurfaceNormals:
    """Return the normals for new sums and readings, which differ from those before only in a window.

    Parameters
    ----------
    s : State
        With the normals before.
    size : int
        Number of readings.
    grid : Grid
    model : ModelParameters
    sums : int64, shape (3, cells)
        Of all these readings.
    window : first row, last one plus one, and columns likewise
    """
    around = window_of_influence(window, grid)
    normals, edges = renewed(s.normals, sums, grid, around), edges_of(model)
    if edges is None:
        return normals
    readings = np.flatnonzero(near(s.cones[:size], around))
    weights = s.reading_states['multiplicity'][readings]
    with_own_angles(normals, s.cones[readings], weights, grid, window, edges)
    # outside of the window nothing changed
    outside = np.ones(grid.shape, np.bool_)
    outside[window[0] : window[1], window[2] : window[3]] = False
    for new, old in ((normals.x, s.normals.x), (normals.y, s.normals.y)):
        np.copyto(new.reshape(grid.shape), old.reshape(grid.shape), where=outside)
    return normals


def keep_bearings(cones: NDArray[np.void], grid: Grid, sums: NDArray[np.int64]) -> None:
    """Add the bearings of readings to `sums`. It cannot fail: it is single-threaded and ignores `stop`."""
    gather(cones, grid.shape, (0, len(cones)), sums, NEVER)
