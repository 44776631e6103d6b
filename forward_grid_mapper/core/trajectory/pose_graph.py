"""The pose graph: nodes and calibration of the odometry that fit all measurements best, by nonlinear least squares.

Unknowns are the poses x_k of the nodes, the calibration c of the odometry, and of each wall its offset w and its angle
a to the axis. With d_ij the pose of node j in the frame of node i, the solution minimises

    Σ ρ(‖d_ij − z_ij‖²_Ω)                          matches and loop closures z_ij
    + Σ ρ(‖d_k,k+1 − (o_k + C_k c)‖²_Ω) + ‖c‖²_Ω   odometry o_k, its calibration and the prior of this
    + Σ τ((θ_k − y_k)² Ω)                          measured yaws y_k
    + Σ τ((n · x_k + z_k − w − a t_k)² Ω)          measured distances z_k to walls of normal n; t_k along the wall
    + Σ (a / `WALL_ANGLE_SIGMA`)²                  the prior of the angles of walls

where ρ(s) = k² log(1 + s / k²) is Cauchy's loss and τ(s) = s / (1 + s / k²) that of Geman and McClure, under which
outliers, such as the direction of a wall at another angle, have almost no influence. Solved by Gauss-Newton with
iteratively reweighted residuals and damping; the normal equations are sparse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..common.readings import Floats
from .bordered import Bordered
from .poses import relative, wrapped

ROBUST = 4.0
"""k of Cauchy's loss for matches, σ: larger residuals count less and less."""

ROBUST_ODOMETRY = 3.0
"""k of Cauchy's loss for odometry, σ: slip of wheels has heavier tails than a normal distribution."""

ROBUST_YAW = 3.0
"""k of Geman and McClure's loss for measured yaws and distances of walls, σ."""

WALL_ANGLE_SIGMA = math.radians(0.5)
"""σ of the angle between a wall and its axis, radians."""

ITERATIONS = 30

LEAST_STEP = 1e-4
"""The iterations end if no node moves by more than this, metres and radians."""


class Edges(NamedTuple):
    """E measured relative poses.

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
    """Y measured yaws; a few of them may be outliers.

    Attributes
    ----------
    node : int64, shape (Y,)
    yaw : float64, shape (Y,)
        Radians.
    information : float64, shape (Y,)
        In 1/rad².
    part : float
        Factor of the loss of each; less than 1 if their errors are correlated.
    """

    node: NDArray[np.int64]
    yaw: Floats
    information: Floats
    part: float = 1.0


class Walls(NamedTuple):
    """D measured distances of nodes from W straight walls, which are nearly parallel to axes.

    Attributes
    ----------
    node, wall : int64, shape (D,)
        Index of the node; number of the wall, from 0.
    normal : float64, shape (D, 2)
        Unit vector along an axis, from the node to the wall.
    distance : float64, shape (D,)
        From the node to the wall, metres.
    lever : float64, shape (D,)
        Derivative of the offset of the wall with respect to the yaw of the node, metres a radian.
    yaw : float64, shape (D,)
        Yaw of the node at which `distance` was measured.
    along : float64, shape (D,)
        Position of the node along the wall, metres.
    information : float64, shape (D,)
        In 1/m².
    """

    node: NDArray[np.int64]
    wall: NDArray[np.int64]
    normal: Floats
    distance: Floats
    lever: Floats
    yaw: Floats
    along: Floats
    information: Floats

    @property
    def total(self) -> int:
        """W."""
        return int(self.wall.max(initial=-1)) + 1

    def places(self, nodes: Floats) -> Floats:
        """Return the offset of its wall along the normal by each distance, shape (D,), metres."""
        at = nodes[self.node]
        off = wrapped(at[:, 2] - self.yaw)
        out: Floats = (self.normal * at[:, :2]).sum(1) + self.distance + self.lever * off
        return out


def no_walls() -> Walls:
    """Return an empty set of distances."""
    none, zero = np.zeros(0, np.int64), np.zeros(0)
    return Walls(none, none, np.zeros((0, 2)), zero, zero, zero, zero, zero)


def no_yaws() -> Yaws:
    """Return an empty set of yaws."""
    return Yaws(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


def no_edges() -> Edges:
    """Return an empty set of edges."""
    none = np.zeros(0, np.int64)
    return Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))


def joined(*parts: Edges) -> Edges:
    """Return all edges of several sets."""
    return Edges(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Graph:
    """All measurements. The first node is fixed; with `yaws`, its yaw is not.

    Attributes
    ----------
    odometry : Edges
        From each node to the next one, K − 1 edges, without calibration.
    sensitivity : float64, shape (K − 1, 3, C)
        Derivative of the pose of each odometry edge with respect to the calibration.
    calibration_sigma : float64, shape (C,)
        σ of the prior.
    matches : Edges
    yaws : Yaws
    walls : Walls
    """

    odometry: Edges
    sensitivity: Floats
    calibration_sigma: Floats
    matches: Edges
    yaws: Yaws
    walls: Walls


@dataclass(frozen=True)
class Solution:
    """The solution of a graph.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
    calibration : float64, shape (C,)
    squared : float64, shape (E,)
        Squared residual of each match, σ².
    samples : float64, shape (S, K, 3)
        Deviations of the nodes from the solution, drawn from the posterior.
    """

    nodes: Floats
    calibration: Floats
    squared: Floats
    samples: Floats


def solution_at(nodes: Floats, calibration: int) -> Solution:
    """Return nodes as a solution without residuals and samples; the calibration has this many values, all 0."""
    return Solution(nodes, np.zeros(calibration), np.zeros(0), np.zeros((0, *nodes.shape)))


def residuals(nodes: Floats, edges: Edges) -> Floats:
    """Return d_ij − z_ij of each edge, shape (E, 3)."""
    d = relative(nodes[edges.first], nodes[edges.second])
    out: Floats = d - edges.pose
    out[:, 2] = wrapped(out[:, 2])
    return out


def jacobians(nodes: Floats, edges: Edges) -> tuple[Floats, Floats]:
    """Return the Jacobians of the residuals with respect to the first and the second node, both (E, 3, 3)."""
    d = relative(nodes[edges.first], nodes[edges.second])
    yaw = nodes[edges.first, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    one, other = np.zeros((len(d), 3, 3)), np.zeros((len(d), 3, 3))
    other[:, 0, 0], other[:, 0, 1], other[:, 1, 0], other[:, 1, 1], other[:, 2, 2] = c, s, -s, c, 1.0
    one[:] = -other
    one[:, 0, 2], one[:, 1, 2] = d[:, 1], -d[:, 0]
    return one, other


def weights(squared: Floats, robust: Floats) -> Floats:
    """Return the weights of Cauchy's loss for squared residuals, σ²; `robust` is its k."""
    out: Floats = 1.0 / (1.0 + squared / robust**2)
    return out


