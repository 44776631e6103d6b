"""Readings and cells as Parquet files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ..core.common.readings import Readings
from .work_folder import whole

COLUMNS = tuple(field.name for field in fields(Readings) if field.name != 'sensor_names')

FEW_VALUES = ['z_max', 'half_angle', 'sigma', 'sensor', 'drive']
"""Columns with few different values, for which a dictionary saves space."""


def write_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of equal lengths.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    table = pa.table({name: np.ascontiguousarray(column) for name, column in columns.items()})
    few = [name for name in FEW_VALUES if name in columns]
    with whole(path) as partial:
        pq.write_table(table, str(partial), use_dictionary=few, compression='snappy')


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """Read columns."""
    # not as a data set, which would take columns from names of folders
    with path.open('rb') as file:
        table = pq.read_table(file)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def columns_of(readings: Readings) -> dict[str, NDArray[Any]]:
    """Return the columns of readings, by name."""
    return {name: getattr(readings, name) for name in COLUMNS}


def readings_of(columns: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> Readings:
    """Return the readings of such columns."""
    return Readings.from_columns(names, **columns)
