"""Fitting trajectories to their own maps, so that their J can be compared.

J depends on centimetres and degrees within a metre or two as much as on where corridors lie. Trajectories that were
solved with different trust in odometry differ in both. So before J decides between them, each is fitted to the map
along it: all windows are matched with the map of all visits around them, and the pose graph of these matches, and of
the shape that the trajectory had, is solved. This hardly moves a trajectory: places stay where they are.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Floats
from ..runtime.threads import in_order
from .holding_out import LEAST_SIGMAS, NEAR, Gain
from .judging import gain_of_objective
from .matching import ENOUGH, Match, measure
from .odometry_model import Noise, covariances
from .passes import BLOCK, FEWEST
from .pose_graph import Edges, Graph, no_walls, no_yaws, solve
from .poses import axes_at, compose, relative
from .scans import MOST_ON_MAP, Scans

SHAPE = Noise(yaw=math.radians(3.0))
"""Noise of the motions of a trajectory that is fitted; the same for all, however they were found."""

ON_MAP, EVALUATED = 2 * MOST_ON_MAP, 2 * ENOUGH
"""Most readings that a map is made from, and that are evaluated to measure a pose: there are several visits."""

ROUNDS = 2
"""Times that the windows are matched and the graph is solved; in more rounds, J hardly grows."""


def gain_when_fitted(scans: Scans, before: Floats, after: Floats) -> Gain:
    """Return the gain in J of one trajectory over another; if it is large, that after both were fitted.

    The parameters are those of `gain_of_objective`.
    """
    better = gain_of_objective(scans, before, after)
    if better.sigmas < LEAST_SIGMAS:
        return better
    return gain_of_objective(scans, fitted(scans, before), fitted(scans, after))


def fitted(scans: Scans, nodes: Floats) -> Floats:
    """Return the nodes of a trajectory, shape (K, 3), fitted to the map along it; the first one stays."""
    motion = relative(nodes[:-1], nodes[1:])
    count = np.arange(len(nodes))
    information = np.asarray(np.linalg.inv(covariances(scans.windows, SHAPE)), np.float64)
    shape, no_calibration = Edges(count[:-1], count[1:], motion, information), np.zeros((len(motion), 3, 0))
    for _ in range(ROUNDS):
        matches = _matched_with_map(scans, nodes)
        graph = Graph(shape, no_calibration, np.zeros(0), matches, no_yaws(), no_walls())
        nodes = solve(graph, nodes, np.zeros(0)).nodes
    return nodes


def _matched_with_map(scans: Scans, nodes: Floats) -> Edges:
    """Return the poses of windows on the map of all other windows around, as edges from the first node."""
    work = [
        partial(_matches, scans, nodes, np.arange(k, min(k + BLOCK, len(nodes)))) for k in range(0, len(nodes), BLOCK)
    ]
    rows = [row for found in in_order(work, scans.threads) for row in found if row[1]]
    frames = nodes[np.array([place for place, _, _ in rows], np.int64)]
    measured = np.array([match.pose for _, _, match in rows]).reshape(-1, 3)
    information = np.empty((len(rows), 3, 3))
    for k, (_, _, match) in enumerate(rows):
        axes = axes_at(frames[k, 2] - nodes[0, 2])
        information[k] = axes @ match.information @ axes.T
    window = np.array([window for _, window, _ in rows], np.int64)
    return Edges(np.zeros(len(rows), np.int64), window, relative(nodes[0], compose(frames, measured)), information)


def _matches(scans: Scans, nodes: Floats, block: NDArray[np.int64]) -> list[tuple[int, int, Match]]:
    """Return the matches of the windows of a block with that map: the node that is its frame, the window, the match."""
    place = int(block[0])
    near = np.hypot(*(nodes[:, :2] - nodes[block, :2].mean(0)).T) < NEAR
    near[block] = False
    members = np.flatnonzero(near)
    around = scans.map(members, nodes[place], nodes, ON_MAP) if len(members) >= FEWEST else None
    if around is None:
        return []
    return [
        (place, int(k), measure(scans.scan[k], around, relative(nodes[place], nodes[k]), EVALUATED))
        for k in block[scans.count[block] >= FEWEST]
    ]
