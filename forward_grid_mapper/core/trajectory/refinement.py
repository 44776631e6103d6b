"""From readings and drifting odometry to the trajectory that explains both: the steps, one after the other.

windows         the drive in pieces of 0.4 m, each a node of the pose graph
heading         yaw from walls at right angles, followed over the whole drive
straight walls  distances of walls along the drive, which hold it straight and tell scale and heading of the wheels
matching        each block matched with what was driven before it, and then with what lies around it
places          blocks matched with what was mapped there at another time
scan matching   where walls tell no heading, or a doubtful one: windows matched one by one, then blocks and places
judgement       what was held out and where walls stand must speak for the trajectory, or odometry stays
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
from ..common.readings import Readings
from ..runtime.cancelling import check
from .any_angle import matched
from .certainty import MOST, of_yaw
from .heading import NOISES, Heading, heading
from .holding_out import LEAST_SIGMAS, Gain, came_back, held_out
from .hypotheses import solved
from .judging import chosen, explained_better, over_the_drive, seen_again, turned_right
from .jumps import MOST_JUMPS, Part, begins_of, jumps, parts_at, with_doubtful, without_outliers
from .local_map import for_matching
from .odometry_model import CALIBRATION
from .outcome import Refinement, differences, joined_parts, replaced, with_outliers
from .poses import Floats, compose, inverse
from .relocating import LEAST_RECOGNISED, recognised_part
from .scans import Scans
from .solving import Solver
from .walls import wall_votes
from .windows import Odometry, Windows, corrected, cut

SHORTEST = 8.0
"""Metres of a drive below which nothing is refined: its drift is small, and there is little to judge it by."""

FEWEST_READINGS = 200

LEAST_ECHOES = 0.05
"""Part of the readings that must have an echo."""

LEAST_SENSORS = 2

LEAST_WITNESS, LEAST_SIGMAS_WITH_WALLS = 10.0, -1.0
"""Nats that the votes of walls must say against odometry's yaw, beyond what sensors say by where they look, to be a
witness of their own, and the standard errors that are then enough where the robot came to no place twice: readings must
not be predicted worse. Little drift hardly shows in a few metres."""

LEAST_CERTAINTY = 0.9
"""Probability that the heading did not get lost by a right angle."""

LEAST_MOVED = 0.15
"""Metres that odometry must be off, in the root mean square: about the error of what takes its place."""

NOT_ENOUGH = ': this does not show that odometry is wrong'

NO_WALLS = (
    'the echoes do not agree on directions of walls: this needs walls at right angles to each other beside the robot, '
    'and odometry with an accurate yaw over a few metres'
)

NOR_MATCHES = '; scan matching alone gives no better trajectory'

Watch = Callable[[str, float], None]
"""Receives what is going on, and how much of it is done, from 0 to 1."""


class _Drive(NamedTuple):
    """A drive, in windows."""

    readings: Readings
    odometry: Odometry
    windows: Windows
    scans: Scans


class _Attempt(NamedTuple):
    """What became of a drive in one way: its nodes, and whether no other way needs to be tried."""

    refinement: Refinement
    nodes: Floats
    sure: bool = False


class Refiner:
    """Runs from a drive to its trajectory; can be cancelled from another thread, once and for all."""

    def __init__(self, parameters: Parameters) -> None:
        """Prepare runs with these parameters; the search and σ are those of the maps."""
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
            Called from this thread as the work goes on.

        Raises
        ------
        Cancelled
            If `cancel` was called.
        """
        self._watch = watch
        if reason := without_times(readings, odometry):
            return Refinement(False, reason, readings, odometry, {})
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
        """Return the trajectory of a drive whose odometry jumps: of each part by itself, each on the map of others."""
        watch, cuts, outcomes = self._watch, parts_at(readings, odometry, jumped_to), []
        for k, (own, part) in enumerate(cuts, 1):
            self._watch = partial(_named, watch, f'part {k} of {len(cuts)}, ')
            # to be placed, a part needs the best heading that there is, however little it moves
            outcomes.append(self._whole(own, part, 0.0))
        self._watch = watch
        self._say('what follows jumps of odometry')
        parts = [Part(o.readings, part, o.trajectory, o.lost) for (_, part), o in zip(cuts, outcomes, strict=True)]
        begins = begins_of(parts, self._parameters, self._stop)
        return joined_parts(readings, odometry, parts, outcomes, begins)

    def _whole(self, readings: Readings, odometry: Odometry, least_moved: float = LEAST_MOVED) -> Refinement:
        """Return the trajectory of a drive whose odometry does not jump; one that moves it by less is not taken."""
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
        """Return the trajectory if walls stand at right angles to each other, or why there is none."""
        readings, odometry, windows, scans = drive
        walls, witness = self._heading(windows, scans)
        if walls is None:
            return _Attempt(Refinement(False, NO_WALLS, readings, odometry, {}), windows.node)

        def solver_of(heading: Heading) -> Solver:
            return Solver(odometry, windows, scans, heading, self._say)

        def left(reason: str, better: Gain) -> _Attempt:
            refused = Refinement(False, reason, readings, odometry, named, gain=better.mean)
            return _Attempt(refused, windows.node)

        solver = solver_of(walls)
        along = solver.along_walls()
        calibration = solver.calibration_of(along)
        simple = solver.simple(calibration)
        better = over_the_drive(scans, windows.node, simple, self._say('judgement'))
        said = _said(better)
        named = dict(zip(CALIBRATION, calibration.tolist(), strict=True))
        proven = better.sigmas >= LEAST_SIGMAS
        witnessed = witness > LEAST_WITNESS and better.sigmas >= LEAST_SIGMAS_WITH_WALLS
        # where walls stand at right angles along odometry as it is, that is the answer
        stands = differences(odometry, refined(odometry, windows, along.nodes))[0] < LEAST_MOVED
        unproven = left(said + NOT_ENOUGH, better)._replace(sure=stands)
        if not proven and not witnessed:
            if walls.certainty < LEAST_CERTAINTY:
                return _lost(drive, walls.certainty)
            if witness <= LEAST_WITNESS:
                return unproven
        found = solved(scans, walls, solver, along, solver_of)
        if found.certainty < LEAST_CERTAINTY:
            return _lost(drive, found.certainty)
        if found.solver is not solver:
            solver, simple = found.solver, found.solver.simple(found.solver.calibration_of(found.along))
        self._say('judgement')
        nodes = chosen(scans, simple, found.along.nodes, found.solution.nodes)
        if not proven:
            # places seen before tell wheels that are right over metres from those that are not, and walls that stand
            # askew from a yaw that is off; where odometry alone says that the robot came back, it need not be so
            again = came_back(scans, nodes)
            if not again and not witnessed:
                return unproven
            better = seen_again(scans, windows.node, nodes)
            said = f'with recognised places, {_said(better)}' if again else _said(better)
            if better.sigmas < (LEAST_SIGMAS if again else LEAST_SIGMAS_WITH_WALLS):
                return left(said + NOT_ENOUGH, better)._replace(sure=stands)
            if not again:
                said = (
                    f'with walls at right angles, the readings are more likely by {witness:.0f} nats than with '
                    f'odometry; {said}'
                )
        loops = found.loops if nodes is found.solution.nodes else []
        if nodes is found.solution.nodes:
            named = dict(zip(CALIBRATION, solver.calibration_of(found.solution).tolist(), strict=True))
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if moved < least_moved:
            return left(too_little_words(moved), better)._replace(sure=True)
        placed, noise = replaced(readings, odometry, trajectory), walls.drifts.noise
        outcome = Refinement(True, said, placed, trajectory, named, moved, turned, len(loops), better.mean, noise=noise)
        sure = recognised_part(scans, nodes, loops) >= LEAST_RECOGNISED and turned_right(scans, nodes)
        return _Attempt(outcome, nodes, sure)

    def _at_any_angle(self, drive: _Drive, by_walls: _Attempt, least_moved: float) -> Refinement:
        """Return the trajectory that matches alone say, if it is better than what walls at right angles say."""
        readings, odometry, windows, scans = drive
        known = by_walls.nodes if by_walls.refinement.accepted else None
        try:
            found = matched(odometry, scans, self._say, self._parameters.association.odometry_noise, known)
        except InputError:
            # its cells are of one size, so that a map of the whole drive may be too large though the maps are not
            found = None
        if found is None:
            return _stays(by_walls.refinement)
        nodes = found.nodes
        if known is not None and explained_better(scans, known, nodes).sigmas < LEAST_SIGMAS:
            return by_walls.refinement
        better = seen_again(scans, windows.node, nodes)
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if better.sigmas < LEAST_SIGMAS or moved < least_moved:
            return _stays(by_walls.refinement)
        again = 'with recognised places, ' if came_back(scans, nodes) else ''
        named = dict.fromkeys(CALIBRATION, 0.0) | {
            name: told.value for name, told in of_yaw(odometry, trajectory).items() if told.sigma <= MOST[name]
        }
        return Refinement(
            True,
            f'walls are not assumed to be at right angles; {again}{_said(better)}{_doubt(found.part)}',
            replaced(readings, odometry, trajectory),
            trajectory,
            named,
            moved,
            turned,
            len(found.loops),
            better.mean,
            right_angles=False,
        )

    def _say(self, stage: str) -> Callable[[float], None]:
        def progress(part: float) -> None:
            check(self._stop)
            self._watch(stage, part)

        progress(0.0)
        return progress

    def _heading(self, windows: Windows, scans: Scans) -> tuple[Heading | None, float]:
        """Return what walls say about the yaw, and the nats by which they say that odometry's is wrong."""
        self._say('directions of walls')
        told = self._parameters.association.odometry_noise
        noises = (told,) if told else NOISES
        found = heading(windows, *wall_votes(windows, scans.held_out), noises)
        if found is None:
            return None, 0.0
        # sensors have directions of their own, which vote with whatever ranges: a robot that drives and looks along
        # two axes seems to know of walls
        readings, rng = windows.readings, np.random.default_rng(0)
        drawn = np.where(readings.echo, rng.random(len(readings)) * readings.z_max, readings.z)
        by_chance = replace(windows, readings=replace(readings, z=drawn))
        chance = heading(by_chance, *wall_votes(by_chance, scans.held_out), noises)
        looks = 0.0 if chance is None else max(chance.over_odometry, 0.0)
        return found, found.over_odometry - looks


