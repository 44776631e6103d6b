"""SLAM with walls at right angles to each other: the heading from walls, then matching, then the judgement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from ..common.readings import Floats
from .attempt import ACCURACY, CONTRADICTED, EXACT, UNMATCHED, Attempt, Drive, gain_words, refined
from .corners import turns_supported, with_likeliest_turns
from .folds import accepted_in_folds
from .heading import NOISES, Heading, heading
from .holding_out import LEAST_SIGMAS, Gain, has_revisits, tears_apart
from .hypotheses import Solved, solve_hypotheses
from .judging import (
    gain_at_revisits,
    gain_of_objective,
    gain_over_drive,
    gain_within_visits,
    is_worse_nearby,
    last_not_worse,
)
from .loops import Loop
from .odometry_model import CALIBRATION
from .outcome import Differences, Refinement, differences, replaced
from .passes import Progress
from .pose_graph import Solution
from .poses import rms_after_alignment
from .relocating import confirmed_by_places, fits_earlier_visits, recognised
from .repeated_errors import BENT, are_walls_bent
from .scans import Scans
from .solving import SETTLED, Solver
from .walls import wall_votes
from .windows import Windows

LEAST_VOTE_GAIN, LEAST_SIGMAS_WITH_WALLS = 10.0, -1.0
"""If votes of walls are likelier by this many nats than with the yaw of odometry, beyond what random ranges give, and
the robot came back to no place, the gain in predicting readings need only be this many standard errors: readings must
not be predicted worse. Small drift hardly shows within a few metres."""

WORTH_MATCHING = 1.0
"""Standard errors by which readings must be predicted better along straight walls, where the robot came back, for a
drive to be matched although nothing else shows that odometry is wrong."""

ROUNDS = 3
"""Most times that the drive is matched again if readings do not show that odometry is wrong."""

FEWEST_RECOGNISED = 3
"""Fewest blocks on earlier visits that are recognised if votes suffice for a drive that comes back to places."""

LEAST_CERTAINTY = 0.9
"""Least probability that no right angle of the heading was lost."""

NOT_ENOUGH = ': this does not show that odometry is wrong'

NO_WALLS = (
    'the echoes do not agree on directions of walls: this needs walls at right angles to each other beside the robot, '
    'and odometry with an accurate yaw over a few metres'
)


class _AlongWalls(NamedTuple):
    """What walls at right angles give before anything is matched.

    Attributes
    ----------
    heading : Heading
    vote_gain : float
        By how many nats votes of walls are likelier than with the yaw of odometry, beyond what random ranges give.
    solver : Solver
        Of this heading.
    along : Solution
        By odometry and straight walls.
    calibration : dict
        Of `along`.
    simple : float64, shape (K, 3)
        Nodes of odometry with only the heading and this calibration applied.
    gain : Gain
        That of `simple` over odometry.
    """

    heading: Heading
    vote_gain: float
    solver: Solver
    along: Solution
    calibration: dict[str, float]
    simple: Floats
    gain: Gain

    @property
    def proven(self) -> bool:
        """Whether readings all over the drive are predicted better."""
        return self.gain.sigmas >= LEAST_SIGMAS

    @property
    def votes_suffice(self) -> bool:
        """Whether votes of walls are enough evidence, since readings are not predicted worse."""
        return self.vote_gain > LEAST_VOTE_GAIN and self.gain.sigmas >= LEAST_SIGMAS_WITH_WALLS

    @property
    def verdict(self) -> _Verdict:
        """The judgement by readings all over the drive."""
        return _Verdict(self.proven, self.gain, gain_words(self.gain))


class _Verdict(NamedTuple):
    """Whether a trajectory is accepted in place of odometry, its gain over odometry, and the reason in words.

    `by_votes` is as in `Attempt`.
    """

    accepted: bool
    gain: Gain
    words: str
    by_votes: bool = False


class _Candidate(NamedTuple):
    """Nodes to be judged, shape (K, 3), the calibration, and the loop closures that they fulfil.

    `matched` is whether they come from scan matching and loop closures, too, and not from walls alone.
    """

    nodes: Floats
    calibration: dict[str, float]
    loops: list[Loop]
    matched: bool = True


def at_right_angles(
    drive: Drive,
    odometry_noise: float,
    least: Differences,
    start_stage: Callable[[str], Progress],
    odometry_is_wrong: bool = False,
) -> Attempt:
    """Return the trajectory with walls at right angles to each other, or why there is none.

    Parameters
    ----------
    drive : Drive
    odometry_noise : float
        The parameter of this name; 0 to estimate it.
    least : Differences
        An accepted trajectory differs from odometry by more.
    start_stage : callable
        Receives the name of a stage, and returns the callable that receives its progress.
    odometry_is_wrong : bool
        Whether this is known, so that the trajectory need not show it.
    """
    found_heading, vote_gain = heading_of_walls(
        drive.windows, drive.scans, odometry_noise, start_stage('directions of walls')
    )
    if found_heading is None:
        return _kept(drive, NO_WALLS)
    solver_of = partial(_solver_of, drive, start_stage)
    walls = _along_walls(drive, found_heading, vote_gain, solver_of(found_heading), start_stage)
    # matching takes most of the time, and is left out if nothing supports its result
    if not (walls.proven or walls.votes_suffice or odometry_is_wrong):
        if walls.heading.certainty < LEAST_CERTAINTY:
            return _heading_lost(drive, walls.heading.certainty, odometry_noise)._replace(start=walls.along.nodes)
        if walls.vote_gain <= LEAST_VOTE_GAIN and not _may_be_proven_at_revisits(drive, walls, start_stage):
            return _unproven(drive, walls, walls.verdict)._replace(before_matching=True)
    found = solve_hypotheses(drive.scans, walls.heading, walls.solver, walls.along, solver_of)
    if found.certainty < LEAST_CERTAINTY:
        return _heading_lost(drive, found.certainty, odometry_noise)._replace(start=found.solution.nodes)
    watch = start_stage('judgement')
    best, verdict = _judged(drive, walls, found, watch)
    attempt = _accepted(drive, best, verdict, walls.heading.drifts.noise, least)
    # a trajectory that hardly differs from odometry would be refused anyway
    unproven = attempt.refinement.accepted and not verdict.accepted
    if unproven and (further := _matched_further(drive.scans, found)) is not found:
        best, verdict = _judged(drive, walls, further, watch)
        attempt = _accepted(drive, best, verdict, walls.heading.drifts.noise, least)
    # bent walls are refused whatever the readings say, and matching may start from them
    if verdict.accepted or odometry_is_wrong or attempt.start is not None:
        return attempt
    if not attempt.refinement.accepted:
        return _unproven(drive, walls, verdict)
    if (proven := proven_in_folds(drive, attempt, odometry_noise, start_stage)) is not None:
        return proven
    start = None if tears_apart(drive.scans, drive.windows.node, attempt.nodes) else start_from(drive.scans, attempt)
    return _unproven(drive, walls, verdict)._replace(unproven=attempt, start=start)


def start_from(scans: Scans, attempt: Attempt) -> Floats:
    """Return the nodes of an attempt, from which matching alone may start, with the likeliest turns if need be."""
    return with_likeliest_turns(scans, attempt.nodes) if attempt.turns_contradicted else attempt.nodes


def proven_in_folds(
    drive: Drive, attempt: Attempt, odometry_noise: float, start_stage: Callable[[str], Progress]
) -> Attempt | None:
    """Return the trajectory with walls if other held-out windows show that odometry is wrong; otherwise None.

    `attempt` is the one that does not show it; the other parameters are those of `at_right_angles`.
    """

    def solve(other: Drive) -> Attempt:
        return at_right_angles(other, odometry_noise, EXACT, start_stage, odometry_is_wrong=True)

    return accepted_in_folds(drive, attempt, solve)


def heading_of_walls(
    windows: Windows, scans: Scans, odometry_noise: float, watch: Progress = lambda part: None
) -> tuple[Heading | None, float]:
    """Return the heading from walls, and by how many nats votes are likelier than with the yaw of odometry.

    The same gain of random ranges is subtracted.
    """
    noises = (odometry_noise,) if odometry_noise else NOISES
    found = heading(windows, *wall_votes(windows, scans.held_out), noises)
    if found is None:
        return None, 0.0
    watch(0.5)
    # a robot that drives and looks along two axes gets votes for these even with random ranges
    readings, rng = windows.readings, np.random.default_rng(0)
    drawn = np.where(readings.echo, rng.random(len(readings)) * readings.z_max, readings.z)
    randomised = replace(windows, readings=replace(readings, z=drawn))
    chance = heading(randomised, *wall_votes(randomised, scans.held_out), noises)
    gain_by_chance = 0.0 if chance is None else max(chance.over_odometry, 0.0)
    return found, found.over_odometry - gain_by_chance


def _solver_of(drive: Drive, start_stage: Callable[[str], Progress], heading: Heading) -> Solver:
    return Solver(drive.odometry, drive.windows, drive.scans, heading, start_stage)


def _along_walls(
    drive: Drive, heading: Heading, vote_gain: float, solver: Solver, start_stage: Callable[[str], Progress]
) -> _AlongWalls:
    """Solve a drive along straight walls, and compare it with odometry."""
    along = solver.along_walls()
    calibration = solver.calibration_of(along)
    simple = solver.simple(calibration)
    better = gain_over_drive(drive.scans, drive.windows.node, simple, start_stage('judgement'))
    return _AlongWalls(heading, vote_gain, solver, along, _by_name(calibration), simple, better)


def _may_be_proven_at_revisits(drive: Drive, walls: _AlongWalls, start_stage: Callable[[str], Progress]) -> bool:
    """Return whether straight walls alone predict readings better where the robot came back along them.

    Wheels that are good over metres are off by more after a whole drive, and only revisits show it.
    """
    scans, nodes = drive.scans, walls.along.nodes
    if not has_revisits(scans, nodes):
        return False
    return gain_at_revisits(scans, drive.windows.node, nodes, start_stage('judgement')).sigmas >= WORTH_MATCHING


def _matched_further(scans: Scans, found: Solved) -> Solved:
    """Return the drive matched again from its solution, as long as J grows and nodes move."""
    try:
        value = scans.objective(found.solution.nodes)
        for _ in range(ROUNDS):
            solution, loops = found.solver.with_matches(found.solution)
            now = scans.objective(solution.nodes)
            if now <= value:
                break
            moved = rms_after_alignment(found.solution.nodes, solution.nodes)
            found, value = replace(found, solution=solution, loops=loops), now
            if moved < SETTLED:
                break
    except InputError:
        # at the cell size of matching, the map of the whole drive may be too large although the final maps are not
        pass
    return found


def _judged(drive: Drive, walls: _AlongWalls, found: Solved, watch: Progress) -> tuple[_Candidate, _Verdict]:
    """Return the best nodes of a solved drive, and the judgement."""
    best = _best_of(drive, walls, found)
    return best, walls.verdict if walls.proven else _at_revisits(drive, walls, best, watch)


def _best_of(drive: Drive, walls: _AlongWalls, found: Solved) -> _Candidate:
    """Return the solution with matches, or the one before it that predicts held-out readings better."""
    solver, simple = found.solver, walls.simple
    if solver is not walls.solver:
        simple = solver.simple(solver.calibration_of(found.along))
    nodes = last_not_worse(drive.scans, simple, found.along.nodes, found.solution.nodes)
    if nodes is found.solution.nodes:
        return _Candidate(nodes, _by_name(solver.calibration_of(found.solution)), found.loops)
    return _Candidate(nodes, walls.calibration, [], matched=False)


def _kept(
    drive: Drive, reason: str, calibration: Mapping[str, float] | None = None, gain: float = 0.0, sure: bool = False
) -> Attempt:
    """Return odometry as it is."""
    refused = Refinement(False, reason, drive.readings, drive.odometry, dict(calibration or {}), gain=gain)
    return Attempt(refused, drive.windows.node, sure)


def _heading_lost(drive: Drive, certainty: float, odometry_noise: float) -> Attempt:
    """Return odometry, since the heading is only this certain."""
    reason = f'the heading was lost: it may be wrong by a right angle (probability {1.0 - certainty:.0%})'
    if not odometry_noise:
        reason += '; if you know the random error of the yaw of odometry, set odometry_noise'
    refused = Refinement(False, reason, drive.readings, drive.odometry, {}, lost=True)
    return Attempt(refused, drive.windows.node)


def _unproven(drive: Drive, walls: _AlongWalls, verdict: _Verdict) -> Attempt:
    """Return odometry, since nothing shows that it is wrong."""
    along = refined(drive.odometry, drive.windows, walls.along.nodes)
    off = differences(drive.odometry, along)
    # if walls agree with odometry, other methods need not be tried
    agrees, reason = off.within(ACCURACY), verdict.words + NOT_ENOUGH
    if walls.vote_gain > LEAST_VOTE_GAIN and not agrees:
        reason += f', but it is off by {off.moved:.1f} m (root mean square) if all walls are at right angles'
    return _kept(drive, reason, walls.calibration, verdict.gain.mean, agrees)


def _at_revisits(drive: Drive, walls: _AlongWalls, best: _Candidate, watch: Progress) -> _Verdict:
    """Judge refined nodes where the robot came back, or by votes of walls.

    Revisits show drift over the whole drive, and walls that are not parallel. Whether the robot came back is decided
    along the refined nodes, since by odometry it may be wrong. But votes do not suffice if the robot comes back to
    places by odometry and to none along the refined nodes: the walls of a corridor around a hall can be taken for
    straight ones. Then readings must be predicted better within a few metres. If it comes back along the refined
    nodes, votes suffice if the places are recognised.
    """
    revisited = has_revisits(drive.scans, best.nodes)
    if not revisited and not walls.votes_suffice:
        return walls.verdict
    better = gain_at_revisits(drive.scans, drive.windows.node, best.nodes, watch)
    if tears_apart(drive.scans, drive.windows.node, best.nodes):
        nearby = gain_within_visits(drive.scans, drive.windows.node, best.nodes, watch)
        return _nearby(nearby) if _is_proven_nearby(nearby, better) else walls.verdict
    words = gain_words(better)
    if revisited:
        words, proven = f'where the robot came back, {words}', better.sigmas >= LEAST_SIGMAS
        nearby = gain_within_visits(drive.scans, drive.windows.node, best.nodes, watch)
        if is_worse_nearby(nearby, better):
            return _Verdict(False, better, f'{words}; within a few metres, they are predicted clearly worse')
        if not proven and _is_proven_nearby(nearby, better):
            return _nearby(nearby)
        if proven or not (walls.votes_suffice and _is_recognised(drive.scans, best)):
            return _Verdict(proven, better, words)
    if better.sigmas < LEAST_SIGMAS_WITH_WALLS:
        return _Verdict(False, better, words)
    likelier = f'the readings are more likely by {walls.vote_gain:.0f} nats than with odometry'
    return _Verdict(True, better, f'with walls at right angles, {likelier}; {words}', by_votes=True)


def _is_proven_nearby(nearby: Gain, everywhere: Gain) -> bool:
    """Return whether gains on maps of the few metres around and of all visits show that odometry is wrong."""
    return nearby.sigmas >= LEAST_SIGMAS and everywhere.sigmas >= LEAST_SIGMAS_WITH_WALLS


def _nearby(nearby: Gain) -> _Verdict:
    """Return the judgement by readings within a few metres that show that odometry is wrong."""
    return _Verdict(True, nearby, f'within a few metres, {gain_words(nearby)}')


def _is_recognised(scans: Scans, best: _Candidate) -> bool:
    """Return whether enough places are recognised along nodes to confirm them."""
    return len(recognised(best.loops)) >= FEWEST_RECOGNISED and confirmed_by_places(scans, best.nodes, best.loops)


def _accepted(drive: Drive, best: _Candidate, verdict: _Verdict, noise: float, least: Differences) -> Attempt:
    """Return the trajectory of nodes that are better than odometry; odometry if that is hardly off."""
    readings, odometry, windows, scans = drive
    trajectory = refined(odometry, windows, best.nodes)
    off = differences(odometry, trajectory)
    if off.within(least):
        reason = f'odometry is off by {off.moved:.2f} m, which is not more than the accuracy of sonar'
        return _kept(drive, reason, best.calibration, verdict.gain.mean, sure=True)
    if are_walls_bent(windows, best.nodes):
        return _kept(drive, BENT, gain=verdict.gain.mean)._replace(start=best.nodes)
    contradicted = not turns_supported(scans, best.nodes)
    words = verdict.words if best.matched else verdict.words + UNMATCHED
    outcome = Refinement(
        True,
        words + CONTRADICTED if contradicted else words,
        replaced(readings, odometry, trajectory),
        trajectory,
        best.calibration,
        *off,
        len(best.loops),
        verdict.gain.mean,
        noise=noise,
    )
    sure = not contradicted and fits_earlier_visits(scans, best.nodes, best.loops)
    sure = sure and not (verdict.by_votes and _has_smaller_objective(drive, best.nodes))
    return Attempt(outcome, best.nodes, sure, verdict.by_votes, matched=best.matched, turns_contradicted=contradicted)


def _has_smaller_objective(drive: Drive, nodes: Floats) -> bool:
    """Return whether J is clearly smaller than with odometry, although the trajectory was fitted to the readings."""
    try:
        return gain_of_objective(drive.scans, drive.windows.node, nodes).sigmas <= -LEAST_SIGMAS
    except InputError:
        # the map along this trajectory is too large
        return True


def _by_name(calibration: Floats) -> dict[str, float]:
    return dict(zip(CALIBRATION, calibration.tolist(), strict=True))
