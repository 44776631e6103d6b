"""The report of a mapping run: readings used and rejected, results, and durations."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.common.grid import UNKNOWN
from ..core.common.parameters import TABLE
from ..core.learning.sensor_health import health_warning, sensor_health
from ..core.maps.map_set import MapSet
from .output_folder import output_errors
from .quality_warning import contradiction_of_halves, halves_warning
from .report_text import report_text

__all__ = ['json_text', 'report_data', 'report_text', 'write_report']


def report_data(maps: MapSet, source: Mapping[str, Any]) -> dict[str, Any]:
    """Return all data of the report of a run, for JSON.

    Parameters
    ----------
    maps : MapSet
    source : mapping
        Origin of the readings. All keys are optional: `bag`, `range_topics`, `odom_topic`, `odom_frame`, `map_frame`,
        `mounts_from`, `extrinsics` (poses of the sensors on the robot, by frame), `stamps` (first and last,
        nanoseconds), `duration_s`, `path_m`, `counts` (`received`, `accepted`, `rejected` by reason), `sensors` (by
        frame: `accepted`, `no_echo`, `unexplained`), `warnings`; for several drives `drives`, a list of such mappings.
        Other keys are copied to `input`.

    Returns
    -------
    dict
        Of plain Python values; numbers that are not finite are None.
    """
    rest = dict(source)
    counts = dict(rest.pop('counts', None) or {})
    counts.setdefault('accepted', len(maps.readings))
    drives = rest.pop('drives', None)
    health = sensor_health(maps)
    sensors = {name: {**row, 'health': dataclasses.asdict(health[name])} for name, row in _sensors(maps).items()}
    for name, row in (rest.pop('sensors', None) or {}).items():
        sensors[name] = {**sensors.get(name, {}), **row}
    contradiction, halves = _halves(maps, source)
    statistics = dict(maps.statistics)
    data = {
        'version': __version__,
        'warnings': [*(rest.pop('warnings', None) or []), *filter(None, [health_warning(health), halves])],
        'input': rest,
        'counts': counts,
        'sensors': sensors,
        **({'drives': _drives(maps, drives)} if drives else {}),
        'map': _map(maps),
        'result': {
            'readings': len(maps.readings),
            'unexplained': int(np.count_nonzero(maps.unexplained)),
            'log_likelihood': maps.log_likelihood,
            'objective': maps.objective,
            'contradiction': contradiction,
        },
        'seconds': statistics.pop('seconds', {}),
        'statistics': statistics,
        'parameters': maps.parameters.flat(),
        'changed_parameters': {
            row.name: {'value': value, 'default': row.default}
            for row in TABLE
            if (value := maps.parameters.flat()[row.name]) != row.default
        },
    }
    made: dict[str, Any] = plain(data)
    return made


def _halves(maps: MapSet, source: Mapping[str, Any]) -> tuple[float | None, str]:
    """Return by how much the halves of a drive contradict each other, nats an echo, and the warning, or ''.

    None if there are several drives, or if the trajectory was refined.
    """
    trajectory = source.get('trajectory') or {}
    if source.get('drives') or trajectory.get('refined'):
        return None, ''
    contradiction = contradiction_of_halves(maps)
    option = '--refine-poses' if source.get('bag') else 'refine_poses'
    # a trajectory that was only calibrated has no reason
    return contradiction, halves_warning(contradiction, '' if trajectory.get('reason') else option)


def write_report(folder: Path | str, data: dict[str, Any]) -> None:
    """Write `report.json` and `report.txt`.

    Raises
    ------
    OutputError
        If they cannot be written.
    """
    texts = {
        'report.json': json_text(data),
        'report.txt': report_text(data),
    }
    for name, text in texts.items():
        path = Path(folder) / name
        with output_errors(path):
            path.write_text(text, encoding='utf-8')


def _sensors(maps: MapSet, which: NDArray[np.bool_] | None = None) -> dict[str, dict[str, Any]]:
    """Return the counts of each sensor, of all readings or of those that `which` selects."""
    readings, size = maps.readings, len(maps.readings.sensor_names)
    marked = np.ones(len(readings), np.bool_) if which is None else which
    masks = {'accepted': marked, 'no_echo': marked & ~readings.echo, 'unexplained': marked & maps.unexplained}
    counts = {kind: np.bincount(readings.sensor[mask], minlength=size).tolist() for kind, mask in masks.items()}
    return {name: {kind: counts[kind][k] for kind in masks} for k, name in enumerate(readings.sensor_names)}


def _drives(maps: MapSet, drives: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the data of each drive, with the counts of its sensors."""
    rows = []
    for number, drive in enumerate(drives):
        sensors = _sensors(maps, maps.readings.drive == number)
        mine = {name: row for name, row in sensors.items() if row['accepted']}
        rows.append({**drive, 'unexplained': sum(row['unexplained'] for row in mine.values()), 'sensors': mine})
    return rows


def _map(maps: MapSet) -> dict[str, Any]:
    grid = maps.grid
    return {
        'resolution': grid.resolution,
        'width': grid.width,
        'height': grid.height,
        'origin': list(grid.origin),
        'free_cells': int(np.count_nonzero(maps.ml == 0)),
        'occupied_cells': int(np.count_nonzero(maps.ml == 1)),
        'unknown_cells': int(np.count_nonzero(maps.ml == UNKNOWN)),
    }


def json_text(data: Mapping[str, Any], ascii: bool = False) -> str:
    """Return data, which may contain numpy types, as lines of JSON; numbers that are not finite are null.

    With `ascii` all other characters are escaped.
    """
    return json.dumps(plain(data), indent=2, ensure_ascii=ascii, allow_nan=False) + '\n'


def plain(value: Any) -> Any:
    """Return `value` converted to Python's own types, for JSON."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, int)) else str(value)