def without_times(readings: Readings, odometry: Odometry) -> str:
    """Return why odometry does not tell where each reading was taken; empty if it does."""
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
    """Return why a drive stays that is off by so little, metres."""
    return f'odometry is off by {moved:.2f} m, which is not more than the accuracy of sonar'


def lost_words(certainty: float) -> str:
    """Return why a drive stays whose heading is this certain."""
    return f'the heading was lost: the probability that it is not wrong by a right angle is only {certainty:.0%}'


def refined(odometry: Odometry, windows: Windows, nodes: Floats) -> Odometry:
    """Return the corrected odometry, which begins where odometry does."""
    w = windows
    pose = corrected(odometry.progress, odometry.pose, w.node_progress, w.node, nodes)
    home = compose(odometry.pose[0], inverse(pose[0]))
    pose = compose(home, pose)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Odometry(odometry.stamp, pose)


def _stays(found: Refinement) -> Refinement:
    """Return what walls said, after matches alone told nothing better."""
    return found if found.accepted else replace(found, reason=found.reason + NOR_MATCHES)


def _lost(drive: _Drive, certainty: float) -> _Attempt:
    refused = Refinement(False, lost_words(certainty), drive.readings, drive.odometry, {}, lost=True)
    return _Attempt(refused, drive.windows.node)


def _said(better: Gain) -> str:
    if not np.isfinite(better.error):
        return 'too few readings overlap with maps of other readings to compare the prediction with that of odometry'
    return f'readings are predicted {better.mean:+.3f} ± {better.error:.3f} nats a reading better than with odometry'


def _doubt(part: float) -> str:
    """Return what is to be said where this part of the blocks at places seen before is recognised."""
    if part >= LEAST_RECOGNISED:
        return ''
    return f'; {part:.0%} of the path through places seen before is recognised: the drive may be bent as a whole'


def _named(watch: Watch, name: str, stage: str, part: float) -> None:
    watch(name + stage, part)
