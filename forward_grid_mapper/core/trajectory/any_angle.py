"""The trajectory from matching alone, for walls at any angle: scan matching, then matches of blocks and loop closures.

A bent trajectory has bent local maps, and few places are recognised on them. So blocks are matched and loops are closed
again with the result in place of odometry, as long as J of the map of the whole drive grows.

Matches confirm a wrong scale of the wheels. So the trajectory is scaled as a whole if readings show it (`scale`).
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
from .holding_out import OTHERS, held_out
from .loops import Loop
from .odometry_model import CALIBRATION, log_likelihood_of_yaw, sensitivity
from .passes import Progress
from .pose_graph import solution_at
from .poses import relative, rms_after_alignment
from .relocating import LEAST_RECOGNISED, recognised_part
from .scale import at_likeliest_scale, enlarged
from .scan_matching import TRUSTS, Trust, scan_matched
from .scans import Scans
from .solving import SETTLED, MatchSolver
from .windows import Odometry

REMAINING_YAW_NOISE, SMALL_YAW_NOISE = math.radians(3.0), math.radians(1.0)
"""σ of the yaw error after scan matching, and after each round, radians a √metre; and that of good odometry."""

ROUNDS = 4
"""Most rounds of matching and loop closing."""

NEARLY_ALL = 0.95
"""If so many of the blocks on an earlier visit are recognised, no other start is tried, except one from walls."""

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
    noise : float
        σ of the yaw of the start, radians a √metre.
    agreed : bool
        Whether another start led to the same trajectory.
    """

    nodes: Floats
    loops: list[Loop]
    value: float
    part: float
    scans: Scans
    noise: float = REMAINING_YAW_NOISE
    agreed: bool = False


class Start(NamedTuple):
    """Nodes from which matching starts, and the noise of the yaw that they have, radians a √metre."""

    nodes: Callable[[], Floats]
    noise: float


def match_drive(
    odometry: Odometry,
    scans: Scans,
    start_stage: Callable[[str], Progress],
    noise: float = 0.0,
    known: Floats | None = None,
    start: Floats | None = None,
) -> MatchedDrive | None:
    """Return the trajectory of a drive from matching alone; None if its J is not larger than that of odometry.

    If a trajectory is `known`, J must be larger than that of it as well. A search that got lost somewhere ends
    elsewhere after small changes. So unless nearly all places are recognised, it is repeated from other starts and with
    other windows held out, until two agree. J decides between them, with the likelihood of odometry. If there is a
    trajectory from walls, it is always one of the starts: on a bent trajectory, all places may be recognised.

    Parameters
    ----------
    odometry : Odometry
    scans : Scans
    start_stage : callable
        Receives the name of a stage, and returns the callable that receives its progress.
    noise : float
        σ of the yaw error of odometry, radians a √metre; 0 if it is not known.
    known : float64, shape (K, 3), optional
        Nodes of an accepted trajectory from walls whose corners are not contradicted.
    start : float64, shape (K, 3), optional
        Nodes of a trajectory from walls, from which matching starts, too.
    """
    remaining = min(REMAINING_YAW_NOISE, noise or REMAINING_YAW_NOISE)
    change = sensitivity(odometry, scans.windows)
    least = -math.inf if known is None else scans.objective(known)
    enough = max(scans.objective(scans.windows.node), least)

    def scan_matched_with(trust: Trust, scans: Scans = scans) -> Floats:
        return scan_matched(scans, trust._replace(yaw=noise or trust.yaw), start_stage('scan matching'))

    def finished(best: MatchedDrive, agreed: bool = False) -> MatchedDrive:
        return _at_likeliest_scale(best, start_stage, change)._replace(agreed=agreed)

    usual, trusting = (Start(partial(scan_matched_with, trust), remaining) for trust in TRUSTS)
    from_walls = [] if start is None else [Start(lambda: start, remaining)]
    # an accepted trajectory shows that odometry is wrong
    from_odometry = [] if known is not None else [Start(lambda: scans.windows.node, min(SMALL_YAW_NOISE, remaining))]
    likeliest = log_likelihood_of_yaw(scans.windows, scans.windows.node)
    best, value = None, -math.inf
    for begin in (usual, *from_walls, *from_odometry, trusting):
        # more trust in readings does not help if nothing had a larger J than odometry
        if begin is trusting and best is None:
            return None
        # from odometry, only one round is made if its J could not be the best even with the largest likelihood
        beyond = value - likeliest if begin in from_odometry else least
        found = _rounds(scans, start_stage, begin.nodes(), begin.noise, change, beyond)
        agreed = best is not None and _agree(best.nodes, found.nodes)
        if found.value > enough and (score := _score(scans, found)) > value:
            best, value = found, score
        walls_come_next = bool(from_walls) and begin is usual
        if best is not None and not walls_come_next and (agreed or best.part >= NEARLY_ALL):
            return finished(best, agreed)
    assert best is not None
    for fold in OTHERS if known is None else ():
        other = scans.with_held_out(held_out(len(scans.windows), fold))
        of_odometry = other.objective(other.windows.node)
        found = _rounds(other, start_stage, scan_matched_with(TRUSTS[0], other), remaining, change)
        agreed = _agree(best.nodes, found.nodes)
        if found.value > of_odometry and (score := _score(scans, found)) > value:
            best, value = found, score
        if agreed or best.part >= NEARLY_ALL:
            return finished(best, agreed)
    return finished(best)


