"""Maps in the format of map_server and Nav2 (YAML and PGM), and as values of an OccupancyGrid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.common.errors import InputError, OutputError
from ..core.common.grid import Grid
from .output_folder import output_errors
from .pgm import read_pgm, write_pgm
from .small_text import read_text

FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205
RAW_UNKNOWN_PIXEL = 255
OCCUPIED_THRESHOLD = 0.65
# map_server's own value: that of the unknown pixel, (255 - 205) / 255 = 0.19608, is just above it.
FREE_THRESHOLD = 0.196


def occupancy_values(values: NDArray[Any]) -> NDArray[np.int8]:
    """Return a map as values of `nav_msgs/OccupancyGrid`: 0 … 100, −1 where unknown.

    Parameters
    ----------
    values : float, any shape, or int, any shape
        Probabilities with NaN where unknown, or cells −1 unknown, 0 free, 1 occupied.

    Returns
    -------
    int8, of the same shape
    """
    made: NDArray[np.int8]
    if np.issubdtype(values.dtype, np.integer):
        # sums of bytes: selection with numbers of eight bytes takes ten times as long, and delays the node's executor
        made = (values > 0).view(np.int8) * np.int8(100) - (values < 0).view(np.int8)
    else:
        # fmax of a number and NaN is the number
        made = np.fmax(np.clip(np.rint(values * 100.0), 0, 100), -1).astype(np.int8)
    return made


def write_trinary(path_stem: Path | str, grid: Grid, cells: NDArray[np.int8]) -> Path:
    """Write `path_stem`.pgm and `path_stem`.yaml in mode trinary.

    Parameters
    ----------
    path_stem : Path or str
        The files' name without suffix.
    grid : Grid
    cells : int8, shape `grid.shape`
        −1 unknown, 0 free, 1 occupied; row 0 has the smallest y.

    Returns
    -------
    Path
        The YAML file.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    pixels = np.full(cells.shape, UNKNOWN_PIXEL, np.uint8)
    pixels[cells == 0] = FREE_PIXEL
    pixels[cells == 1] = OCCUPIED_PIXEL
    return _write(Path(path_stem), grid, pixels, 'trinary')


def write_raw(path_stem: Path | str, grid: Grid, probability: NDArray[np.float32]) -> Path:
    """Write `path_stem`.pgm and `path_stem`.yaml in mode raw: a pixel is the cell's occupancy in percent.

    Parameters
    ----------
    path_stem : Path or str
        The files' name without suffix.
    grid : Grid
    probability : float32, shape `grid.shape`
        NaN where unknown; row 0 has the smallest y.

    Returns
    -------
    Path
        The YAML file.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    percent = occupancy_values(probability)
    pixels = np.where(percent < 0, RAW_UNKNOWN_PIXEL, percent.astype(np.int16)).astype(np.uint8)
    return _write(Path(path_stem), grid, pixels, 'raw')


def read_map(path: Path | str) -> tuple[Grid, NDArray[np.float32]]:
    """Read a map in mode trinary, scale or raw.

    Parameters
    ----------
    path : Path or str
        The YAML file; its image must be a PGM.

    Returns
    -------
    grid : Grid
    probability : float32, shape `grid.shape`
        NaN where unknown; row 0 has the smallest y.

    Raises
    ------
    InputError
        If the map is missing or damaged, is rotated, or is not aligned to the lattice of its resolution.
    """
    path = Path(path)
    try:
        meta = yaml.safe_load(read_text(path, InputError))
        image = path.parent / str(meta['image'])
        mode = str(meta.get('mode', 'trinary')).lower()
        resolution = float(meta['resolution'])
        x, y, yaw = (float(v) for v in meta['origin'])
        negate = bool(int(meta.get('negate', 0)))
        occupied, free = float(meta['occupied_thresh']), float(meta['free_thresh'])
    except OSError as error:
        raise InputError(f'{path} cannot be read: {error.strerror}') from error
    except KeyError as error:
        raise InputError(f'{path} is not the YAML of a map: {error.args[0]} is missing') from error
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f'{path} is not the YAML of a map: {error}') from error
    shade = read_pgm(image)[::-1]
    height, width = shade.shape
    grid = _grid_at(path, resolution, x, y, yaw, (height, width))
    darkness = shade if negate else 1.0 - shade
    if mode == 'raw':
        percent = np.rint(shade * 255.0)
        probability = np.where(percent <= 100, percent / 100.0, np.nan)
    elif mode in ('trinary', 'scale'):
        between = np.nan if mode == 'trinary' else (darkness - free) / (occupied - free)
        probability = np.where(darkness > occupied, 1.0, np.where(darkness < free, 0.0, between))
    else:
        raise InputError(f'{path}: mode {mode!r} is not one of trinary, scale, raw')
    return grid, probability.astype(np.float32)


def _grid_at(path: Path, resolution: float, x: float, y: float, yaw: float, shape: tuple[int, int]) -> Grid:
    if not resolution > 0.0 or not np.isfinite([x, y, resolution]).all():
        raise InputError(f'{path}: resolution and origin must be finite numbers, the resolution above zero')
    if abs(yaw) > 1e-9:
        raise InputError(f'{path}: the map is rotated by {yaw:g} rad; only maps without rotation are read')
    column, row = round(x / resolution), round(y / resolution)
    if max(abs(x / resolution - column), abs(y / resolution - row)) > 0.01:
        raise InputError(f'{path}: the origin ({x:g}, {y:g}) is not a multiple of the resolution {resolution:g}')
    return Grid(resolution, column, row, shape[1], shape[0])


def _write(stem: Path, grid: Grid, pixels: NDArray[np.uint8], mode: str) -> Path:
    if pixels.shape != grid.shape:
        raise ValueError(f'a map of shape {pixels.shape} does not fit a grid of shape {grid.shape}')
    if not grid.size:
        raise OutputError(f'{stem}: the map has no cells; there is nothing to write')
    # Not with_suffix: a stem may contain dots.
    image, meta = (stem.with_name(stem.name + suffix) for suffix in ('.pgm', '.yaml'))
    write_pgm(image, pixels[::-1])
    fields = {
        'image': image.name,
        'mode': mode,
        'resolution': float(grid.resolution),
        'origin': [*(float(v) for v in grid.origin), 0.0],
        'negate': 0,
        'occupied_thresh': OCCUPIED_THRESHOLD,
        'free_thresh': FREE_THRESHOLD,
    }
    with output_errors(meta):
        meta.write_text(yaml.safe_dump(fields, sort_keys=False, allow_unicode=True), encoding='utf-8')
    return meta
