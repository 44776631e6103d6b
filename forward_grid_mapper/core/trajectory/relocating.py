"""Stretches of a drive that lie in a wrong place, and where they belong.

If odometry is off by metres after a hall whose walls are out of reach, loop closures are searched in the wrong places,
and either rooms that look alike are found or nothing. So hardly any block on an earlier visit is recognised. Such a
stretch is matched as a whole in a larger area than a single block: 25 m of a building hardly look like any other part
of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from .likelihood import Scan, scores
from .local_map import LocalMap
from .loops import APART, GOOD, LENGTH, SHARED, Loop, Places, find_loop
from .loops import REACH as LOOP_REACH
from .matching import grid_around
from .poses import compose, relative
from .scans import FEWEST_ON_MAP, Scans

NEAR = 2.0
"""Metres from an earlier part of the drive within which a block lies on an earlier visit."""

RUN, FEW = 8, 3
"""Blocks of a stretch, and the most of them that are recognised if it is searched."""

LONGEST = RUN + 4
"""Most blocks from the first to the last of a stretch; those between, on no earlier visit, follow by the pose graph."""

CONFIRMING = 5
"""Fewest blocks from before a node that must be recognised after it to confirm the heading there; it must be more than
half of those that lie on such a visit, too."""

AROUND = 10.0
"""Metres around the stretch within which earlier windows make the map."""

ON_MAP = 6000
"""Most readings that the map is made from."""

REACH = np.array([5.0, 5.0, math.radians(10.0)])
"""Half the size of the searched area: metres ahead and aside, radians."""

STEPS = (0.2, 0.2, math.radians(2.5))
"""Steps of the first grid."""

EVALUATED, FOLLOWED = (60, 600), 600
"""Readings that are evaluated at all poses of the first grid, and at the best ones; the number of these."""

FINER = ((0.1, 0.1, math.radians(1.2)), (0.05, 0.05, math.radians(0.6)))
"""Steps of the finer grids."""

MOVED = 0.5
"""Least distance between two places of a stretch, metres."""

SIGMA = np.array([0.1, 0.1, math.radians(1.5)])
"""σ of the pose of a block after its stretch was moved: metres, metres, radians."""

LEAST_RECOGNISED = 0.85
"""Fraction of the blocks on an earlier visit that are recognised if the trajectory is not bent."""

LEAST_FITTING, FEWEST_RECOGNISED = 0.95, 0.5
"""Least fraction of the blocks on an earlier visit that are recognised or fit where they lie, if the trajectory is not
bent; and least fraction that are recognised."""

MORE_RECOGNISED = 2
"""This many more blocks must be recognised at another place."""


def recognised(loops: Sequence[Loop]) -> set[int]:
    """Return the numbers of the blocks that were recognised on an earlier visit."""
    return {max(loop.block, loop.place) // LENGTH for loop in loops}


def revisits(scans: Scans, nodes: Floats, passed: int | None = None) -> NDArray[np.int64]:
    """Return the numbers of the blocks that lie on an earlier visit.

    With `passed`, only blocks after this node that lie on a visit before it.
    """
    progress, out = scans.windows.node_progress, []
    for first in range(0, len(nodes) - LENGTH // 2, LENGTH):
        middle = min(first + LENGTH // 2, len(nodes) - 1)
        if passed is not None and middle < passed:
            continue
        # progress increases, so earlier nodes are the first ones
        until = int(np.searchsorted(progress, progress[middle] - APART))
        before = nodes[: until if passed is None else min(until, passed), :2]
        if len(before) and np.hypot(*(before - nodes[middle, :2]).T).min() < NEAR:
            out.append(first // LENGTH)
    return np.array(out, np.int64)


def recognised_part(scans: Scans, nodes: Floats, loops: Sequence[Loop]) -> float:
    """Return the fraction of the blocks on an earlier visit that are recognised; 1 if there are none."""
    blocks = revisits(scans, nodes).tolist()
    return len(recognised(loops).intersection(blocks)) / len(blocks) if blocks else 1.0


def fits_earlier_visits(scans: Scans, nodes: Floats, loops: Sequence[Loop]) -> bool:
    """Return whether nearly all blocks on an earlier visit are recognised there or fit there.

    A block is not recognised if it looks alike from several poses, as along a bare corridor. It contradicts the
    trajectory only if it does not fit where it lies.
    """
    blocks, seen = revisits(scans, nodes), recognised(loops)
    others = [block for block in blocks.tolist() if block not in seen]
    if len(others) <= (1.0 - LEAST_RECOGNISED) * len(blocks):
        return True
    if len(others) > (1.0 - FEWEST_RECOGNISED) * len(blocks):
        return False
    usual, places = float(np.median([loop.matches.mean_score for loop in loops])), Places(scans, nodes)
    misfits = sum(not _fits(scans, nodes, block, places, GOOD * usual) for block in others)
    return misfits <= (1.0 - LEAST_FITTING) * len(blocks)


def _fits(scans: Scans, nodes: Floats, number: int, places: Places, least: float) -> bool:
    """Return whether a block fits on its nearest earlier visit, by at least so many nats a reading."""
    progress, block = scans.windows.node_progress, windows_of(np.array([number]), len(nodes))
    middle = int(block[len(block) // 2])
    before = _places_before(progress, middle)
    place = int(before[np.hypot(*(nodes[before, :2] - nodes[middle, :2]).T).argmin()])
    around, joint = places[place], scans.joint(block, relative(nodes[middle], nodes[block]))
    if around is None or not len(joint.readings):
        return False
    value = float(scores(joint, around, relative(nodes[place], nodes[middle])[None])[0])
    return value >= least * len(joint.readings)


def confirmed_by_places(scans: Scans, nodes: Floats, loops: Sequence[Loop]) -> bool:
    """Return whether places seen before confirm a trajectory: nearly all blocks on an earlier visit are recognised.

    There must be at least half as many of them as blocks that lie on an earlier visit by odometry: a trajectory that
    comes back to no place has none to be recognised. True if neither comes back to a place.
    """
    if 2 * len(recognised(loops)) < len(revisits(scans, scans.windows.node)):
        return False
    return recognised_part(scans, nodes, loops) >= LEAST_RECOGNISED


def unsupported(blocks: NDArray[np.int64], seen: set[int], begin: int) -> NDArray[np.int64] | None:
    """Return the first stretch from block `begin` on of which hardly any block is recognised; None if there is none.

    Parameters
    ----------
    blocks : int64
        Those on an earlier visit.
    seen : set of int
        Those that are recognised.
    begin : int
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
    """Return whether enough blocks from before a node are recognised after it, so that the heading is right there."""
    across = [loop for loop in loops if max(loop.block, loop.place) >= node > min(loop.block, loop.place)]
    blocks = revisits(scans, nodes, node).tolist()
    crossed = len(recognised(across).intersection(blocks))
    return crossed >= CONFIRMING and 2 * crossed > len(blocks)


