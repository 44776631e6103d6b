"""The passes over a drive: each gives matches of windows with local maps, which the pose graph joins."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .chain import Chain, in_frame_of
from .local_map import LocalMap
from .matching import Match, grid_around, measure, search
from .pose_graph import Edges, no_edges
from .poses import Floats, compose, relative
from .scans import Scans

BLOCK = 4
"""Windows that are matched with one local map."""

BEHIND = 7.0
"""Metres of progress before a block that its map is made of in the first pass."""

AROUND = 6.0
"""Metres of progress before and after a block that its map is made of in later passes."""

FEWEST = 3
"""Readings that a window must have to be matched, and windows that a map must have."""

ROUNDS = 3
"""Times that the matches of a block are measured anew where it has moved to."""

ASKED = 40
"""Readings that a search asks."""

SIGMAS = 2.0
FARTHEST = np.array([0.3, 0.4, math.radians(15.0)])
"""How far a block is searched in the first pass: σ of odometry, and metres ahead and aside, and radians at most."""

Progress = Callable[[float], None]
"""Receives how much of a pass is done, from 0 to 1."""


class Found:
    """Matches as they are found.

    Attributes
    ----------
    score : float
        Σ log ratio, nats.
    readings : int
        Of how many.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, Floats, Floats]] = []
        self.score = 0.0
        self.readings = 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, place: int, window: int, match: Match, count: int) -> None:
        """Add a match of a window of `count` readings with the map of a place, given in the frame of its node."""
        self._rows.append((place, window, match.pose, match.information))
        self.score += match.score
        self.readings += count

    @property
    def usual(self) -> float:
        """The mean log ratio of a reading, nats."""
        return self.score / max(self.readings, 1)

    def edges(self) -> Edges:
        """Return the matches as edges of the pose graph."""
        if not self._rows:
            return no_edges()
        place, window, pose, information = zip(*self._rows, strict=True)
        return Edges(np.array(place), np.array(window), np.array(pose), np.array(information))


def first_pass(scans: Scans, chain: Chain, start: Floats, watch: Progress) -> tuple[Floats, Found]:
    """Match each block with the map of what was driven before it.

    Returns
    -------
    nodes : float64, shape (K, 3)
        The first one at `start`.
    found : Found
    """
    w, found = scans.windows, Found()
    nodes = np.array(w.node)
    nodes[0] = start
    for k in range(1, len(nodes), BLOCK):
        watch(k / len(nodes))
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        for j in block:
            nodes[j] = compose(nodes[j - 1], chain.motion[j - 1])
        nodes[block] = chain.solve(nodes[k - 1], block, nodes[block], [])
        members = np.flatnonzero(w.node_progress[k] - w.node_progress[:k] < BEHIND)
        usable = [i for i, j in enumerate(block) if scans.count[j] >= FEWEST]
        if not usable or len(members) < FEWEST:
            continue
        place = int(members[len(members) // 2])
        around = scans.map(members, nodes[place], nodes[:k])
        if around is None:
            continue
        nodes[block] = _searched(scans, chain, around, nodes[place], block, nodes[block])
        for _ in range(ROUNDS):
            local = relative(nodes[place], nodes[block])
            matches = [(i, measure(scans.scan[block[i]], around, local[i])) for i in usable]
            here = [(i, in_frame_of(nodes[place], match)) for i, match in matches]
            nodes[block] = chain.solve(nodes[k - 1], block, nodes[block], here)
        for i, match in matches:
            found.add(place, int(block[i]), match, int(scans.count[block[i]]))
    return nodes, found


def _searched(
    scans: Scans, chain: Chain, around: LocalMap, origin: Floats, block: NDArray[np.int64], guess: Floats
) -> Floats:
    """Return the nodes of a block where it fits best as a whole, within what odometry admits."""
    shape = relative(guess[0], guess)
    first = relative(origin, guess[0])
    covariance = chain.covariance[block[0] - 1] * len(block)
    reach = np.minimum(SIGMAS * np.sqrt(np.diag(covariance)), FARTHEST)
    joint = scans.joint(block, shape)
    best = search(joint, around, grid_around(first, reach), first, np.linalg.inv(covariance), ASKED)
    return compose(compose(origin, best), shape)


def again(scans: Scans, nodes: Floats, watch: Progress) -> Found:
    """Match each block with the map of what was driven before and after it, where the nodes are now."""
    w, found = scans.windows, Found()
    for k in range(0, len(nodes), BLOCK):
        watch(k / len(nodes))
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        near = np.abs(w.node_progress - w.node_progress[block].mean()) < AROUND
        near[block] = False
        members = np.flatnonzero(near)
        if len(members) < FEWEST:
            continue
        place = int(members[0])
        around = scans.map(members, nodes[place], nodes)
        if around is None:
            continue
        for j in block[scans.count[block] >= FEWEST]:
            match = measure(scans.scan[j], around, relative(nodes[place], nodes[j]))
            found.add(place, int(j), match, int(scans.count[j]))
    return found
