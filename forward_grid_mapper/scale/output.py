"""The results of a job: the usual files if the map is small enough, otherwise files in parts.

Beyond `MOST_CELLS_OF_A_FILE` cells no file contains the whole map:

maps.zarr       live_map, ml_map, uncertainty_map and dynamic in chunks; 0 is the full resolution, and each further
                level has half as many cells a side, the largest of four, down to `OVERVIEW`
tiles/          each map in parts of `REGION` x `REGION` cells for map_server, and index.json
maps.png        the coarsest level

For any size, tasks.csv contains the time and memory of every task.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import OutputError
from ..core.common.grid import UNKNOWN, Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.learning.sensor_health import health_warning
from ..core.maps.map_set import MapSet
from ..core.tiles.tiling import Tiling, common_part
from ..files.map_archive import write_npz
from ..files.map_files import write_raw, write_trinary
from ..files.output_folder import output_errors
from ..files.panels import coarse
from ..files.picture import write_overview
from ..files.png import write_png
from ..files.report import json_text, report_data, write_report
from .cluster import Cluster
from .job import Job, plan_of, task
from .mapping import JobResult, Say
from .work_folder import outcome_in, read_arrays

MOST_CELLS_OF_A_FILE = 16_000_000
"""Most cells of maps in one file: 4000 x 4000, which is 400 m with cells of 0.1 m."""

REGION = 1024
"""Cells along the side of a chunk, and of a part for map_server."""

OVERVIEW = 2400
"""Most cells along the longer side of the coarsest level: more cannot be distinguished in a picture."""

LAYERS: Mapping[str, tuple[str, Any]] = {
    'live_map': ('live', np.float32),
    'ml_map': ('ml', np.int8),
    'uncertainty_map': ('uncertainty', np.float32),
}
"""The maps by their names in files: names in a tile's `maps.npz`, and types of their values."""

TITLES = {
    'live_map': 'Standard map',
    'ml_map': 'Maximum likelihood map',
    'uncertainty_map': 'Uncertainty map',
}


