"""Loop closures: blocks matched with local maps of other visits of a place.

The searched area follows from samples of the posterior of the pose graph. The posterior does not include a wall that
was taken for another one, or votes with a common error, so real errors are larger. If the right pose is outside of the
searched area, a room that looks alike is found instead. So the area is larger than the posterior. A loop closure is
accepted if its readings fit about as well as in the matches with neighbouring windows, and clearly better than at any
other pose in the area. Loop closures that disagree with the rest are removed when the graph is solved.
"""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..runtime.threads import in_order
from .local_map import LocalMap
from .matching import climbed, measure
from .passes import FEWEST, Matches, Progress
from .poses import axes_at, compose, relative, wrapped
from .scans import FEWEST_ON_MAP, Scans
from .searching import search

LENGTH = 8
"""Windows of a block."""

APART = 8.0
"""Metres of progress between two visits of a place."""

REACH = 3.0
"""Largest distance between a block and the node of a place, metres, beside the uncertainty."""

AROUND = 4.0
"""Metres of progress before and after a place within which windows make its map."""

SIGMA_FACTOR = np.array([2.0, 2.0, 1.0])
"""Factors of σ of the posterior, for x, y and yaw."""

SIGMAS = 2.5
LARGEST_REACH = np.array([2.5, 2.5, math.radians(20.0)])
"""Half the size of the searched area: in σ, and its upper limit, metres and radians."""

LEAST_REACH = np.array([0.2, 0.2, math.radians(3.0)])
"""Its lower limit, metres and radians."""

SHARED = 4
"""Windows between the nodes of places, so that blocks and visits share local maps."""

MEASURED = 150
"""Readings that are evaluated to measure the best pose of the search."""

GOOD = 0.65
"""Least score of a loop closure, as a fraction of the usual score of its readings."""

LEAST_SEPARATION = 0.45
"""Metres from the best pose beyond which a pose is an alternative to it."""

LEAST_DISTANCE = 8.0
"""Least squared Mahalanobis distance of an alternative, by the information of the best pose: without it, poses along a
bare corridor would count as alternatives."""

LEAST_MARGIN = 12.0
"""Nats by which the best pose must be better than any alternative."""

CANDIDATES = 2
"""Most places that a block is matched with."""


@dataclass(frozen=True)
class Loop:
    """A loop closure: a block that was matched with the map of another visit.

    Attributes
    ----------
    block, place : int
        Nodes in the middle of the block, and of the map.
    matches : Matches
        Of the windows of the block with the map.
    """

    block: int
    place: int
    matches: Matches


SearchResults = dict[tuple[int, int], Loop | None]
"""Results of searches by (block, place), the nodes in their middle; None if the block was not recognised there."""


class Places:
    """Local maps around nodes, each made when it is first used; threads wait for a map that another one makes."""

    def __init__(self, scans: Scans, nodes: Floats) -> None:
        self._scans, self._nodes = scans, nodes
        self._maps: dict[int, LocalMap | None] = {}
        self._made: defaultdict[int, threading.Lock] = defaultdict(threading.Lock)

    def __getitem__(self, node: int) -> LocalMap | None:
        with self._made[node]:
            if node not in self._maps:
                progress = self._scans.windows.node_progress
                members = np.flatnonzero(np.abs(progress - progress[node]) < AROUND)
                self._maps[node] = self._scans.map(members, self._nodes[node], self._nodes)
            return self._maps[node]


def candidates(
    nodes: Floats, samples: Floats, progress: Floats, middle: int, known: Sequence[int] = ()
) -> list[tuple[int, Floats]]:
    """Return the places that a block may lie at, without known ones, and σ of its pose relative to them.

    Parameters
    ----------
    nodes : float64, shape (K, 3)
    samples : float64, shape (S, K, 3)
        Deviations of the nodes.
    progress : float64, shape (K,)
        Metres.
    middle : int
        Node in the middle of the block.
    known : sequence of int
        Places where it was recognised already.
    """
    places = np.arange(0, len(nodes), SHARED)
    # farther ones are impossible, and a long drive has thousands of them
    far = np.hypot(*(nodes[places, :2] - nodes[middle, :2]).T)
    places = places[(np.abs(progress[places] - progress[middle]) > APART) & (far < REACH + LARGEST_REACH[0])]
    there = nodes[places] + samples[:, places]
    drawn = relative(there, (nodes[middle] + samples[:, middle])[:, None])
    mean = relative(nodes[places], nodes[middle])
    off = drawn - mean
    off[..., 2] = wrapped(off[..., 2])
    sigma = np.sqrt((off**2).mean(0))
    far = np.hypot(mean[:, 0], mean[:, 1])
    wide = np.hypot(sigma[:, 0], sigma[:, 1])
    possible = far < REACH + np.minimum(wide, LARGEST_REACH[0])
    out: list[tuple[int, Floats]] = []
    for k in np.argsort(np.where(possible, far + wide, np.inf))[: possible.sum()]:
        node = int(places[k])
        taken = [*known, *(other for other, _ in out)]
        if len(taken) >= CANDIDATES:
            break
        if all(abs(progress[node] - progress[other]) > AROUND for other in taken):
            out.append((node, SIGMA_FACTOR * sigma[k]))
    return out


