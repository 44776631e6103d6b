"""SLAM of a whole drive: from readings and drifting odometry to a refined trajectory, in these steps.

windows         the drive is cut into pieces of 0.4 m, each with a node of the pose graph
heading         yaw from the directions of walls at right angles, by a hidden Markov model over the whole drive
straight walls  distances to walls, which keep the trajectory straight and give scale and heading of the wheels
matching        each block is matched with a local map of what was driven before it, then of what lies around it
loop closures   blocks are matched with local maps of other visits
scan matching   if walls give no heading or a doubtful one: matching alone, then loop closures; if this shows that
                odometry is wrong, walls are tried again
judgement       the trajectory is accepted if held-out readings or walls support it; otherwise odometry is kept
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.parameters import Parameters
from ..common.readings import Readings
from ..runtime.cancelling import check
from .after_jumps import Part, begins_of, parts_at, with_doubtful
from .any_angle import MatchedDrive, match_drive
from .attempt import ACCURACY, EXACT, Attempt, Drive, gain_words, refined
from .certainty import LARGEST_SIGMA, yaw_errors
from .fitting import gain_when_fitted
from .holding_out import LEAST_SIGMAS, Gain, has_revisits, held_out, tears_apart
from .judging import gain_at_revisits, gain_of_objective, gain_within_visits, is_worse_nearby
from .jumps import MOST_JUMPS, jumps, without_outliers
from .local_map import for_matching
from .odometry_model import CALIBRATION
from .outcome import Differences, Refinement, differences, joined_parts, replaced, with_all_poses, with_outliers
from .passes import BLOCK
from .refinable import unfit, without_times
from .relocating import LEAST_RECOGNISED, confirmed_by_places
from .right_angles import at_right_angles, proven_in_folds, start_from
from .scans import Scans
from .standing import without_stands
from .windows import TRAVEL, Odometry, cut

SHOWN_BY_MATCHING = '; scan matching alone shows that odometry is wrong, and is no better than walls at right angles'

NOR_MATCHES = '; scan matching alone gives no better trajectory'

SCAN_MATCHED = 2 * TRAVEL
"""Largest median distance between poses of odometry for matching alone, metres. Scan matching takes the shape of two
windows from odometry, and between poses readings are interpolated on a straight line, so turns are lost."""

WORSE_NEARBY = '; with scan matching alone, readings within a few metres are predicted worse than with odometry'

Watch = Callable[[str, float], None]
"""Receives the name of the stage, and the fraction of it that is done, from 0 to 1."""


class Refiner:
    """Estimates the trajectories of drives; can be cancelled from another thread, for good."""

    def __init__(self, parameters: Parameters) -> None:
        """Set the parameters; cell size and sensor model are replaced (`for_matching`)."""
        self._parameters = for_matching(parameters)
        self._stop = np.zeros(1, np.uint8)
        self._watch: Watch = lambda stage, part: None

    def cancel(self) -> None:
        """Make `run` raise `Cancelled` soon; may be called from any thread."""
        self._stop[0] = 1

    def run(self, readings: Readings, odometry: Odometry, watch: Watch = lambda stage, part: None) -> Refinement:
        """Return the trajectory of a drive.

        Parameters
        ----------
        readings : Readings
            Placed by `odometry`.
        odometry : Odometry
        watch : callable
            Called from this thread during the work.

        Raises
        ------
        Cancelled
            If `cancel` was called.
        """
        self._watch = watch
        if reason := without_times(readings, odometry):
            return Refinement(False, reason, readings, odometry, {})
        if (moving := without_stands(odometry)) is not odometry:
            return with_all_poses(self.run(replaced(readings, odometry, moving), moving, watch), readings, odometry)
        if (sound := without_outliers(odometry)) is not odometry:
            found = self.run(replaced(readings, odometry, sound), sound, watch)
            return with_outliers(found, readings, odometry, len(odometry.stamp) - len(sound.stamp))
        jumped_to = jumps(odometry)
        if len(jumped_to) > MOST_JUMPS:
            reason = f'odometry jumps {len(jumped_to)} times: it is not wheel odometry, or messages are missing'
            return Refinement(False, reason, readings, odometry, {})
        jumped_to = with_doubtful(readings, odometry, jumped_to, self._parameters, self._stop)
        if not len(jumped_to):
            return self._whole(readings, odometry)
        return self._in_parts(readings, odometry, jumped_to)

    def _in_parts(self, readings: Readings, odometry: Odometry, jumped_to: NDArray[np.int64]) -> Refinement:
        """Return the trajectory of a drive with jumps: each part is refined alone, then placed on the map before it."""
        watch, cuts, outcomes = self._watch, parts_at(readings, odometry, jumped_to), []
        for k, (own, part) in enumerate(cuts, 1):
            self._watch = partial(_report_part, watch, f'part {k} of {len(cuts)}, ')
            # the placement needs the best heading, so refined parts are accepted however little they move
            outcomes.append(self._whole(own, part, EXACT))
        self._watch = watch
        self._start_stage('what follows jumps of odometry')
        parts = [Part(o.readings, part, o.trajectory, o.lost) for (_, part), o in zip(cuts, outcomes, strict=True)]
        begins = begins_of(parts, self._parameters, self._stop)
        return joined_parts(readings, odometry, parts, outcomes, begins)

    def _whole(self, readings: Readings, odometry: Odometry, least: Differences = ACCURACY) -> Refinement:
        """Return the trajectory of a drive without jumps; it must differ from odometry by more than `least`."""
        reason = unfit(readings, odometry)
        if reason:
            return Refinement(False, reason, readings, odometry, {})
        windows = cut(readings, odometry)
        scans = Scans(windows, self._parameters, self._stop, held_out(len(windows)))
        drive = Drive(readings, odometry, windows, scans)
        noise = self._parameters.association.odometry_noise
        by_walls = at_right_angles(drive, noise, least, self._start_stage)
        if by_walls.sure:
            return by_walls.refinement
        found = self._at_any_angle(drive, by_walls, least)
        if found is by_walls.refinement and by_walls.by_votes:
            return self._unless_unsupported(drive, by_walls, noise)
        return found

    def _at_any_angle(self, drive: Drive, by_walls: Attempt, least: Differences) -> Refinement:
        """Return the trajectory by matching alone, if it is better than that by walls at right angles."""
        readings, odometry, windows, scans = drive
        known = by_walls.nodes if by_walls.refinement.accepted else None
        apart = usual_step(odometry)
        if apart > SCAN_MATCHED:
            return _without_better(by_walls.refinement, too_sparse_words(apart))
        try:
            noise = self._parameters.association.odometry_noise
            start = start_from(scans, by_walls) if by_walls.turns_contradicted else by_walls.start
            limit = None if by_walls.turns_contradicted else known
            found = match_drive(odometry, scans, self._start_stage, noise, limit, start)
        except InputError:
            # at the cell size of matching, the map of the whole drive may be too large although the final maps are not
            found = None
        if found is None:
            return _without_better(by_walls.refinement)
        nodes, scans = found.nodes, found.scans
        if known is not None:
            larger = gain_when_fitted(scans, known, nodes, self._start_stage('judgement'))
            if larger.sigmas < LEAST_SIGMAS:
                return by_walls.refinement
        trajectory = refined(odometry, windows, nodes)
        off = differences(odometry, trajectory)
        if off.within(least):
            return _without_better(by_walls.refinement, near_words(off.moved))
        better = gain_at_revisits(scans, windows.node, nodes, self._start_stage('judgement'))
        if better.sigmas < LEAST_SIGMAS:
            return _without_better(by_walls.refinement)
        within = gain_within_visits(scans, windows.node, nodes, self._start_stage('judgement'))
        if not confirmed_by_places(scans, nodes, found.loops) and within.sigmas < LEAST_SIGMAS:
            return _without_better(by_walls.refinement, unconfirmed_words(found.part))
        if is_worse_nearby(within, better):
            return _without_better(by_walls.refinement, WORSE_NEARBY)
        if known is None and (walls := self._by_walls_after_all(drive, by_walls, found, least)) is not None:
            return walls
        at_revisits = 'where the robot came back, ' if has_revisits(scans, nodes) else ''
        by_name = dict.fromkeys(CALIBRATION, 0.0) | {
            name: estimate.value
            for name, estimate in yaw_errors(odometry, trajectory).items()
            if estimate.sigma <= LARGEST_SIGMA[name]
        }
        return Refinement(
            True,
            f'walls are not assumed to be at right angles; {at_revisits}{gain_words(better)}'
            f'{_recognition_words(found)}',
            replaced(readings, odometry, trajectory),
            trajectory,
            by_name,
            *off,
            len(found.loops),
            better.mean,
            right_angles=False,
        )

    def _by_walls_after_all(
        self, drive: Drive, refused: Attempt, matched: MatchedDrive, least: Differences
    ) -> Refinement | None:
        """Return the trajectory with walls at right angles, unless matching alone is better; then None.

        Matching has shown that odometry is wrong; `refused` is the attempt with walls, which has not.
        """
        by_walls, nodes = refused.unproven, matched.nodes
        if refused.before_matching:
            noise = self._parameters.association.odometry_noise
            by_walls = at_right_angles(drive, noise, least, self._start_stage, odometry_is_wrong=True)
        if by_walls is None or not by_walls.refinement.accepted:
            return None
        if by_walls.turns_contradicted or tears_apart(drive.scans, nodes, by_walls.nodes):
            return None
        # neither must have been fitted to the windows that are predicted
        by_held_out = (gain_at_revisits,) if matched.scans is drive.scans else ()
        for compared in (*by_held_out, gain_when_fitted):
            try:
                if compared(drive.scans, by_walls.nodes, nodes, self._start_stage('judgement')).sigmas >= LEAST_SIGMAS:
                    return None
            except InputError:
                # the map along this trajectory is too large
                return None
        found = by_walls.refinement
        return replace(found, reason=found.reason + SHOWN_BY_MATCHING)

    def _unless_unsupported(self, drive: Drive, by_walls: Attempt, noise: float) -> Refinement:
        """Return a trajectory that only doubtful walls support, or odometry if nothing else supports it as well.

        J must do so, or readings of other held-out windows.
        """
        try:
            better = gain_of_objective(drive.scans, drive.windows.node, by_walls.nodes)
        except InputError:
            # the map along this trajectory is too large
            better = Gain(0.0, np.inf)
        if better.sigmas >= LEAST_SIGMAS:
            return by_walls.refinement
        if (proven := proven_in_folds(drive, by_walls, noise, self._start_stage)) is not None:
            return proven.refinement
        return _unsupported(drive, by_walls, better)

    def _start_stage(self, stage: str) -> Callable[[float], None]:
        def progress(part: float) -> None:
            check(self._stop)
            self._watch(stage, part)

        progress(0.0)
        return progress


def usual_step(odometry: Odometry) -> float:
    """Return the step between poses that half of the distance was driven with or less, metres (weighted median)."""
    steps = np.sort(np.diff(odometry.travel))
    return float(steps[np.searchsorted(np.cumsum(steps), steps.sum() / 2)])


def too_sparse_words(apart: float) -> str:
    """Return why matching alone is not tried if poses are so far apart, metres."""
    return (
        f'; poses of odometry are usually {apart:.1f} m apart, and scan matching needs one every {SCAN_MATCHED:g} m: '
        f'record odometry at a higher rate'
    )


def near_words(moved: float) -> str:
    """Return why a trajectory from matching alone is not used that moves odometry by so little, metres."""
    return (
        f'; scan matching alone moves odometry by {moved:.2f} m (root mean square), which is not more than the '
        'accuracy of sonar'
    )


def unconfirmed_words(part: float) -> str:
    """Return why matching alone is not used if this part of the blocks on its earlier visits is recognised."""
    recognised = 'hardly any of the places to which the robot came back by odometry are'
    if part < LEAST_RECOGNISED:
        recognised = f'only {part:.0%} of the path through places seen before is'
    return (
        f'; with scan matching alone, {recognised} recognised, and within a few metres it does not predict readings '
        'clearly better than odometry'
    )


def _without_better(found: Refinement, why: str = NOR_MATCHES) -> Refinement:
    """Return the result by walls, with the reason why matching alone gave no better one if it is not accepted."""
    return found if found.accepted else replace(found, reason=found.reason + why)


def _unsupported(drive: Drive, by_walls: Attempt, better: Gain) -> Refinement:
    """Return odometry, since the gain in J does not support a trajectory from walls."""
    by = (
        f' ({better.mean:.1f} ± {better.error:.1f} nats for each {BLOCK * TRAVEL:g} m)' if better.error < np.inf else ''
    )
    reason = (
        'what walls say is doubtful, and along that trajectory the readings as a whole are not clearly more likely '
        f'than with odometry{by}'
    )
    found = by_walls.refinement
    return Refinement(False, reason + NOR_MATCHES, drive.readings, drive.odometry, found.calibration, gain=found.gain)


def _recognition_words(found: MatchedDrive) -> str:
    """Return the warning about the fraction of blocks on earlier visits that are recognised; empty if it is large.

    If two starts agree, the search is not lost, but places look alike.
    """
    if found.part >= LEAST_RECOGNISED or found.agreed:
        return ''
    return f'; {found.part:.0%} of the path through places seen before is recognised: the drive may be bent as a whole'


def _report_part(watch: Watch, name: str, stage: str, part: float) -> None:
    watch(name + stage, part)
