"""SLAM of a whole drive: from readings and drifting odometry to a refined trajectory, in these steps.

windows         the drive is cut into pieces of 0.4 m, each with a node of the pose graph
heading         yaw from the directions of walls at right angles, by a hidden Markov model over the whole drive
straight walls  distances to walls, which keep the trajectory straight and give scale and heading of the wheels
matching        each block is matched with a local map of what was driven before it, then of what lies around it
loop closures   blocks are matched with local maps of other visits
scan matching   if walls give no heading or a doubtful one: matching alone, then loop closures
judgement       the trajectory is accepted if held-out readings or walls support it; otherwise odometry is kept
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..runtime.cancelling import check
from .any_angle import match_drive
from .certainty import LARGEST_SIGMA, yaw_errors
from .heading import NOISES, Heading, heading
from .holding_out import LEAST_SIGMAS, Gain, has_revisits, held_out
from .hypotheses import solve_hypotheses
from .judging import gain_at_revisits, gain_of_objective, gain_over_drive, last_not_worse, turns_supported
from .jumps import MOST_JUMPS, Part, begins_of, jumps, parts_at, with_doubtful, without_outliers
from .local_map import for_matching
from .odometry_model import CALIBRATION
from .outcome import Refinement, differences, joined_parts, replaced, with_all_poses, with_outliers
from .poses import compose, inverse
from .relocating import LEAST_RECOGNISED, recognised_part
from .scans import Scans
from .solving import Solver
from .standing import without_stands
from .walls import wall_votes
from .windows import TRAVEL, Odometry, Windows, corrected, cut

SHORTEST = 8.0
"""Shortest drive that is refined, metres: shorter ones drift little, and have few readings for the judgement."""

FEWEST_READINGS = 200

LEAST_ECHOES = 0.05
"""Fraction of the readings that must have an echo."""

LEAST_SENSORS = 2

LEAST_VOTE_GAIN, LEAST_SIGMAS_WITH_WALLS = 10.0, -1.0
"""If votes of walls are likelier by so many nats than with the yaw of odometry, beyond what random ranges give, and the
robot came back to no place, the gain in predicting readings need only be so many standard errors: readings must not be
predicted worse. Small drift hardly shows within a few metres."""

LEAST_CERTAINTY = 0.9
"""Least probability that no right angle of the heading was lost."""

LEAST_MOVED = 0.15
"""Least difference from odometry of an accepted trajectory, metres (rms): about the error of the trajectory itself."""

NOT_ENOUGH = ': this does not show that odometry is wrong'

NO_WALLS = (
    'the echoes do not agree on directions of walls: this needs walls at right angles to each other beside the robot, '
    'and odometry with an accurate yaw over a few metres'
)

NOR_MATCHES = '; scan matching alone gives no better trajectory'

SCAN_MATCHED = 2 * TRAVEL
"""Largest median distance between poses of odometry for matching alone, metres. Scan matching takes the shape of two
windows from odometry, and between poses readings are interpolated on a straight line, so turns are lost."""

Watch = Callable[[str, float], None]
"""Receives the name of the stage, and the fraction of it that is done, from 0 to 1."""


class _Drive(NamedTuple):
    """A drive, its windows and their scans."""

    readings: Readings
    odometry: Odometry
    windows: Windows
    scans: Scans


class _Attempt(NamedTuple):
    """The result by one method, its nodes, and whether it is so sure that no other method needs to be tried."""

    refinement: Refinement
    nodes: Floats
    sure: bool = False


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
            outcomes.append(self._whole(own, part, 0.0))
        self._watch = watch
        self._start_stage('what follows jumps of odometry')
        parts = [Part(o.readings, part, o.trajectory, o.lost) for (_, part), o in zip(cuts, outcomes, strict=True)]
        begins = begins_of(parts, self._parameters, self._stop)
        return joined_parts(readings, odometry, parts, outcomes, begins)

    def _whole(self, readings: Readings, odometry: Odometry, least_moved: float = LEAST_MOVED) -> Refinement:
        """Return the trajectory of a drive without jumps; it must differ from odometry by `least_moved` metres."""
        reason = unfit(readings, odometry)
        if reason:
            return Refinement(False, reason, readings, odometry, {})
        windows = cut(readings, odometry)
        scans = Scans(windows, self._parameters, self._stop, held_out(len(windows)))
        drive = _Drive(readings, odometry, windows, scans)
        by_walls = self._at_right_angles(drive, least_moved)
        if by_walls.sure:
            return by_walls.refinement
        return self._at_any_angle(drive, by_walls, least_moved)

    def _at_right_angles(self, drive: _Drive, least_moved: float) -> _Attempt:
        """Return the trajectory with walls at right angles to each other, or why there is none."""
        readings, odometry, windows, scans = drive
        walls, vote_gain = self._heading(windows, scans)
        if walls is None:
            return _Attempt(Refinement(False, NO_WALLS, readings, odometry, {}), windows.node)

        def solver_of(heading: Heading) -> Solver:
            return Solver(odometry, windows, scans, heading, self._start_stage)

        def keep_odometry(reason: str, better: Gain) -> _Attempt:
            refused = Refinement(False, reason, readings, odometry, by_name, gain=better.mean)
            return _Attempt(refused, windows.node)

        solver = solver_of(walls)
        along = solver.along_walls()
        calibration = solver.calibration_of(along)
        simple = solver.simple(calibration)
        better = gain_over_drive(scans, windows.node, simple, self._start_stage('judgement'))
        gain_words = _gain_words(better)
        by_name = dict(zip(CALIBRATION, calibration.tolist(), strict=True))
        proven = better.sigmas >= LEAST_SIGMAS
        votes_suffice = vote_gain > LEAST_VOTE_GAIN and better.sigmas >= LEAST_SIGMAS_WITH_WALLS
        # if walls agree with odometry, other methods need not be tried
        agrees = differences(odometry, refined(odometry, windows, along.nodes))[0] < LEAST_MOVED
        unproven = keep_odometry(gain_words + NOT_ENOUGH, better)._replace(sure=agrees)
        if not proven and not votes_suffice:
            if walls.certainty < LEAST_CERTAINTY:
                return _heading_lost(drive, walls.certainty)
            if vote_gain <= LEAST_VOTE_GAIN:
                return unproven
        found = solve_hypotheses(scans, walls, solver, along, solver_of)
        if found.certainty < LEAST_CERTAINTY:
            return _heading_lost(drive, found.certainty)
        if found.solver is not solver:
            solver, simple = found.solver, found.solver.simple(found.solver.calibration_of(found.along))
        self._start_stage('judgement')
        nodes = last_not_worse(scans, simple, found.along.nodes, found.solution.nodes)
        if not proven:
            # revisits show drift over the whole drive, and walls that are not parallel; whether the robot came back is
            # decided along the refined nodes, since by odometry it may be wrong
            revisited = has_revisits(scans, nodes)
            if not revisited and not votes_suffice:
                return unproven
            better = gain_at_revisits(scans, windows.node, nodes)
            gain_words = f'with recognised places, {_gain_words(better)}' if revisited else _gain_words(better)
            if better.sigmas < (LEAST_SIGMAS if revisited else LEAST_SIGMAS_WITH_WALLS):
                return keep_odometry(gain_words + NOT_ENOUGH, better)._replace(sure=agrees)
            if not revisited:
                gain_words = (
                    f'with walls at right angles, the readings are more likely by {vote_gain:.0f} nats than with '
                    f'odometry; {gain_words}'
                )
        loops = found.loops if nodes is found.solution.nodes else []
        if nodes is found.solution.nodes:
            by_name = dict(zip(CALIBRATION, solver.calibration_of(found.solution).tolist(), strict=True))
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if moved < least_moved:
            return keep_odometry(too_little_words(moved), better)._replace(sure=True)
        placed, noise = replaced(readings, odometry, trajectory), walls.drifts.noise
        outcome = Refinement(
            True, gain_words, placed, trajectory, by_name, moved, turned, len(loops), better.mean, noise=noise
        )
        sure = recognised_part(scans, nodes, loops) >= LEAST_RECOGNISED and turns_supported(scans, nodes)
        return _Attempt(outcome, nodes, sure)

    def _at_any_angle(self, drive: _Drive, by_walls: _Attempt, least_moved: float) -> Refinement:
        """Return the trajectory by matching alone, if it is better than that by walls at right angles."""
        readings, odometry, windows, scans = drive
        known = by_walls.nodes if by_walls.refinement.accepted else None
        apart = usual_step(odometry)
        if apart > SCAN_MATCHED:
            return _without_better(by_walls.refinement, too_sparse_words(apart))
        try:
            found = match_drive(odometry, scans, self._start_stage, self._parameters.association.odometry_noise, known)
        except InputError:
            # at the cell size of matching, the map of the whole drive may be too large although the final maps are not
            found = None
        if found is None:
            return _without_better(by_walls.refinement)
        nodes = found.nodes
        if known is not None and gain_of_objective(scans, known, nodes).sigmas < LEAST_SIGMAS:
            return by_walls.refinement
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if moved < least_moved:
            return _without_better(by_walls.refinement)
        better = gain_at_revisits(scans, windows.node, nodes)
        if better.sigmas < LEAST_SIGMAS:
            return _without_better(by_walls.refinement)
        at_revisits = 'with recognised places, ' if has_revisits(scans, nodes) else ''
        by_name = dict.fromkeys(CALIBRATION, 0.0) | {
            name: estimate.value
            for name, estimate in yaw_errors(odometry, trajectory).items()
            if estimate.sigma <= LARGEST_SIGMA[name]
        }
        return Refinement(
            True,
            f'walls are not assumed to be at right angles; {at_revisits}{_gain_words(better)}'
            f'{_recognition_words(found.part)}',
            replaced(readings, odometry, trajectory),
            trajectory,
            by_name,
            moved,
            turned,
            len(found.loops),
            better.mean,
            right_angles=False,
        )

    def _start_stage(self, stage: str) -> Callable[[float], None]:
        def progress(part: float) -> None:
            check(self._stop)
            self._watch(stage, part)

        progress(0.0)
        return progress

    def _heading(self, windows: Windows, scans: Scans) -> tuple[Heading | None, float]:
        """Return the heading from walls, and by how many nats votes are likelier than with the yaw of odometry.

        The same gain of random ranges is subtracted.
        """
        self._start_stage('directions of walls')
        given_noise = self._parameters.association.odometry_noise
        noises = (given_noise,) if given_noise else NOISES
        found = heading(windows, *wall_votes(windows, scans.held_out), noises)
        if found is None:
            return None, 0.0
        # a robot that drives and looks along two axes gets votes for these even with random ranges
        readings, rng = windows.readings, np.random.default_rng(0)
        drawn = np.where(readings.echo, rng.random(len(readings)) * readings.z_max, readings.z)
        randomised = replace(windows, readings=replace(readings, z=drawn))
        chance = heading(randomised, *wall_votes(randomised, scans.held_out), noises)
        gain_by_chance = 0.0 if chance is None else max(chance.over_odometry, 0.0)
        return found, found.over_odometry - gain_by_chance


def without_times(readings: Readings, odometry: Odometry) -> str:
    """Return why the odometry does not cover all readings; empty if it does."""
    if not len(odometry.stamp):
        return 'there are no poses of odometry, as in a journal'
    early, late = readings.stamp.min(initial=odometry.stamp[0]), readings.stamp.max(initial=odometry.stamp[-1])
    if early < odometry.stamp[0] or late > odometry.stamp[-1]:
        return "there are readings at times without odometry, as after a jump of odometry's clock"
    return ''


def unfit(readings: Readings, odometry: Odometry) -> str:
    """Return why a drive cannot be refined; empty if it can."""
    if reason := without_times(readings, odometry):
        return reason
    if len(odometry.stamp) < 2 or odometry.travel[-1] < SHORTEST:
        return (
            f'the drive is {odometry.travel[-1]:.1f} m long; the drift of odometry can be measured from {SHORTEST:g} '
            'm on'
        )
    if len(readings) < FEWEST_READINGS:
        return f'there are {len(readings)} readings; at least {FEWEST_READINGS} are needed'
    if readings.echo.mean() < LEAST_ECHOES:
        return f'only {readings.echo.mean():.0%} of the readings have an echo'
    if len(np.unique(readings.sensor)) < LEAST_SENSORS:
        return 'there is only one sensor, which cannot distinguish a rotation from a sideways translation'
    return ''


def too_little_words(moved: float) -> str:
    """Return the reason for keeping an odometry whose error, metres, is so small."""
    return f'odometry is off by {moved:.2f} m, which is not more than the accuracy of sonar'


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


def lost_words(certainty: float) -> str:
    """Return the reason for keeping odometry if the heading is only this certain."""
    return f'the heading was lost: the probability that it is not wrong by a right angle is only {certainty:.0%}'


def refined(odometry: Odometry, windows: Windows, nodes: Floats) -> Odometry:
    """Return the trajectory: odometry corrected by nodes, moved so that its first pose is that of odometry."""
    w = windows
    pose = corrected(odometry.progress, odometry.pose, w.node_progress, w.node, nodes)
    home = compose(odometry.pose[0], inverse(pose[0]))
    pose = compose(home, pose)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Odometry(odometry.stamp, pose)


def _without_better(found: Refinement, why: str = NOR_MATCHES) -> Refinement:
    """Return the result by walls, with the reason why matching alone gave no better one if it is not accepted."""
    return found if found.accepted else replace(found, reason=found.reason + why)


def _heading_lost(drive: _Drive, certainty: float) -> _Attempt:
    refused = Refinement(False, lost_words(certainty), drive.readings, drive.odometry, {}, lost=True)
    return _Attempt(refused, drive.windows.node)


def _gain_words(better: Gain) -> str:
    if not np.isfinite(better.error):
        return 'too few readings overlap with maps of other readings to compare the prediction with that of odometry'
    better_or_worse = 'better' if better.mean >= 0 else 'worse'
    return (
        f'readings are predicted {better_or_worse} than with odometry, by {abs(better.mean):.3f} ± {better.error:.3f} '
        f'nats a reading'
    )


def _recognition_words(part: float) -> str:
    """Return the warning about the fraction of blocks on earlier visits that are recognised; empty if it is large."""
    if part >= LEAST_RECOGNISED:
        return ''
    return f'; {part:.0%} of the path through places seen before is recognised: the drive may be bent as a whole'


def _report_part(watch: Watch, name: str, stage: str, part: float) -> None:
    watch(name + stage, part)
