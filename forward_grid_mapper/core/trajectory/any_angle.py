"""The trajectory that matches alone say, whatever the directions of walls: scan matching, then blocks and places."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from .judging import held_out_nearby, seen_again
from .loops import Loop
from .odometry_model import CALIBRATION, sensitivity
from .passes import Progress
from .pose_graph import solution_at
from .poses import Floats, relative
from .relocating import LEAST_RECOGNISED, recognised_part
from .scan_matching import TRUSTS, scan_matched
from .scans import Scans
from .solving import MatchSolver
from .windows import Odometry

LEFT_BY_SCANS = math.radians(3.0)
"""By how much the yaw strays after scan matching, radians a √metre."""


class Matched(NamedTuple):
    """Where a drive is by matches alone.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
    loops : list of Loop
        Places seen before that it rests on.
    """

    nodes: Floats
    loops: list[Loop]


def matched(odometry: Odometry, scans: Scans, say: Callable[[str], Progress], noise: float = 0.0) -> Matched | None:
    """Return the nodes that matches alone say; None if scan matching foresees nothing better.

    Parameters
    ----------
    odometry : Odometry
    scans : Scans
    say : callable
        Receives a stage, and returns what receives how much of it is done.
    noise : float
        By how much the yaw of odometry strays, radians a √metre; 0 if nobody knows.
    """
    windows, best = scans.windows, None
    change = sensitivity(odometry, windows)
    left = min(LEFT_BY_SCANS, noise or LEFT_BY_SCANS)
    for trust in TRUSTS:
        own = trust._replace(yaw=noise or trust.yaw)
        start = scan_matched(scans, own, say('scan matching'))
        if held_out_nearby(scans, windows.node, start).mean <= 0.0:
            continue
        solver = MatchSolver(windows, scans, say, relative(start[:-1], start[1:]), left, change)
        solution, loops = solver.with_matches(solution_at(start, len(CALIBRATION)))
        found = Matched(solution.nodes, loops)
        if best is None or seen_again(scans, best.nodes, found.nodes).mean > 0.0:
            best = found
        # a drive that fits together hardly gains from another trial
        if recognised_part(scans, best.nodes, best.loops) >= LEAST_RECOGNISED:
            break
    return best
