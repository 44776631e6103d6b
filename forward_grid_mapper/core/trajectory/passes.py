"""The passes over a drive: each gives matches of windows with local maps, which the pose graph joins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .matching import Match, measure
from .pose_graph import Edges, no_edges
from .poses import Floats, relative, rms_after_alignment
from .scans import Scans

BLOCK = 4
"""Windows that are matched with one local map."""

BEHIND, BACK = 5.0, 1.2
"""Metres of progress before a block that its map is made of in the first pass, and at which the match is tied to it."""

AROUND = 4.0
"""Metres of progress before and after a block that its map is made of in the second pass."""

FEWEST = 3
"""Readings that a window must have to be matched, and windows that a map must have."""

Progress = Callable[[float], None]
"""Receives how much of a pass is done, from 0 to 1."""


class Matches:
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
    def mean_score(self) -> float:
        """The mean log ratio of a reading, nats."""
        return self.score / max(self.readings, 1)

    def edges(self) -> Edges:
        """Return the matches as edges of the pose graph."""
        if not self._rows:
            return no_edges()
        place, window, pose, information = zip(*self._rows, strict=True)
        return Edges(np.array(place), np.array(window), np.array(pose), np.array(information))


def deformation(progress: Floats, before: Floats, after: Floats, at: NDArray[np.int64]) -> Floats:
    """Return by how much the nodes around some have moved relative to each other, shape (len(at),), metres.

    It is the root mean square after the best alignment of the nodes that a map of both sides is made of: a map that
    was only carried along as a whole is the same again.

    Parameters
    ----------
    progress : float64, shape (K,)
        Metres, of all nodes.
    before, after : float64, shape (K, 3)
    at : int64
        Nodes.
    """
    near = (np.abs(progress - progress[k]) < AROUND for k in at)
    return np.array([rms_after_alignment(before[each], after[each]) for each in near])


def match_preceding(scans: Scans, nodes: Floats, watch: Progress) -> Matches:
    """Match each block with the map of what was driven just before it, where the nodes are now.

    What it has in common with that map lies about `BACK` behind it, so there the match is tied to. It tells the scale
    of odometry, which a map of both sides does not: it is stretched as the drive is.
    """
    w, found = scans.windows, Matches()
    for k in range(0, len(nodes), BLOCK):
        watch(k / len(nodes))
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        behind = w.node_progress[k] - w.node_progress[:k]
        members = np.flatnonzero(behind < BEHIND)
        if len(members) >= FEWEST:
            place = int(members[np.abs(behind[members] - BACK).argmin()])
            _match(scans, nodes, block, members, place, found)
    return found


def match_surrounding(scans: Scans, nodes: Floats, watch: Progress) -> Matches:
    """Match each block with the map of what was driven before and after it, where the nodes are now."""
    w, found = scans.windows, Matches()
    for k in range(0, len(nodes), BLOCK):
        watch(k / len(nodes))
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        near = np.abs(w.node_progress - w.node_progress[block].mean()) < AROUND
        near[block] = False
        members = np.flatnonzero(near)
        if len(members) < FEWEST:
            continue
        _match(scans, nodes, block, members, int(members[0]), found)
    return found


def _match(
    scans: Scans, nodes: Floats, block: NDArray[np.int64], members: NDArray[np.int64], place: int, found: Matches
) -> None:
    """Match the windows of a block with the map of others, in the frame of a node."""
    around = scans.map(members, nodes[place], nodes)
    if around is None:
        return
    for j in block[scans.count[block] >= FEWEST]:
        match = measure(scans.scan[j], around, relative(nodes[place], nodes[j]))
        found.add(place, int(j), match, int(scans.count[j]))
