"""The pose graph: derivatives, solutions against a general optimiser, and what false matches do to it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from forward_grid_mapper.core.trajectory.chain import Chain
from forward_grid_mapper.core.trajectory.matching import Match
from forward_grid_mapper.core.trajectory.pose_graph import (
    ROBUST,
    ROBUST_ODOMETRY,
    ROBUST_YAW,
    Edges,
    Graph,
    Yaws,
    jacobians,
    no_edges,
    no_yaws,
    residuals,
    solve,
)
from forward_grid_mapper.core.trajectory.poses import compose, inverse, relative, rms_after_alignment, wrapped

STEP = np.diag([1e3, 1e3, 3e3])


def loop_of(count: int = 12) -> np.ndarray:
    """Poses around a polygon."""
    turn = 2 * math.pi / count
    poses = [np.zeros(3)]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], np.array([1.0, 0.0, turn])))
    return np.array(poses)


def chain_of(nodes: np.ndarray, noise: float, seed: int = 0) -> Edges:
    rng = np.random.default_rng(seed)
    motion = relative(nodes[:-1], nodes[1:]) + rng.normal(0, noise, (len(nodes) - 1, 3))
    k = np.arange(len(nodes))
    return Edges(k[:-1], k[1:], motion, np.tile(STEP, (len(nodes) - 1, 1, 1)))


def graph_of(odometry: Edges, matches: Edges, yaws: Yaws | None = None) -> Graph:
    none = np.zeros((len(odometry.first), 3, 1))
    return Graph(odometry, none, np.ones(1), matches, no_yaws() if yaws is None else yaws)


def test_poses_compose_and_come_apart() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 2, (2, 20, 3))
    there = relative(a, compose(a, b))
    assert there[:, :2] == pytest.approx(b[:, :2])
    assert wrapped(there[:, 2] - b[:, 2]) == pytest.approx(0, abs=1e-12)
    home = compose(a, inverse(a))
    assert home[:, :2] == pytest.approx(0, abs=1e-12)


def test_derivatives_are_those_of_small_steps() -> None:
    nodes, rng = loop_of(), np.random.default_rng(1)
    edges = Edges(np.array([0, 5, 7]), np.array([3, 2, 11]), rng.normal(0, 1, (3, 3)), np.tile(STEP, (3, 1, 1)))
    one, other = jacobians(nodes, edges)
    for ends, derivative in ((edges.first, one), (edges.second, other)):
        for k in range(3):
            moved = nodes.copy()
            moved[ends, k] += 1e-6
            small = (residuals(moved, edges) - residuals(nodes, edges)) / 1e-6
            assert derivative[:, :, k] == pytest.approx(small, abs=1e-5)


def test_the_solution_is_that_of_a_general_optimiser() -> None:
    nodes = loop_of(6)
    odometry = chain_of(nodes, 0.02)
    match = Edges(np.array([0]), np.array([5]), relative(nodes[0], nodes[5])[None], STEP[None])
    yaws = Yaws(np.array([2, 4]), nodes[[2, 4], 2] + np.array([0.01, 0.9]), np.array([2e3, 2e3]))
    graph = graph_of(odometry, match, yaws)
    start = np.array(nodes)
    solution = solve(graph, start, np.zeros(1), samples=1)

    def cost(free: np.ndarray) -> float:
        x = np.vstack([[0.0, 0.0, free[0]], free[1:].reshape(-1, 3)])
        total = 0.0
        for edges, k in ((odometry, ROBUST_ODOMETRY), (match, ROBUST)):
            r = residuals(x, edges)
            s = np.einsum('ei,eij,ej->e', r, edges.information, r)
            total += (k**2 * np.log1p(s / k**2)).sum()
        s = wrapped(x[yaws.node, 2] - yaws.yaw) ** 2 * yaws.information
        return total + (s / (1 + s / ROBUST_YAW**2)).sum()

    def free_of(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:1, 2], x[1:].ravel()])

    best = minimize(cost, free_of(nodes), method='BFGS', options={'gtol': 1e-6})
    assert cost(free_of(solution.nodes)) <= best.fun + 1e-3
    assert free_of(solution.nodes) == pytest.approx(best.x, abs=2e-3)


def test_false_matches_are_let_go() -> None:
    nodes = loop_of(40)
    odometry = chain_of(nodes, 0.01)
    rng = np.random.default_rng(3)
    first = np.arange(0, 20)
    second = first + 19
    pose = relative(nodes[first], nodes[second]) + rng.normal(0, 0.01, (20, 3))
    pose[::5] += [2.0, -1.0, 0.8]
    matches = Edges(first, second, pose, np.tile(STEP, (20, 1, 1)))
    walked = [nodes[0]]
    for motion in odometry.pose:
        walked.append(compose(walked[-1], motion))
    start = np.array(walked)
    solution = solve(graph_of(odometry, matches), start, np.zeros(1), samples=1)
    assert rms_after_alignment(solution.nodes, nodes) < 0.05
    assert solution.squared[::5].min() > 20 * np.median(solution.squared)


def test_calibration_is_found_from_matches() -> None:
    nodes = loop_of(30)
    odometry = chain_of(nodes, 0.0)
    measured = odometry._replace(pose=odometry.pose * [1 / 1.05, 1 / 1.05, 1.0])
    change = np.zeros((29, 3, 1))
    change[:, :2, 0] = measured.pose[:, :2]
    first = np.arange(0, 25)
    matches = Edges(first, first + 5, relative(nodes[first], nodes[first + 5]), np.tile(STEP, (25, 1, 1)))
    start = np.array(nodes)
    graph = Graph(measured, change, np.array([0.1]), matches, no_yaws())
    assert solve(graph, start, np.zeros(1), samples=1).calibration[0] == pytest.approx(0.05, abs=0.002)


def test_deviations_are_as_wide_as_odometry_drifts() -> None:
    nodes = loop_of(20)
    odometry = chain_of(nodes, 0.0)
    solution = solve(graph_of(odometry, no_edges()), np.array(nodes), np.zeros(1), samples=400)
    # yaws add up: 19 steps of variance 1 / 3000
    assert solution.samples[:, -1, 2].std() == pytest.approx(math.sqrt(19 / 3e3), rel=0.15)
    assert np.abs(solution.samples[:, 0]).max() < 1e-3


def test_a_block_alone_is_solved_like_a_graph() -> None:
    nodes = loop_of(6)
    odometry = chain_of(nodes, 0.03)
    yaws = Yaws(np.array([3]), nodes[[3], 2], np.array([2e3]))
    match = Match(nodes[4] + [0.05, 0.0, 0.01], STEP, 0.0)
    chain = Chain(odometry.pose, np.linalg.inv(odometry.information), yaws)
    block = np.arange(1, 6)
    alone = nodes[block]
    for _ in range(5):
        alone = chain.solve(nodes[0], block, alone, [(3, match)])
    one = Edges(np.array([0]), np.array([4]), relative(nodes[0], match.pose)[None], STEP[None])
    weak = Yaws(np.array([0, 3]), np.array([0.0, nodes[3, 2]]), np.array([1e9, 2e3]))
    whole = solve(graph_of(odometry, one, weak), np.array(nodes), np.zeros(1), samples=1)
    assert alone == pytest.approx(whole.nodes[1:], abs=1e-3)


def test_a_graph_moves_as_a_whole() -> None:
    nodes = loop_of(12)
    odometry = chain_of(nodes, 0.02)
    matches = Edges(np.array([0]), np.array([11]), relative(nodes[0], nodes[11])[None], STEP[None])
    one = solve(graph_of(odometry, matches), np.array(nodes), np.zeros(1), samples=1).nodes
    home = np.array([4.0, -7.0, 2.0])
    other = solve(graph_of(odometry, matches), compose(home, nodes), np.zeros(1), samples=1).nodes
    assert relative(home, other)[:, :2] == pytest.approx(one[:, :2], abs=1e-4)
