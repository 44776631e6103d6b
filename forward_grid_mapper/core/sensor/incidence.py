"""The limit of the incidence angle of each surface: large for rough walls, small for smooth ones and glass.

A surface that is detected near its normal and missed beyond 20° is no gap, but smooth. With one limit for all surfaces,
readings that passed it at 30° would be evidence against it. So the limit is one of three: the smallest and the largest
of the model, and the middle. For each cell whose normal is known, readings are counted in the three zones of incidence
up to these: echoes, weighted by how well their range agrees (w of `surface_normals`), and passes, readings that end
beyond it, weighted by the strength of their beam. Counts are summed over the square of `NEIGHBOURHOOD` around the cell.

Let the fraction r of the readings within a limit be echoes, and r' of those beyond. With e echoes and p passes

    log L(r) = e log r + p log (1 − r)        r = e / (e + p)

The limit is the one whose two rates are most likely, if they are likelier by `GAIN` than one rate for all. At least
`LEAST_RATE` of the readings within must be echoes, and `CONTRAST` times the rate beyond: of readings through an open
door few are echoes, so all its passes are evidence against a wall.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.constants import (
    CONTRAST,
    FEW_ECHOES,
    FEW_READINGS,
    GAIN,
    LEAST_RATE,
    NEIGHBOURHOOD,
    THROUGH,
    WEIGHT_CELL,
)
from ..common.grid import Grid, Window
from ..common.parameter_groups import ModelParameters
from ..runtime.cancelling import NEVER
from ..runtime.jit import inlined_kernel, kernel
from .cone import rows_of, runs_of, strength
from .cone_table import Cones, cone_of
from .surface_normals import (
    WEIGHT_UNIT,
    Square,
    SurfaceNormals,
    square_of,
    sum_across,
    unit_of_sums,
    window_of_influence,
)

ZONES = 3
"""Number of zones of incidence; two that are a few degrees wider, or five, are about as good."""


def slots_of(normals: SurfaceNormals, window: Window) -> NDArray[np.int32]:
    """Return consecutive numbers for the cells of a window with known normals, -1 for all others, shape (cells,)."""
    bottom, top, left, right = window
    height, width = len(normals.before), normals.before.shape[1] - 1
    out = np.full((height, width), -1, np.int32)
    known = normals.known.reshape(height, width)[bottom:top, left:right] > 0
    out[bottom:top, left:right][known] = np.arange(known.sum(), dtype=np.int32)
    return out.ravel()


def no_counts(slots: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return zero counts for these cells: echoes and passes in each zone, shape (2 · ZONES, known)."""
    return np.zeros((2 * ZONES, int(slots.max(initial=-1)) + 1), np.int64)


def limits_of(model: ModelParameters) -> NDArray[np.float64]:
    """Return the limits of the incidence angle that a surface may have, radians, increasing; shape (ZONES,) or (1,)."""
    if model.min_incidence_angle >= model.max_incidence_angle:
        return np.array([model.max_incidence_angle])
    return np.linspace(model.min_incidence_angle, model.max_incidence_angle, ZONES)


def edges_of(model: ModelParameters) -> NDArray[np.float64] | None:
    """Return the squared cosines at which the zones end, shape (ZONES,); None if all surfaces have the same limit."""
    limits = limits_of(model)
    if len(limits) == 1:
        return None
    out: NDArray[np.float64] = np.cos(limits) ** 2
    return out


@kernel
def count(
    cones: Cones,
    weights: Any,
    normals: SurfaceNormals,
    slots: Any,
    window: tuple[int, int, int, int],
    edges: Any,
    part: tuple[int, int],
    counts: Any,
    stop: Any,
) -> None:
    """Add echoes and passes of the readings `part[0]` to `part[1]` to `counts`, in units of WEIGHT_UNIT.

    Parameters
    ----------
    cones : records of `CONE`, shape (N,)
    weights : int32, shape (N,)
        Number of readings that each represents.
    normals : SurfaceNormals
        Of length one in the window.
    slots : int32, shape (cells,)
        `slots_of` the window.
    window : first row, last one plus one, and columns likewise
    edges : float64, shape (ZONES,)
    part : int, int
    counts : int64, shape (2 · ZONES, known)
        Echoes in the first rows, passes in the others.
    stop : uint8, shape (1,)
    """
    width = normals.before.shape[1] - 1
    for t in range(part[0], part[1]):
        if stop[0]:
            break
        reading = cones[t]
        cone = cone_of(reading)
        unit = weights[t] / WEIGHT_UNIT
        sine2 = reading.sine * reading.sine
        bottom, top = rows_of(cone, window[1])
        for row in range(max(bottom, window[0]), top):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for begin, end in ((runs.first, runs.last), (runs.first2, runs.last2)):
                first, last = max(begin, window[2]), min(end, window[3] - 1)
                if first > last or normals.before[row, last + 1] == normals.before[row, first]:
                    continue
                for column in range(first, last + 1):
                    c = row * width + column
                    if slots[c] < 0:
                        continue
                    u = column + 0.5 - cone.x
                    square = u * u + v * v
                    along = u * normals.x[c] + v * normals.y[c]
                    zone = 0
                    while zone < len(edges) and along * along < edges[zone] * square:
                        zone += 1
                    if zone == len(edges) or square == 0.0:
                        continue
                    error = (math.sqrt(square) - reading.z) / reading.sigma
                    if error <= -THROUGH:
                        share = strength(reading.axis_x, reading.axis_y, sine2, u, v)
                        counts[zone + len(edges), slots[c]] += int(unit * share)
                    elif error < THROUGH and reading.z < reading.z_max:
                        counts[zone, slots[c]] += int(unit * math.exp(-0.5 * error * error))


