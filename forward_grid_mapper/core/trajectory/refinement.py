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

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameters import Parameters
from ..common.readings import Readings
from ..runtime.cancelling import check
from .certainty import of_yaw
from .heading import NOISES, Heading, heading
from .holding_out import (
    FEWEST_BLOCKS,
    LEAST_SIGMAS,
    Gain,
    blocks_of,
    came_back,
    foreseen,
    gain,
    held_out,
    held_out_blocks,
)
from .hypotheses import solved
from .jumps import MOST_JUMPS, Part, begins_of, jumps, parts_at, with_yaw_anew, without_outliers
from .local_map import for_matching
from .loops import Loop
from .odometry_model import CALIBRATION, sensitivity
from .outcome import Refinement, differences, joined_parts, replaced, with_outliers
from .passes import BLOCK
from .pose_graph import solution_at
from .poses import Floats, compose, inverse, relative, wrapped
from .relocating import recognised_part
from .scan_matching import TRUSTS, Trust, scan_matched
from .scans import Scans
from .solving import MatchSolver, Solver
from .walls import wall_votes
from .windows import Odometry, Windows, corrected, cut

SHORTEST = 8.0
"""Metres of a drive below which nothing is refined: its drift is small, and there is little to judge it by."""

FEWEST_READINGS = 200

LEAST_ECHOES = 0.05
"""Part of the readings that must have an echo."""

LEAST_SENSORS = 2

SPAN = 6.0
"""Metres of progress before and after a block that the map is made of on which odometry is compared."""

JUDGED_ON, HELD_OUT = 60, 40
"""Blocks, and held-out windows, that trajectories are compared on at the most."""

LEAST_WITNESS, LEAST_SIGMAS_WITH_WALLS = 10.0, -1.0
"""Nats that the votes of walls must say against odometry's yaw, beyond what sensors say by where they look, to be a
witness of their own, and the standard errors that are then enough where the robot came to no place twice: readings must
not be foreseen worse. Little drift hardly shows in a few metres."""

MOST_WORSE = 1.0
"""Standard errors by which matching may foresee what was held out worse."""

LEAST_CERTAINTY = 0.9
"""Probability that the heading did not get lost by a right angle."""

LEAST_MOVED = 0.15
"""Metres that odometry must be off, in the root mean square: about the error of what takes its place."""

LEAST_RECOGNISED = 0.85
"""Part of the blocks where the robot was before that are recognised if walls do stand at right angles. Else the map is
bent somewhere, and matches alone may say more."""

TURNED, LEAST_SIGMAS_OF_TURNS = math.radians(8.0), 1.5
"""Radians by which odometry must turn otherwise within `SPAN` for readings to tell it, and by how many standard errors
they must then be foreseen better. Corners that are not square make it -4 to -6, drift 2 to 7."""

LEFT_BY_SCANS = math.radians(3.0)
"""By how much the yaw strays after scan matching, radians a √metre."""

NOT_ENOUGH = ': not enough to tell that odometry is off'