def windows_of(blocks: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the windows of blocks; the drive has `count` windows."""
    out = (blocks[:, None] * LENGTH + np.arange(LENGTH)).ravel()
    return out[out < count]


def displaced(scans: Scans, nodes: Floats, stretch: NDArray[np.int64]) -> Floats | None:
    """Return the nodes with a stretch moved to its best pose on the map of earlier visits; None if it lies there."""
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
    """Return the best pose of a stretch, relative to the present one, shape (3,)."""
    mixed = joint.readings[np.random.default_rng(0).permutation(len(joint.readings))]
    few, more = (Scan(mixed[:count], joint.weight) for count in EVALUATED)
    poses = grid_around(np.zeros(3), REACH, STEPS)
    poses = poses[np.argsort(-scores(few, around, poses), kind='stable')[:FOLLOWED]]
    best: Floats = poses[int(scores(more, around, poses).argmax())]
    for steps in FINER:
        near = grid_around(best, 2.0 * np.array(steps), steps)
        best = near[int(scores(more, around, near).argmax())]
    return best


def _places_before(progress: Floats, node: int) -> NDArray[np.int64]:
    """Return the nodes of places on earlier visits than that of a node."""
    places = np.arange(0, len(progress), SHARED)
    out: NDArray[np.int64] = places[progress[places] < progress[node] - APART]
    return out


def loops_at(scans: Scans, nodes: Floats, stretch: NDArray[np.int64], usual: float) -> list[Loop]:
    """Return the loop closures of the blocks of a stretch with earlier visits, near the given nodes."""
    places, out = Places(scans, nodes), []
    before = _places_before(scans.windows.node_progress, int(stretch[0]))
    for first in range(0, len(stretch), LENGTH):
        block = stretch[first : first + LENGTH]
        middle = block[len(block) // 2]
        far = np.hypot(*(nodes[before, :2] - nodes[middle, :2]).T)
        if scans.count[block].sum() < FEWEST_ON_MAP or far.min(initial=np.inf) > LOOP_REACH:
            continue
        place = int(before[far.argmin()])
        loop = find_loop(scans, block, nodes, place, SIGMA, places, usual)
        if loop is not None:
            out.append(loop)
    return out