@inlined_kernel
def _rate(echoes: float, passes: float) -> float:
    """Return the fraction of the readings that are echoes, one half without readings."""
    return (echoes + FEW_ECHOES) / (echoes + passes + FEW_READINGS)


@inlined_kernel
def _log_likelihood(echoes: float, passes: float) -> float:
    """Return log L of the maximum likelihood rate."""
    rate = _rate(echoes, passes)
    return echoes * math.log(rate) + passes * math.log(1.0 - rate)


@inlined_kernel
def limit(counts: Any) -> int:
    """Return the last zone in which a surface returns echoes, from its counts: float64, shape (2 · ZONES,)."""
    echoes, passes = 0.0, 0.0
    for k in range(ZONES):
        echoes += counts[k]
        passes += counts[ZONES + k]
    one_rate = _log_likelihood(echoes, passes)
    best, zone = GAIN, ZONES - 1
    echoes_within, passes_within = 0.0, 0.0
    for k in range(ZONES - 1):
        echoes_within += counts[k]
        passes_within += counts[ZONES + k]
        echoes_beyond, passes_beyond = echoes - echoes_within, passes - passes_within
        gained = (
            _log_likelihood(echoes_within, passes_within) + _log_likelihood(echoes_beyond, passes_beyond) - one_rate
        )
        rate = _rate(echoes_within, passes_within)
        if gained > best and rate >= LEAST_RATE and rate >= CONTRAST * _rate(echoes_beyond, passes_beyond):
            best, zone = gained, k
    return zone


@kernel
def _narrow(
    normals: SurfaceNormals,
    counts: Any,
    slots: Any,
    lengths: Any,
    window: Window,
    square: Square,
    unit: float,
    columns: Any,
    pooled: Any,
) -> None:
    """Scale the normals in a window so that their lengths state the limits of their surfaces.

    Parameters
    ----------
    normals, counts, slots, window
        As for `narrowed`.
    lengths : float64, shape (ZONES,)
    square, unit
        Of the square around a cell, and the factor of sums over it.
    columns : float64, shape (columns of the window and margins of `square`, 2 · ZONES)
        Workspace.
    pooled : float64, shape (2 · ZONES,)
        Workspace.
    """
    bottom, top, left, right = window
    height, width = len(normals.before), normals.before.shape[1] - 1
    first = left - square[0]
    for row in range(bottom, top):
        if normals.before[row, right] == normals.before[row, left]:
            continue
        columns[:] = 0.0
        for other in range(max(row - square[0], 0), min(row + square[0] + 1, height)):
            weight = square[1] if abs(other - row) == square[0] else 1.0
            for column in range(max(first, 0), min(right + square[0], width)):
                slot = slots[other * width + column]
                if slot >= 0:
                    for k in range(2 * ZONES):
                        columns[column - first, k] += weight * counts[k, slot]
        for column in range(left, right):
            c = row * width + column
            if not normals.known[c]:
                continue
            for k in range(2 * ZONES):
                pooled[k] = sum_across(columns[:, k], column - left, square) * unit
            length = lengths[limit(pooled)]
            normals.x[c] *= length
            normals.y[c] *= length


def narrowed(
    normals: SurfaceNormals,
    counts: NDArray[np.int64],
    slots: NDArray[np.int32],
    edges: NDArray[np.float64],
    grid: Grid,
    window: Window,
) -> SurfaceNormals:
    """Return the normals, whose lengths in a window state the limit of the incidence angle of each surface.

    Parameters
    ----------
    normals : SurfaceNormals
        Of length one in the window; they are changed.
    counts, slots
        Of all cells in the `window_of_influence` of the window.
    edges : float64, shape (ZONES,)
    grid : Grid
    window : first row, last one plus one, and columns likewise
    """
    square = square_of(grid.resolution)
    unit = unit_of_sums(grid.resolution) * WEIGHT_CELL / NEIGHBOURHOOD
    columns = np.empty((window[3] - window[2] + 2 * square[0], 2 * ZONES))
    _narrow(normals, counts, slots, np.sqrt(edges[-1] / edges), window, square, unit, columns, np.empty(2 * ZONES))
    return normals


def with_own_angles(
    normals: SurfaceNormals,
    cones: Cones,
    weights: NDArray[np.int32],
    grid: Grid,
    window: Window,
    edges: NDArray[np.float64],
) -> SurfaceNormals:
    """Return the normals, whose lengths state the limit of the incidence angle of each surface; single-threaded.

    Parameters
    ----------
    normals : SurfaceNormals
        Of length one in the `window_of_influence` of the window; they are changed in the window.
    cones : records of `CONE`, shape (N,)
        All that reach into that `window_of_influence`.
    weights : int32, shape (N,)
        Number of readings that each represents.
    grid : Grid
    window : first row, last one plus one, and columns likewise
    edges : float64, shape (ZONES,)
    """
    around = window_of_influence(window, grid)
    slots = slots_of(normals, around)
    counts = no_counts(slots)
    count(cones, weights, normals, slots, around, edges, (0, len(cones)), counts, NEVER)
    return narrowed(normals, counts, slots, edges, grid, window)
