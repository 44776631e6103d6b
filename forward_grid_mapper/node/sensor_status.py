"""The health of each sensor, as a status of `/diagnostics`, and which sensors have stopped sending."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus

from ..core.common.words import counted
from ..core.learning.sensor_health import SensorHealth, health_warning
from ..core.messages.rejections import (
    MOST_NO_ECHO,
)
from .diagnostics import listed, status

LEAST_PAUSES, LEAST_READINGS, READINGS_A_PAUSE = 5, 100, 1000
"""Pauses of sensors, and readings, from which a driver that sends nothing without an echo is likely; and readings for
each pause from which it is not."""


def unsent_warning(pauses: int, counts: Mapping[str, tuple[int, int]]) -> str:
    """Return a warning that a driver seems to send nothing if there is no echo, or ''.

    Parameters
    ----------
    pauses : int
        How often sensors paused (`SensorSilence.pauses`).
    counts : mapping of str to (int, int)
        From `ReadingBuffer.counts`.
    """
    readings, silent = (sum(numbers[k] for numbers in counts.values()) for k in (0, 1))
    if (
        pauses < max(LEAST_PAUSES, readings / READINGS_A_PAUSE)
        or readings < LEAST_READINGS
        or silent > MOST_NO_ECHO * readings
    ):
        return ''
    return (
        f'sensors stopped sending for half a second or more, and sent again, {pauses} times so far, and hardly any '
        'reading is without an echo: does the driver send nothing if there is no echo? It must send +inf then (REP '
        '117), since these readings show which space is free'
    )


class SensorWatch:
    """Keeps the table of the latest EM run; before the first, the status has counts only."""

    def __init__(self) -> None:
        self._table: dict[str, SensorHealth] = {}

    def clear(self) -> None:
        """Forget the table."""
        self._table = {}

    def take(self, table: dict[str, SensorHealth]) -> None:
        """Take the table of a run."""
        self._table = table

    def status(
        self,
        name: str,
        counts: Mapping[str, tuple[int, int]],
        quiet: Mapping[str, float] | None = None,
        unsent: str = '',
    ) -> DiagnosticStatus:
        """Return the status of all sensors, with a key for each.

        Parameters
        ----------
        name : str
            Of the node.
        counts : dict of name → (int, int)
            Readings accepted so far, and those without echo; for sensors that are not in the table.
        quiet : dict of name → float, optional
            Seconds since the last message of sensors that have stopped sending.
        unsent : str
            From `unsent_warning`.
        """
        quiet = quiet or {}
        table = self._table
        values = {
            sensor: f'{counted(count, "reading")}, {silent / max(count, 1):.0%} max range'
            for sensor, (count, silent) in counts.items()
        }
        values |= {sensor: str(row) for sensor, row in table.items()}
        for sensor, seconds in quiet.items():
            values[sensor] = f'SILENT for {seconds:.0f} s; {values.get(sensor, "")}'
        silence = f'{listed(quiet)}: no more messages' if quiet else ''
        warning = '; '.join(filter(None, [silence, unsent, health_warning(table)]))
        message = warning or ('none differs from the others' if table else 'judged after EM')
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        return status(f'{name}: sensors', level, message, name, values)
