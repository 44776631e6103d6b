"""`report.html`: the maps, the readings and the report as one page, which needs neither a server nor a network.

The page is a canvas with a few hundred lines of script (folder `web`). bokeh would add 1.6 MB of script to every
report, plotly 4.8 MB, and neither can compute the evidence of a reading for a cell: this part would be the same. Cones,
densities, causes and priors are computed here, by the functions of the core; the page only adds them up along a cone,
as `explain` does.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.constants import THROUGH
from ..core.common.errors import OutputError
from ..core.common.grid import UNKNOWN, Grid
from ..core.maps.cell_evidence import END_SIGMAS, ROUNDING, prior_odds
from ..core.maps.map_set import MapSet
from ..core.maps.moments import moments
from ..core.maps.reading_causes import likeliest_causes
from ..core.maps.traversed import traversed_cells
from ..core.messages.message_types import NANOSECONDS
from ..core.sensor.density import CUT, causes_of
from .output_folder import distinguished, output_errors
from .picture import NOWHERE, figures_of, view_of
from .report_text import report_text

WEB = Path(__file__).with_name('web')
SCRIPTS = ('evidence.js', 'chart.js', 'page.js')

MOST_CELLS = 6_000_000
"""Most cells; browsers are slow with more."""

MOST_READINGS = 100_000
"""Most readings of a page; each needs about 60 bytes. With more, it shows only the maps; `explain` shows evidence."""

MOMENTS = 10
"""Number of parts of the drive after each of which the page has the standard map at that time."""

MOST_CELLS_OF_MOMENTS = 8_000_000
"""Most cells of all these maps together; for larger maps there are fewer of them, or none."""

MOST_POINTS = 4000
"""Most points of a path: more cannot be distinguished."""

UNKNOWN_SHARE = 65535
STEPS = 10_000
"""Levels of probabilities on the page."""

UNKNOWN_THEN, STEPS_THEN = 255, 250
"""The value of unknown cells, and the levels, of the standard map during the drive."""

MOST_DRIVES = 8
"""Most drives whose names a page shows."""

_CONE = ('x', 'y', 'axis_x', 'axis_y', 'sine', 'cosine', 'z', 'z_max', 'sigma', 'reach')


def write_page(
    path: Path,
    maps: MapSet,
    report: Mapping[str, Any],
    title: str,
    path_xy: NDArray[np.float64] = NOWHERE,
    odometry_xy: NDArray[np.float64] = NOWHERE,
    reference: tuple[Grid, NDArray[np.int8]] | None = None,
) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
    maps : MapSet
    report : mapping
        The result of `report_data`.
    title : str
    path_xy : float64, shape (P, 2)
        Path of the robot, in order, metres; may be empty. Several drives are separated by rows of NaN.
    odometry_xy : float64, shape (Q, 2)
        Path of odometry, metres, if it differs.
    reference : (Grid, int8 array), optional
        The true map.

    Raises
    ------
    OutputError
        If the map has more cells than `MOST_CELLS`, or the file cannot be written; then no file remains.
    """
    if maps.grid.size > MOST_CELLS:
        raise OutputError(f'a page shows at most {MOST_CELLS:,} cells, the map has {maps.grid.size:,}')
    page = page_data(maps, report, path_xy, odometry_xy, reference)
    count = len(maps.readings)
    hint = 'Point at a cell to see its state and evidence. Click it to list the readings for and against an obstacle.'
    if count > MOST_READINGS:
        hint = f'{count:,} readings are too many for a page: use forward_grid_mapper explain to list them.'
    warnings = ''.join(f'<li>{html.escape(str(text))}</li>' for text in report.get('warnings') or ())
    parts = {
        'title': html.escape(title),
        'figures': html.escape(figures_of(maps)),
        'warnings': f'<ul id="warnings">{warnings}</ul>' if warnings else '',
        'hint': html.escape(hint),
        'report': html.escape(report_text(dict(report))),
        'style': (WEB / 'page.css').read_text(encoding='utf-8'),
        'script': '\n'.join((WEB / name).read_text(encoding='utf-8') for name in SCRIPTS),
        # names from a bag may contain the end of a script
        'data': json.dumps(page, allow_nan=False).replace('<', '\\u003c'),
    }
    # in one pass, since a title may contain the name of another part
    pieces = (WEB / 'page.html').read_text(encoding='utf-8').split('{{')
    text = pieces[0] + ''.join(parts[piece.partition('}}')[0]] + piece.partition('}}')[2] for piece in pieces[1:])
    try:
        with output_errors(path):
            path.write_text(text, encoding='utf-8', errors='backslashreplace')
    except OutputError:
        with suppress(OSError):
            path.unlink()
        raise


