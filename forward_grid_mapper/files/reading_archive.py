"""`readings.npz`: the readings of the maps, so that `explain` can show the evidence for a cell."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.common.errors import InputError
from ..core.common.readings import Readings
from ..core.maps.map_set import MapSet
from ..core.sensor.surface_normals import SurfaceNormals, known_normals, no_normals
from .map_archive import MapArchive
from .output_folder import output_errors

COLUMNS = tuple(field.name for field in fields(Readings) if field.name != 'sensor_names')


class ReadingArchive(NamedTuple):
    """Contents of `readings.npz`."""

    readings: Readings
    normals: SurfaceNormals


def write_readings(path: Path | str, maps: MapSet) -> None:
    """Write the readings and the surface normals of a map as compressed arrays, none of them pickled.

    The names are those of `Readings`: metres, radians, nanoseconds, in the map frame; `sensor` is an index into
    `sensor_names`. `normals` is float32, shape (2, height, width): unit vectors along the normals, 0 where none is
    known.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    known = len(maps.normals.known) > 0
    normals = np.stack([maps.normals.x, maps.normals.y]) if known else np.zeros((2, maps.grid.size), np.float32)
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        **{name: getattr(maps.readings, name) for name in COLUMNS},
        sensor_names=np.array(maps.readings.sensor_names or ('',)),
        normals=normals.reshape(2, *maps.grid.shape),
        log_likelihood=np.float64(maps.log_likelihood),
    )
    with output_errors(path):
        path.write_bytes(packed.getvalue())


def read_readings(path: Path | str, maps: MapArchive) -> ReadingArchive:
    """Read a file of `write_readings` that belongs to these maps.

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind or belongs to other maps.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        # reading a pipe would wait
        raise InputError(f'{path} is not a file')
    try:
        with path.open('rb') as file, np.load(file, allow_pickle=False) as data:
            names = tuple(str(name) for name in data['sensor_names'])
            columns = {name: data[name] for name in COLUMNS if name != 'drive' or name in data}
            readings = Readings.from_columns(names, **columns)
            x, y = data['normals']
            same = float(data['log_likelihood']) == maps.log_likelihood
            sound = all(np.isfinite(column).all() for column in columns.values())
    except FileNotFoundError as error:
        raise InputError(
            f'{path} does not exist; make the maps again, without --workers and --scheduler, which write no readings'
        ) from error
    except PermissionError as error:
        raise InputError(f'{path} cannot be read: {error.strerror}') from error
    except Exception as error:  # zipfile, zlib and numpy have many kinds for damaged bytes
        raise InputError(f'{path} is not an archive of readings, or is damaged: {error}') from error
    if not sound:
        raise InputError(f'{path} is damaged: it has numbers that are not finite')
    if (
        not same
        or x.shape != maps.grid.shape
        or not (0 <= readings.sensor.min(initial=0) <= readings.sensor.max(initial=0) < len(names))
    ):
        raise InputError(f'{path} does not belong to the maps next to it')
    known = ((x != 0) | (y != 0)).astype(np.uint8)
    found = known_normals(known, x, y, maps.parameters.model.max_incidence_angle) if known.any() else no_normals()
    return ReadingArchive(readings, found)
