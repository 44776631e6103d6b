"""The pose graph: derivatives, solutions compared with a general optimiser, and the effect of false matches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from forward_grid_mapper.core.trajectory.pose_graph import (
    ROBUST,
    ROBUST_ODOMETRY,
    ROBUST_YAW,
    WALL_ANGLE_SIGMA,
    Edges,
    Graph,
    Walls,
    Yaws,
    jacobians,
    no_edges,
    no_walls,
    no_yaws,
    residuals,
    solve,
)
from forward_grid_mapper.core.trajectory.poses import compose, inverse, relative, rms_after_alignment, wrapped

STEP = np.diag([1e3, 1e3, 3e3])


def loop_of(count: int = 12) -> np.ndarray:
    """Poses along a polygon."""
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


def graph_of(odometry: Edges, matches: Edges, yaws: Yaws | None = None, walls: Walls | None = None) -> Graph:
    none = np.zeros((len(odometry.first), 3, 1))
    return Graph(odometry, none, np.ones(1), matches, yaws or no_yaws(), walls or no_walls())


def walls_of(nodes: np.ndarray, wrong: float = 0.0) -> Walls:
    """Distances from two walls, of nodes 1 to 4 and 3 to 5; one distance is wrong."""
    node, wall = np.array([1, 2, 3, 4, 3, 4, 5]), np.array([0, 0, 0, 0, 1, 1, 1])
    normal = np.where(wall[:, None] == 0, [0.0, 1.0], [-1.0, 0.0])
    place = nodes[node, :2]
    distance = np.where(wall == 0, 3.0, 1.0) - (normal * place).sum(1)
    distance[2] += wrong
    along = np.where(wall == 0, place[:, 0], -place[:, 1])
    lever = np.linspace(-0.2, 0.3, 7)
    return Walls(node, wall, normal, distance, lever, nodes[node, 2] + 0.01, along, np.full(7, 1e4))


def test_relative_poses_reverse_composition() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 2, (2, 20, 3))
    there = relative(a, compose(a, b))
    assert there[:, :2] == pytest.approx(b[:, :2])
    assert wrapped(there[:, 2] - b[:, 2]) == pytest.approx(0, abs=1e-12)
    home = compose(a, inverse(a))
    assert home[:, :2] == pytest.approx(0, abs=1e-12)


def test_derivatives_equal_finite_differences() -> None:
    nodes, rng = loop_of(), np.random.default_rng(1)
    edges = Edges(np.array([0, 5, 7]), np.array([3, 2, 11]), rng.normal(0, 1, (3, 3)), np.tile(STEP, (3, 1, 1)))
    one, other = jacobians(nodes, edges)
    for ends, derivative in ((edges.first, one), (edges.second, other)):
        for k in range(3):
            moved = nodes.copy()
            moved[ends, k] += 1e-6
            small = (residuals(moved, edges) - residuals(nodes, edges)) / 1e-6
            assert derivative[:, :, k] == pytest.approx(small, abs=1e-5)


@pytest.mark.parametrize('part', [1.0, 0.4])
def test_solution_equals_that_of_a_general_optimiser(part) -> None:
    nodes = loop_of(6)
    odometry = chain_of(nodes, 0.02)
    match = Edges(np.array([0]), np.array([5]), relative(nodes[0], nodes[5])[None], STEP[None])
    yaws = Yaws(np.array([2, 4]), nodes[[2, 4], 2] + np.array([0.01, 0.9]), np.array([2e3, 2e3]), part)
    walls = walls_of(nodes, 0.05)
    graph = graph_of(odometry, match, yaws, walls)
    start = np.array(nodes)
    solution = solve(graph, start, np.zeros(1), samples=1)

    def cost(free: np.ndarray) -> float:
        lines, x = free[-4:].reshape(2, 2), np.vstack([[0.0, 0.0, free[0]], free[1:-4].reshape(-1, 3)])
        total = 0.0
        for edges, k in ((odometry, ROBUST_ODOMETRY), (match, ROBUST)):
            r = residuals(x, edges)
            s = np.einsum('ei,eij,ej->e', r, edges.information, r)
            total += (k**2 * np.log1p(s / k**2)).sum()
        s = wrapped(x[yaws.node, 2] - yaws.yaw) ** 2 * yaws.information
        total += part * (s / (1 + s / ROBUST_YAW**2)).sum() + ((lines[:, 1] / WALL_ANGLE_SIGMA) ** 2).sum()
        for k, wall, n, z, lever, yaw, along, information in zip(*walls, strict=True):
            off = n @ x[k, :2] + z + lever * wrapped(x[k, 2] - yaw) - lines[wall, 0] - lines[wall, 1] * along
            total += off**2 * information / (1 + off**2 * information / ROBUST_YAW**2)
        return float(total)

    def free_of(x: np.ndarray, lines: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:1, 2], x[1:].ravel(), lines.ravel()])

    guess = free_of(nodes, np.array([[3.0, 0.0], [1.0, 0.0]]))
    best = minimize(cost, guess, method='BFGS', options={'gtol': 1e-6})
    assert free_of(solution.nodes, best.x[-4:]) == pytest.approx(best.x, abs=2e-3)
    assert solution.nodes != pytest.approx(
        solve(graph_of(odometry, match, yaws), start, np.zeros(1), 1).nodes, abs=5e-3
    )


def test_false_matches_are_ignored() -> None:
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
    graph = Graph(measured, change, np.array([0.1]), matches, no_yaws(), no_walls())
    assert solve(graph, start, np.zeros(1), samples=1).calibration[0] == pytest.approx(0.05, abs=0.002)


def test_samples_spread_as_odometry_drifts() -> None:
    nodes = loop_of(20)
    odometry = chain_of(nodes, 0.0)
    solution = solve(graph_of(odometry, no_edges()), np.array(nodes), np.zeros(1), samples=400)
    # variances of the yaw add up: 19 steps of variance 1 / 3000
    assert solution.samples[:, -1, 2].std() == pytest.approx(math.sqrt(19 / 3e3), rel=0.15)
    assert np.abs(solution.samples[:, 0]).max() < 1e-3


def test_straight_wall_keeps_a_drive_straight() -> None:
    rng = np.random.default_rng(5)
    nodes = np.column_stack([np.arange(60) * 0.4, np.zeros((60, 2))])
    odometry = chain_of(nodes, 0.0)
    odometry.pose[:, 2] += rng.normal(0, 0.003, 59)
    walked = [nodes[0]]
    for motion in odometry.pose:
        walked.append(compose(walked[-1], motion))
    start = np.array(walked)
    node, count = np.arange(60), 60
    far = np.full(count, 1.3) + rng.normal(0, 0.01, count)
    # another wall is 40 cm behind, and was taken for the same wall
    far[30:36] += 0.4
    normal = np.tile([0.0, 1.0], (count, 1))
    none = np.zeros(count)
    walls = Walls(node, np.zeros(count, int), normal, far, none, none, nodes[:, 0] - 11.8, np.full(count, 600.0))
    begin = Yaws(np.array([0]), np.zeros(1), np.array([1e6]))
    solution = solve(graph_of(odometry, no_edges(), begin, walls), start, np.zeros(1), samples=200)
    assert np.abs(start[:, 1] - nodes[:, 1]).max() > 0.15
    assert np.abs(solution.nodes[:, 1] - nodes[:, 1]).max() < 0.06
    without = solve(graph_of(odometry, no_edges(), begin), start, np.zeros(1), samples=200)
    assert solution.samples[:, -1, 1].std() < 0.3 * without.samples[:, -1, 1].std()


def test_places_of_walls_in_turned_and_moved_maps() -> None:
    nodes = loop_of(6)
    walls = walls_of(nodes)
    assert walls.total == 2
    assert walls.places(nodes) == pytest.approx(np.where(walls.wall == 0, 3.0, 1.0) - 0.01 * walls.lever)
    moved = nodes + np.array([0.3, -0.2, 0.01])
    assert walls.places(moved) == pytest.approx(np.where(walls.wall == 0, 2.8, 0.7))
    assert no_walls().total == 0


def test_solution_of_a_moved_graph_is_moved() -> None:
    nodes = loop_of(12)
    odometry = chain_of(nodes, 0.02)
    matches = Edges(np.array([0]), np.array([11]), relative(nodes[0], nodes[11])[None], STEP[None])
    one = solve(graph_of(odometry, matches), np.array(nodes), np.zeros(1), samples=1).nodes
    home = np.array([4.0, -7.0, 2.0])
    other = solve(graph_of(odometry, matches), compose(home, nodes), np.zeros(1), samples=1).nodes
    assert relative(home, other)[:, :2] == pytest.approx(one[:, :2], abs=1e-4)
