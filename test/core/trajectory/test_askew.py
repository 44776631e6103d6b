"""Buildings with two parts at an angle: different directions of walls are not taken for drift of the yaw."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory import heading as module
from forward_grid_mapper.core.trajectory.heading import Drifts, Heading, heading
from forward_grid_mapper.core.trajectory.holding_out import held_out
from forward_grid_mapper.core.trajectory.poses import compose, rms_after_alignment, wrapped
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.core.trajectory.wall_distances import Distances
from forward_grid_mapper.core.trajectory.walls import DIRECTIONS, wall_votes
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan, World, building_tour, building_world

KINK = math.radians(25.0)
PIVOT = np.array([16.0, 5.0])
LENGTH, HALF = 13.0, 1.0
"""Metres: the length of each of the two corridors, and half of their width."""


def along(metres: float, aside: float = 0.0) -> np.ndarray:
    """A place at this distance along the middle line of both corridors, from the kink on, and to the left of it."""
    angle = KINK if metres > 0.0 else 0.0
    c, s = math.cos(angle), math.sin(angle)
    return PIVOT + np.array([metres * c - aside * s, metres * s + aside * c])


def kinked_world() -> World:
    """Two corridors with a kink of 25° between them, and cupboards along their walls."""
    plan = Floorplan('kink', 320, 160)

    def line(*places: np.ndarray) -> None:
        cells = [tuple(np.floor(place * 10).astype(int).tolist()) for place in places]
        for start, end in itertools.pairwise(cells):
            plan.line(start, end)

    for side in (-HALF, HALF):
        corner = PIVOT + side / math.cos(KINK / 2) * np.array([-math.sin(KINK / 2), math.cos(KINK / 2)])
        line(along(-LENGTH, side), corner, along(LENGTH, side))
        for metres in (-10.5, -6.0, -4.0, 3.5, 7.0, 10.0):
            near, far = (metres + (0.6 if side > 0 else 0.0) + more for more in (0.0, 0.8))
            inner = side - math.copysign(0.3, side)
            line(along(near, side), along(near, inner), along(far, inner), along(far, side))
    for end in (-LENGTH, LENGTH):
        line(along(end, -HALF), along(end, HALF))
    return plan.world((160, 50))


@pytest.fixture(scope='module')
def exact() -> Recording:
    ends = [along(-LENGTH + 1.5), along(0.0), along(LENGTH - 1.5), along(0.0)]
    way = np.array([*ends, *ends, ends[0]])
    return drive(kinked_world(), way, 0.15, sonar_ring(16), NOISY, seed=3)


@pytest.fixture(scope='module')
def bent(exact: Recording) -> tuple[Recording, Odometry, Windows]:
    recording = with_drift(exact, LEVELS['low'], 8)
    odometry = odometry_of(recording)
    return recording, odometry, cut(recording.readings, odometry)


@pytest.fixture(scope='module')
def found(bent: tuple[Recording, Odometry, Windows]) -> Heading:
    windows = bent[2]
    found_heading = heading(windows, *wall_votes(windows, np.zeros(len(windows), bool)))
    assert found_heading is not None
    return found_heading


def test_second_direction_of_walls_is_found(exact, bent, found) -> None:
    windows = bent[2]
    x = odometry_of(exact).at(windows.node_stamp)[found.at, 0] - PIVOT[0]
    second = (
        found.wall_direction != 0.0
        if (found.wall_direction[x < -4.0] == 0.0).mean() > 0.5
        else found.wall_direction == 0.0
    )
    assert (second[x > 4.0]).mean() > 0.9 and (second[x < -4.0]).mean() < 0.1
    directions = set(found.wall_direction.tolist())
    assert len(directions) == 2
    angle = max(directions)
    assert abs(abs(math.remainder(angle, math.pi / 2)) - KINK) < math.radians(3.0)


def test_heading_is_right_in_both_parts(exact, bent, found, monkeypatch) -> None:
    windows = bent[2]

    def off(found_heading: Heading) -> float:
        true = odometry_of(exact).at(windows.node_stamp)[found_heading.at, 2]
        wrong = wrapped(windows.node[found_heading.at, 2] + found_heading.correction - true)
        middle = math.atan2(np.sin(wrong).mean(), np.cos(wrong).mean())
        return float(np.degrees(np.sqrt((wrapped(wrong - middle) ** 2).mean())))

    assert off(found) < 2.0
    monkeypatch.setattr(module, 'MOST_FURTHER_PARTS', 0)
    alike = heading(windows, *wall_votes(windows, np.zeros(len(windows), bool)))
    assert alike is not None and (alike.wall_direction == 0.0).all()
    assert off(alike) > 8.0


def test_yaw_is_measured_in_both_parts(found) -> None:
    for part in (found.wall_direction == 0.0, found.wall_direction != 0.0):
        measured = part & (found.information > 0.0)
        assert measured.sum() > 0.6 * part.sum()
        off = np.degrees(wrapped(found.measured - found.correction))[measured]
        assert np.sqrt((off**2).mean()) < 2.0


def test_node_has_the_direction_of_the_nearest_votes(bent, found) -> None:
    _, odometry, windows = bent
    scans = Scans(windows, Parameters(), np.zeros(1, np.uint8), held_out(len(windows)))
    solver = Solver(odometry, windows, scans, found, lambda stage: lambda part: None)
    for node, angle in enumerate(solver._wall_angle.tolist()):
        off = np.abs(found.at - node)
        assert angle in found.wall_direction[off == off.min()]


@pytest.mark.slow
def test_drive_through_both_parts_is_refined(exact: Recording, bent: tuple[Recording, Odometry, Windows]) -> None:
    (recording, odometry, _), true = bent, odometry_of(exact)
    assert rms_after_alignment(odometry.pose, true.pose) > 1.0
    outcome = Refiner(Parameters()).run(recording.readings, odometry)
    assert outcome.accepted
    assert rms_after_alignment(outcome.trajectory.pose, true.pose) < 0.15


@pytest.mark.slow
def test_exact_odometry_in_both_parts_is_kept(exact: Recording) -> None:
    outcome = Refiner(Parameters()).run(exact.readings, odometry_of(exact))
    assert not outcome.accepted
    assert outcome.readings is exact.readings


@pytest.mark.parametrize('askew', [(0.0,), (0.0, 0.7), (0.0, 0.3, 1.1)])
def test_beliefs_of_two_places_equal_a_sum_over_all_pairs_of_states(bent, askew: tuple[float, ...]) -> None:
    windows = bent[2]
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    drifts = Drifts(0.01, 0.02, 0.05, 0.09)
    chain = module._Chain(windows, at[3:5], votes[3:5], askew)
    count, states = len(askew), module.STATES
    moved = drifts.bias * chain.length[0] + drifts.turn_scale * chain.turn[0]
    sigma = math.sqrt(
        drifts.noise**2 * chain.length[0] + drifts.turn_noise**2 * chain.turned[0] + module.LEAST_NOISE**2
    )
    x = (chain.grid - moved + math.pi / 4) % (math.pi / 2) - math.pi / 4
    density = (1 - module.SLIPS) * np.exp(-0.5 * (x / sigma) ** 2) + module.SLIPS / 3 * np.exp(
        -0.5 * (x / sigma / 3) ** 2
    )
    density /= density.sum()
    other = 1.0 - math.exp(-module.ENTERED * chain.length[0]) if count > 1 else 0.0
    both = np.zeros((2, count, states))
    for d0 in range(count):
        for s0 in range(states):
            for d1 in range(count):
                stays = (1.0 - other) * (d0 == d1) + other / count
                joint = chain.likelihood[0, d0, s0] * stays * np.roll(density, s0) * chain.likelihood[1, d1]
                joint /= count * states
                both[0, d0, s0] += joint.sum()
                both[1, d1] += joint
    assert chain.log_likelihood(drifts) == pytest.approx(math.log(both[1].sum()), abs=1e-9)
    smooth = chain.smooth(drifts)
    for k in range(2):
        assert smooth[k] == pytest.approx(both[k] / both[k].sum(), abs=1e-12)


def test_votes_for_turned_walls_equal_those_of_a_robot_turned_back(bent) -> None:
    windows = bent[2]
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    steps = 50
    chain = module._Chain(windows, at[:4], votes[:4], (0.0, steps * module.STEP))
    assert chain.likelihood[:, 1] == pytest.approx(np.roll(chain.likelihood[:, 0], steps, axis=1), abs=1e-9)
    assert DIRECTIONS * 2 == module.STATES


def test_distances_of_turned_walls_equal_those_of_a_map_turned_back(bent) -> None:
    windows = bent[2]
    nothing, angle = np.zeros(len(windows), bool), 0.4
    turned = compose(np.array([0.0, 0.0, angle]), windows.node)
    one = Distances(windows, nothing, windows.node)
    other = Distances(windows, nothing, turned, np.full(len(windows), angle))
    assert np.array_equal(one.direction, other.direction) and np.array_equal(one.node, other.node)
    assert one.distance == pytest.approx(other.distance, abs=1e-9)
    assert one.lever == pytest.approx(other.lever, abs=1e-9)
    assert np.array_equal(one.tracked(True), other.tracked(True))
    c, s = math.cos(angle), math.sin(angle)
    assert one.normal @ np.array([[c, s], [-s, c]]) == pytest.approx(other.normal, abs=1e-9)


@pytest.mark.slow
def test_drift_gives_no_second_direction_of_walls() -> None:
    recording = drive(building_world(), building_tour(), 0.1, front_array(), NOISY, seed=3)
    drifting = with_drift(recording, LEVELS['wheels'], 2)
    windows = cut(drifting.readings, odometry_of(drifting))
    found_heading = heading(windows, *wall_votes(windows, np.zeros(len(windows), bool)))
    assert found_heading is not None and (found_heading.wall_direction == 0.0).all()


def test_wall_ends_at_the_border_between_parts(bent) -> None:
    windows = bent[2]
    nothing, askew = np.zeros(len(windows), bool), np.zeros(len(windows))
    askew[len(windows) // 2 :] = 1e-12
    found = Distances(windows, nothing, windows.node, askew)
    wall, second = found.tracked(True), askew[found.node] != 0.0
    assert not set(wall[second].tolist()) & set(wall[~second].tolist())
