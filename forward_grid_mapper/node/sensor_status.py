"""The health of each sensor, as a status of `/diagnostics`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ..core.common.readings import Readings
from ..core.learning.sensor_health import SensorHealth, health_warning, sensor_health
from ..core.maps.map_set import MapSet
from .diagnostics import status


class SensorWatch:
    """Keeps the table of the latest EM run; before the first, there are counts alone."""

    def __init__(self) -> None:
        self._table: dict[str, SensorHealth] = {}

    def clear(self) -> None:
        """Forget the table."""
        self._table = {}

    def judge(self, maps: MapSet | None, wanted: Callable[[], bool]) -> None:
        """Make the table of a run's maps, in the run's own thread; None, of a run that failed, changes nothing.

        `wanted` says at the end whether the run still counts.
        """
        if maps is not None:
            table = sensor_health(maps)
            if wanted():
                self._table = table

    def status(self, name: str, readings: Readings) -> DiagnosticStatus:
        """Return the status of all sensors, with a key for each.

        Parameters
        ----------
        name : str
            Of the node.
        readings : Readings
            All so far; sensors that the last run of EM did not judge are counted.
        """
        table = self._table
        values = {**_counts(readings), **{sensor: str(row) for sensor, row in table.items()}}
        warning = health_warning(table)
        message = warning or ('none stands out' if table else 'judged when EM has run')
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        return status(f'{name}: sensors', level, message, name, values)


def _counts(readings: Readings) -> dict[str, str]:
    names = readings.sensor_names
    total = np.bincount(readings.sensor, minlength=len(names))
    silent = np.bincount(readings.sensor, weights=~readings.echo, minlength=len(names))
    return {
        name: f'{count} readings, {quiet / max(count, 1):.0%} max range'
        for name, count, quiet in zip(names, total.tolist(), silent.tolist(), strict=True)
    }