def _score(scans: Scans, found: MatchedDrive) -> float:
    """Return J of a trajectory and the log-likelihood of odometry, nats.

    A bent corridor may look straight to few sonars, and J may even be larger along it. But then odometry must have
    made large errors.
    """
    value = found.value if found.scans is scans else _objective(scans, found.nodes)
    return value + log_likelihood_of_yaw(scans.windows, found.nodes)


def _agree(nodes: Floats, others: Floats) -> bool:
    """Return whether two trajectories agree, apart from their size, which is changed last."""
    middle = others[:, :2].mean(0)
    spread = [float(np.square(each[:, :2] - each[:, :2].mean(0)).sum()) for each in (nodes, others)]
    return rms_after_alignment(nodes, enlarged(others, middle, math.sqrt(spread[0] / spread[1]))) < AGREED


def _rounds(
    scans: Scans,
    start_stage: Callable[[str], Progress],
    start: Floats,
    noise: float,
    change: Floats,
    least: float = -math.inf,
    found_before: Sequence[Loop] = (),
) -> MatchedDrive:
    """Return the best of some rounds of matching, each from the result before, as long as J grows beyond `least`.

    With loop closures that were found before, the first search is near the poses that these give.
    """
    nodes, best = start, None
    for _ in range(ROUNDS):
        solver = MatchSolver(scans.windows, scans, start_stage, relative(nodes[:-1], nodes[1:]), noise, change)
        solution, loops = solver.with_matches(solution_at(nodes, len(CALIBRATION)), found_before)
        before, nodes, found_before = nodes, solution.nodes, ()
        value = _objective(scans, nodes)
        if best is not None and value <= best.value:
            break
        best = MatchedDrive(nodes, loops, value, recognised_part(scans, nodes, loops), scans, noise)
        if value <= least or best.part >= LEAST_RECOGNISED or rms_after_alignment(before, nodes) < SETTLED:
            break
    assert best is not None
    return best


def _at_likeliest_scale(found: MatchedDrive, start_stage: Callable[[str], Progress], change: Floats) -> MatchedDrive:
    """Return the drive at the scale that readings show, matched once more there; `found` itself if it is right."""
    nodes, factor = at_likeliest_scale(found.scans, found.nodes, start_stage('scale'))
    if factor == 1.0:
        return found
    # places lie in the frames of nodes, which are farther apart by the same factor
    loops = [replace(loop, matches=loop.matches.scaled(factor)) for loop in found.loops]
    part = recognised_part(found.scans, nodes, loops)
    scaled = found._replace(nodes=nodes, loops=loops, value=_objective(found.scans, nodes), part=part)
    # otherwise matches would undo a part of the change
    change = change.copy()
    change[:, :, CALIBRATION.index('scale')] = 0.0
    again = _rounds(found.scans, start_stage, nodes, found.noise, change, found_before=loops)
    return max(scaled, again, key=partial(_score, found.scans))


def _objective(scans: Scans, nodes: Floats) -> float:
    """Return J of nodes, nats; −inf if the map along them would be too large."""
    try:
        return scans.objective(nodes)
    except InputError:
        return -math.inf
