"""A run of EM that refines the trajectory first, as `process_bag --refine-poses` does, in the node's worker."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import Cancelled
from ..core.common.grid import Grid
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.mapping import Mapper, Watch
from ..core.maps.log_odds_map import LogOddsMap
from ..core.maps.map_set import MapSet
from ..core.runtime.threads import cores
from ..core.trajectory.correction import Correction
from ..core.trajectory.following import Follower
from ..core.trajectory.keeping import keep_if_not_worse
from ..core.trajectory.outcome import Refinement
from ..core.trajectory.refinement import Refiner
from ..core.trajectory.windows import Odometry
from .background import reason

BATCH = 20_000
"""Readings after which the construction of a live map checks for cancellation."""


def leaving_a_core(parameters: Parameters) -> Parameters:
    """Return the parameters of a refinement, which takes long: messages have a core, unless `threads` is given."""
    return parameters.varied({'threads': parameters.search.threads or max(cores() - 1, 1)})


class RefinementInput(NamedTuple):
    """Input of refinement: the poses of odometry, and all readings that they placed."""

    odometry: Odometry
    readings: Readings


class FoundTrajectory(NamedTuple):
    """The trajectory of a run.

    `refinement` is None if none was wanted, `correction` if odometry is used. `live` is the live map of the drive's
    readings, None if the current one is still right. `follower` continues the trajectory; None if it is not followed.
    `kept` is the reason why this run alone would use odometry, if the trajectory of an earlier run is kept; else ''.
    """

    refinement: Refinement | None
    correction: Correction | None
    live: LogOddsMap | None
    follower: Follower | None = None
    kept: str = ''


class RefiningMapper:
    """Makes maps of readings as `Mapper` does, at the poses of the refined trajectory.

    Attributes
    ----------
    found_trajectory : FoundTrajectory or None
        Set by `run`, once the maps are made.
    """

    def __init__(
        self,
        parameters: Parameters,
        drive: Callable[[], RefinementInput],
        refine: bool,
        before: FoundTrajectory | None,
        now: Callable[[], RefinementInput] | None = None,
    ) -> None:
        """Prepare a run.

        Parameters
        ----------
        parameters : Parameters
        drive : callable
            Called in the thread of the run, once the readings are available.
        refine : bool
            Whether to refine the trajectory; otherwise that of odometry is used.
        before : FoundTrajectory or None
            The current trajectory, on which the live map is based; None if it is that of odometry.
        now : callable, optional
            Called in the thread of the run; returns the drive so far, so that the part after the start is followed.
        """
        self.found_trajectory: FoundTrajectory | None = None
        self._now = now
        self._follower: Follower | None = None
        self._parameters, self._drive = parameters, drive
        self._to_refine, self._before = refine, before
        self._stop, self._kept = np.zeros(1, np.uint8), ''
        self._mapper, self._matching = Mapper(parameters), leaving_a_core(parameters)
        self._refiner = Refiner(self._matching)
        self._cancelled, self._moves = False, before is not None

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` soon; may be called from any thread."""
        self._cancelled = True
        self._stop[0] = 1
        self._refiner.cancel()
        if self._follower is not None:
            self._follower.cancel()
        self._mapper.cancel()

    def so_far(self) -> tuple[Grid, NDArray[np.int8]] | None:
        """Return the result of `Mapper.so_far`; None along another trajectory than the current one.

        Its coordinates are those of a transform that is published only after the run.
        """
        return None if self._moves else self._mapper.so_far()

    def run(
        self,
        readings: Readings,
        watch: Watch = lambda stage, progress: None,
        start: tuple[Grid, NDArray[np.int8]] | None = None,
    ) -> MapSet:
        """Return the maps of `readings`, which odometry placed; see `Mapper.run` for the parameters.

        `start` is used only with the trajectory of odometry.
        """
        drive, refinement, correction = self._drive(), None, None
        seconds: dict[str, float] = {}
        if self._to_refine:
            begun = time.perf_counter()
            refinement = self._refine(readings, drive.odometry, watch)
            seconds['trajectory'] = time.perf_counter() - begun
            readings = refinement.readings
            if refinement.accepted:
                correction, start = Correction(drive.odometry, refinement.trajectory), None
                self._moves = True
        live = None
        if correction is not None or self._before is not None:
            watch('live map along the trajectory', None)
            live = self._live_map(drive.readings, correction)
        maps = self._mapper.run(readings, watch, start)
        maps.statistics['seconds'] = {**seconds, **maps.statistics['seconds']}
        if refinement is not None:
            # so that the readings are in memory only once
            refinement = replace(refinement, readings=maps.readings)
        if refinement is not None and correction is not None and self._now is not None:
            watch('following', None)
            self._follow(correction, refinement, self._now)
        self.found_trajectory = FoundTrajectory(refinement, correction, live, self._follower, self._kept)
        return maps

    def _follow(self, correction: Correction, found: Refinement, now: Callable[[], RefinementInput]) -> None:
        """Follow what was driven during the refinement; the maps are valid even if this fails."""
        follower = self._follower = Follower(
            correction, found.calibration, self._parameters, found.noise, found.right_angles
        )
        if self._cancelled:
            raise Cancelled('the work was cancelled')
        try:
            odometry, readings = now()
            follower.follow(readings, odometry)
        except Cancelled:
            raise
        except Exception as error:
            follower.obstacle = reason(error)

    def _refine(self, readings: Readings, odometry: Odometry, watch: Watch) -> Refinement:
        def say(stage: str, part: float) -> None:
            watch(f'trajectory ({stage}, {part:.0%})', None)

        found, before = self._refiner.run(readings, odometry, say), self._before
        if found.accepted or before is None or before.refinement is None or before.correction is None:
            return found
        say('that of the previous run', 0.0)
        outcome = keep_if_not_worse(before.refinement, before.correction, found, self._matching, self._stop)
        if outcome.accepted:
            self._kept = found.reason
        return outcome

    def _live_map(self, readings: Readings, correction: Correction | None) -> LogOddsMap:
        live = LogOddsMap(self._parameters)
        for first in range(0, len(readings), BATCH):
            if self._cancelled:
                raise Cancelled('the work was cancelled')
            part = readings.select(slice(first, first + BATCH))
            live.add(part if correction is None else correction.apply(part))
        return live


def outcome_words(found: FoundTrajectory) -> str:
    """Return a description of the trajectory, in words; '' if no refinement was wanted."""
    refinement, correction = found.refinement, found.correction
    if refinement is None:
        return ''
    if correction is None:
        return f'odometry is used as the trajectory: {refinement.reason}'
    said = f'trajectory refined ({refinement.reason})'
    if found.kept:
        said = f'trajectory of the previous run kept ({refinement.reason}; result of this run alone: {found.kept})'
    return (
        f'{said}: odometry was off by {refinement.moved:.2f} m (root mean square), '
        f'{correction.moved:.2f} m at the end of the drive, {counted(refinement.loops, "place")} recognised'
        + (f'; {refinement.jumps}' if refinement.jumps else '')
    )
