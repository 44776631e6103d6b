"""What becomes of places where a right angle of the heading may have been lost: matching decides.

Votes of walls know the heading modulo 90°. In a hall whose walls are out of reach it may slip over to the next one. If
places seen before such a hall are recognised after it, it did not. If they are not, the drive is solved with the
heading turned by a right angle from there on, one way and the other, and what foresees its readings best is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from .heading import Heading
from .holding_out import LEAST_SIGMAS, blocks_of, foreseen, gain
from .loops import Loop
from .passes import BLOCK
from .pose_graph import Solution
from .relocating import confirmed
from .scans import Scans
from .solving import Solver

JUDGED_ON = 60
"""Blocks that solutions are compared on."""


@dataclass(frozen=True)
class Solved:
    """A drive that was solved with one heading.

    Attributes
    ----------
    solver : Solver
    along : Solution
        By straight walls alone.
    solution : Solution
        With matches.
    loops : list of Loop
    certainty : float
        Probability that no right angle was lost.
    """

    solver: Solver
    along: Solution
    solution: Solution
    loops: list[Loop]
    certainty: float


def solved(
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
    first = _matched(scans, heading, solver, along)
    open_doubts = [node for node, _ in _unconfirmed(scans, heading, first)]
    # with two of them it would take many solutions, and none is likely to be right
    if len(open_doubts) != 1:
        return first
    blocks = blocks_of(len(scans.windows), BLOCK, JUDGED_ON)
    best, seen = first, foreseen(scans, first.solution.nodes, blocks)
    for angle in (math.pi / 2, -math.pi / 2):
        other = heading.turned(open_doubts[0], angle)
        solver = solver_of(other)
        tried = _matched(scans, other, solver, solver.along_walls())
        if not confirmed(scans, tried.solution.nodes, tried.loops, open_doubts[0]):
            continue
        now = foreseen(scans, tried.solution.nodes, blocks)
        if gain(seen, now).sigmas >= LEAST_SIGMAS:
            best, seen = tried, now
    return best


def _matched(scans: Scans, heading: Heading, solver: Solver, along: Solution) -> Solved:
    solution, loops = solver.with_matches(along)
    found = Solved(solver, along, solution, loops, heading.certainty)
    # what is confirmed was no loss
    not_lost = [
        probability
        for node, probability in (*heading.doubts, *heading.slight)
        if confirmed(scans, solution.nodes, loops, node)
    ]
    return replace(found, certainty=heading.certainty + sum(not_lost))


def _unconfirmed(scans: Scans, heading: Heading, found: Solved) -> list[tuple[int, float]]:
    nodes = found.solution.nodes
    return [doubt for doubt in heading.doubts if not confirmed(scans, nodes, found.loops, doubt[0])]