def _squared(r: Floats, information: Floats) -> Floats:
    out: Floats = np.einsum('ei,eij,ej->e', r, information, r)
    return out


class _State(NamedTuple):
    """All unknowns.

    Attributes
    ----------
    nodes : float64, shape (K, 3)
    calibration : float64, shape (C,)
    walls : float64, shape (W, 2)
        Offset and angle of each wall.
    """

    nodes: Floats
    calibration: Floats
    walls: Floats

    def moved(self, step: Floats) -> _State:
        """Return the unknowns after a step, shape (3 K + C + 2 W,)."""
        ends = np.cumsum([3 * len(self.nodes), len(self.calibration)])
        nodes, calibration, walls = np.split(step, ends)
        return _State(
            self.nodes + nodes.reshape(-1, 3), self.calibration + calibration, self.walls + walls.reshape(-1, 2)
        )


class _Normal:
    """Normal equations of a graph, linearised at a guess."""

    def __init__(self, graph: Graph, state: _State) -> None:
        self.graph, self.state = graph, state
        nodes, calibration = state.nodes, state.calibration
        both = joined(graph.odometry, graph.matches)
        n, count, wide = len(graph.odometry.first), len(nodes), len(calibration)
        self.size = 3 * count + wide + 2 * len(state.walls)
        r = residuals(nodes, both)
        r[:n] -= graph.sensitivity @ calibration
        self.squared = _squared(r, both.information)
        loss = np.where(np.arange(len(r)) < n, ROBUST_ODOMETRY, ROBUST)
        weight = weights(self.squared, loss)
        self.cost = float((loss**2 * np.log1p(self.squared / loss**2)).sum())
        self.information = both.information * weight[:, None, None]
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
        self.j = sparse.csr_matrix((v, (i, j)), shape=(3 * len(r), self.size))
        blocks = np.arange(len(r) + 1)
        self.omega = sparse.bsr_matrix((self.information, blocks[:-1], blocks), shape=(3 * len(r),) * 2).tocsr()
        self.h = self.j.T @ self.omega @ self.j
        self.gradient = self.j.T @ (self.omega @ r.ravel())
        self.pulled = [self._add(*self._yaws(), graph.yaws.part), self._add(*self._walls())]
        self._add_prior()

    def _yaws(self) -> tuple[Any, Floats, Floats]:
        """Return the Jacobian of the residuals of measured yaws, the residuals, and their information."""
        yaws = self.graph.yaws
        j = sparse.csr_matrix(
            (np.ones(len(yaws.node)), (np.arange(len(yaws.node)), 3 * yaws.node + 2)), (len(yaws.node), self.size)
        )
        return j, wrapped(self.state.nodes[yaws.node, 2] - yaws.yaw), yaws.information

    def _walls(self) -> tuple[Any, Floats, Floats]:
        """Return the same of distances of walls."""
        walls, (nodes, calibration, lines) = self.graph.walls, self.state
        count, first = len(walls.node), 3 * len(nodes) + len(calibration)
        off = walls.places(nodes) - lines[walls.wall, 0] - lines[walls.wall, 1] * walls.along
        at, wall = 3 * walls.node, first + 2 * walls.wall
        columns = np.stack([at, at + 1, at + 2, wall, wall + 1], axis=1)
        values = np.column_stack([walls.normal, walls.lever, -np.ones(count), -walls.along])
        rows = np.broadcast_to(np.arange(count)[:, None], columns.shape)
        j = sparse.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (count, self.size))
        return j, off, walls.information

    def _add(self, j: Any, off: Floats, information: Floats, part: float = 1.0) -> tuple[Any, Floats]:
        """Add measurements with Geman and McClure's loss, times `part`; return what `draw` needs of them."""
        far = 1.0 + off**2 * information / ROBUST_YAW**2
        self.cost += part * float((off**2 * information / far).sum())
        pull = part * information / far**2
        self.h = self.h + j.T @ sparse.diags(pull) @ j
        self.gradient += j.T @ (pull * off)
        return j, np.sqrt(pull)

    def _add_prior(self) -> None:
        nodes, calibration, walls = self.state
        end = 3 * len(nodes)
        prior = np.zeros(self.size)
        prior[:2], prior[2] = 1e8, 1e-3 if len(self.graph.yaws.node) else 1e8
        prior[end : end + len(calibration)] = 1.0 / self.graph.calibration_sigma**2
        prior[end + len(calibration) :: 2], prior[end + len(calibration) + 1 :: 2] = 1e-6, 1.0 / WALL_ANGLE_SIGMA**2
        self.cost += float(((calibration / self.graph.calibration_sigma) ** 2).sum())
        self.cost += float(((walls[:, 1] / WALL_ANGLE_SIGMA) ** 2).sum())
        self.gradient[end : end + len(calibration)] += calibration / self.graph.calibration_sigma**2
        self.gradient[end + len(calibration) + 1 :: 2] += walls[:, 1] / WALL_ANGLE_SIGMA**2
        self.h = (self.h + sparse.diags(prior)).tocsc()
        self.prior = prior
        self.prior[:3] = 0.0

    def step(self, damping: float) -> Floats:
        return self._factors(sparse.diags(damping * self.h.diagonal())).solve(-self.gradient)

    def _factors(self, more: Any = 0.0) -> Bordered:
        first = 3 * len(self.state.nodes)
        return Bordered((self.h + more).tocsc(), slice(first, first + len(self.state.calibration)))

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Return deviations of all unknowns, drawn from the posterior, shape (3 K + C + 2 W, count)."""
        if not count:
            return np.zeros((self.size, 0))
        roots = np.linalg.cholesky(self.information + 1e-9 * np.eye(3))
        noise = rng.standard_normal((len(roots), 3, count))
        right = self.j.T @ np.einsum('eij,ejs->eis', roots, noise).reshape(3 * len(roots), count)
        for j, root in self.pulled:
            right += j.T @ (root[:, None] * rng.standard_normal((len(root), count)))
        right += np.sqrt(self.prior)[:, None] * rng.standard_normal(right.shape)
        return self._factors().solve(right)


def _where_walls_are(walls: Walls, nodes: Floats) -> Floats:
    """Return offset and angle of each wall, shape (W, 2): the median by its distances, and 0."""
    at = walls.places(nodes)
    order = np.lexsort((at, walls.wall))
    first = np.searchsorted(walls.wall[order], np.arange(walls.total + 1))
    out = np.zeros((walls.total, 2))
    out[:, 0] = at[order[(first[:-1] + first[1:] - 1) // 2]] if walls.total else 0.0
    return out


def solve(graph: Graph, nodes: Floats, calibration: Floats, samples: int = 0) -> Solution:
    """Return the solution of a graph.

    Parameters
    ----------
    graph : Graph
    nodes : float64, shape (K, 3)
        Initial guess.
    calibration : float64, shape (C,)
        Initial guess.
    samples : int
        Number of deviations that are drawn from the posterior.
    """
    normal, damping = _Normal(graph, _State(nodes, calibration, _where_walls_are(graph.walls, nodes))), 0.0
    for _ in range(ITERATIONS):
        step = normal.step(damping)
        tried = _Normal(graph, normal.state.moved(step))
        if tried.cost > normal.cost * (1 + 1e-9):
            damping = max(10 * damping, 1e-4)
            if damping > 1e4:
                break
            continue
        normal, damping = tried, damping / 10 if damping > 1e-6 else 0.0
        if np.abs(step[: 3 * len(nodes)]).max() < LEAST_STEP:
            break
    n = len(graph.odometry.first)
    drawn = normal.draw(samples, np.random.default_rng(0))[: 3 * len(nodes)].T.reshape(samples, len(nodes), 3)
    state = normal.state
    return Solution(state.nodes, state.calibration, normal.squared[n:], drawn)
