"""Walls and the heading: votes compared with plain Python, and drives with known yaw."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from forward_grid_mapper.core.trajectory import heading as module
from forward_grid_mapper.core.trajectory.heading import LEAST_GAIN, NOISES, TURN_NOISES, heading, yaws_of_votes
from forward_grid_mapper.core.trajectory.odometry_model import calibrated, motions, sensitivity, with_yaw
from forward_grid_mapper.core.trajectory.poses import wrapped
from forward_grid_mapper.core.trajectory.right_angles import LEAST_CERTAINTY
from forward_grid_mapper.core.trajectory.walls import (
    BESIDE,
    BIN,
    BINS,
    CHANCE,
    COUNTS,
    DIRECTIONS,
    LONGEST_VOTE,
    POINT,
    THING,
    beside,
    count_votes,
    votes_for,
    wall_votes,
)
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, corrected, cut
from forward_grid_mapper.simulation.drift import LEVELS, Drift, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import building_tour, building_world


@pytest.fixture(scope='module')
def tour() -> Recording:
    return drive(building_world(), building_tour()[:20], 0.1, front_array(), NOISY, seed=3)


@pytest.fixture(scope='module')
def true(tour: Recording) -> Odometry:
    return odometry_of(tour)


@pytest.fixture(scope='module')
def bent(tour: Recording) -> tuple[Recording, Odometry, Windows]:
    recording = with_drift(tour, LEVELS['high'], 6)
    odometry = odometry_of(recording)
    return recording, odometry, cut(recording.readings, odometry)


def test_votes_are_those_of_the_twin() -> None:
    rng = np.random.default_rng(0)
    echoes = np.column_stack(
        [rng.normal(0, 1, (60, 2)), rng.uniform(-4, 4, 60), rng.choice([0.13, 0.3], 60), rng.uniform(0.3, 3, 60)]
    )
    echoes = np.column_stack([echoes, rng.choice([0.0, 0.2, BESIDE], (60, 2))])
    wanted = np.zeros(DIRECTIONS)
    for degree in range(360):
        angle, bins = math.radians(degree), {}
        even = 0.0
        for x, y, bearing, half, z, right, left in echoes:
            # positive to the left of the cone
            off = wrapped(angle - bearing)
            edge = min(max(off, -half), half)
            if -half - right <= off <= half + left:
                at = (z * math.cos(off - edge) + math.cos(angle) * x + math.sin(angle) * y) / BIN + BINS // 2
                below, vote = math.floor(at), 1.0 if off == edge else COUNTS
                row = (math.cos(angle) * y - math.sin(angle) * x, (half * z) ** 2 / 3 + THING)
                bins.setdefault(below, []).append((vote * (1 - (at - below)), *row))
                bins.setdefault(below + 1, []).append((vote * (at - below), *row))
                even += vote * BIN / LONGEST_VOTE
        for rows in bins.values():
            weight, along, point = np.array(rows).T
            n = weight.sum()
            more = n - even - CHANCE * math.sqrt(even)
            spread = (weight * (along - (weight * along).sum() / n) ** 2).sum() / n
            if more > 1:
                part = max(0.0, 1 - POINT * (weight * point).sum() / n / spread)
                wanted[degree % DIRECTIONS] += more * (more - 1) * part
    assert (wanted > 0).any()
    votes = np.empty(DIRECTIONS)
    count_votes(echoes, np.empty((BINS, 4)), votes)
    assert votes == pytest.approx(wanted)


def echoes_along_a_way(touched) -> np.ndarray:
    """Return the echoes of 16 sensors along 3 m; `touched` returns bearing and range of an echo."""
    rows = []
    for x in np.arange(-1.5, 1.5, 0.1):
        bearing, z = touched(x)
        sensor = round(bearing / (math.pi / 8)) * math.pi / 8
        rows.append((x, 0.0, sensor, math.pi / 16, z, 0.0, 0.0))
    return np.array(rows)


def test_votes_between_directions_are_interpolated() -> None:
    votes = np.random.default_rng(0).random((2, DIRECTIONS))
    degrees = np.array([[[3.0, 3.25, 89.5]], [[-1.0, -0.5, 4 * 90.0 + 7.75]]])
    a, b = votes
    assert votes_for(votes, degrees) == pytest.approx(
        np.array(
            [
                [[a[3], 0.75 * a[3] + 0.25 * a[4], (a[89] + a[0]) / 2]],
                [[b[89], (b[89] + b[0]) / 2, 0.25 * b[7] + 0.75 * b[8]]],
            ]
        )
    )
    assert votes_for(votes[:0], degrees[:0]).shape == (0, 1, 3)


def test_no_place_with_votes_measures_no_heading() -> None:
    none = np.zeros(0)
    correction, information = yaws_of_votes(np.zeros((0, DIRECTIONS)), none, none)
    assert (len(correction), len(information)) == (0, 0)


def test_wall_gets_votes_and_a_post_does_not() -> None:
    votes = np.empty((2, DIRECTIONS))
    count_votes(echoes_along_a_way(lambda x: (math.pi / 2, 1.2)), np.empty((BINS, 4)), votes[0])
    count_votes(
        echoes_along_a_way(lambda x: (math.atan2(1.0, 2.5 - x), math.hypot(1.0, 2.5 - x))),
        np.empty((BINS, 4)),
        votes[1],
    )
    assert votes[0].argmax() == 0
    assert votes[1].max() < 0.05 * votes[0].max()


def test_random_ranges_give_few_votes() -> None:
    rng = np.random.default_rng(0)
    sensors = np.radians([-90, -50, -30, -10, 10, 30, 50, 90])
    x, bearing = (grid.ravel() for grid in np.meshgrid(np.arange(-1.5, 1.5, 0.1), sensors))
    echoes = np.column_stack([x, 0 * x, bearing, 0 * x + 0.26, rng.uniform(0.3, 3.5, len(x)), 0 * x, 0 * x])
    wall, votes = np.empty(DIRECTIONS), np.empty(DIRECTIONS)
    count_votes(echoes, np.empty((BINS, 4)), votes)
    echoes[np.abs(bearing) > 1.5, 4] = 1.2
    count_votes(echoes, np.empty((BINS, 4)), wall)
    assert wall.argmax() == 0
    assert votes.max() < 0.1 * wall.max()


def in_degrees(bearings, half: float) -> list[list[float]]:
    return np.degrees(beside(np.radians(bearings), np.full(len(bearings), math.radians(half)))).tolist()


def test_gaps_beside_cones_without_a_sensor_to_the_side() -> None:
    # eight cones at equal angles, none straight ahead: each has a gap of 30 degrees on both sides
    eighths = np.arange(-157.5, 180.0, 45.0)
    assert in_degrees(eighths, 7.4) == pytest.approx(np.full((8, 2), 30.0))
    assert in_degrees(eighths, 17.4) == pytest.approx(np.full((8, 2), 10.0))
    # to the right of the cone at 20 degrees right there is none; between the two there are 10 degrees
    assert (
        in_degrees([-20.0, 0.0, 0.0], 4.9)
        == [[pytest.approx(30.0), pytest.approx(10.0)]] + [[pytest.approx(10.0), pytest.approx(30.0)]] * 2
    )


@pytest.mark.parametrize(('bearing', 'to_a_side'), [(97.0, False), (95.0, True), (-95.0, True), (265.0, True)])
def test_cone_that_contains_the_direction_to_a_side_has_no_gap(bearing: float, to_a_side: bool) -> None:
    assert (in_degrees([bearing, 0.0], 9.0) == [[0.0, 0.0]] * 2) == to_a_side


def test_gaps_of_many_cones_take_little_memory() -> None:
    bearings = np.radians(np.linspace(-75.0, 75.0, 20_000))
    tracemalloc.start()
    past = np.degrees(beside(bearings, np.full(len(bearings), math.radians(8.0))))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 30e6
    # to the right of the rightmost and to the left of the leftmost cone
    assert past[0] == pytest.approx([30.0, 0.0]) and past[-1] == pytest.approx([0.0, 30.0])
    assert past[5000:-5000].max() == 0.0


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_wall_at_the_edge_of_all_cones_gets_votes(side: float) -> None:
    # 1.2 m away, at first seen by the edge of the cone at 67.5 degrees to its side
    bearings, half = np.radians(np.arange(-157.5, 180.0, 45.0)), math.radians(7.5)
    slant = math.radians(15.0)
    x = np.arange(-1.5, 1.5, 0.1)
    echoes = np.column_stack([x, 0 * x, 0 * x + side * np.radians(67.5), 0 * x + half, 0 * x + 1.2 / math.cos(slant)])
    past = beside(bearings, np.full(8, half))[[np.abs(bearings - side * np.radians(67.5)).argmin()] * len(x)]
    votes = np.empty((2, DIRECTIONS))
    count_votes(np.column_stack([echoes, past]), np.empty((BINS, 4)), votes[0])
    count_votes(np.column_stack([echoes, 0 * past]), np.empty((BINS, 4)), votes[1])
    assert votes[0].argmax() == 0
    assert votes[0, 0] > 3 * votes[1].max()


def test_windows_contain_each_reading_once(bent) -> None:
    recording, odometry, windows = bent
    assert windows.first[0] == 0
    assert windows.first[-1] == len(windows.readings) <= len(recording.readings)
    assert (np.diff(windows.first) >= 0).all()
    assert (np.diff(windows.node_progress) > 0).all()
    # without correction, the poses are unchanged
    same = corrected(windows.progress, windows.robot, windows.node_progress, windows.node, windows.node)
    assert same == pytest.approx(windows.robot)
    assert odometry.travel[-1] == pytest.approx(windows.travel[-1], abs=1.5)


def test_heading_is_found_if_odometry_drifts(bent, true) -> None:
    _, _, windows = bent
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    found = heading(windows, at, votes)
    assert found is not None
    off = wrapped(windows.node[at, 2] + found.correction - true.at(windows.node_stamp)[at, 2])
    was = wrapped(windows.node[at, 2] - true.at(windows.node_stamp)[at, 2])
    off, was = (np.degrees(wrapped(yaw - np.median(yaw))) for yaw in (off, was))
    assert np.sqrt(np.mean(was**2)) > 10
    assert np.sqrt(np.mean(off**2)) < np.sqrt(np.mean(was**2)) / 3
    assert found.certainty > 0.99
    assert found.over_odometry > 20


def test_votes_are_likelihoods(bent) -> None:
    _, _, windows = bent
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    chain = module._Chain(windows, at[:3], votes[:3])
    for k in range(3):
        for state in (0, 17, 100):
            place = np.degrees(-(windows.node[at[k], 2] + state * module.STEP)) % DIRECTIONS
            left = int(place)
            row = votes[k]
            here = row[left] + (place - left) * (row[(left + 1) % DIRECTIONS] - row[left])
            wanted = module.UNIFORM_PART + (1 - module.UNIFORM_PART) * here
            assert chain.likelihood[k, 0, state] == pytest.approx(wanted)


def test_given_noise_is_not_estimated(bent) -> None:
    _, _, windows = bent
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    found = heading(windows, at, votes, (0.055,))
    assert found is not None
    assert found.drifts.noise == 0.055
    assert heading(windows, at, votes).drifts.noise in NOISES


@pytest.mark.parametrize('noises', [NOISES, (0.055,)])
@pytest.mark.parametrize(('travel', 'turns', 'more'), [(2.0, 0.0, False), (0.0, 8.0, True)])
def test_noise_of_turns_is_found_beside_that_of_travel(
    tour, monkeypatch, travel: float, turns: float, more: bool, noises: tuple[float, ...]
) -> None:
    chosen, choose = [], module._with_noise_of_turns

    def noted(*given) -> module.Drifts:
        chosen.append(choose(*given))
        return chosen[-1]

    monkeypatch.setattr(module, '_with_noise_of_turns', noted)
    for seed in range(4):
        level = Drift(math.radians(travel), 0.0, 0.0, 0.0, 0.0, turn_noise=math.radians(turns))
        recording = with_drift(tour, level, seed)
        windows = cut(recording.readings, odometry_of(recording))
        found = heading(windows, *wall_votes(windows, np.zeros(len(windows), bool)), noises)
        assert chosen[-1].noise == found.drifts.noise
        assert found.drifts.turn_noise == TURN_NOISES[0]
    if noises is NOISES:
        assert (np.median([drifts.turn_noise for drifts in chosen]) > TURN_NOISES[0]) == more


def test_lost_right_angle_of_wheels_that_err_in_turns_is_noticed(monkeypatch) -> None:
    exact = drive(building_world(), building_tour(), 0.1, front_array(), NOISY, seed=61)
    recording = with_drift(exact, LEVELS['turns'], 61)
    windows = cut(recording.readings, odometry_of(recording))
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    found = heading(windows, at, votes)
    off = windows.node[found.at, 2] + found.correction - odometry_of(exact).at(windows.node_stamp)[found.at, 2]
    assert np.abs(off - off[0]).max() > math.pi / 4
    assert found.certainty < LEAST_CERTAINTY
    # the noise of travel alone does not explain the errors
    monkeypatch.setattr(module, 'TURN_NOISES', TURN_NOISES[:1])
    assert heading(windows, at, votes).certainty > found.certainty + 0.1


def test_exact_odometry_is_more_likely_than_any_drift(tour, true) -> None:
    windows = cut(tour.readings, true)
    found = heading(windows, *wall_votes(windows, np.zeros(len(windows), bool)))
    assert found is not None
    assert found.over_odometry < 0


def test_contradictory_votes_give_no_heading(bent) -> None:
    _, _, windows = bent
    at, votes = wall_votes(windows, np.zeros(len(windows), bool))
    rng = np.random.default_rng(1)
    turned = np.stack([np.roll(row, rng.integers(DIRECTIONS)) for row in votes])
    found = heading(windows, at, turned)
    assert found is None or found.certainty < 0.9
    assert heading(windows, at, np.ones_like(votes)) is None
    assert LEAST_GAIN > 0


def test_held_out_windows_do_not_vote(bent) -> None:
    _, _, windows = bent
    _, votes = wall_votes(windows, np.ones(len(windows), bool))
    assert (votes == 1).all()


def test_calibration_corrects_systematic_errors() -> None:
    t = np.linspace(0, 40, 400)
    right = np.column_stack([3 * np.sin(t / 5), 2 * np.cos(t / 7), np.zeros(400)])
    steps = np.diff(right[:, :2], axis=0)
    right[:, 2] = np.unwrap(np.arctan2(np.r_[steps[:1, 1], steps[:, 1]], np.r_[steps[:1, 0], steps[:, 0]]))
    odometry = Odometry.of(np.arange(400) * 10**8, right)
    wrong = np.array([0.04, 0.02, 0.05, -0.03])
    there = calibrated(odometry, wrong)
    assert np.abs(there.pose - odometry.pose).max() > 0.3
    # to first order, the opposite calibration undoes it
    small = wrong / 100
    back = calibrated(calibrated(odometry, small), -small)
    assert back.pose == pytest.approx(odometry.pose, abs=2e-3)


def test_sensitivity_is_the_derivative_of_motions(bent) -> None:
    _, odometry, windows = bent
    change = sensitivity(odometry, windows)
    c = np.array([2e-3, -1e-3, 1e-3, 3e-3])
    wanted = motions(calibrated(odometry, c), windows) - motions(odometry, windows)
    assert change @ c == pytest.approx(wanted, abs=2e-5)


def test_drive_with_another_yaw_is_turned() -> None:
    line = np.column_stack([np.linspace(0, 5, 50), np.zeros(50), np.zeros(50)])
    odometry = Odometry.of(np.arange(50) * 10**8, line)
    turned = with_yaw(odometry, np.array([0.0, 5.0]), np.full(2, math.pi / 2))
    assert turned.pose[-1] == pytest.approx([0.0, 5.0, math.pi / 2])
