"""The pose graph: the nodes that agree best with odometry and with all matches, and the calibration of the odometry.

Unknown are the poses x_k of the nodes and the calibration c of the odometry. With d_ij the pose of node j in the frame
of node i, the sum of

    ρ(‖d_ij − z_ij‖²_Ω) over matches   and   ρ(‖d_k,k+1 − (o_k + C_k c)‖²_Ω) over odometry   and   ‖c‖²_Ω

and, where yaws are measured, of τ((θ_k − y_k)² Ω), is minimised by Gauss-Newton steps. ρ(s) = k² log(1 + s / k²) is
Cauchy's loss; τ(s) = s / (1 + s / k²), that of Geman and McClure, lets go of what is far off, as the direction of a
wall is that stands askew. Both work by weights that follow the residuals. The normal equations are sparse, and solved
as such.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from .poses import Floats, relative, wrapped

ROBUST = 4.0
"""σ from which on a match counts less and less: k of Cauchy's loss for matches."""

ROBUST_ODOMETRY = 3.0
"""The same for odometry: wheels slip more often than a normal distribution has it."""

ROBUST_YAW = 3.0
"""σ from which on a measured yaw is let go."""

ITERATIONS = 30

LEAST_STEP = 1e-4
"""Metres and radians below which a step ends the iterations."""


class Edges(NamedTuple):
    """Relative poses that were measured: E of them.

    Attributes
    ----------
    first, second : int64, shape (E,)
        Nodes i and j.
    pose : float64, shape (E, 3)
        Of node j in the frame of node i.
    information : float64, shape (E, 3, 3)
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    pose: Floats
    information: Floats


class Yaws(NamedTuple):
    """Yaws that were measured, with an unknown few wrong ones among them: Y of them.

    Attributes
    ----------
    node : int64, shape (Y,)
    yaw : float64, shape (Y,)
        Radians.
    information : float64, shape (Y,)
        In 1/rad².
    """

    node: NDArray[np.int64]
    yaw: Floats
    information: Floats


def no_yaws() -> Yaws:
    """Return measured yaws, of which there are none."""
    return Yaws(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


def no_edges() -> Edges:
    """Return edges, of which there are none."""
    none = np.zeros(0, np.int64)
    return Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))


def joined(*parts: Edges) -> Edges:
    """Return all edges of several sets."""
    return Edges(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Graph:
    """What is measured. The first node keeps its place, and without `yaws` its yaw as well.

    Attributes
    ----------
    odometry : Edges
        From each node to the next one, shape K − 1, without calibration.
    sensitivity : float64, shape (K − 1, 3, C)
        How the pose of each odometry edge changes with the calibration.
    calibration_sigma : float64, shape (C,)
        A priori.
    matches : Edges
    yaws : Yaws
    """

    odometry: Edges
    sensitivity: Floats
    calibration_sigma: Floats
    matches: Edges
    yaws: Yaws


@dataclass(frozen=True)
class Solution:
    """The poses and the calibration that agree best with a graph.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
        The first one as it was given.
    calibration : float64, shape (C,)
    squared : float64, shape (E,)
        Squared residual of each match, in σ².
    odometry_squared : float64, shape (K − 1,)
    samples : float64, shape (S, K, 3)
        Deviations drawn from the posterior.
    """

    nodes: Floats
    calibration: Floats
    squared: Floats
    odometry_squared: Floats
    samples: Floats


def residuals(nodes: Floats, edges: Edges) -> Floats:
    """Return d_ij − z_ij of each edge, shape (E, 3)."""
    d = relative(nodes[edges.first], nodes[edges.second])
    out: Floats = d - edges.pose
    out[:, 2] = wrapped(out[:, 2])
    return out


def jacobians(nodes: Floats, edges: Edges) -> tuple[Floats, Floats]:
    """Return how the residuals change with the poses of the first and of the second node, both (E, 3, 3)."""
    d = relative(nodes[edges.first], nodes[edges.second])
    yaw = nodes[edges.first, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    one, other = np.zeros((len(d), 3, 3)), np.zeros((len(d), 3, 3))
    other[:, 0, 0], other[:, 0, 1], other[:, 1, 0], other[:, 1, 1], other[:, 2, 2] = c, s, -s, c, 1.0
    one[:] = -other
    one[:, 0, 2], one[:, 1, 2] = d[:, 1], -d[:, 0]
    return one, other


def weights(squared: Floats, robust: Floats) -> Floats:
    """Return the weights of Cauchy's loss for squared residuals in σ²."""
    out: Floats = 1.0 / (1.0 + squared / robust**2)
    return out


def _squared(r: Floats, information: Floats) -> Floats:
    out: Floats = np.einsum('ei,eij,ej->e', r, information, r)
    return out


