"""The trajectory from matching alone, for walls at any angle: scan matching, then matches of blocks and loop closures.

A bent trajectory has bent local maps, and few places are recognised on them. So blocks are matched and loops are closed
again with the result in place of odometry, as long as J of the map of the whole drive grows.

Local maps are scaled as the trajectory is, so matches confirm a wrong scale of the wheels. The map of the whole drive
does not: ranges are in metres, and walls are blurred if they do not agree with the way between the places they were
measured from. So the trajectory is scaled as a whole if J becomes clearly larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from ..common.readings import Floats
from .fitting import gain_of_fitted
from .holding_out import LEAST_SIGMAS, OTHERS, held_out
from .judging import gain_of_objective
from .loops import Loop
from .odometry_model import CALIBRATION, sensitivity
from .passes import Progress
from .pose_graph import solution_at
from .poses import relative, rms_after_alignment
from .relocating import LEAST_RECOGNISED, recognised_part
from .scan_matching import TRUSTS, Trust, scan_matched
from .scans import Scans
from .solving import SETTLED, MatchSolver
from .windows import Odometry

REMAINING_YAW_NOISE = math.radians(3.0)
"""σ of the yaw error after scan matching, and after each round, radians a √metre."""

ROUNDS = 4
"""Most rounds of matching and loop closing."""

SCALE_STEP, LEAST_STEPS, MOST_STEPS = 1.03, 0.5, 5
"""Factor from one scale to the next that is tried after the rounds, fewest steps by which the scale is changed, since J
is noisy, and number of steps at which the search ends without a result."""

WORTH_FITTING = 1.0
"""If J is larger at another scale by this many standard errors, and by less than `LEAST_SIGMAS`, both trajectories are
fitted before they are compared."""


NEARLY_ALL = 0.95
"""If so many of the blocks on an earlier visit are recognised, no other start is tried."""

AGREED = 0.15
"""Two starts agree if their trajectories differ by less than this, metres (rms after alignment, also of the size)."""


class MatchedDrive(NamedTuple):
    """The trajectory of a drive from matching alone.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
    loops : list of Loop
        Loop closures that it uses.
    value : float
        `Scans.objective` of the nodes, nats.
    part : float
        Fraction of the blocks on an earlier visit that are recognised.
    scans : Scans
        With the windows that were held out.
    agreed : bool
        Whether another start led to the same trajectory.
    """

    nodes: Floats
    loops: list[Loop]
    value: float
    part: float
    scans: Scans
    agreed: bool = False


def match_drive(
    odometry: Odometry,
    scans: Scans,
    start_stage: Callable[[str], Progress],
    noise: float = 0.0,
    known: Floats | None = None,
    start: Floats | None = None,
) -> MatchedDrive | None:
    """Return the trajectory of a drive from matching alone; None if its J is not larger than that of odometry.

    If the trajectory from walls is `known`, J must be larger than that of it as well. A search that got lost somewhere
    ends elsewhere after small changes. So unless nearly all places are recognised, it is repeated from other starts and
    with other windows held out, until two agree. J decides between them.

    Parameters
    ----------
    odometry : Odometry
    scans : Scans
    start_stage : callable
        Receives the name of a stage, and returns the callable that receives its progress.
    noise : float
        σ of the yaw error of odometry, radians a √metre; 0 if it is not known.
    known : float64, shape (K, 3), optional
        Nodes of the trajectory from walls.
    start : float64, shape (K, 3), optional
        Nodes of a trajectory from walls, from which matching starts if it recognises few places from those of scan
        matching.
    """
    best, value = None, scans.objective(scans.windows.node)
    if known is not None:
        value = max(value, scans.objective(known))
    least = value
    remaining = min(REMAINING_YAW_NOISE, noise or REMAINING_YAW_NOISE)

    def scan_matched_with(trust: Trust, scans: Scans = scans) -> Floats:
        return scan_matched(scans, trust._replace(yaw=noise or trust.yaw), start_stage('scan matching'))

    starts: list[tuple[Callable[[], Floats], bool]] = [(partial(scan_matched_with, trust), False) for trust in TRUSTS]
    if start is not None:
        starts.insert(1, (lambda: start, True))
    for make, from_walls in starts:
        # more trust in readings does not help if nothing had a larger J than odometry
        if make is starts[-1][0] and best is None:
            break
        # from walls, J may grow beyond that of the other start only in a later round
        beyond = least if from_walls else value
        found, reached = _match_repeatedly(odometry, scans, start_stage, make(), remaining, beyond)
        agreed = best is not None and _agree(best.nodes, reached)
        if found is not None and found.value > value:
            best, value = found, found.value
        if best is not None and (agreed or best.part >= NEARLY_ALL):
            return best._replace(agreed=agreed)
    for begin in OTHERS:
        if best is None or known is not None:
            break
        other = scans.with_held_out(held_out(len(scans.windows), begin))
        nodes, of_odometry = scan_matched_with(TRUSTS[0], other), other.objective(other.windows.node)
        found, reached = _match_repeatedly(odometry, other, start_stage, nodes, remaining, of_odometry)
        agreed = _agree(best.nodes, reached)
        if found is not None and _objective(scans, found.nodes) > value:
            best, value = found, scans.objective(found.nodes)
        if agreed or best.part >= NEARLY_ALL:
            return best._replace(agreed=agreed)
    return best


def _agree(nodes: Floats, others: Floats) -> bool:
    """Return whether two trajectories agree, apart from their size, which is changed last."""
    middle = others[:, :2].mean(0)
    spread = [float(np.square(each[:, :2] - each[:, :2].mean(0)).sum()) for each in (nodes, others)]
    sized = others.copy()
    sized[:, :2] = middle + math.sqrt(spread[0] / spread[1]) * (others[:, :2] - middle)
    return rms_after_alignment(nodes, sized) < AGREED


def _match_repeatedly(
    odometry: Odometry, scans: Scans, start_stage: Callable[[str], Progress], start: Floats, noise: float, least: float
) -> tuple[MatchedDrive | None, Floats]:
    """Return the best result of repeated matching, once more at another scale; None if J is at most `least`.

    And the nodes that were reached.
    """
    change = sensitivity(odometry, scans.windows)
    found, reached = _rounds(scans, start_stage, start, noise, change, least)
    if found is None:
        return None, reached
    scaled = _scaled(found, start_stage('scale'))
    if scaled is not found:
        # otherwise matches would undo a part of the change
        change[:, :, CALIBRATION.index('scale')] = 0.0
        again, _ = _rounds(scans, start_stage, scaled.nodes, noise, change, scaled.value, scaled.loops)
        found = _scaled(again or scaled, start_stage('scale'))
    return found, found.nodes


def _rounds(
    scans: Scans,
    start_stage: Callable[[str], Progress],
    start: Floats,
    noise: float,
    change: Floats,
    least: float,
    found_before: Sequence[Loop] = (),
) -> tuple[MatchedDrive | None, Floats]:
    """Return the best of some rounds of matching, each from the result before; None if J is at most `least`.

    And the nodes of the last round. With loop closures that were found before, the first search is near the poses that
    these give.
    """
    nodes, best = start, None
    for _ in range(ROUNDS):
        solver = MatchSolver(scans.windows, scans, start_stage, relative(nodes[:-1], nodes[1:]), noise, change)
        solution, loops = solver.with_matches(solution_at(nodes, len(CALIBRATION)), found_before)
        before, nodes, found_before = nodes, solution.nodes, ()
        value = _objective(scans, nodes)
        if value <= least:
            break
        best, least = MatchedDrive(nodes, loops, value, recognised_part(scans, nodes, loops), scans), value
        if best.part >= LEAST_RECOGNISED or rms_after_alignment(before, nodes) < SETTLED:
            break
    return best, nodes


def _objective(scans: Scans, nodes: Floats) -> float:
    """Return J of nodes, nats; −inf if the map along them would be too large."""
    try:
        return scans.objective(nodes)
    except InputError:
        return -math.inf


def _scaled(found: MatchedDrive, watch: Progress) -> MatchedDrive:
    """Return the drive at the scale of the largest J if that is clearly larger, otherwise `found` itself.

    A trajectory that was matched at one scale does not fit the map at another. So if J is larger, but not clearly, both
    are fitted to their own maps, and J of these decides.
    """
    nodes, scans = found.nodes, found.scans

    def at(steps: float) -> Floats:
        out = nodes.copy()
        out[:, :2] = nodes[0, :2] + SCALE_STEP**steps * (nodes[:, :2] - nodes[0, :2])
        return out

    values = {0: found.value, **{step: _objective(scans, at(step)) for step in (-1, 1)}}
    top = max(values, key=values.__getitem__)
    while top in (min(values), max(values)) and abs(top) < MOST_STEPS:
        beyond = top + int(np.sign(top))
        values[beyond] = _objective(scans, at(beyond))
        top = max(values, key=values.__getitem__)
    if top in (min(values), max(values)):
        return found
    before, here, after = (values[top + step] for step in (-1, 0, 1))
    curvature = 2.0 * here - before - after
    steps = top + 0.5 * (after - before) / curvature if 0.0 < curvature < math.inf else top
    if abs(steps) < LEAST_STEPS:
        return found
    scaled = at(steps)
    try:
        better = gain_of_objective(scans, nodes, scaled).sigmas
        if WORTH_FITTING <= better < LEAST_SIGMAS:
            better = gain_of_fitted(scans, nodes, scaled, watch).sigmas
    except InputError:
        # between the scales that were tried, or after fitting, the map may be some cells larger
        return found
    if better < LEAST_SIGMAS:
        return found
    # places lie in the frames of nodes, which are farther apart by the same factor
    loops = [replace(loop, matches=loop.matches.scaled(SCALE_STEP**steps)) for loop in found.loops]
    return found._replace(nodes=scaled, loops=loops, value=_objective(scans, scaled))
