"""Writes all results of a run, for the node and the offline tool."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import OutputError
from ..core.common.grid import Grid
from ..core.maps.map_set import MapSet
from .map_archive import write_npz
from .map_files import write_raw, write_trinary
from .output_folder import output_errors, output_folder
from .picture import NOWHERE, write_picture
from .png import write_png
from .quality_warning import data_warnings
from .reading_archive import write_readings
from .report import report_data, write_report
from .web_page import write_page


def write_results(
    path: Path | str,
    maps: MapSet,
    source: Mapping[str, Any],
    path_xy: NDArray[np.float64],
    title: str,
    reference: tuple[Grid, NDArray[np.int8]] | None = None,
    extras: Mapping[str, str] | None = None,
    odometry_xy: NDArray[np.float64] = NOWHERE,
    judged: Sequence[str] | None = None,
    agree: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Write maps, archive, picture, page and report into a new folder; if any of them fails, no folder remains.

    Parameters
    ----------
    path : Path or str
        The folder, which must not exist, or must be empty.
    maps : MapSet
    source : mapping
        As in `report_data`.
    path_xy : float64, shape (P, 2)
        Path of the robot, metres; drives are separated by rows of NaN.
    title : str
        Of the picture.
    reference : (Grid, int8 array), optional
        The true map, for the picture.
    extras : mapping of str to str, optional
        Further text files, by name.
    odometry_xy : float64, shape (Q, 2)
        Path of odometry, metres, if it differs.
    judged : sequence of str, optional
        Result of `data_warnings` for the maps, if known.
    agree : callable, optional
        Called when all files are written; if it raises, no folder remains.

    Returns
    -------
    dict
        The report.

    Raises
    ------
    OutputError
        If the folder exists, or cannot be written.
    """
    with output_folder(path) as folder:
        write_raw(folder / 'live_map', maps.grid, maps.live)
        write_trinary(folder / 'ml_map', maps.grid, maps.ml)
        write_raw(folder / 'uncertainty_map', maps.grid, maps.uncertainty)
        for name, values in (('live_map', maps.live), ('uncertainty_map', maps.uncertainty)):
            write_png(folder / f'{name}.png', values)
        write_npz(folder / 'maps.npz', maps)
        write_readings(folder / 'readings.npz', maps)
        warnings = [
            *(source.get('warnings') or []),
            *(data_warnings(maps, source) if judged is None else judged),
        ]
        drives = [str(drive.get('bag')) for drive in source.get('drives') or ()]
        try:
            write_picture(folder / 'maps.png', maps, path_xy, title, reference, odometry_xy, drives)
        except OutputError as error:
            warnings.append(f'no picture was drawn: {error}')
        report = report_data(maps, {**source, 'warnings': warnings})
        try:
            write_page(folder / 'report.html', maps, report, title, path_xy, odometry_xy, reference)
        except OutputError as error:
            report['warnings'].append(f'report.html was not written: {error}')
        write_report(folder, report)
        for name, text in (extras or {}).items():
            with output_errors(folder / name):
                (folder / name).write_text(text, encoding='utf-8')
        agree()
    return report
