"""Hypotheses about the heading at places where a right angle may have been lost; matching decides between them.

Walls give the heading modulo 90°. In a hall whose walls are out of reach, it may be off by a right angle afterwards. It
is not if blocks from before the hall are recognised after it. Otherwise the drive is solved again, with the heading
turned by +90° and by −90° from there on, and the solution that predicts readings best is right. Several such places are
examined in the order of the drive: after the decision on the first one, the heading is right up to the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from ..common.readings import Floats
from .heading import Heading
from .holding_out import LEAST_SIGMAS, blocks_of, gain, predicted
from .loops import APART, Loop
from .passes import BLOCK
from .pose_graph import Solution
from .relocating import confirmed
from .scans import Scans
from .solving import Solver

JUDGED_ON = 60
"""Most blocks that solutions are compared by."""

MOST_DOUBTFUL = 3
"""Most doubtful places that are examined: each takes two more solutions, and with many hardly one would be right."""


@dataclass(frozen=True)
class Solved:
    """A drive that was solved with one hypothesis of the heading.

    Attributes
    ----------
    heading : Heading
    solver : Solver
        Of this heading.
    along : Solution
        By odometry and straight walls.
    solution : Solution
        With matches as well.
    loops : list of Loop
    certainty : float
        Probability that no right angle was lost.
    """

    heading: Heading
    solver: Solver
    along: Solution
    solution: Solution
    loops: list[Loop]
    certainty: float


def solve_hypotheses(
    scans: Scans, heading: Heading, solver: Solver, along: Solution, solver_of: Callable[[Heading], Solver]
) -> Solved:
    """Return the drive solved with the given heading, or with a better hypothesis.

    Parameters
    ----------
    scans : Scans
    heading : Heading
    solver, along
        Of this heading, and its solution by straight walls.
    solver_of : callable
        Makes the solver of another heading.
    """
    best = _solve_with(scans, heading, solver, along)
    doubtful_nodes = _doubtful_nodes(scans, best)
    if not 0 < len(doubtful_nodes) <= MOST_DOUBTFUL:
        return best
    blocks = blocks_of(len(scans.windows), BLOCK, JUDGED_ON)
    best_values = predicted(scans, best.solution.nodes, blocks)
    for node in doubtful_nodes:
        # the decision on an earlier place may have confirmed this one
        doubtful = _doubtful_nodes(scans, best)
        if node not in doubtful:
            continue
        tried, values = [best], [best_values]
        for angle in (math.pi / 2, -math.pi / 2):
            other = best.heading.turned(node, angle)
            solver = solver_of(other)
            tried.append(_solve_with(scans, other, solver, solver.along_walls()))
            values.append(predicted(scans, tried[-1].solution.nodes, blocks))
        right, decisive = _best(scans, tried, values, node)
        best, best_values = tried[right], values[right]
        # two lost right angles may cancel, and then turning at one place alone is no better
        if decisive and (right or len(doubtful) == 1):
            best = _without_doubt(best, node)
    return best


def _best(scans: Scans, tried: list[Solved], values: list[Floats], node: int) -> tuple[int, bool]:
    """Return the number of the right solution, and whether its prediction of readings alone proves that it is right.

    It does if it is better than that of both others. Otherwise the first solution, which is not turned, is right unless
    others predict readings better and have blocks from before the node recognised; then it is the best of these.
    """
    for k, now in enumerate(values):
        if all(gain(other, now).sigmas >= LEAST_SIGMAS for j, other in enumerate(values) if j != k):
            return k, not _is_confirmed(scans, tried[k], node)
    right = 0
    for k in range(1, len(tried)):
        better = gain(values[0], values[k]).sigmas >= LEAST_SIGMAS and _is_confirmed(scans, tried[k], node)
        if better and (not right or gain(values[right], values[k]).mean > 0.0):
            right = k
    return right, False


def _without_doubt(found: Solved, node: int) -> Solved:
    """Return the solved drive without the doubt at a node."""
    probability = dict(found.heading.doubts)[node]
    heading = replace(
        found.heading,
        certainty=found.heading.certainty + probability,
        doubts=tuple(doubt for doubt in found.heading.doubts if doubt[0] != node),
    )
    return replace(found, heading=heading, certainty=found.certainty + probability)


def _is_confirmed(scans: Scans, found: Solved, node: int) -> bool:
    return confirmed(scans, found.solution.nodes, found.loops, node)


def _solve_with(scans: Scans, heading: Heading, solver: Solver, along: Solution) -> Solved:
    solution, loops = solver.with_matches(along)
    found = Solved(heading, solver, along, solution, loops, heading.certainty)
    # at confirmed places no right angle was lost
    not_lost = [
        probability for node, probability in (*heading.doubts, *heading.slight) if _is_confirmed(scans, found, node)
    ]
    return replace(found, certainty=heading.certainty + sum(not_lost))


def _doubtful_nodes(scans: Scans, found: Solved) -> list[int]:
    """Return the doubtful nodes that are not confirmed, in the order of the drive."""
    progress = scans.windows.node_progress
    return [
        node
        for node, _ in found.heading.doubts
        # before the first metres there is nothing that could be recognised
        if progress[node] - progress[0] >= APART and not _is_confirmed(scans, found, node)
    ]
