"""Fitting trajectories to their own maps, so that their J can be compared.

J depends on where corridors lie. It depends as much on small errors, of centimetres and degrees, within a metre or two.
Trajectories that were solved with different trust in odometry have different small errors. So before J decides between
two, each is fitted to the map along it. All windows that are not held out are matched with the map of the other windows
around them, of all visits. Then a pose graph is solved. It has these matches, and the shape that the trajectory had.
This hardly moves a trajectory: places stay where they are. After a change of the scale (`scale`), a trajectory is
fitted as well, and is the result.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.readings import Floats
from ..runtime.threads import in_order
from .holding_out import LEAST_SIGMAS, NEAR, Gain
from .judging import gain_of_objective
from .matching import ENOUGH
from .odometry_model import Noise, covariances
from .passes import BLOCK, FEWEST, Progress, Row, matches_of
from .pose_graph import Edges, Graph, no_walls, no_yaws, solve
from .poses import axes_at, compose, relative
from .scans import MOST_ON_MAP, Scans

SHAPE = Noise(yaw=math.radians(3.0))
"""Noise of the motions of a trajectory that is fitted; the same for all, however they were found."""

ON_MAP, EVALUATED = 2 * MOST_ON_MAP, 2 * ENOUGH
"""Most readings that a map is made from, and that are evaluated to measure a pose: twice as many as usual, since there
are several visits on the map."""

ROUNDS = 2
"""Times that the windows are matched and the graph is solved. If visits agree, J hardly grows in more rounds. If they
do not, more rounds would slowly bend the trajectory until they do."""


def gain_when_fitted(scans: Scans, before: Floats, after: Floats, watch: Progress = lambda part: None) -> Gain:
    """Return the gain in J of `after` over `before`, nats a block.

    If it is at least `LEAST_SIGMAS`, both are fitted first, and the gain is that of the fitted trajectories.

    Parameters
    ----------
    scans : Scans
    before, after : float64, shape (K, 3)
        Nodes.
    watch : callable
        Receives the fraction of the work that is done.

    Raises
    ------
    InputError
        If the map along one of the trajectories is too large.
    """
    better = gain_of_objective(scans, before, after)
    if better.sigmas < LEAST_SIGMAS:
        return better
    try:
        return gain_of_fitted(scans, before, after, watch)
    except InputError:
        # fitted trajectories may be some cells larger
        return better


def gain_of_fitted(scans: Scans, before: Floats, after: Floats, watch: Progress = lambda part: None) -> Gain:
    """Return the gain in J of `after` over `before` after both were fitted; the parameters are those above.

    Raises
    ------
    InputError
        If the map along one of the fitted trajectories is too large.
    """
    first = fitted(scans, before, lambda part: watch(part / 2))
    second = fitted(scans, after, lambda part: watch((1.0 + part) / 2))
    return gain_of_objective(scans, first, second)


def fitted(scans: Scans, nodes: Floats, watch: Progress = lambda part: None) -> Floats:
    """Return the nodes of a trajectory, shape (K, 3), fitted to the map along it; the first one stays."""
    motion = relative(nodes[:-1], nodes[1:])
    count = np.arange(len(nodes))
    information = np.asarray(np.linalg.inv(covariances(scans.windows, SHAPE)), np.float64)
    shape, no_calibration = Edges(count[:-1], count[1:], motion, information), np.zeros((len(motion), 3, 0))
    for k in range(ROUNDS):
        matches = _matched_with_map(scans, nodes, partial(_in_round, watch, k))
        graph = Graph(shape, no_calibration, np.zeros(0), matches, no_yaws(), no_walls())
        nodes = solve(graph, nodes, np.zeros(0)).nodes
    return nodes


def _in_round(watch: Progress, k: int, part: float) -> None:
    """Report the progress of round k."""
    watch((k + part) / ROUNDS)


def _matched_with_map(scans: Scans, nodes: Floats, watch: Progress) -> Edges:
    """Return the poses of windows on the map of all other windows around, as edges from the first node.

    The map stays where it is, so the edges begin at the node that is fixed. Their information is not reduced as in
    `solving`: the result only has to fit its map.
    """
    work = [
        partial(_matches, scans, nodes, np.arange(k, min(k + BLOCK, len(nodes)))) for k in range(0, len(nodes), BLOCK)
    ]
    rows: list[Row] = []
    for done, found in enumerate(in_order(work, scans.threads)):
        watch(done / len(work))
        # the first node is fixed
        rows += [row for row in found if row[1] > 0]
    frames = nodes[np.array([frame for frame, *_ in rows], np.int64)]
    poses = np.array([match.pose for _, _, match, _ in rows]).reshape(-1, 3)
    information = np.empty((len(rows), 3, 3))
    for k, (_, _, match, _) in enumerate(rows):
        axes = axes_at(frames[k, 2] - nodes[0, 2])
        information[k] = axes @ match.information @ axes.T
    window = np.array([window for _, window, _, _ in rows], np.int64)
    return Edges(np.zeros(len(rows), np.int64), window, relative(nodes[0], compose(frames, poses)), information)


def _matches(scans: Scans, nodes: Floats, block: NDArray[np.int64]) -> list[Row]:
    """Return the matches of the windows of a block with the map of all other windows around it."""
    near = np.hypot(*(nodes[:, :2] - nodes[block, :2].mean(0)).T) < NEAR
    near[block] = False
    members = np.flatnonzero(near)
    if len(members) < FEWEST:
        return []
    return matches_of(scans, nodes, block, members, int(block[0]), ON_MAP, EVALUATED)