def page_data(
    maps: MapSet,
    report: Mapping[str, Any],
    path_xy: NDArray[np.float64],
    odometry_xy: NDArray[np.float64],
    reference: tuple[Grid, NDArray[np.int8]] | None,
) -> dict[str, Any]:
    """Return the numbers of the page, for JSON; the parameters are those of `write_page`."""
    arrays: dict[str, NDArray[Any]] = {
        'ml_map': np.where(maps.ml == UNKNOWN, 255, maps.ml).astype(np.uint8),
        'live_map': _shares(maps.live),
        'uncertainty_map': _shares(maps.uncertainty),
        'prior': prior_odds(maps.grid, maps.ml, maps.parameters).astype(np.float32),
        'traversed': traversed_cells(maps.readings, maps.grid).astype(np.uint8),
        'path': _thinned(path_xy),
    }
    if len(odometry_xy):
        arrays['odometry'] = _thinned(odometry_xy)
    if reference is not None:
        arrays['reference'] = np.where(reference[1] == UNKNOWN, 255, reference[1]).astype(np.uint8)
    stamps = maps.readings.stamp
    then: list[float] = []
    if 0 < len(maps.readings) <= MOST_READINGS:
        arrays |= _readings(maps)
        then, arrays['moments'] = _moments(maps)
    everywhere = np.concatenate([path_xy.reshape(-1, 2), odometry_xy])
    model = maps.parameters.model
    return {
        'grid': _grid(maps.grid),
        'reference': None if reference is None else _grid(reference[0]),
        'view': view_of(maps, everywhere[np.isfinite(everywhere).all(axis=1)]),
        'model': {
            'p_hit': causes_of(maps.readings.select(slice(0)), np.zeros(0), model, maps.grid.resolution).p_hit,
            'mixture_weight': 1.0 - model.p_rand - model.p_lost,
            'exponent': model.likelihood_exponent,
            'surface_offset': model.surface_offset,
            'cut': CUT,
            'here': END_SIGMAS,
            'nothing': ROUNDING,
            'through': THROUGH,
            'cos2_limit': maps.normals.cos2_limit if len(maps.normals.known) else 0.0,
        },
        'moments': then,
        'drives': distinguished([str(drive.get('bag')) for drive in report.get('drives') or ()])[:MOST_DRIVES],
        'start': float(stamps.min() / NANOSECONDS) if len(stamps) else 0.0,
        'sensors': [_sensor(name, report) for name in maps.readings.sensor_names or ('',)],
        'arrays': {name: _packed(values) for name, values in arrays.items()},
    }


def _readings(maps: MapSet) -> dict[str, NDArray[Any]]:
    """Return the columns from which the page computes the evidence of a reading for a cell."""
    forward, readings = maps.forward_model(), maps.readings
    causes = causes_of(readings, forward.cones['sigma'] * maps.grid.resolution, forward.model, maps.grid.resolution)
    columns: dict[str, NDArray[Any]] = {name: forward.cones[name] for name in _CONE}
    columns |= {'random': causes.random, 'lost': causes.lost, 'max_range': causes.max_range}
    columns |= {'stamp': readings.stamp / NANOSECONDS, 'drive': readings.drive.astype(np.uint16)}
    columns |= {'sensor': readings.sensor.astype(np.uint16), 'cause': likeliest_causes(maps)}
    if len(maps.normals.known):
        columns |= {'normal_x': maps.normals.x, 'normal_y': maps.normals.y}
    return columns


def _moments(maps: MapSet) -> tuple[list[float], NDArray[np.uint8]]:
    """Return the standard maps during the drive: the end of the time of each, seconds, and its difference to the last.

    Differences are modulo 256; unchanged cells are 0, which compresses well. The last map, `live_map`, is left out.
    """
    count = min(MOMENTS, MOST_CELLS_OF_MOMENTS // max(maps.grid.size, 1))
    then: list[float] = []
    changes: list[NDArray[np.uint8]] = [np.zeros((0, *maps.grid.shape), np.uint8)]
    before = np.zeros(maps.grid.shape, np.uint8)
    for moment in moments(maps, count) if count > 1 else ():
        if moment.live is maps.live:
            break
        steps = np.rint(np.nan_to_num(moment.live) * STEPS_THEN)
        now = np.where(np.isnan(moment.live), UNKNOWN_THEN, steps).astype(np.uint8)
        changes.append((now - before)[None])
        then.append(moment.stamp / NANOSECONDS)
        before = now
    return then, np.concatenate(changes)


def _shares(probability: NDArray[np.float32]) -> NDArray[np.uint16]:
    steps = np.rint(np.nan_to_num(probability) * STEPS)
    return np.where(np.isnan(probability), UNKNOWN_SHARE, steps).astype(np.uint16)


def _thinned(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a path of about `MOST_POINTS` points, with the last one and all rows of NaN, which separate drives."""
    which = np.linspace(0, len(xy) - 1, min(len(xy), MOST_POINTS)).astype(np.int64)
    parted = np.flatnonzero(~np.isfinite(xy).all(axis=1))
    ends = np.concatenate([parted - 1, parted, parted + 1])
    which = np.union1d(which, ends[(ends >= 0) & (ends < len(xy))])
    # single precision is half a metre in UTM coordinates
    return xy[which]


def _grid(grid: Grid) -> dict[str, float]:
    x, y = grid.origin
    return {'width': grid.width, 'height': grid.height, 'resolution': grid.resolution, 'x': x, 'y': y}


def _sensor(name: str, report: Mapping[str, Any]) -> dict[str, Any]:
    row = (report.get('sensors') or {}).get(name) or {}
    total = row.get('accepted') or 0
    shares = [f'{100 * (row.get(key) or 0) / max(total, 1):.1f} %' for key in ('no_echo', 'unexplained')]
    return {'name': name, 'cells': [f'{total:,}', *shares], 'verdict': (row.get('health') or {}).get('verdict', '')}


def _packed(values: NDArray[Any]) -> dict[str, str]:
    """Return an array in the format of the page: little-endian, deflated, in base64."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder('<'))
    data = base64.b64encode(zlib.compress(little.tobytes(), 6)).decode('ascii')
    return {'type': f'{little.dtype.kind}{little.dtype.itemsize}', 'data': data}