def write_output(
    folder: Path, job: Job, found: JobResult, cluster: Cluster, parameters: Parameters, title: str, say: Say
) -> dict[str, Any]:
    """Write maps, picture and report into a new folder; return the report.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    grid = found.tiling.grid
    large = grid.size > MOST_CELLS_OF_A_FILE
    if large:
        layers, step = _write_parts(folder, job, found, cluster, say)
    else:
        layers, step = _write_whole(folder, job, found, parameters), 1
    warnings = list(found.source.get('warnings') or [])
    panels = []
    for name, values in layers.items():
        more = max(1, -(-max(values.shape) // OVERVIEW))
        shown = coarse(values, more) if more > 1 else values
        panels.append((TITLES[name], np.asarray(shown, np.float32), step * more * grid.resolution))
    try:
        readings = int(found.counts[..., 0].sum())
        drives = [str(drive['bag']) for drive in found.source.get('drives') or ()]
        figures = readings, found.log_likelihood
        write_overview(folder / 'maps.png', panels, grid.origin, found.path_xy, title, *figures, drives)
    except OutputError as error:
        warnings.append(f'no picture was drawn: {error}')
    report = _report(found, parameters, warnings)
    write_report(folder, report)
    rows = [f'"{stage}",{number},{seconds:.3f},{peak}' for stage, number, seconds, peak in found.tasks]
    with output_errors(folder / 'tasks.csv'):
        text = '\n'.join(['stage,number,cpu_seconds,peak_bytes', *rows, ''])
        (folder / 'tasks.csv').write_text(text, encoding='utf-8')
    return report


def _write_whole(folder: Path, job: Job, found: JobResult, parameters: Parameters) -> dict[str, NDArray[Any]]:
    grid = found.tiling.grid
    maps = _map_set(found, parameters, layers_in(job, grid))
    write_raw(folder / 'live_map', grid, maps.live)
    write_trinary(folder / 'ml_map', grid, maps.ml)
    write_raw(folder / 'uncertainty_map', grid, maps.uncertainty)
    for name, values in (('live_map', maps.live), ('uncertainty_map', maps.uncertainty)):
        write_png(folder / f'{name}.png', values)
    write_npz(folder / 'maps.npz', maps)
    return {'live_map': maps.live, 'ml_map': _shown(maps.ml), 'uncertainty_map': maps.uncertainty}


def _map_set(found: JobResult, parameters: Parameters, layers: Mapping[str, NDArray[Any]]) -> MapSet:
    """Return maps without readings, which are not in memory."""
    nothing = np.zeros(0)
    none = Readings.from_columns(x=nothing, y=nothing, yaw=nothing, z=nothing, z_max=nothing, half_angle=nothing)
    return MapSet(
        grid=found.tiling.grid,
        live=layers['live_map'],
        ml=layers['ml_map'],
        uncertainty=layers['uncertainty_map'],
        readings=none,
        unexplained=np.zeros(0, np.bool_),
        log_likelihood=found.log_likelihood,
        objective=found.objective,
        parameters=parameters,
        dynamic=layers['dynamic'],
        statistics={**found.statistics, 'occupied': found.cells['1']},
    )


def layers_in(job: Job, box: Grid) -> dict[str, NDArray[Any]]:
    """Return the maps in a part of the grid, from the files of tiles."""
    tiling = plan_of(job.folder, job.size).tiling
    out: dict[str, NDArray[Any]] = {
        name: np.full(box.shape, UNKNOWN if kind is np.int8 else np.nan, kind) for name, (_, kind) in LAYERS.items()
    }
    for number in tiling.with_cores_in(box):
        tile = tiling.tiles[number]
        part = common_part(tile.core, box)
        found = read_arrays(job.folder.tile(tile.row, tile.column, 'maps.npz'), *(own for own, _ in LAYERS.values()))
        for name, values in zip(LAYERS, found, strict=True):
            out[name][box.window(part)] = values[tile.core.window(part)]
    out['dynamic'] = np.where(out['ml_map'] == 0, _dynamic(job, tiling, box), np.float32(0))
    return out


def _dynamic(job: Job, tiling: Tiling, box: Grid) -> NDArray[np.float32]:
    """Return the sum of the counts of tiles in their boxes, which overlap."""
    out = np.zeros(box.shape, np.float32)
    # a region has a few tiles of the thousands of a large map
    for number in tiling.with_boxes_in(box):
        tile = tiling.tiles[number]
        result = outcome_in(job.folder.tile(tile.row, tile.column, 'ground.npz'))
        if result is None or not result['readings']:
            continue
        of = Grid(*result['box'])
        part = common_part(of, box)
        if part.size:
            (values,) = read_arrays(job.folder.tile(tile.row, tile.column, 'judged.npz'), 'dynamic')
            out[box.window(part)] += values[of.window(part)]
    return out


def _shown(ml: NDArray[np.int8]) -> NDArray[np.float32]:
    return np.where(ml == UNKNOWN, np.nan, ml).astype(np.float32)


# ---- in parts


def shape_of(grid: Grid, level: int) -> tuple[int, int]:
    """Return the shape of a level of the overviews."""
    return -(-grid.height // 2**level), -(-grid.width // 2**level)


def levels_of(grid: Grid) -> int:
    """Return the number of the coarsest level."""
    return max(math.ceil(math.log2(max(grid.shape) / OVERVIEW)), 0)


def _place_of(number: int, shape: tuple[int, int]) -> tuple[int, int]:
    """Return the first row and column of a region of an array."""
    row, column = divmod(number, -(-shape[1] // REGION))
    return row * REGION, column * REGION


def _regions(shape: tuple[int, int]) -> range:
    return range(-(-shape[0] // REGION) * -(-shape[1] // REGION))


def _write_parts(
    folder: Path, job: Job, found: JobResult, cluster: Cluster, say: Say
) -> tuple[dict[str, NDArray[Any]], int]:
    """Let workers write the parts; return the coarsest maps, and how many cells a side one of theirs has."""
    import zarr

    grid, levels = found.tiling.grid, levels_of(found.tiling.grid)
    with output_errors(folder):
        (folder / 'tiles').mkdir()
        _create(folder / 'maps.zarr', grid, levels)
    index = []
    for level in range(levels + 1):
        regions = _regions(shape_of(grid, level))
        work, name = (write_region, 'writing') if level == 0 else (write_overview_of, f'writing overview {level}')
        for done, (_, result) in enumerate(cluster.each(name, work, job, regions, str(folder), level), 1):
            index += result.get('files', [])
            say(f'{name}: {done:,} of {len(regions):,}')
    index.sort(key=lambda entry: (entry['map'], entry['origin'][1], entry['origin'][0]))
    with output_errors(folder):
        (folder / 'tiles' / 'index.json').write_text(
            json_text({'resolution': grid.resolution, 'cells': REGION, 'tiles': index}), encoding='utf-8'
        )
    coarsest = {name: np.asarray(zarr.open(str(_array(folder, levels, name)), mode='r')[:]) for name in LAYERS}
    return {**coarsest, 'ml_map': _shown(coarsest['ml_map'])}, 2**levels


def _array(folder: Path, level: int, name: str) -> Path:
    return folder / 'maps.zarr' / str(level) / name


def _create(path: Path, grid: Grid, levels: int) -> None:
    """Create empty arrays of all levels, in version 2 of the format, which all versions of zarr read."""
    import zarr

    version: dict[str, Any] = {} if zarr.__version__.startswith('2.') else {'zarr_format': 2}
    for level in range(levels + 1):
        kinds = {**{name: kind for name, (_, kind) in LAYERS.items()}, **({} if level else {'dynamic': np.float32})}
        for name, kind in kinds.items():
            fill = UNKNOWN if kind is np.int8 else 0.0 if name == 'dynamic' else math.nan
            zarr.create(
                shape=shape_of(grid, level),
                chunks=(REGION, REGION),
                dtype=np.dtype(kind).str,
                fill_value=fill,
                store=str(path / str(level) / name),
                **version,
            )
    group = zarr.open_group(str(path), mode='a', **version)
    group.attrs['resolution'] = grid.resolution
    group.attrs['origin'] = list(grid.origin)
    group.attrs['levels'] = [
        {'path': str(level), 'resolution': grid.resolution * 2**level} for level in range(levels + 1)
    ]
    group.attrs['rows'] = 'row 0 has the smallest y'


def is_empty(name: str, values: NDArray[Any]) -> bool:
    """Return whether a region of a map has only the value that `_create` fills in, so that it need not be written."""
    if name == 'dynamic':
        return not values.any()
    # where the robot traversed, the uncertainty map is 0
    return bool((values == UNKNOWN if values.dtype == np.int8 else np.isnan(values)).all())


@task
def write_region(job: Job, number: int, folder: str, level: int) -> dict[str, Any]:
    """Write a region at full resolution: chunks, and parts for map_server unless all cells are unknown."""
    import zarr

    grid, target = plan_of(job.folder, job.size).tiling.grid, Path(folder)
    row, column = _place_of(number, grid.shape)
    whole = Grid(grid.resolution, grid.column + column, grid.row + row, REGION, REGION)
    box = common_part(whole, grid)
    layers = layers_in(job, box)
    files = []
    for name, values in layers.items():
        if is_empty(name, values):
            continue
        array = zarr.open(str(_array(target, level, name)), mode='r+')
        array[row : row + box.height, column : column + box.width] = values
        if name in LAYERS:
            stem = target / 'tiles' / f'{name}_{row // REGION:03d}_{column // REGION:03d}'
            (write_trinary if values.dtype == np.int8 else write_raw)(stem, box, values)
            files.append({'map': name, 'yaml': f'{stem.name}.yaml', 'origin': box.origin, 'shape': box.shape})
    return {'files': files}


@task
def write_overview_of(job: Job, number: int, folder: str, level: int) -> dict[str, Any]:
    """Write a region of a coarser level, from the level before."""
    import zarr

    grid, target = plan_of(job.folder, job.size).tiling.grid, Path(folder)
    row, column = _place_of(number, shape_of(grid, level))
    for name, (_, kind) in LAYERS.items():
        finer = zarr.open(str(_array(target, level - 1, name)), mode='r')
        values = np.asarray(finer[2 * row : 2 * (row + REGION), 2 * column : 2 * (column + REGION)])
        made = coarse(_shown(values) if kind is np.int8 else values, 2)
        if np.isfinite(made).any():
            kept = np.where(np.isnan(made), UNKNOWN, made).astype(np.int8) if kind is np.int8 else made
            array = zarr.open(str(_array(target, level, name)), mode='r+')
            array[row : row + kept.shape[0], column : column + kept.shape[1]] = kept
    return {}


# ---- the report


def _report(found: JobResult, parameters: Parameters, warnings: list[str]) -> dict[str, Any]:
    empty = np.zeros((0, 0), np.float32)
    none: dict[str, NDArray[Any]] = {
        'live_map': empty,
        'ml_map': empty.astype(np.int8),
        'uncertainty_map': empty,
        'dynamic': empty,
    }
    counts, names = found.counts, found.sensor_names

    def rows(of: NDArray[np.int64]) -> dict[str, dict[str, int]]:
        return {
            name: dict(zip(('accepted', 'no_echo', 'unexplained'), of[k].tolist(), strict=True))
            for k, name in enumerate(names)
            if of[k, 0]
        }

    sensors = {
        name: {**row, 'health': dataclasses.asdict(found.health[name])}
        for name, row in rows(counts.sum(axis=0)).items()
    }
    warnings = [*warnings, *filter(None, [health_warning(found.health)])]
    source = {**found.source, 'warnings': warnings, 'sensors': sensors}
    report = report_data(_map_set(found, parameters, none), source)
    for k, drive in enumerate(report.get('drives') or ()):
        drive['sensors'], drive['unexplained'] = rows(counts[k]), int(counts[k, :, 2].sum())
    report['result']['readings'] = int(counts[..., 0].sum())
    report['result']['unexplained'] = int(counts[..., 2].sum())
    for name, value in (('free', '0'), ('occupied', '1'), ('unknown', '-1')):
        report['map'][f'{name}_cells'] = found.cells[value]
    return report
