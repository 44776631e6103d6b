"""Normals of surfaces, and which readings exceed the incidence angle at which a surface returns an echo.

Sound that meets a smooth surface at a slant does not come back. So a reading that reaches past a surface contradicts it
only if it met the surface nearly along its normal. Most of what speaks against walls that are there, in recordings
of real sonars, comes from readings that graze them.

The normal is estimated before any search, from the echoes alone. Near a surface the bearings of those readings whose
range agrees gather around its normal; φ and φ + π are one, so 2φ is averaged, over the square of `NEIGHBOURHOOD`
around the cell:

    C = Σ w cos 2φ      S = Σ w sin 2φ      M = Σ w      w = exp(−(d − z)² / 2σ²)      normal = atan2(S, C) / 2

It counts as known where M and √(C² + S²) / M are large enough.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.constants import LEAST_AGREEMENT, LEAST_WEIGHT, NEIGHBOURHOOD, THROUGH, WEIGHT_CELL
from ..common.grid import Grid
from ..runtime.jit import kernel
from .cone import rows_of, runs_of
from .cone_table import Cones, cone_of

QUANTUM = 2.0**-20
"""Unit of the sums, which as whole numbers do not depend on their order."""


class SurfaceNormals(NamedTuple):
    """The normals of surfaces.

    Attributes
    ----------
    known : uint8, shape (cells,)
    x, y : float32, shape (cells,)
        Unit vector along the normal, either way.
    before : int32, shape (height, width + 1)
        Number of known cells in each row before a column.
    cos2_limit : float
        Squared cosine of the angle off the normal above which a reading exceeds_incidence_angle; 0 if none does.
    """

    known: NDArray[np.uint8]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    before: NDArray[np.int32]
    cos2_limit: float


def on_larger_grid(normals: SurfaceNormals, inner: Grid, outer: Grid) -> SurfaceNormals:
    """Return the normals of `inner` as those of `outer`, which holds it; none is known outside of `inner`."""
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


def no_normals() -> SurfaceNormals:
    """Return that no reading exceeds_incidence_angle."""
    none = np.zeros(0, np.float32)
    return SurfaceNormals(np.zeros(0, np.uint8), none, none, np.zeros((1, 1), np.int32), 0.0)


@kernel
def gather(cones: Cones, shape: tuple[int, int], part: tuple[int, int], sums: Any, stop: Any) -> None:
    """Add C, S and M of the readings `part[0]` to `part[1]` to `sums`, int64, shape (3, cells), in units of QUANTUM."""
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
                    weight = math.exp(-0.5 * error * error) / QUANTUM
                    cell = row * width + column
                    sums[0, cell] += int(weight * (u * u - v * v) / square)
                    sums[1, cell] += int(weight * 2.0 * u * v / square)
                    sums[2, cell] += int(weight)


def _before(known: NDArray[Any]) -> NDArray[np.int32]:
    """Return the number of known cells in each row before a column, shape (height, width + 1)."""
    out = np.zeros((known.shape[0], known.shape[1] + 1), np.int32)
    np.cumsum(known, axis=1, out=out[:, 1:])
    return out


def _moving_sum(values: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """Return the sums down the columns over `length` cells around each, of which the outermost may be parts of cells.

    Parameters
    ----------
    values : float64, shape (height, width)
    length : float
        Cells, at least 1.
    """
    whole = math.ceil((length - 1.0) / 2.0 - 1e-9)
    part = (length - 1.0) / 2.0 - (whole - 1)
    height = len(values)
    total = np.cumsum(np.pad(values, ((whole + 1, whole), (0, 0))), axis=0)
    outer = total[2 * whole + 1 :] - total[:height]
    if whole == 0:
        return outer
    inner = total[2 * whole : 2 * whole + height] - total[1 : height + 1]
    return inner + part * (outer - inner)


def _box(values: NDArray[np.int64], resolution: float) -> NDArray[np.float64]:
    """Return the sums over the square of `NEIGHBOURHOOD` around each cell, in cells of `WEIGHT_CELL`."""
    length = max(round(NEIGHBOURHOOD / resolution, 6), 1.0)
    sums = _moving_sum(_moving_sum(values.astype(np.float64), length).T, length).T
    return sums * (QUANTUM * (resolution / WEIGHT_CELL) ** 2)


def normals_of(sums: NDArray[np.int64], grid: Grid, angle: float) -> SurfaceNormals:
    """Return the normals that the sums of `gather` give; readings graze more than `angle` (radians) off them."""
    shape = grid.shape
    cosine, sine, mass = (_box(values.reshape(shape), grid.resolution) for values in sums)
    agreement = np.hypot(cosine, sine)
    known = (mass >= LEAST_WEIGHT) & (agreement >= LEAST_AGREEMENT * mass)
    normal = np.arctan2(sine, cosine) / 2
    return SurfaceNormals(
        known.ravel().view(np.uint8),
        np.cos(normal).ravel().astype(np.float32),
        np.sin(normal).ravel().astype(np.float32),
        _before(known),
        math.cos(angle) ** 2,
    )


@kernel
def exceeds_incidence_angle(normals: SurfaceNormals, reading: Any, c: int, u: float, v: float) -> bool:
    """Tell whether a reading meets cell c, at (u, v) from its apex, beyond the incidence angle, and goes on."""
    if not normals.known[c]:
        return False
    square = u * u + v * v
    through = reading.z - THROUGH * reading.sigma
    if through <= 0.0 or square >= through * through:
        return False
    along = u * normals.x[c] + v * normals.y[c]
    return bool(along * along < normals.cos2_limit * square)
