"""`maps.npz`: the three maps with all data needed to process them in numpy."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.common.grid import UNKNOWN, Grid
from ..core.common.parameters import Parameters
from ..core.maps.map_set import MapSet
from .output_folder import output_errors


class MapArchive(NamedTuple):
    """Contents of `maps.npz`; the names are those of `MapSet`."""

    grid: Grid
    live: NDArray[np.float32]
    ml: NDArray[np.int8]
    uncertainty: NDArray[np.float32]
    log_likelihood: float
    objective: float
    parameters: Parameters


def write_npz(path: Path | str, maps: MapSet) -> None:
    """Write the maps as compressed arrays, none of them pickled.

    `live_map`, `ml_map` and `uncertainty_map` are float32 probabilities, NaN where unknown, row 0 with the smallest y;
    `dynamic` (float32) counts echoes in free space that no object of the map explains, such as those of people.
    `origin` (2,) is the corner of cell (0, 0) and `resolution` the edge of a cell, metres; `log_likelihood` and
    `objective` are in nats; `parameters` is a JSON text.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    # in memory first: after a failed write, a ZipFile raises again when it is collected
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        live_map=maps.live.astype(np.float32),
        ml_map=np.where(maps.ml == UNKNOWN, np.nan, maps.ml).astype(np.float32),
        uncertainty_map=maps.uncertainty.astype(np.float32),
        dynamic=maps.dynamic,
        origin=np.array(maps.grid.origin, np.float64),
        resolution=np.float64(maps.grid.resolution),
        log_likelihood=np.float64(maps.log_likelihood),
        objective=np.float64(maps.objective),
        parameters=np.array(json.dumps(maps.parameters.complete())),
    )
    with output_errors(path):
        path.write_bytes(packed.getvalue())


def read_npz(path: Path | str) -> MapArchive:
    """Read a file of `write_npz`.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        # reading a pipe would wait
        raise InputError(f'{path} is not a file')
    try:
        with path.open('rb') as file, np.load(file, allow_pickle=False) as data:
            ml = data['ml_map']
            resolution = float(data['resolution'])
            column, row = (round(float(v) / resolution) for v in data['origin'])
            return MapArchive(
                grid=Grid(resolution, column, row, ml.shape[1], ml.shape[0]),
                live=data['live_map'],
                ml=np.where(np.isnan(ml), UNKNOWN, ml).astype(np.int8),
                uncertainty=data['uncertainty_map'],
                log_likelihood=float(data['log_likelihood']),
                objective=float(data['objective']),
                parameters=Parameters.restored(json.loads(str(data['parameters']))),
            )
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(f'{path} does not exist; give a folder that process_bag or save_maps wrote') from error
    except PermissionError as error:
        raise InputError(f'{path} cannot be read: {error.strerror}') from error
    except Exception as error:  # zipfile, zlib and numpy have many kinds for damaged bytes
        raise InputError(f'{path} is not an archive of maps, or is damaged: {error}') from error