def find_loop(
    scans: Scans, block: NDArray[np.int64], nodes: Floats, place: int, sigma: Floats, places: Places, usual: float
) -> Loop | None:
    """Return the loop closure of a block with a place; None if it is not recognised there, or the place has no map.

    Parameters
    ----------
    scans : Scans
    block : int64
        Windows.
    nodes : float64, shape (K, 3)
    place : int
        Node of the place.
    sigma : float64, shape (3,)
        σ of the pose of the block relative to the place: metres, metres, radians.
    places : Places
    usual : float
        Usual log-likelihood ratio of a reading, nats.
    """
    around = places[place]
    if around is None:
        return None
    middle = block[len(block) // 2]
    shape = relative(nodes[middle], nodes[block])
    joint = scans.joint(block, shape)
    guess = relative(nodes[place], nodes[middle])
    reach = np.clip(SIGMAS * sigma, LEAST_REACH, LARGEST_REACH)
    found = search(joint, around, guess, np.maximum(sigma, LEAST_REACH / 2), reach)
    best = climbed(joint, around, found.best, MEASURED)
    final = measure(joint, around, best, MEASURED)
    count = len(joint.readings)
    if final.score < GOOD * usual * count:
        return None
    # poses that differ only in directions that are not measured are no alternatives
    apart, axes = relative(best, found.poses), axes_at(best[2])
    curved = np.einsum('pi,ij,pj->p', apart, axes.T @ final.information @ axes, apart)
    elsewhere = (np.hypot(apart[:, 0], apart[:, 1]) > LEAST_SEPARATION) & (curved > LEAST_DISTANCE)
    if elsewhere.any() and final.score - found.values[elsewhere].max() < LEAST_MARGIN:
        return None
    matches = Matches()
    for j, local in zip(block, shape, strict=True):
        if scans.count[j] >= FEWEST:
            matches.add(place, int(j), measure(scans.scan[j], around, compose(best, local)), int(scans.count[j]))
    return Loop(int(middle), place, matches)


def find_loops(
    scans: Scans, nodes: Floats, samples: Floats, usual: float, watch: Progress, known: SearchResults | None = None
) -> SearchResults:
    """Return the results of searching each block of a drive at the places that it may lie at.

    Parameters
    ----------
    scans : Scans
    nodes : float64, shape (K, 3)
    samples : float64, shape (S, K, 3)
        Deviations of the nodes.
    usual : float
        Usual log-likelihood ratio of a reading, nats.
    watch : callable
        Receives the fraction of the work that is done.
    known : dict, optional
        Results that are taken over without a search.
    """
    known, work = known or {}, dict[tuple[int, int], Callable[[], Loop | None]]()
    places, out, progress = Places(scans, nodes), SearchResults(), scans.windows.node_progress
    for k in range(0, len(nodes) - LENGTH // 2, LENGTH):
        block = np.arange(k, min(k + LENGTH, len(nodes)))
        if scans.count[block].sum() < FEWEST_ON_MAP:
            continue
        middle = int(block[len(block) // 2])
        found = {key: loop for key, loop in known.items() if key[0] == middle and loop is not None}
        out.update(found)
        for place, sigma in candidates(nodes, samples, progress, middle, [place for _, place in found]):
            out[middle, place] = None
            if (middle, place) not in known:
                work[middle, place] = partial(find_loop, scans, block, nodes, place, sigma, places, usual)
    for done, (key, loop) in enumerate(zip(work, in_order(work.values(), scans.threads), strict=True)):
        watch(done / len(work))
        out[key] = loop
    return out


def loops_of(results: SearchResults) -> list[Loop]:
    """Return the loop closures among results."""
    return [loop for loop in results.values() if loop is not None]