NO_WALLS = (
    'echoes do not agree on the directions of walls, so the drift of the yaw cannot be told: it takes walls at right '
    'angles to each other beside the robot, and odometry whose yaw holds for a few metres'
)

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
            reason = f'odometry jumps {len(jumped_to)} times: it is no wheel odometry, or messages are missing'
            return Refinement(False, reason, readings, odometry, {})
        jumped_to = with_yaw_anew(readings, odometry, jumped_to, self._parameters, self._stop)
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
        better = self._compare(scans, windows.node, simple)
        said = _said(better)
        named = dict(zip(CALIBRATION, calibration.tolist(), strict=True))
        proven = better.sigmas >= LEAST_SIGMAS
        witnessed = witness > LEAST_WITNESS and better.sigmas >= LEAST_SIGMAS_WITH_WALLS
        unproven = left(said + NOT_ENOUGH, better)
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
        nodes = self._choose(scans, simple, found.along.nodes, found.solution.nodes)
        if not proven:
            # places seen before tell wheels that are right over metres from those that are not, and walls that stand
            # askew from a yaw that is off; where odometry alone says that the robot came back, it need not be so
            again = came_back(scans, nodes)
            if not again and not witnessed:
                return unproven
            better = self._seen_again(scans, windows.node, nodes)
            said = f'with places seen before, {_said(better)}' if again else _said(better)
            if better.sigmas < (LEAST_SIGMAS if again else LEAST_SIGMAS_WITH_WALLS):
                return left(said + NOT_ENOUGH, better)
            if not again:
                said = f'that walls stand at right angles is likelier by {witness:.0f} nats than with odometry; {said}'
        if nodes is found.solution.nodes:
            named = dict(zip(CALIBRATION, solver.calibration_of(found.solution).tolist(), strict=True))
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if moved < least_moved:
            return left(too_little_words(moved), better)._replace(sure=True)
        placed, noise = replaced(readings, odometry, trajectory), walls.drifts.noise
        outcome = Refinement(
            True, said, placed, trajectory, named, moved, turned, len(found.loops), better.mean, noise=noise
        )
        sure = recognised_part(scans, nodes, found.loops) >= LEAST_RECOGNISED and self._turned_right(scans, nodes)
        return _Attempt(outcome, nodes, sure)

    def _at_any_angle(self, drive: _Drive, by_walls: _Attempt, least_moved: float) -> Refinement:
        """Return the trajectory that matches alone say, if it is better than what walls at right angles say."""
        readings, odometry, windows, scans = drive
        tried = [found for found in (self._matched(drive, trust) for trust in TRUSTS) if found is not None]
        if not tried:
            return by_walls.refinement
        nodes, loops = tried[0]
        for other, seen in tried[1:]:
            if self._seen_again(scans, nodes, other).mean > 0.0:
                nodes, loops = other, seen
        better = self._seen_again(scans, windows.node, nodes)
        trajectory = refined(odometry, windows, nodes)
        moved, turned = differences(odometry, trajectory)
        if better.sigmas < LEAST_SIGMAS or moved < least_moved:
            return by_walls.refinement
        if by_walls.refinement.accepted and self._seen_again(scans, by_walls.nodes, nodes).mean <= 0.0:
            return by_walls.refinement
        named = dict.fromkeys(CALIBRATION, 0.0) | {
            name: told.value for name, told in of_yaw(odometry, trajectory).items()
        }
        return Refinement(
            True,
            f'walls are not taken to stand at right angles; with places seen before, {_said(better)}',
            replaced(readings, odometry, trajectory),
            trajectory,
            named,
            moved,
            turned,
            len(loops),
            better.mean,
            right_angles=False,
        )

    def _matched(self, drive: _Drive, trust: Trust) -> tuple[Floats, list[Loop]] | None:
        """Return the nodes that matches alone say, and the loops among them; None if scan matching gains nothing."""
        windows, scans = drive.windows, drive.scans
        start, blocks = scan_matched(scans, trust, self._say('scan matching')), held_out_blocks(scans, len(windows))
        if gain(*(foreseen(scans, nodes, blocks, SPAN) for nodes in (windows.node, start))).mean <= 0.0:
            return None
        change = sensitivity(drive.odometry, windows)
        solver = MatchSolver(windows, scans, self._say, relative(start[:-1], start[1:]), LEFT_BY_SCANS, change)
        solution, loops = solver.with_matches(solution_at(start, len(CALIBRATION)))
        return solution.nodes, loops

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

    def _compare(self, scans: Scans, before: Floats, after: Floats) -> Gain:
        """Return by how much one trajectory foresees readings better than another, all over the drive."""
        say = self._say('judgement')
        blocks = blocks_of(len(before), BLOCK, JUDGED_ON)
        # places of another time are left out: where they overlap by half they contradict, far apart they say nothing
        one = foreseen(scans, before, blocks, SPAN)
        say(0.5)
        return gain(one, foreseen(scans, after, blocks, SPAN))

    def _turned_right(self, scans: Scans, nodes: Floats) -> bool:
        """Return whether readings are foreseen better where these nodes turn within a few metres as odometry does not.

        A robot that goes around a corner which is not square looks as if its odometry were off by as much.
        """
        windows = scans.windows
        blocks = blocks_of(len(windows), BLOCK, len(windows))
        by = np.array([_turned(windows, nodes, block[len(block) // 2]) for block in blocks])
        chosen = [blocks[k] for k in np.sort(np.argsort(-by, kind='stable')[:JUDGED_ON]) if by[k] > TURNED]
        if len(chosen) < FEWEST_BLOCKS:
            return True
        return (
            gain(*(foreseen(scans, each, chosen, SPAN) for each in (windows.node, nodes))).sigmas
            > LEAST_SIGMAS_OF_TURNS
        )

    def _seen_again(self, scans: Scans, before: Floats, after: Floats) -> Gain:
        """Return by how much what was held out is foreseen better on maps of all times that the robot came by."""
        # it is the only proof, so all that was held out has a say
        blocks = held_out_blocks(scans, len(before))
        return gain(foreseen(scans, before, blocks), foreseen(scans, after, blocks))

    def _choose(self, scans: Scans, first: Floats, *others: Floats) -> Floats:
        """Return the last nodes that do not foresee what was held out from them worse than those before."""
        self._say('judgement')
        blocks = held_out_blocks(scans, HELD_OUT)
        best, seen = first, foreseen(scans, first, blocks)
        for nodes in others:
            now = foreseen(scans, nodes, blocks)
            if gain(seen, now).sigmas > -MOST_WORSE:
                best, seen = nodes, now
        return best


def _turned(windows: Windows, nodes: Floats, middle: int) -> float:
    """Return by how much nodes turn, radians, within `SPAN` about one of them, beyond what odometry has."""
    near = np.flatnonzero(np.abs(windows.node_progress - windows.node_progress[middle]) <= SPAN / 2)[[0, -1]]
    return float(abs(wrapped(np.diff(nodes[near, 2] - windows.node[near, 2])[0])))


def without_times(readings: Readings, odometry: Odometry) -> str:
    """Return why odometry does not tell where each reading was taken; empty if it does."""
    if not len(odometry.stamp):
        return 'the poses of odometry are not at hand, as in a journal'
    early, late = readings.stamp.min(initial=odometry.stamp[0]), readings.stamp.max(initial=odometry.stamp[-1])
    if early < odometry.stamp[0] or late > odometry.stamp[-1]:
        return "there are readings of a time that has no odometry, as where odometry's clock jumped"
    return ''


def unfit(readings: Readings, odometry: Odometry) -> str:
    """Return why a drive cannot be refined; empty if it can."""
    if reason := without_times(readings, odometry):
        return reason
    if len(odometry.stamp) < 2 or odometry.travel[-1] < SHORTEST:
        return (
            f'the drive is {odometry.travel[-1]:.1f} m long; from {SHORTEST:g} m on odometry drifts enough to be told'
        )
    if len(readings) < FEWEST_READINGS:
        return f'there are {len(readings)} readings; it takes {FEWEST_READINGS}'
    if readings.echo.mean() < LEAST_ECHOES:
        return f'only {readings.echo.mean():.0%} of the readings have an echo'
    if len(np.unique(readings.sensor)) < LEAST_SENSORS:
        return 'there is one sensor only, which cannot tell a turn from a step aside'
    return ''


def too_little_words(moved: float) -> str:
    """Return why a drive stays that is off by so little, metres."""
    return f'odometry is off by {moved:.2f} m, which is no more than sonar can tell'


def lost_words(certainty: float) -> str:
    """Return why a drive stays whose heading is this certain."""
    return f'the heading was lost somewhere: that it is not off by a right angle is only {certainty:.0%} certain'


def refined(odometry: Odometry, windows: Windows, nodes: Floats) -> Odometry:
    """Return the corrected odometry, which begins where odometry does."""
    w = windows
    pose = corrected(odometry.progress, odometry.pose, w.node_progress, w.node, nodes)
    home = compose(odometry.pose[0], inverse(pose[0]))
    pose = compose(home, pose)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Odometry(odometry.stamp, pose)


def _lost(drive: _Drive, certainty: float) -> _Attempt:
    refused = Refinement(False, lost_words(certainty), drive.readings, drive.odometry, {}, lost=True)
    return _Attempt(refused, drive.windows.node)


def _said(better: Gain) -> str:
    return f'readings are foreseen {better.mean:+.3f} ± {better.error:.3f} nats a reading better than with odometry'


def _named(watch: Watch, name: str, stage: str, part: float) -> None:
    watch(name + stage, part)
