"""The first step, drive by drive: readings get their poses, and are written to the tiles that they touch."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from ..core.common.errors import BagError, InputError
from ..core.common.readings import Readings, in_canonical_order
from ..core.maps.log_odds_map import map_grid
from ..core.maps.traversed import traversed_cells
from ..core.tiles.mosaic import FIRST_AROUND
from ..core.tiles.tiling import boxes_of, by_tile, edge_of, widest_of
from ..files.quality_warning import reading_warnings
from ..recordings.contradictions import echoes_of, limits_of
from ..recordings.drive import jumps_note
from ..recordings.drives import digest_of
from ..recordings.journal_drive import poses_unused
from ..recordings.read_drive import read_drive
from .job import DriveArguments, Job, task
from .tables import columns_of, write_table
from .work_folder import read_json, write_json

MOST_POINTS = 2000
"""Most points of a drive's path in the picture."""


@task
def place(job: Job, number: int, recordings: DriveArguments) -> dict[str, Any]:
    """Place the readings of a drive and divide them by tile; return the data of the drive.

    If a drive cannot be mapped, this is not yet an error of the job: `error` is returned, so that all such drives are
    reported.
    """
    file = job.folder.drive(number)
    if file.exists():
        return read_json(file)
    path, p = Path(recordings.paths[number]), job.parameters
    topics = list(recordings.range_topics) if recordings.range_topics else None
    try:
        others = [other for other in recordings.paths if other != recordings.paths[number]]
        drive = read_drive(
            path, p, recordings.extrinsics, topics, recordings.odom_topic, None, recordings.part, others=others
        )
        readings = in_canonical_order(drive.associator.readings)
        grid = map_grid(readings, p)
    except (BagError, InputError) as error:
        return {'error': str(error), 'kind': type(error).__name__}
    source, points = drive.source, drive.path_xy
    source['warnings'] += poses_unused(source, recordings.extrinsics)
    source['warnings'] += [*reading_warnings(readings, source, p), *jumps_note(drive.associator)]
    del drive
    boxes, echoes = boxes_of(readings, p), echoes_of(readings)
    known = {
        'source': source,
        'first': int(readings.stamp.min()),
        'digest': digest_of(readings).hex(),
        # drives without an echo are not copies of each other
        'echoes': hashlib.blake2b(echoes.tobytes(), digest_size=16).hexdigest() if len(echoes) else '',
        'limits': limits_of(readings),
        'sensors': list(readings.sensor_names),
        'readings': len(readings),
        'grid': [grid.resolution, grid.column, grid.row, grid.width, grid.height],
        'widest': widest_of(boxes),
        'path': np.round(points[:: max(len(points) // MOST_POINTS, 1)], 3),
    }
    _part_readings(job, number, readings, boxes)
    rows, columns = np.nonzero(traversed_cells(readings, grid))
    _part_cells(job, number, rows + grid.row, columns + grid.column)
    # last, so that all other files exist if it does
    write_json(file, known)
    return read_json(file)


def _part_readings(job: Job, number: int, readings: Readings, boxes: Any) -> None:
    """Write the readings that touch each tile, or are within the surroundings that its first map uses."""
    cell = job.parameters.grid.resolution
    for (row, column), which in by_tile(boxes, cell, edge_of(job.size, cell), FIRST_AROUND).items():
        columns = columns_of(readings.select(which))
        write_table(job.folder.parts('readings', row, column) / f'drive_{number:04d}.parquet', columns)


def _part_cells(job: Job, number: int, rows: Any, columns: Any) -> None:
    """Write the traversed cells of each tile, by their rows and columns on the lattice."""
    edge = edge_of(job.size, job.parameters.grid.resolution)
    tiles, of = np.unique(np.stack([rows // edge, columns // edge]), axis=1, return_inverse=True)
    order = np.argsort(of.ravel(), kind='stable')
    for tile, which in zip(tiles.T.tolist(), np.split(order, _ends(of.ravel())), strict=False):
        cells = {'row': rows[which].astype(np.int32), 'column': columns[which].astype(np.int32)}
        write_table(job.folder.parts('ground', *tile) / f'drive_{number:04d}.parquet', cells)


def _ends(of: Any) -> Any:
    return np.cumsum(np.bincount(of))[:-1]
