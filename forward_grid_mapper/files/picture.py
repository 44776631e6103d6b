"""The picture of a run: the three maps side by side, with the robot's path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import OutputError
from ..core.common.grid import UNKNOWN, Grid
from ..core.common.words import counted
from ..core.maps.map_set import MapSet
from .output_folder import output_errors
from .panels import Box, Panel, Picture, coarse

# More cells along a side cannot be distinguished in the picture.
_MAX_SIDE = 2400
_MARGIN = 0.03

NOWHERE = np.zeros((0, 2))


def write_picture(
    path: Path | str,
    maps: MapSet,
    path_xy: NDArray[np.float64],
    title: str,
    reference: tuple[Grid, NDArray[np.int8]] | None = None,
    odometry_xy: NDArray[np.float64] = NOWHERE,
    drives: Sequence[str] = (),
) -> None:
    """Draw the maps into an image file (`.png`, or another format of matplotlib).

    Parameters
    ----------
    path : Path or str
    maps : MapSet
    path_xy : float64, shape (P, 2)
        Path of the robot, in order, metres; may be empty. Drives are separated by rows of NaN.
    title : str
    reference : (Grid, int8 array), optional
        The true map, −1 unknown, 0 free, 1 occupied, drawn as a further panel.
    odometry_xy : float64, shape (Q, 2)
        Path of odometry, metres, if it differs.
    drives : sequence of str
        Names of the drives, if there are several.

    Raises
    ------
    OutputError
        If matplotlib is not installed, or the file cannot be written.
    """
    # compared with drawing, the choice of the contents takes little time
    path_xy = np.asarray(path_xy, np.float64).reshape(-1, 2)
    _draw(Path(path), compose(maps, path_xy, title, reference, odometry_xy, drives))


def write_overview(
    path: Path,
    layers: Sequence[tuple[str, NDArray[np.float32], float]],
    origin: tuple[float, float],
    path_xy: NDArray[np.float64],
    title: str,
    readings: int,
    log_likelihood: float,
    drives: Sequence[str] = (),
) -> None:
    """Draw maps whose cells are too small to be seen, or whose readings are not in memory.

    Parameters
    ----------
    path : Path
    layers : sequence of (str, float32 array, float)
        Name, probabilities with NaN where unknown, and the edge of a cell of each map, metres.
    origin : (float, float)
        Corner of all of them, metres.
    path_xy, title
        As in `write_picture`.
    readings : int
        Number of readings of the maps.
    log_likelihood : float
    drives : sequence of str
        As in `write_picture`.

    Raises
    ------
    OutputError
        As `write_picture`.
    """
    x, y = origin
    panels = [
        Panel(name, values, (x, x + values.shape[1] * edge, y, y + values.shape[0] * edge))
        for name, values, edge in layers
    ]
    figures = figures_text(readings, layers[0][2], log_likelihood)
    _draw(path, Picture(title, figures, panels, panels[0].extent, 1, path_xy, NOWHERE, NOWHERE, tuple(drives)))


def _draw(path: Path, picture: Picture) -> None:
    try:
        from . import drawing
    except (ImportError, AttributeError) as error:  # AttributeError: a matplotlib built for another numpy
        raise OutputError(
            f'no picture: matplotlib is missing or broken ({error}); install it with "pip install matplotlib" or '
            '"apt install python3-matplotlib"'
        ) from error
    with output_errors(path):
        drawing.draw(path, picture)


def compose(
    maps: MapSet,
    path_xy: NDArray[np.float64],
    title: str,
    reference: tuple[Grid, NDArray[np.int8]] | None,
    odometry_xy: NDArray[np.float64] = NOWHERE,
    drives: Sequence[str] = (),
) -> Picture:
    """Choose the contents of the picture; the parameters are those of `write_picture`."""
    alpha = maps.parameters.search.alpha
    named: list[tuple[str, Grid, NDArray[Any]]] = [
        ('Standard map', maps.grid, maps.live),
        ('Maximum likelihood map', maps.grid, _probability(maps.ml)),
        (f'Uncertainty map (α = {alpha:g})', maps.grid, maps.uncertainty),
    ]
    if reference is not None:
        named.append(('Reference', reference[0], _probability(reference[1])))
    # the path of odometry may leave the map far behind, which would then be small
    view = view_of(maps, path_xy)
    panels = [Panel(name, *_crop(grid, values, view)) for name, grid, values in named]
    odd = _unexplained_ends(maps)
    return Picture(title, figures_of(maps), panels, view, 1, path_xy, odd, odometry_xy, tuple(drives))


def _probability(cells: NDArray[np.int8]) -> NDArray[np.float32]:
    return np.where(cells == UNKNOWN, np.nan, cells).astype(np.float32)


def figures_of(maps: MapSet) -> str:
    """Return the line of numbers below the title."""
    return figures_text(len(maps.readings), maps.grid.resolution, maps.log_likelihood)


def figures_text(readings: int, resolution: float, log_likelihood: float) -> str:
    """Return the line of numbers below the title."""
    parts = [counted(readings, 'reading', ','), f'{100 * resolution:g} cm cells']
    if np.isfinite(log_likelihood):
        total, mean = (f'{v:,.2f}'.replace('-', '−') for v in (log_likelihood, log_likelihood / max(1, readings)))
        parts.append(f'log-likelihood {total} nats ({mean} a reading)')
    return '   ·   '.join(parts)


def view_of(maps: MapSet, path_xy: NDArray[np.float64]) -> Box:
    """Return the box around the known cells and the path, with a margin: left, right, bottom, top in metres."""
    grid, known = maps.grid, (maps.ml != UNKNOWN) | np.isfinite(maps.live)
    columns, rows = np.flatnonzero(known.any(axis=0)), np.flatnonzero(known.any(axis=1))
    left, right, bottom, top = grid.extent
    if len(rows):
        x, y = grid.origin
        left, right = x + columns[0] * grid.resolution, x + (columns[-1] + 1) * grid.resolution
        bottom, top = y + rows[0] * grid.resolution, y + (rows[-1] + 1) * grid.resolution
    path_xy = path_xy[np.isfinite(path_xy).all(axis=1)]
    if len(path_xy):
        left, bottom = np.minimum((left, bottom), path_xy.min(axis=0))
        right, top = np.maximum((right, top), path_xy.max(axis=0))
    margin = max(_MARGIN * max(right - left, top - bottom), 2 * grid.resolution)
    return float(left - margin), float(right + margin), float(bottom - margin), float(top + margin)


def _crop(grid: Grid, values: NDArray[Any], view: Box) -> tuple[NDArray[np.float32], Box]:
    """Return the part of a map in the view, reduced to a size that can be drawn, and its extent."""
    left, right, bottom, top = (np.array(v) for v in view)
    (row0, row1), (column0, column1) = grid.cells_of(np.stack([left, right]), np.stack([bottom, top]))
    row0, row1 = np.clip((row0, row1 + 1), 0, grid.height)
    column0, column1 = np.clip((column0, column1 + 1), 0, grid.width)
    part = np.asarray(values[row0:row1, column0:column1], np.float32)
    step = max(1, -(-max(part.shape) // _MAX_SIDE))
    if step > 1:
        part = coarse(part, step)
    x, y = grid.origin
    x, y, size = x + column0 * grid.resolution, y + row0 * grid.resolution, step * grid.resolution
    return part, (float(x), float(x + part.shape[1] * size), float(y), float(y + part.shape[0] * size))


def _unexplained_ends(maps: MapSet) -> NDArray[np.float64]:
    """Return the ends of the axes of the readings that the maximum likelihood map does not explain, shape (U, 2)."""
    odd = maps.readings.select(maps.unexplained)
    return np.stack([odd.x + odd.z * np.cos(odd.yaw), odd.y + odd.z * np.sin(odd.yaw)], axis=1)
