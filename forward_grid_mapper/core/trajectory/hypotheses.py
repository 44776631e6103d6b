"""What becomes of places where a right angle of the heading may have been lost: matching decides.

Votes of walls know the heading modulo 90°. In a hall whose walls are out of reach it may slip over to the next one. If
places seen before such a hall are recognised after it, it did not. If they are not, the drive is solved with the
heading turned by a right angle from there on, one way and the other, and what predicts its readings best is right. Of
several such places, one after the other is asked: what follows the first one is right up to the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from .heading import Heading
from .holding_out import LEAST_SIGMAS, blocks_of, gain, predicted
from .loops import APART, Loop
from .passes import BLOCK
from .pose_graph import Solution
from .poses import Floats
from .relocating import confirmed
from .scans import Scans
from .solving import Solver

JUDGED_ON = 60
"""Blocks that solutions are compared on."""

MOST_DOUBTFUL = 3
"""Places that are asked: each takes two solutions more, and of many none is likely to be right."""


@dataclass(frozen=True)
class Solved:
    """A drive that was solved with one heading.

    Attributes
    ----------
    heading : Heading
    solver : Solver
        Of this heading.
    along : Solution
        By straight walls alone.
    solution : Solution
        With matches.
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
    """Return the drive solved with the heading that was followed, or with another one if that is right.

    Parameters
    ----------
    scans : Scans
    heading : Heading
    solver, along
        Of this heading.
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
        # it may be known by now, since an earlier one is
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
        # of two right angles that make up for each other, neither is better turned alone
        if decisive and (right or len(doubtful) == 1):
            best = _without_doubt(best, node)
    return best


def _best(scans: Scans, tried: list[Solved], values: list[Floats], node: int) -> tuple[int, bool]:
    """Return which solution is right, and whether that it predicts readings better than the others tells so by itself.

    Without that, the first one is, unless others that predict readings better have what was before the node
    recognised: then the one of them that predicts them best.
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
    """Return what was found, with no doubt at a node."""
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
    # what is confirmed was no loss
    not_lost = [
        probability for node, probability in (*heading.doubts, *heading.slight) if _is_confirmed(scans, found, node)
    ]
    return replace(found, certainty=heading.certainty + sum(not_lost))


def _doubtful_nodes(scans: Scans, found: Solved) -> list[int]:
    """Return the nodes at which a right angle may have been lost, as far as the drive can tell, in its order."""
    progress = scans.windows.node_progress
    return [
        node
        for node, _ in found.heading.doubts
        # before the first metres there is nothing to recognise, and hardly anything to turn
        if progress[node] - progress[0] >= APART and not _is_confirmed(scans, found, node)
    ]
