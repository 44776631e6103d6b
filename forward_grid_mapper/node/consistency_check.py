"""Checks whether sensor poses, clocks and odometry agree with the readings, after the maps of a run are published."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from ..core.common.parameters import Parameters
from ..core.learning.consistency import consistency_warnings
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2
from ..files.quality_warning import contradiction_of_halves, halves_warning
from .background import Inbox, Worker

CHECKED_AGAIN = 2.0
"""Factor by which the number of readings must grow before they are checked again, which takes seconds."""


class _Checked(NamedTuple):
    """The warnings of the last check, and what was checked."""

    readings: int
    mounts: Mapping[str, Pose2]
    parameters: Parameters
    refined: bool
    found: list[str]


class ConsistencyCheck:
    """Checks the latest maps in a worker; the executor owns it."""

    def __init__(self, worker: Worker, inbox: Inbox) -> None:
        self._worker, self._inbox = worker, inbox
        self._latest: MapSet | None = None
        self._last: _Checked | None = None
        self._forgotten = 0

    def forget(self) -> None:
        """Forget the maps and what was found."""
        self._latest = self._last = None
        self._forgotten += 1

    def warnings(
        self, maps: MapSet, mounts: Mapping[str, Pose2], refined: bool, later: Callable[[list[str]], object]
    ) -> list[str]:
        """Return the warnings of the last check if they hold for these maps as well; otherwise check these.

        Parameters
        ----------
        maps : MapSet
            The latest ones.
        mounts : mapping
            Poses of the sensors that are fixed to the robot, by frame.
        refined : bool
            Whether the maps are along a refined trajectory: then odometry was compared with the readings before.
        later : callable
            Called by the executor with the warnings of a new check, unless there are later maps by then.
        """
        self._latest, last, forgotten = maps, self._last, self._forgotten
        same = last is not None and last[1:4] == (mounts, maps.parameters, refined)
        if last is not None and same and len(maps.readings) < CHECKED_AGAIN * last.readings:
            return last.found

        def check() -> None:
            if maps is not self._latest:
                # there were later maps, or a reset, before it began
                return
            found = consistency_warnings(maps.readings, mounts, maps.parameters)
            if not refined:
                remedy = '' if maps.parameters.node.refine_poses else 'refine_poses'
                found += filter(None, [halves_warning(contradiction_of_halves(maps), remedy)])
            self._inbox.put(lambda: take(found))

        def take(found: list[str]) -> None:
            if forgotten != self._forgotten:
                return
            # also if there are later maps: otherwise runs that follow each other fast would never be checked
            self._last = _Checked(len(maps.readings), mounts, maps.parameters, refined, found)
            if maps is self._latest:
                later(found)

        self._worker.put(check)
        return []