class _Normal:
    """Normal equations of a graph, linearised at a guess."""

    def __init__(self, graph: Graph, nodes: Floats, calibration: Floats) -> None:
        self.graph, self.nodes, self.calibration = graph, nodes, calibration
        both = joined(graph.odometry, graph.matches)
        n, count, wide = len(graph.odometry.first), len(nodes), len(calibration)
        r = residuals(nodes, both)
        r[:n] -= graph.sensitivity @ calibration
        self.squared = _squared(r, both.information)
        loss = np.where(np.arange(len(r)) < n, ROBUST_ODOMETRY, ROBUST)
        weight = weights(self.squared, loss)
        self.cost = float((loss**2 * np.log1p(self.squared / loss**2)).sum())
        self.cost += float(((calibration / graph.calibration_sigma) ** 2).sum())
        self.information = both.information * weight[:, None, None]
        yaws = graph.yaws
        off = wrapped(nodes[yaws.node, 2] - yaws.yaw)
        far = 1.0 + off**2 * yaws.information / ROBUST_YAW**2
        self.cost += float((off**2 * yaws.information / far).sum())
        pull = yaws.information / far**2
        one, other = jacobians(nodes, both)
        rows = np.arange(3 * len(r)).reshape(-1, 3, 1)
        columns = [3 * ends[:, None, None] + np.arange(3) for ends in (both.first, both.second)]
        parts = [
            (np.broadcast_to(rows, one.shape), np.broadcast_to(c, one.shape), v)
            for c, v in zip(columns, (one, other), strict=True)
        ]
        shape = (n, 3, wide)
        extra = np.broadcast_to(3 * count + np.arange(wide), shape)
        parts.append((np.broadcast_to(rows[:n], shape), extra, -graph.sensitivity))
        i, j, v = (np.concatenate([part[k].ravel() for part in parts]) for k in range(3))
        self.j = sparse.csr_matrix((v, (i, j)), shape=(3 * len(r), 3 * count + wide))
        self.omega = sparse.block_diag(list(self.information), format='csr')
        prior = np.zeros(3 * count + wide)
        prior[:2], prior[3 * count :] = 1e8, 1.0 / graph.calibration_sigma**2
        prior[2] = 1e-3 if len(yaws.node) else 1e8
        np.add.at(prior, 3 * yaws.node + 2, pull)
        self.h = (self.j.T @ self.omega @ self.j + sparse.diags(prior)).tocsc()
        gradient = self.j.T @ (self.omega @ r.ravel())
        np.add.at(gradient, 3 * yaws.node + 2, pull * off)
        self.yaw_pull = np.bincount(3 * yaws.node + 2, pull, 3 * count + wide)
        gradient[3 * count :] += calibration / graph.calibration_sigma**2
        self.gradient = gradient
        self.factor = None

    def step(self, damping: float) -> Floats:
        diagonal = sparse.diags(damping * self.h.diagonal())
        out: Floats = splu(self.h + diagonal).solve(-self.gradient)
        return out

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Return deviations of all unknowns, shape (3 K + C, count)."""
        roots = np.linalg.cholesky(self.information + 1e-9 * np.eye(3))
        noise = rng.standard_normal((len(roots), 3, count))
        pulled = np.einsum('eij,ejs->eis', roots, noise).reshape(-1, count)
        right = self.j.T @ pulled
        wide = len(self.calibration)
        right += np.sqrt(self.yaw_pull)[:, None] * rng.standard_normal(right.shape)
        right[-wide:] += rng.standard_normal((wide, count)) / self.graph.calibration_sigma[:, None]
        out: Floats = splu(self.h).solve(np.ascontiguousarray(right))
        return out


def solve(graph: Graph, nodes: Floats, calibration: Floats, samples: int = 0, seed: int = 0) -> Solution:
    """Return the solution of a graph near a guess.

    Parameters
    ----------
    graph : Graph
    nodes : float64, shape (K, 3)
    calibration : float64, shape (C,)
    samples : int
        How many deviations to draw from the posterior.
    """
    normal, damping = _Normal(graph, nodes, calibration), 0.0
    for _ in range(ITERATIONS):
        step = normal.step(damping)
        moved = normal.nodes + step[: 3 * len(nodes)].reshape(-1, 3)
        tried = _Normal(graph, moved, normal.calibration + step[3 * len(nodes) :])
        if tried.cost > normal.cost * (1 + 1e-9):
            damping = max(10 * damping, 1e-4)
            if damping > 1e4:
                break
            continue
        normal, damping = tried, damping / 10 if damping > 1e-6 else 0.0
        if np.abs(step).max() < LEAST_STEP:
            break
    n = len(graph.odometry.first)
    drawn = normal.draw(samples, np.random.default_rng(seed))[: 3 * len(nodes)].T.reshape(samples, -1, 3)
    return Solution(normal.nodes, normal.calibration, normal.squared[n:], normal.squared[:n], drawn)
