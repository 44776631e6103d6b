"""Stretches of a drive that were put in a wrong place, and where they belong.

Where wheels stray in a hall whose walls are out of reach, all that comes after it is off by metres. Loops are then
looked for in the wrong places; rooms that look alike are found, or nothing. So of the blocks that lie where the robot
was before hardly any is recognised. Such a stretch is searched as a whole, farther than one block can be: 25 metres of
a building look like hardly anything else in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .likelihood import Scan, scores
from .local_map import LocalMap
from .loops import APART, LENGTH, SHARED, Loop, Places, find_loop
from .loops import REACH as LOOP_REACH
from .matching import grid_around
from .poses import Floats, compose, relative
from .scans import FEWEST_ON_MAP, Scans

NEAR = 2.0
"""Metres within which a block lies where the robot was before."""

RUN, FEW = 8, 3
"""Blocks of a stretch, and how many of them are recognised at the most where it is searched."""

LONGEST = RUN + 4
"""Blocks from the first to the last of a stretch: what lies between moves along, as stiff as it is."""

CONFIRMING = 5
"""Blocks that must be recognised across a place to know how it was passed, and more than half of those that could."""

AROUND = 10.0
"""Metres from the stretch up to which the robot's way of before is on the map."""

ON_MAP = 6000
"""Readings that the map of a stretch is made of at the most."""

REACH = np.array([5.0, 5.0, math.radians(10.0)])
STEPS = (0.2, 0.2, math.radians(2.5))
EVALUATED, FOLLOWED = (60, 600), 600
"""Readings that are asked at all poses of the search and at the best of them, and how many these are."""

FINER = ((0.1, 0.1, math.radians(1.2)), (0.05, 0.05, math.radians(0.6)))

MOVED = 0.5
"""Metres from where on it is another place."""

SIGMA = np.array([0.1, 0.1, math.radians(1.5)])
"""σ of a block in the stretch, once this is in its place."""

LEAST_RECOGNISED = 0.85
"""Part of the blocks that lie where the robot was before that are recognised where nothing is bent."""

MORE_RECOGNISED = 2
"""Blocks more that must be recognised in another place."""


def recognised(loops: Sequence[Loop]) -> set[int]:
    """Return the blocks that were recognised where the robot was before, by their numbers."""
    return {max(loop.block, loop.place) // LENGTH for loop in loops}


def revisits(scans: Scans, nodes: Floats, passed: int | None = None) -> NDArray[np.int64]:
    """Return the numbers of blocks that lie where the robot was before.

    With `passed`, of blocks behind this node that lie where the robot was before it.
    """
    progress, out = scans.windows.node_progress, []
    for first in range(0, len(nodes) - LENGTH // 2, LENGTH):
        middle = min(first + LENGTH // 2, len(nodes) - 1)
        if passed is not None and middle < passed:
            continue
        # progress grows, so what was before is the first nodes
        until = int(np.searchsorted(progress, progress[middle] - APART))
        before = nodes[: until if passed is None else min(until, passed), :2]
        if len(before) and np.hypot(*(before - nodes[middle, :2]).T).min() < NEAR:
            out.append(first // LENGTH)
    return np.array(out, np.int64)


def recognised_part(scans: Scans, nodes: Floats, loops: Sequence[Loop]) -> float:
    """Return the part of the blocks that lie where the robot was before that are recognised; 1 if there are none."""
    blocks = revisits(scans, nodes).tolist()
    return len(recognised(loops).intersection(blocks)) / len(blocks) if blocks else 1.0


def unsupported(blocks: NDArray[np.int64], seen: set[int], begin: int) -> NDArray[np.int64] | None:
    """Return the first blocks from `begin` on, of those that lie where the robot was, that are hardly recognised.

    None if there are none.
    """
    blocks = blocks[blocks >= begin]
    found = np.array([int(block) in seen for block in blocks], np.int64)
    if len(blocks) < RUN:
        return None
    counts = np.convolve(found, np.ones(RUN, np.int64), 'valid')
    low = np.flatnonzero((counts <= FEW) & (blocks[RUN - 1 :] - blocks[: len(counts)] < LONGEST))
    if not len(low):
        return None
    k = int(low[0])
    while k + 1 in low and counts[k + 1] < counts[k]:
        k += 1
    out: NDArray[np.int64] = blocks[k : k + RUN]
    return out


def confirmed(scans: Scans, nodes: Floats, loops: Sequence[Loop], node: int) -> bool:
    """Return whether places seen before a node were recognised after it: then the way past it is known."""
    across = [loop for loop in loops if max(loop.block, loop.place) >= node > min(loop.block, loop.place)]
    blocks = revisits(scans, nodes, node).tolist()
    crossed = len(recognised(across).intersection(blocks))
    return crossed >= CONFIRMING and 2 * crossed > len(blocks)


def windows_of(blocks: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the windows of blocks, of which the drive has `count`."""
    out = (blocks[:, None] * LENGTH + np.arange(LENGTH)).ravel()
    return out[out < count]


def displaced(scans: Scans, nodes: Floats, stretch: NDArray[np.int64]) -> Floats | None:
    """Return the nodes with a stretch where it fits best on the map of what was before; None if that is where it is."""
    progress = scans.windows.node_progress
    before = np.flatnonzero(progress < progress[stretch[0]] - APART)
    far = np.array([np.hypot(*(nodes[stretch, :2] - nodes[k, :2]).T).min() for k in before])
    before, middle = before[far < AROUND], stretch[len(stretch) // 2]
    if scans.count[stretch].sum() < FEWEST_ON_MAP:
        return None
    around = scans.map(before, nodes[middle], nodes, ON_MAP)
    if around is None:
        return None
    shape = relative(nodes[middle], nodes[stretch])
    best = _best_pose(scans.joint(stretch, shape), around)
    if np.hypot(best[0], best[1]) < MOVED:
        return None
    out = nodes.copy()
    out[stretch] = compose(compose(nodes[middle], best), shape)
    return out


def _best_pose(joint: Scan, around: LocalMap) -> Floats:
    """Return the best pose of a stretch around where it is."""
    mixed = joint.readings[np.random.default_rng(0).permutation(len(joint.readings))]
    few, more = (Scan(mixed[:count], joint.weight) for count in EVALUATED)
    poses = grid_around(np.zeros(3), REACH, STEPS)
    poses = poses[np.argsort(-scores(few, around, poses), kind='stable')[:FOLLOWED]]
    best: Floats = poses[int(scores(more, around, poses).argmax())]
    for steps in FINER:
        near = grid_around(best, 2.0 * np.array(steps), steps)
        best = near[int(scores(more, around, near).argmax())]
    return best


def loops_at(scans: Scans, nodes: Floats, stretch: NDArray[np.int64], usual: float) -> list[Loop]:
    """Return the loops of the blocks of a stretch with what was before it, where the nodes are."""
    progress, places, out = scans.windows.node_progress, Places(scans, nodes), []
    before = np.arange(0, len(nodes), SHARED)
    before = before[progress[before] < progress[stretch[0]] - APART]
    for first in range(0, len(stretch), LENGTH):
        block = stretch[first : first + LENGTH]
        middle = block[len(block) // 2]
        far = np.hypot(*(nodes[before, :2] - nodes[middle, :2]).T)
        if scans.count[block].sum() < FEWEST_ON_MAP or far.min(initial=np.inf) > LOOP_REACH:
            continue
        place = int(before[far.argmin()])
        around = places[place]
        loop = None if around is None else find_loop(scans, block, nodes, place, SIGMA, around, usual)
        if loop is not None:
            out.append(loop)
    return out
