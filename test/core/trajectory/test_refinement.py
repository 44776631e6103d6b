"""Refinement of whole drives: drift is corrected, exact odometry is kept, and unsuitable drives are rejected."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled, InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats, Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.trajectory import holding_out, refinement, right_angles
from forward_grid_mapper.core.trajectory.any_angle import MatchedDrive
from forward_grid_mapper.core.trajectory.attempt import Attempt, Drive, gain_words
from forward_grid_mapper.core.trajectory.heading import NOISES, Drifts, Heading
from forward_grid_mapper.core.trajectory.holding_out import (
    EVERY,
    FEWEST_BLOCKS,
    NEAR,
    REVISIT_AFTER,
    Gain,
    gain,
    has_revisits,
    held_out,
)
from forward_grid_mapper.core.trajectory.hypotheses import Solved
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.pose_graph import Solution, solution_at
from forward_grid_mapper.core.trajectory.poses import compose, relative, rms_after_alignment
from forward_grid_mapper.core.trajectory.refinable import SHORTEST, unfit
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

TOUR = building_tour()[:10]


@pytest.fixture(scope='module')
def tour() -> Recording:
    """A drive of 26 m with eight sonars."""
    return drive(building_world(), TOUR, 0.15, sonar_ring(8), NOISY, seed=3)


@pytest.fixture(scope='module')
def bent(tour: Recording) -> tuple[Readings, Odometry]:
    recording = with_drift(tour, LEVELS['high'], 6)
    return recording.readings, odometry_of(recording)


@pytest.fixture(scope='module')
def stages() -> list[str]:
    """The stages reported while `outcome` was computed."""
    return []


@pytest.fixture(scope='module')
def outcome(bent, stages) -> Refinement:
    return Refiner(Parameters()).run(*bent, lambda stage, part: stages.append(stage))


def test_unknown_gain_is_reported_without_a_number() -> None:
    """For example one sweep each metre, with too few readings in each block."""
    nothing = np.full(20, np.nan)
    assert 'too few readings' in gain_words(gain(nothing, nothing))
    rng = np.random.default_rng(0)
    assert '± 0.' in gain_words(gain(rng.random(20), rng.random(20)))
    assert gain_words(Gain(0.0004, 0.003)) == gain_words(Gain(-0.0004, 0.003))
    assert 'as well as with odometry, to ± 0.003 nats' in gain_words(Gain(-0.0004, 0.003))
    assert 'worse than with odometry, by 0.001 ± 0.003' in gain_words(Gain(-0.0006, 0.003))
    assert 'better than with odometry' in gain_words(Gain(0.0004, 0.0001)), 'it is significant'


def test_drift_is_corrected(tour, bent, outcome, stages) -> None:
    _, odometry = bent
    true = odometry_of(tour).pose
    before = rms_after_alignment(odometry.pose, true)
    after = rms_after_alignment(outcome.trajectory.pose, true)
    assert outcome.accepted and outcome.right_angles
    # walls at right angles explain all of it, so no other method is tried
    assert 'matching' in stages and 'scan matching' not in stages
    assert before > 0.8
    assert after < 0.2
    assert outcome.moved == pytest.approx(before, abs=0.2)
    assert outcome.trajectory.pose[0] == pytest.approx(odometry.pose[0], abs=1e-6)


def test_single_sensor_that_turns_on_the_robot_suffices(tour) -> None:
    """As on a servo: of each sweep of the ring, only the reading of the next sensor is kept."""
    straight = drive(building_world(), TOUR, 0.02, sonar_ring(16), NOISY, seed=3)
    recording = with_drift(straight, LEVELS['high'], 6)
    readings, odometry = recording.readings, odometry_of(recording)
    _, sweep = np.unique(readings.stamp, return_inverse=True)
    turning = readings.select(np.flatnonzero(readings.sensor == 5 * sweep % 16))
    turning = replace(turning, sensor=np.zeros(len(turning), np.int32), sensor_names=('servo',))
    outcome = Refiner(Parameters()).run(turning, odometry)
    true = odometry_of(straight).pose
    assert outcome.accepted
    assert rms_after_alignment(odometry.pose, true) > 0.7
    assert rms_after_alignment(outcome.trajectory.pose, true) < 0.3


def test_reason_of_acceptance_is_named(bent, monkeypatch, outcome) -> None:
    assert outcome.reason.startswith(('readings are predicted', 'with walls at right angles'))
    # at this limit the gain of predicted readings does not suffice, and no place was seen twice, so walls decide
    for module in (right_angles, refinement):
        monkeypatch.setattr(module, 'LEAST_SIGMAS', 1e9)
    let_come_back(monkeypatch, lambda *rest: False)
    assert 'with walls at right angles, the readings are more likely by' in Refiner(Parameters()).run(*bent).reason


@pytest.fixture
def solved_once(monkeypatch) -> None:
    """Solve only once: runs with other judgements need not repeat it."""
    solve, found = right_angles.solve_hypotheses, []

    def once(*rest) -> Solved:
        if not found:
            found.append(solve(*rest))
        return found[0]

    monkeypatch.setattr(right_angles, 'solve_hypotheses', once)


def no_matches(*rest) -> None:
    """Matches without information."""


def let_come_back(monkeypatch, revisits: Callable[[Scans, Floats], bool]) -> None:
    """Replace `has_revisits` in all modules that use it."""
    for module in (holding_out, right_angles, refinement):
        monkeypatch.setattr(module, 'has_revisits', revisits)


def test_recognised_places_prove_what_nearby_readings_do_not(tour, bent, monkeypatch, solved_once) -> None:
    # wheels that are right over metres predict nearby readings better than yaws from walls do
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(-0.05, 0.01))
    found, true = Refiner(Parameters()).run(*bent), odometry_of(tour).pose
    assert found.accepted
    assert found.reason.startswith('where the robot came back, readings are predicted better than')
    assert rms_after_alignment(found.trajectory.pose, true) < 0.2
    # the same without such places, and without walls that contradict the yaw
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    left = Refiner(Parameters()).run(*bent)
    monkeypatch.setattr(right_angles, 'LEAST_VOTE_GAIN', 1e9)
    without_votes = Refiner(Parameters()).run(*bent)
    for outcome in (left, without_votes):
        assert not outcome.accepted
        assert 'does not show that odometry is wrong' in outcome.reason
    assert 'wrong, but it is off by 0.' in left.reason
    assert 'it is off by' not in without_votes.reason


@pytest.mark.parametrize(
    ('accepted', 'held_out_gain', 'gain', 'by_walls'),
    [(True, 0.2, 0.2, True), (True, 0.2, 0.3, False), (True, 0.3, 0.2, False), (False, 0.0, 0.0, False)],
)
def test_walls_are_tried_again_once_matching_shows_that_odometry_is_wrong(
    bent, monkeypatch, accepted: bool, held_out_gain: float, gain: float, by_walls: bool
) -> None:
    (readings, odometry), asked = bent, []

    def at_right_angles(drive: Drive, *rest, odometry_is_wrong: bool = False) -> Attempt:
        asked.append(odometry_is_wrong)
        outcome = Refinement(odometry_is_wrong and accepted, 'walls', readings, odometry, {})
        return Attempt(outcome, drive.windows.node, before_matching=not odometry_is_wrong)

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, 1.0, scans)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', matched)
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: True)
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(-0.1, 0.1))
    # first that over odometry, then that over walls
    gains = iter((1.0, held_out_gain))
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(next(gains), 0.1))
    monkeypatch.setattr(refinement, 'gain_of_objective', lambda *rest: Gain(gain, 0.1))
    found = Refiner(Parameters()).run(readings, odometry)
    assert asked == [False, True] and found.accepted
    assert found.reason.startswith('walls; scan matching alone shows' if by_walls else 'walls are not assumed')


@pytest.mark.parametrize(
    ('confirmed', 'part', 'within', 'everywhere', 'accepted'),
    [
        (False, 1.0, 0.1, 1.0, False),
        (False, 0.5, 0.2, 1.0, False),
        (False, 0.5, 0.3, 1.0, True),
        (True, 1.0, -0.1, 0.3, True),
        (True, 1.0, -0.3, 0.8, False),
        # much better where the robot came back outweighs that
        (True, 1.0, -0.3, 1.0, True),
    ],
)
def test_matching_is_compared_with_odometry_within_a_few_metres(
    bent, monkeypatch, confirmed: bool, part: float, within: float, everywhere: float, accepted: bool
) -> None:
    """It must be better if places do not confirm it, and must not be clearly worse if they do."""
    readings, odometry = bent

    def at_right_angles(drive: Drive, *rest, **options) -> Attempt:
        return Attempt(Refinement(False, 'no walls', readings, odometry, {}), drive.windows.node)

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, part, scans)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', matched)
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(everywhere, 0.1))
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: confirmed)
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(within, 0.1))
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted == accepted
    expected = (
        'only 50% of the path through places seen before is' if part < 1.0 else 'hardly any of the places to which'
    )
    if confirmed:
        expected = 'readings within a few metres are predicted worse than with odometry'
    assert accepted or expected in found.reason


def test_walls_that_tear_apart_what_matching_brings_together_are_not_taken(bent, monkeypatch) -> None:
    readings, odometry = bent

    def at_right_angles(drive: Drive, *rest, odometry_is_wrong: bool = False) -> Attempt:
        outcome = Refinement(odometry_is_wrong, 'walls', readings, odometry, {})
        return Attempt(outcome, drive.windows.node * (50.0, 1.0, 1.0), before_matching=True)

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, 1.0, scans)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', matched)
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: True)
    let_come_back(monkeypatch, lambda scans, nodes: bool(np.ptp(nodes[:, 0]) < 100.0))
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(0.0, 0.1))
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(1.0, 0.1))
    monkeypatch.setattr(refinement, 'gain_of_objective', lambda *rest: Gain(0.0, 0.1))
    assert Refiner(Parameters()).run(readings, odometry).reason.startswith('walls are not assumed')


@pytest.mark.parametrize(('by_votes', 'gain', 'accepted'), [(True, 0.2, False), (True, 0.3, True), (False, 0.2, True)])
def test_doubtful_walls_need_a_larger_objective(bent, monkeypatch, by_votes: bool, gain: float, accepted: bool) -> None:
    (readings, odometry), asked = bent, []

    def at_right_angles(drive: Drive, *rest) -> Attempt:
        outcome = Refinement(True, 'walls', readings, odometry, {'scale': 0.01}, gain=0.4)
        return Attempt(outcome, drive.windows.node * (1.1, 1.0, 1.0), by_votes=by_votes)

    def gain_of_objective(scans: Scans, before, after) -> Gain:
        asked.append((before, after))
        return Gain(gain, 0.1)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    monkeypatch.setattr(refinement, 'gain_of_objective', gain_of_objective)
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted == accepted and found.calibration == {'scale': 0.01}
    assert len(asked) == by_votes
    for before, after in asked:
        assert (before * (1.1, 1.0, 1.0) == after).all()
    if not accepted:
        assert found.trajectory is odometry and found.readings is readings
        assert 'what walls say is doubtful' in found.reason and '(0.2 ± 0.1 nats for each 1.6 m)' in found.reason


@pytest.mark.parametrize('proven', [True, False])
def test_doubtful_walls_may_be_proven_by_other_windows(bent, monkeypatch, proven: bool) -> None:
    readings, odometry = bent

    def at_right_angles(drive: Drive, *rest) -> Attempt:
        return Attempt(Refinement(True, 'walls', readings, odometry, {}), drive.windows.node, by_votes=True)

    def proven_in_folds(drive: Drive, attempt: Attempt, *rest) -> Attempt | None:
        return attempt._replace(refinement=replace(attempt.refinement, reason='trials')) if proven else None

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    monkeypatch.setattr(refinement, 'gain_of_objective', lambda *rest: Gain(0.1, 0.1))
    monkeypatch.setattr(refinement, 'proven_in_folds', proven_in_folds)
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted == proven
    assert found.reason.startswith('trials' if proven else 'what walls say is doubtful')


@pytest.mark.parametrize(('blocks', 'confirmed', 'recognised'), [(3, True, True), (2, True, False), (3, False, False)])
def test_votes_need_some_recognised_places(monkeypatch, blocks: int, confirmed: bool, recognised: bool) -> None:
    monkeypatch.setattr(right_angles, 'recognised', lambda loops: set(range(len(loops))))
    monkeypatch.setattr(right_angles, 'confirmed_by_places', lambda *rest: confirmed)
    best = right_angles._Candidate(np.zeros((1, 3)), {}, [None] * blocks)  # type: ignore[list-item]
    assert right_angles._is_recognised(None, best) == recognised  # type: ignore[arg-type]


def test_walls_are_no_proof_if_recognised_places_do_not_confirm(bent, monkeypatch, solved_once) -> None:
    # walls that are not parallel give a wrong yaw, and readings are predicted about as well
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    monkeypatch.setattr(right_angles, 'confirmed_by_places', lambda *rest: False)
    left = Refiner(Parameters()).run(*bent)
    assert not left.accepted
    assert left.reason.startswith('where the robot came back, readings are predicted better than')
    assert 'does not show that odometry is wrong' in left.reason
    # if the robot visited no place twice, walls are proof, unless readings are predicted worse
    let_come_back(monkeypatch, lambda *rest: False)
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted
    assert found.reason.startswith('with walls at right angles, the readings are more likely')
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(-0.02, 0.01))
    worse = Refiner(Parameters()).run(*bent)
    assert not worse.accepted
    assert worse.reason.startswith('readings are predicted worse than')


@pytest.mark.parametrize(
    ('everywhere', 'nearby', 'accepted'),
    [(100.0, 2.2, False), (100.0, 2.4, True), (-0.9, 2.4, True), (-1.1, 2.4, False)],
)
def test_trajectory_that_tears_apart_must_predict_readings_within_a_few_metres_better(
    bent, monkeypatch, solved_once, everywhere: float, nearby: float, accepted: bool
) -> None:
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda scans, nodes: nodes is scans.windows.node)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.01 * everywhere, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.01 * nearby, 0.01))
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted == accepted
    if accepted:
        assert found.reason.startswith('within a few metres, readings are predicted better')
        assert found.gain == pytest.approx(0.01 * nearby)


@pytest.mark.parametrize(
    ('everywhere', 'nearby', 'places', 'accepted', 'reason'),
    [
        (3.0, 0.0, False, True, 'where the robot came back, readings are predicted better'),
        # corridors that bend, taken for straight ones
        (
            3.0,
            -2.1,
            True,
            False,
            'where the robot came back, readings are predicted better than with odometry, by 0.030',
        ),
        (6.4, -2.1, True, True, 'where the robot came back, readings are predicted better'),
        (0.0, 2.4, False, True, 'within a few metres, readings are predicted better'),
        (-1.1, 2.4, False, False, 'where the robot came back, readings are predicted worse'),
        (0.0, 0.0, False, False, 'where the robot came back, readings are predicted as well as with odometry'),
        # votes suffice for places that are recognised
        (-0.9, 0.0, True, True, 'with walls at right angles, the readings are more likely'),
        (-1.1, 0.0, True, False, 'where the robot came back, readings are predicted worse'),
    ],
)
def test_trajectory_is_judged_on_maps_of_all_visits_and_nearby(
    bent, monkeypatch, solved_once, everywhere: float, nearby: float, places: bool, accepted: bool, reason: str
) -> None:
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: True)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.01 * everywhere, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.01 * nearby, 0.01))
    monkeypatch.setattr(right_angles, '_is_recognised', lambda *rest: places)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted == accepted
    assert found.reason.startswith(reason)
    assert ('but not within a few metres' in found.reason) == (nearby < -2.0 and not accepted)


@pytest.mark.parametrize(('gain', 'accepted'), [(-0.2, True), (-0.3, False)])
def test_votes_do_not_suffice_if_readings_as_a_whole_contradict_them(
    bent, monkeypatch, solved_once, gain: float, accepted: bool
) -> None:
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: False)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'recognised_part', lambda *rest: 1.0)
    monkeypatch.setattr(right_angles, 'turns_supported', lambda *rest: True)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    for module in (right_angles, refinement):
        monkeypatch.setattr(module, 'gain_of_objective', lambda *rest: Gain(gain, 0.1))
    assert Refiner(Parameters()).run(*bent).accepted == accepted


@pytest.mark.parametrize(
    ('refused', 'torn', 'given'), [('unproven', False, True), ('unproven', True, False), ('lost', False, True)]
)
def test_matching_may_start_from_a_refused_trajectory_that_comes_back(
    bent, monkeypatch, solved_once, refused: str, torn: bool, given: bool
) -> None:
    starts: list[Floats | None] = []
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: starts.append(rest[5]))
    let_come_back(monkeypatch, lambda scans, nodes: not torn or nodes is scans.windows.node)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, '_is_recognised', lambda *rest: False)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    if refused == 'lost':
        solve = right_angles.solve_hypotheses
        monkeypatch.setattr(right_angles, 'solve_hypotheses', lambda *rest: replace(solve(*rest), certainty=0.5))
    assert not Refiner(Parameters()).run(*bent).accepted
    assert len(starts) == 1 and (starts[0] is not None) == given


@pytest.mark.parametrize('own_fold', [False, True])
def test_matched_trajectory_is_judged_by_the_windows_that_were_held_out(bent, monkeypatch, own_fold: bool) -> None:
    (readings, odometry), judged_by, after_all = bent, list[Scans](), list[Scans]()

    def at_right_angles(drive: Drive, *rest) -> Attempt:
        outcome = Refinement(True, 'walls', readings, odometry, {})
        walls = Attempt(outcome, drive.windows.node * (1.2, 1.0, 1.0))
        return Attempt(replace(outcome, accepted=False), drive.windows.node, unproven=walls)

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        mine = scans if own_fold else scans.with_held_out(held_out(len(scans.windows), 0))
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, 1.0, mine)

    def gain_at_revisits(scans: Scans, before: Floats, after: Floats, *rest) -> Gain:
        (judged_by if before is scans.windows.node else after_all).append(scans)
        return Gain(1.0, 0.1)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'match_drive', matched)
    let_come_back(monkeypatch, lambda *rest: True)
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: True)
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(0.0, 0.1))
    monkeypatch.setattr(refinement, 'gain_of_objective', lambda *rest: Gain(0.0, 0.1))
    monkeypatch.setattr(refinement, 'gain_at_revisits', gain_at_revisits)
    found = Refiner(Parameters()).run(readings, odometry)
    begin = EVERY // 2 if own_fold else 0
    assert [int(np.flatnonzero(scans.held_out)[0]) for scans in judged_by] == [begin]
    # the trajectory with walls was fitted to the windows that another fold held out
    assert len(after_all) == own_fold
    assert found.reason.startswith('walls are not assumed' if own_fold else 'walls; scan matching alone shows')


def test_drive_whose_map_would_be_too_large_is_not_matched_further(bent, monkeypatch, solved_once) -> None:
    def too_large(*rest) -> float:
        raise InputError

    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: True)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, 'gain_within_visits', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, '_is_recognised', lambda *rest: False)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    monkeypatch.setattr(Scans, 'objective', too_large)
    assert not Refiner(Parameters()).run(*bent).accepted


def test_drive_is_matched_further_while_its_objective_grows(bent, monkeypatch, solved_once) -> None:
    solved = list[Solved]()
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: True)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)

    def judged(drive: Drive, walls, found: Solved, watch) -> tuple:
        solved.append(found)
        accepted = len(solved) == 2
        verdict = right_angles._Verdict(accepted, Gain(0.03, 0.01), 'judged')
        return right_angles._Candidate(found.solution.nodes, {}, found.loops), verdict

    def with_matches(solver: Solver, solution: Solution) -> tuple[Solution, list]:
        nodes = solution.nodes.copy()
        nodes[len(nodes) // 2 :, 0] += 0.5
        return solution_at(nodes, 4), []

    monkeypatch.setattr(right_angles, '_judged', judged)
    monkeypatch.setattr(Solver, 'with_matches', with_matches)
    growing = iter([1.0, 2.0, 3.0, 2.5, 0.0])
    monkeypatch.setattr(Scans, 'objective', lambda *rest: next(growing))
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted and found.reason.startswith('judged')
    first, further = (each.solution.nodes[-1, 0] for each in solved)
    # J is smaller after the third time
    assert further - first == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('way', 'rounds'),
    [([[2.0, 8.85], [29.0, 8.85]], 1), ([[10.0, 8.85], [14.0, 8.85], [10.0, 8.85]], 1), (TOUR, 2)],
)
def test_revisits_are_detected(way, rounds) -> None:
    points = np.concatenate([np.array(way, float)] * rounds)
    recording = drive(building_world(), points, 0.1, front_array(), NOISY, seed=4)
    windows = cut(recording.readings, odometry_of(recording))
    scans = Scans(windows, Parameters(), np.zeros(1, np.uint8), held_out(len(windows)))
    progress, again = windows.node_progress, 0
    for k in np.flatnonzero(scans.held_out):
        others = [j for j in range(len(windows)) if abs(progress[j] - progress[k]) > REVISIT_AFTER]
        again += any(math.dist(windows.node[k, :2], windows.node[j, :2]) < NEAR for j in others)
    assert has_revisits(scans, windows.node) == (again >= FEWEST_BLOCKS) == (rounds == 2)
    far = np.arange(len(windows))[:, None] * np.array([5.0, 0.0, 0.0])
    assert not has_revisits(scans, far)


def test_readings_move_with_the_trajectory(bent, outcome) -> None:
    readings, odometry = bent
    placed = outcome.readings
    for name in ('z', 'stamp', 'sensor', 'z_max', 'half_angle'):
        assert np.array_equal(getattr(placed, name), getattr(readings, name))
    was, now = (
        relative(path.at(r.stamp), np.stack([r.x, r.y, r.yaw], 1))
        for path, r in ((odometry, readings), (outcome.trajectory, placed))
    )
    assert now[:, :2] == pytest.approx(was[:, :2], abs=1e-9)


def test_refined_map_has_a_larger_objective(bent, outcome) -> None:
    drifted, refined = (Mapper(Parameters()).run(readings).objective for readings in (bent[0], outcome.readings))
    assert refined > drifted + 0.1 * len(outcome.readings)


def test_exact_odometry_is_kept(tour, monkeypatch) -> None:
    odometry = odometry_of(tour)
    # walls are at right angles along it, so no other method is tried
    monkeypatch.setattr(refinement, 'match_drive', None)
    left = Refiner(Parameters()).run(tour.readings, odometry)
    assert not left.accepted
    assert left.reason
    assert left.readings is tour.readings
    assert left.trajectory is odometry


def test_moved_drive_gives_the_moved_trajectory(bent, outcome) -> None:
    readings, odometry = bent
    home = np.array([3.0, -12.0, math.pi / 2])
    sensors = compose(home, np.stack([readings.x, readings.y, readings.yaw], 1))
    moved = replace(readings, x=sensors[:, 0].copy(), y=sensors[:, 1].copy(), yaw=sensors[:, 2].copy())
    other = Refiner(Parameters()).run(moved, Odometry.of(odometry.stamp, compose(home, odometry.pose)))
    assert other.accepted
    back = relative(home, other.trajectory.pose)
    assert np.hypot(*(back - outcome.trajectory.pose)[:, :2].T).max() < 0.2


def test_refinement_can_be_cancelled(bent) -> None:
    refiner = Refiner(Parameters())
    stages = []

    def watch(stage: str, part: float) -> None:
        stages.append(stage)
        if stage == 'matching':
            threading.Thread(target=refiner.cancel).run()

    with pytest.raises(Cancelled):
        refiner.run(*bent, watch)
    assert stages[-1] == 'matching'


def still(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings, replace(odometry, pose=np.zeros_like(odometry.pose))


def short(readings: Readings, odometry: Odometry, metres: float = 2.0) -> tuple[Readings, Odometry]:
    last = int(np.searchsorted(odometry.travel, metres))
    kept = readings.stamp <= odometry.stamp[last]
    return readings.select(kept), Odometry(odometry.stamp[: last + 1], odometry.pose[: last + 1])


def nearly_long_enough(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    readings, odometry = short(readings, odometry, SHORTEST)
    by = (SHORTEST - 0.01) / odometry.travel[-1]
    return readings, Odometry(odometry.stamp, odometry.pose * [by, by, 1.0])


def without_echoes(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return replace(readings, z=readings.z_max.copy()), odometry


def one_sensor(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings.select(np.repeat(np.flatnonzero(readings.sensor == 0), 2)), odometry


def one_sensor_to_the_side(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    kept, odometry = one_sensor(readings, odometry)
    return replace(kept, yaw=kept.yaw + np.pi / 2), odometry


def late(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    half = len(odometry.stamp) // 2
    return readings, Odometry(odometry.stamp[half:], odometry.pose[half:])


def nothing(readings: Readings, odometry: Odometry) -> tuple[Readings, Odometry]:
    return readings, Odometry.of(np.zeros(0, np.int64), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ('spoiled', 'word'),
    [
        (short, '2.0 m long'),
        (still, '0.0 m long'),
        (nearly_long_enough, 'the drive is 7.9 m long; the drift of odometry can be measured from 8 m'),
        (without_echoes, 'have an echo'),
        (one_sensor, 'one sensor'),
        (one_sensor_to_the_side, 'one sensor'),
        (late, 'without odometry'),
        (nothing, "no poses of odometry, as in a journal or after a jump of odometry's clock"),
    ],
)
def test_unsuitable_drive_is_not_refined_with_reason(bent, spoiled, word) -> None:
    readings, odometry = spoiled(*bent)
    left = Refiner(Parameters()).run(readings, odometry)
    assert not left.accepted
    assert word in left.reason
    assert left.readings is readings
    assert left.trajectory is odometry
    assert unfit(*bent) == ''


def test_drive_with_random_ranges_is_not_refined(bent) -> None:
    readings, odometry = bent
    z = np.random.default_rng(0).uniform(0.2, 5.9, len(readings))
    assert not Refiner(Parameters()).run(replace(readings, z=z), odometry).accepted


def test_straight_drive_without_revisits_is_no_worse() -> None:
    recording = drive(building_world(), np.array([[2.0, 8.85], [29.0, 8.85]]), 0.1, front_array(), NOISY, seed=4)
    bent = with_drift(recording, LEVELS['middle'], 3)
    true, odometry = odometry_of(recording).pose, odometry_of(bent)
    left = Refiner(Parameters()).run(bent.readings, odometry)
    assert rms_after_alignment(left.trajectory.pose, true) < rms_after_alignment(odometry.pose, true) + 0.02


def test_noise_of_odometry_is_estimated_or_given(bent, monkeypatch) -> None:
    seen = []

    def look(windows, at, votes, noises) -> None:
        seen.append(noises)

    monkeypatch.setattr(right_angles, 'heading', look)
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    for given in ({}, {'odometry_noise': 0.04}):
        found = Refiner(Parameters.from_flat(given)).run(*bent)
        assert found.reason.startswith(right_angles.NO_WALLS)
    assert seen == [NOISES, (0.04,)]


@pytest.mark.parametrize(('by_chance', 'evidence'), [(45.0, 5.0), (-20.0, 50.0), (None, 50.0)])
def test_votes_due_to_the_layout_of_sensors_are_no_evidence(bent, monkeypatch, by_chance, evidence) -> None:
    readings, odometry = bent
    nothing = np.zeros(0)
    found = Heading(nothing.astype(int), nothing, nothing, nothing, Drifts(0.0, 0.0, 0.02), 1.0, 1.0, 50.0, nothing)
    answers = [found, None if by_chance is None else replace(found, over_odometry=by_chance)]
    monkeypatch.setattr(right_angles, 'heading', lambda *rest: answers.pop(0))
    windows = cut(readings, odometry)
    scans = Scans(windows, Parameters(), np.zeros(1, np.uint8), held_out(len(windows)))
    assert right_angles.heading_of_walls(windows, scans, 0.0) == (found, evidence)
