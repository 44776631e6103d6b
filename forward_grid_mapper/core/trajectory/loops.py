"""Loops: blocks matched with local maps of places that the robot came by at another time.

How far a place may be off is asked from the posterior of the graph, of which deviations are drawn; there the block is
searched, wherever it may be. That posterior knows nothing of a wall that was taken for another one or of votes that are
wrong together, so places are off by more; and where the right place is not searched, rooms that look alike are found
instead. So the search goes farther than the posterior does. A loop counts if its readings fit about as well as those
matched with their own surroundings, and nowhere else in the searched area nearly as well. What does not agree with the
rest is taken out again when the graph is solved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .local_map import LocalMap
from .matching import measure
from .passes import FEWEST, Matches, Progress
from .poses import Floats, axes_at, compose, relative, wrapped
from .scans import FEWEST_ON_MAP, Scans
from .searching import search

LENGTH = 8
"""Windows of a block that is looked for."""

APART = 8.0
"""Metres of progress from which on two places are of different times."""

REACH = 3.0
"""Metres between a block and a place that its map may hold."""

AROUND = 4.0
"""Metres of travel before and after a place that its map is made of."""

SIGMA_FACTOR = np.array([2.0, 2.0, 1.0])
"""Times that places, and yaws, are farther off than the posterior has it."""

SIGMAS = 2.5
LARGEST = np.array([2.5, 2.5, math.radians(20.0)])
"""How far a block is searched: σ, and metres and radians at most."""

LEAST = np.array([0.2, 0.2, math.radians(3.0)])

SHARED = 4
"""Windows between places, so that blocks, and each time the robot comes by, share maps."""

MEASURED = 150
"""Readings that measure the best pose of the search."""

GOOD = 0.65
"""Part of the usual score of a reading that a loop must have."""

LEAST_SEPARATION = 0.45
"""Metres from the best pose from where on another is another place."""

LEAST_DISTANCE = 8.0
"""σ² by which another place must differ in what is measured at the best one: along a bare corridor none does."""

LEAST_MARGIN = 12.0
"""Nats by which the best pose must be better than any of another place."""

CLIMBS = 3
"""Parabolas that the best pose of the search is moved to the top of."""

CANDIDATES = 2
"""Places that a block is looked for at, at the most."""


@dataclass(frozen=True)
class Loop:
    """A block that was found at another time's place.

    Attributes
    ----------
    block, place : int
        Nodes in the middle of the block, and of the map.
    matches : Matches
        Matches of the block's windows.
    """

    block: int
    place: int
    matches: Matches


SearchResults = dict[tuple[int, int], Loop | None]
"""What came of looking for blocks at places, by the nodes in their middle: None where a block was not found."""


class Places:
    """Local maps of places, made when they are asked for, from the nodes as they are."""

    def __init__(self, scans: Scans, nodes: Floats) -> None:
        self._scans, self._nodes = scans, nodes
        self._maps: dict[int, LocalMap | None] = {}

    def __getitem__(self, node: int) -> LocalMap | None:
        if node not in self._maps:
            progress = self._scans.windows.node_progress
            members = np.flatnonzero(np.abs(progress - progress[node]) < AROUND)
            self._maps[node] = self._scans.map(members, self._nodes[node], self._nodes)
        return self._maps[node]


def candidates(
    nodes: Floats, samples: Floats, progress: Floats, middle: int, known: Sequence[int] = ()
) -> list[tuple[int, Floats]]:
    """Return places where a block may have been before or after, other than known ones, and σ of its pose there."""
    places = np.arange(0, len(nodes), SHARED)
    there = nodes[places] + samples[:, places]
    drawn = relative(there, (nodes[middle] + samples[:, middle])[:, None])
    mean = relative(nodes[places], nodes[middle])
    off = drawn - mean
    off[..., 2] = wrapped(off[..., 2])
    sigma = np.sqrt((off**2).mean(0))
    far = np.hypot(mean[:, 0], mean[:, 1])
    wide = np.hypot(sigma[:, 0], sigma[:, 1])
    away = np.abs(progress[places] - progress[middle])
    possible = (away > APART) & (far < REACH + np.minimum(wide, LARGEST[0]))
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
    scans: Scans, block: NDArray[np.int64], nodes: Floats, place: int, sigma: Floats, around: LocalMap, usual: float
) -> Loop | None:
    """Return the loop of a block with a place, or None."""
    middle = block[len(block) // 2]
    shape = relative(nodes[middle], nodes[block])
    joint = scans.joint(block, shape)
    guess = relative(nodes[place], nodes[middle])
    reach = np.clip(SIGMAS * sigma, LEAST, LARGEST)
    found = search(joint, around, guess, np.maximum(sigma, LEAST / 2), reach)
    best = found.best
    for _ in range(CLIMBS):
        best = measure(joint, around, best, MEASURED).pose
    final = measure(joint, around, best, MEASURED)
    count = len(joint.readings)
    if final.score < GOOD * usual * count:
        return None
    # directions that are not measured may not decide
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
    """Return what came of looking for each block of a drive where it may have been.

    Parameters
    ----------
    scans : Scans
    nodes : float64, shape (K, 3)
    samples : float64, shape (S, K, 3)
        Deviations of the nodes.
    usual : float
        The usual score of a reading, nats.
    watch : callable
    known : dict, optional
        What is known already, and not looked for again.
    """
    known = known or {}
    places, out, progress = Places(scans, nodes), SearchResults(), scans.windows.node_progress
    for k in range(0, len(nodes) - LENGTH // 2, LENGTH):
        watch(k / len(nodes))
        block = np.arange(k, min(k + LENGTH, len(nodes)))
        if scans.count[block].sum() < FEWEST_ON_MAP:
            continue
        middle = int(block[len(block) // 2])
        found = {key: loop for key, loop in known.items() if key[0] == middle and loop is not None}
        out.update(found)
        for place, sigma in candidates(nodes, samples, progress, middle, [place for _, place in found]):
            if (middle, place) in known:
                out[middle, place] = None
            elif (around := places[place]) is not None:
                out[middle, place] = find_loop(scans, block, nodes, place, sigma, around, usual)
    return out


def loops_of(results: SearchResults) -> list[Loop]:
    """Return the loops that were found."""
    return [loop for loop in results.values() if loop is not None]
