"""Passes over a drive: each matches all blocks with local maps; the matches are edges of the pose graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..runtime.threads import in_order
from .matching import ENOUGH, Match, measure
from .pose_graph import Edges, no_edges
from .poses import relative, rms_after_alignment
from .scans import MOST_ON_MAP, Scans

BLOCK = 4
"""Windows that are matched with one local map."""

BEHIND, BACK = 5.0, 1.2
"""The first pass matches a block with a map of this many metres before it. The edge begins at the node this many metres
before the block. Metres of progress."""

AROUND = 4.0
"""Metres of progress before and after a block whose readings make its map in the second pass."""

FEWEST = 3
"""Fewest readings of a window that is matched, and fewest windows of a map."""

Row = tuple[int, int, Match, int]
"""A match: the node of the place, the window, the match of the window there, and its number of readings."""

Progress = Callable[[float], None]
"""Receives the fraction of the work that is done, from 0 to 1."""


class Matches:
    """Matches of windows with local maps.

    Attributes
    ----------
    score : float
        Sum of the log-likelihood ratios of all matched readings, nats.
    readings : int
        Their number.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, Floats, Floats]] = []
        self.score = 0.0
        self.readings = 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, place: int, window: int, match: Match, count: int) -> None:
        """Add a match of a window of `count` readings with a local map in the frame of the node `place`."""
        self._rows.append((place, window, match.pose, match.information))
        self.score += match.score
        self.readings += count

    @property
    def mean_score(self) -> float:
        """The mean log-likelihood ratio of a reading, nats."""
        return self.score / max(self.readings, 1)

    def scaled(self, factor: float) -> Matches:
        """Return the matches with distances multiplied by a factor."""
        out, scale = copy(self), np.array([factor, factor, 1.0])
        out._rows = [(place, window, scale * pose, information) for place, window, pose, information in self._rows]
        return out

    def edges(self) -> Edges:
        """Return the matches as edges of the pose graph."""
        if not self._rows:
            return no_edges()
        place, window, pose, information = zip(*self._rows, strict=True)
        return Edges(np.array(place), np.array(window), np.array(pose), np.array(information))


def deformation(progress: Floats, before: Floats, after: Floats, at: NDArray[np.int64]) -> Floats:
    """Return how much the trajectory around each of some nodes has changed its shape, shape (len(at),), metres.

    It is the rms distance after rigid alignment of the nodes within `AROUND`: a local map that moved as a whole stays
    the same.

    Parameters
    ----------
    progress : float64, shape (K,)
        Of all nodes, metres.
    before, after : float64, shape (K, 3)
    at : int64
        Nodes.
    """
    near = (np.abs(progress - progress[k]) < AROUND for k in at)
    return np.array([rms_after_alignment(before[each], after[each]) for each in near])


def match_preceding(scans: Scans, nodes: Floats, watch: Progress) -> Matches:
    """Return the matches of each block with the map of the `BEHIND` metres before it, at the present nodes.

    The block and that map overlap about `BACK` behind the block, so the edges begin at the node there. These matches
    give the scale of odometry. Those with a map of both sides do not: such a map is stretched as the trajectory is.
    """
    w, work = scans.windows, []
    for k in range(0, len(nodes), BLOCK):
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        behind = w.node_progress[k] - w.node_progress[:k]
        members = np.flatnonzero(behind < BEHIND)
        if len(members) >= FEWEST:
            place = int(members[np.abs(behind[members] - BACK).argmin()])
            work.append(partial(matches_of, scans, nodes, block, members, place))
    return _found(scans, work, watch)


def match_surrounding(scans: Scans, nodes: Floats, watch: Progress) -> Matches:
    """Return the matches of each block with the map of `AROUND` metres before and after it, at the present nodes."""
    w, work = scans.windows, []
    for k in range(0, len(nodes), BLOCK):
        block = np.arange(k, min(k + BLOCK, len(nodes)))
        near = np.abs(w.node_progress - w.node_progress[block].mean()) < AROUND
        near[block] = False
        members = np.flatnonzero(near)
        if len(members) >= FEWEST:
            work.append(partial(matches_of, scans, nodes, block, members, int(members[0])))
    return _found(scans, work, watch)


def _found(scans: Scans, work: Sequence[Callable[[], list[Row]]], watch: Progress) -> Matches:
    """Return the matches of all blocks."""
    found = Matches()
    for done, rows in enumerate(in_order(work, scans.threads)):
        watch(done / len(work))
        for row in rows:
            found.add(*row)
    return found


def matches_of(
    scans: Scans,
    nodes: Floats,
    block: NDArray[np.int64],
    members: NDArray[np.int64],
    place: int,
    on_map: int = MOST_ON_MAP,
    evaluated: int = ENOUGH,
) -> list[Row]:
    """Return the matches of a block's windows with the map of the windows `members`, in the frame of `place`.

    The map is made from `on_map` readings at most, and `evaluated` of a window measure its pose.
    """
    around = scans.map(members, nodes[place], nodes, on_map)
    if around is None:
        return []
    return [
        (
            place,
            int(j),
            measure(scans.scan[j], around, relative(nodes[place], nodes[j]), evaluated),
            int(scans.count[j]),
        )
        for j in block[scans.count[block] >= FEWEST]
    ]
