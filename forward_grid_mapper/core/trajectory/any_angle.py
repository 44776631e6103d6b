"""The trajectory that matches alone say, whatever the directions of walls: scan matching, then blocks and places.

Where it is bent, maps of places are bent as well, and few are recognised. So the pose graph is made anew from what was
found, and blocks are matched and places looked for again, as long as the map of the whole drive explains its readings
better than before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from .judging import gain_over_drive
from .loops import Loop
from .odometry_model import CALIBRATION, sensitivity
from .passes import Progress
from .pose_graph import solution_at
from .poses import Floats, relative, rms_after_alignment
from .relocating import LEAST_RECOGNISED, recognised_part
from .scan_matching import TRUSTS, scan_matched
from .scans import Scans
from .solving import SETTLED, MatchSolver
from .windows import Odometry

REMAINING_YAW_NOISE = math.radians(3.0)
"""By how much the yaw strays after scan matching, and after each round, radians a √metre."""

WORTH_A_TRIAL = 1.5
"""Standard errors by which scan matching must predict readings near by better than nodes that are known, for more to be
tried. In 3 drives where corners were wrongly taken for square ones it was 3.5 to 7, in 4 others 0 to 0.6."""

ROUNDS = 4
"""Times that the pose graph is made from what was found before, at the most."""


class MatchedDrive(NamedTuple):
    """Where a drive is by matches alone.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
    loops : list of Loop
        Places seen before that it rests on.
    value : float
        `Scans.objective` of the nodes.
    part : float
        Of the blocks that lie where the robot was before, those that are recognised.
    """

    nodes: Floats
    loops: list[Loop]
    value: float
    part: float


def match_drive(
    odometry: Odometry,
    scans: Scans,
    start_stage: Callable[[str], Progress],
    noise: float = 0.0,
    known: Floats | None = None,
) -> MatchedDrive | None:
    """Return where a drive is by matches alone; None if the map along it explains its readings no better.

    It has to explain them better than the map along odometry, and than the one along the nodes that are `known`. More
    than scan matching is tried only if that predicts readings better than these.

    Parameters
    ----------
    odometry : Odometry
    scans : Scans
    start_stage : callable
        Receives a stage, and returns what receives how much of it is done.
    noise : float
        By how much the yaw of odometry strays, radians a √metre; 0 if nobody knows.
    known : float64, shape (K, 3), optional
    """
    best, value = None, scans.objective(scans.windows.node)
    if known is not None:
        value = max(value, scans.objective(known))
    for trust in TRUSTS:
        start = scan_matched(scans, trust._replace(yaw=noise or trust.yaw), start_stage('scan matching'))
        if known is not None and gain_over_drive(scans, known, start, start_stage('judgement')).sigmas < WORTH_A_TRIAL:
            break
        found = _match_repeatedly(
            odometry, scans, start_stage, start, min(REMAINING_YAW_NOISE, noise or REMAINING_YAW_NOISE), value
        )
        if found is not None:
            best, value = found, found.value
        # a drive that fits together hardly gains from another trial, nor does one that is better explained already
        if best is None or best.part >= LEAST_RECOGNISED:
            break
    return best


def _match_repeatedly(
    odometry: Odometry, scans: Scans, start_stage: Callable[[str], Progress], start: Floats, noise: float, least: float
) -> MatchedDrive | None:
    """Return the best of what is found by matching again and again from what was found; None if it is not better."""
    change, nodes = sensitivity(odometry, scans.windows), start
    best = None
    for _ in range(ROUNDS):
        solver = MatchSolver(scans.windows, scans, start_stage, relative(nodes[:-1], nodes[1:]), noise, change)
        solution, loops = solver.with_matches(solution_at(nodes, len(CALIBRATION)))
        before, nodes = nodes, solution.nodes
        found = MatchedDrive(nodes, loops, scans.objective(nodes), recognised_part(scans, nodes, loops))
        if found.value <= least:
            break
        best, least = found, found.value
        if found.part >= LEAST_RECOGNISED or rms_after_alignment(before, nodes) < SETTLED:
            break
    return best
