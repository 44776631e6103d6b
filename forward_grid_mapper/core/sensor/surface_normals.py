"""Normals of surfaces, and readings that exceed the incidence angle up to which a surface returns echoes.

Sound that meets a smooth surface at a slant is reflected away from the sensor. So a reading longer than the distance of
a surface is evidence against it only if it met the surface nearly along its normal. In recordings of real sonars, most
of the evidence against true walls comes from readings that exceed the incidence angle.

Normals are estimated before the search, from the echoes alone. Near a surface, the bearings φ of the readings whose
range agrees are distributed around its normal. φ and φ + π are equivalent, so 2φ is averaged over the square of
`NEIGHBOURHOOD` around the cell:

    C = Σ w cos 2φ      S = Σ w sin 2φ      M = Σ w      w = exp(−(d − z)² / 2σ²)      normal = atan2(S, C) / 2

It is known if M and √(C² + S²) / M are large enough. Up to which angle the surface returns echoes is estimated in
`incidence`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LEAST_AGREEMENT, LEAST_WEIGHT, NEIGHBOURHOOD, THROUGH, WEIGHT_CELL
from ..common.grid import Grid, Window
from ..runtime.jit import inlined_kernel, kernel
from .cone import rows_of, runs_of
from .cone_table import Cones, cone_of

WEIGHT_UNIT = 2.0**-20
"""Unit of the integer sums, which do not depend on their order."""


class SurfaceNormals(NamedTuple):
    """The normals of surfaces.

    Attributes
    ----------
    known : uint8, shape (cells,)
    x, y : float32, shape (cells,)
        Along the normal, with either sign; 0 if unknown. The length is one if the surface returns echoes up to the
        largest angle of the model, and cos(angle of the model) / cos(own limit) if its own limit is smaller
        (`incidence`): so the squared product with a unit vector is compared with `cos2_limit` for all surfaces.
    before : int32, shape (height, width + 1)
        Number of known cells in each row before a column.
    cos2_limit : float
        Squared cosine of the largest angle to the normal; 0 if there is no limit.
    """

    known: NDArray[np.uint8]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    before: NDArray[np.int32]
    cos2_limit: float


def on_larger_grid(normals: SurfaceNormals, inner: Grid, outer: Grid) -> SurfaceNormals:
    """Return the normals of `inner` on the larger grid `outer`; those outside of `inner` are unknown."""
    if not len(normals.known):
        return normals
    window = outer.window(inner)

    def wide(values: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros(outer.shape, values.dtype)
        out[window] = values.reshape(inner.shape)
        return out

    known = wide(normals.known)
    return SurfaceNormals(
        known.ravel(), wide(normals.x).ravel(), wide(normals.y).ravel(), _before(known), normals.cos2_limit
    )


def known_normals(known: NDArray[np.uint8], x: NDArray[Any], y: NDArray[Any], angle: float) -> SurfaceNormals:
    """Return normals from stored arrays.

    Parameters
    ----------
    known : uint8, shape (height, width)
    x, y : float32, shape (height, width)
    angle : float
        As for `normals_of`.
    """
    flat_x, flat_y = (np.ascontiguousarray(values, np.float32).ravel() for values in (x, y))
    return SurfaceNormals(known.ravel(), flat_x, flat_y, _before(known), math.cos(angle) ** 2)


def no_normals() -> SurfaceNormals:
    """Return normals without any limit of the incidence angle."""
    none = np.zeros(0, np.float32)
    return SurfaceNormals(np.zeros(0, np.uint8), none, none, np.zeros((1, 1), np.int32), 0.0)


@kernel
def gather(cones: Cones, shape: tuple[int, int], part: tuple[int, int], sums: Any, stop: Any) -> None:
    """Add C, S and M of the readings `part[0]` to `part[1]` to `sums`, int64, shape (3, cells), in WEIGHT_UNITs."""
    height, width = shape
    for t in range(part[0], part[1]):
        if stop[0]:
            break
        reading = cones[t]
        if reading.z >= reading.z_max:
            continue
        cone = cone_of(reading)
        low = max(reading.z - 4.0 * reading.sigma, 0.0) ** 2
        for row in range(*rows_of(cone, height)):
            v = row + 0.5 - cone.y
            runs = runs_of(cone, row, width)
            for first, last in ((runs.first, runs.last), (runs.first2, runs.last2)):
                for column in range(first, last + 1):
                    u = column + 0.5 - cone.x
                    square = u * u + v * v
                    if square <= low:
                        continue
                    error = (math.sqrt(square) - reading.z) / reading.sigma
                    weight = math.exp(-0.5 * error * error) / WEIGHT_UNIT
                    cell = row * width + column
                    sums[0, cell] += int(weight * (u * u - v * v) / square)
                    sums[1, cell] += int(weight * 2.0 * u * v / square)
                    sums[2, cell] += int(weight)


def _before(known: NDArray[Any]) -> NDArray[np.int32]:
    """Return the number of known cells in each row before a column, shape (height, width + 1)."""
    out = np.zeros((known.shape[0], known.shape[1] + 1), np.int32)
    np.cumsum(known, axis=1, out=out[:, 1:])
    return out


Square = tuple[int, float]
"""Number of cells by which `NEIGHBOURHOOD` extends beyond the middle one, and weight of the outermost ones."""


def square_of(resolution: float) -> Square:
    """Return the square of `NEIGHBOURHOOD` for a cell size, metres."""
    half = (max(round(NEIGHBOURHOOD / resolution, 6), 1.0) - 1.0) / 2.0
    whole = math.ceil(half - 1e-9)
    return whole, half - whole + 1.0


def unit_of_sums(resolution: float) -> float:
    """Return the factor from sums over `NEIGHBOURHOOD` to weights in cells of `WEIGHT_CELL`."""
    return float(WEIGHT_UNIT * (resolution / WEIGHT_CELL) ** 2)


@kernel
def sum_columns(values: Any, row: int, first: int, square: Square, out: Any) -> None:
    """Write the sums of columns, from `first` on, over the height of `NEIGHBOURHOOD` around a row to `out`.

    Outside of `values`, int64, shape (height, width), everything is 0.
    """
    height, width = values.shape
    out[:] = 0.0
    for k in range(-square[0], square[0] + 1):
        if 0 <= row + k < height:
            weight = square[1] if abs(k) == square[0] else 1.0
            for i in range(max(-first, 0), min(len(out), width - first)):
                out[i] += weight * values[row + k, first + i]


@inlined_kernel
def sum_across(columns: Any, begin: int, square: Square) -> float:
    """Return the sum of the results of `sum_columns` over the width of `NEIGHBOURHOOD`."""
    total = 0.0
    for k in range(-square[0], square[0] + 1):
        total += (square[1] if abs(k) == square[0] else 1.0) * columns[begin + square[0] + k]
    return total


@kernel
def _estimate(normals: SurfaceNormals, sums: Any, window: Window, square: Square, unit: float, columns: Any) -> None:
    """Write the normals of the cells of a window.

    Parameters
    ----------
    normals : SurfaceNormals
    sums : int64, shape (3, height, width)
    window, square
    unit : float
        `unit_of_sums`.
    columns : float64, shape (3, columns of the window and margins of `square`)
        Workspace.
    """
    bottom, top, left, right = window
    width = sums.shape[2]
    for row in range(bottom, top):
        for k in range(3):
            sum_columns(sums[k], row, left - square[0], square, columns[k])
        for column in range(left, right):
            c, at = row * width + column, column - left
            normals.known[c], normals.x[c], normals.y[c] = 0, 0.0, 0.0
            mass = sum_across(columns[2], at, square) * unit
            if mass < LEAST_WEIGHT:
                continue
            cosine, sine = sum_across(columns[0], at, square) * unit, sum_across(columns[1], at, square) * unit
            if math.hypot(cosine, sine) >= LEAST_AGREEMENT * mass:
                angle = math.atan2(sine, cosine) / 2
                normals.known[c], normals.x[c], normals.y[c] = 1, math.cos(angle), math.sin(angle)
        for column in range(width):
            normals.before[row, column + 1] = normals.before[row, column] + normals.known[row * width + column]


def _write(normals: SurfaceNormals, sums: NDArray[np.int64], grid: Grid, window: Window) -> None:
    """Write the normals of the cells of a window."""
    square = square_of(grid.resolution)
    columns = np.empty((3, window[3] - window[2] + 2 * square[0]))
    _estimate(normals, sums.reshape(3, *grid.shape), window, square, unit_of_sums(grid.resolution), columns)


def normals_of(sums: NDArray[np.int64], grid: Grid, angle: float) -> SurfaceNormals:
    """Return the normals from the sums of `gather`.

    Parameters
    ----------
    sums : int64, shape (3, cells)
    grid : Grid
    angle : float
        Largest angle to the normal at which surfaces return echoes, radians.
    """
    normals = _unknown(grid.shape, math.cos(angle) ** 2)
    _write(normals, sums, grid, (0, grid.height, 0, grid.width))
    return normals


def _unknown(shape: tuple[int, int], cos2_limit: float) -> SurfaceNormals:
    x, y = (np.zeros(shape[0] * shape[1], np.float32) for _ in range(2))
    known, before = np.zeros(len(x), np.uint8), np.zeros((shape[0], shape[1] + 1), np.int32)
    return SurfaceNormals(known, x, y, before, cos2_limit)


def renewed(normals: SurfaceNormals, sums: NDArray[np.int64], grid: Grid, window: Window) -> SurfaceNormals:
    """Return new normals after the sums changed in a window; the given ones are not modified.

    Parameters
    ----------
    normals : SurfaceNormals
    sums : int64, shape (3, cells)
    grid : Grid
    window
        Of the cells to estimate: first row, last one plus one, and columns likewise.
    """
    new = normals._replace(
        known=normals.known.copy(), x=normals.x.copy(), y=normals.y.copy(), before=normals.before.copy()
    )
    _write(new, sums, grid, window)
    return new


def window_of_influence(window: Window, grid: Grid) -> Window:
    """Return the window of the cells whose squares of `NEIGHBOURHOOD` reach into `window`."""
    bottom, top, left, right = window
    n, _ = square_of(grid.resolution)
    return max(bottom - n, 0), min(top + n, grid.height), max(left - n, 0), min(right + n, grid.width)


@inlined_kernel
def exceeds_incidence_angle(normals: SurfaceNormals, reading: Any, c: int, u: float, v: float) -> bool:
    """Return whether a reading passed cell c, at (u, v) from its apex, beyond the limit of the incidence angle."""
    if not normals.known[c]:
        return False
    square = u * u + v * v
    through = reading.z - THROUGH * reading.sigma
    if through <= 0.0 or square >= through * through:
        return False
    along = u * normals.x[c] + v * normals.y[c]
    return bool(along * along < normals.cos2_limit * square)
