"""The judgement: which of the trajectories is used, and the reason that is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from short_tour import bent_tour, short_tour

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats, Readings
from forward_grid_mapper.core.trajectory import holding_out, refinement, right_angles
from forward_grid_mapper.core.trajectory.any_angle import MatchedDrive
from forward_grid_mapper.core.trajectory.attempt import CONTRADICTED, UNMATCHED, Attempt, Drive, gain_words
from forward_grid_mapper.core.trajectory.heading import Drifts, Heading
from forward_grid_mapper.core.trajectory.holding_out import EVERY, Gain, gain, held_out
from forward_grid_mapper.core.trajectory.hypotheses import Solved
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.pose_graph import Solution, solution_at
from forward_grid_mapper.core.trajectory.poses import rms_after_alignment
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.repeated_errors import BENT
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.solving import Solver
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, cut
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import Recording


@pytest.fixture(scope='module')
def tour() -> Recording:
    return short_tour()


@pytest.fixture(scope='module')
def bent() -> tuple[Readings, Odometry]:
    return bent_tour()


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


def test_votes_of_walls_are_named_as_the_reason(bent, monkeypatch) -> None:
    # at this limit the gain of predicted readings does not suffice, and no place was seen twice, so walls decide
    for module in (right_angles, refinement):
        monkeypatch.setattr(module, 'LEAST_SIGMAS', 1e9)
    let_come_back(monkeypatch, lambda *rest: False)
    assert 'with walls at right angles, the readings are more likely by' in Refiner(Parameters()).run(*bent).reason


@pytest.fixture(scope='module')
def results() -> dict[str, Any]:
    """The solution of the drive, and that matched further: the same in all tests that judge it in another way."""
    return {}


def remember(monkeypatch, results: dict[str, Any], name: str) -> None:
    """Let a function of `right_angles` compute its result in the first test only; later ones must ask for the same."""
    compute = getattr(right_angles, name)

    def known(*rest) -> Any:
        of = [each.solution.nodes if isinstance(each, Solved) else getattr(each, 'nodes', None) for each in rest]
        if name not in results:
            results[name] = compute(*rest), of
        made, made_of = results[name]
        assert all(np.array_equal(now, then) for now, then in zip(of, made_of, strict=True))
        return made

    monkeypatch.setattr(right_angles, name, known)


@pytest.fixture
def solved_once(monkeypatch, results: dict[str, Any]) -> None:
    remember(monkeypatch, results, 'solve_hypotheses')


@pytest.fixture
def matched_once(monkeypatch, results: dict[str, Any], solved_once) -> None:
    remember(monkeypatch, results, '_matched_further')


def no_matches(*rest) -> None:
    """Matches without information."""


def let_come_back(monkeypatch, revisits: Callable[[Scans, Floats], bool]) -> None:
    """Replace `has_revisits` in all modules that use it."""
    for module in (holding_out, right_angles, refinement):
        monkeypatch.setattr(module, 'has_revisits', revisits)


def test_recognised_places_prove_what_nearby_readings_do_not(tour, bent, monkeypatch, matched_once) -> None:
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
    monkeypatch.setattr(refinement, 'gain_when_fitted', lambda *rest: Gain(gain, 0.1))
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


@pytest.mark.parametrize(
    ('comes_back', 'gain', 'matched'), [(True, 1.1, True), (True, 0.9, False), (False, 1.1, False)]
)
def test_drive_is_matched_if_straight_walls_may_be_proven_where_it_came_back(
    bent, monkeypatch, solved_once, comes_back: bool, gain: float, matched: bool
) -> None:
    """Neither nearby readings nor votes show that odometry is wrong."""
    judged = list[bool]()

    def at_revisits(*rest) -> right_angles._Verdict:
        judged.append(True)
        return right_angles._Verdict(True, Gain(0.03, 0.01), 'judged')

    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(-0.05, 0.01))
    monkeypatch.setattr(right_angles, 'LEAST_VOTE_GAIN', 1e9)
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.01 * gain, 0.01))
    monkeypatch.setattr(right_angles, '_at_revisits', at_revisits)
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: comes_back)
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted == matched == bool(judged)
    assert found.reason.startswith('judged' if matched else 'readings are predicted worse')


@pytest.mark.parametrize('proven', [True, False])
def test_bent_walls_are_not_used_but_matching_may_start_from_them(
    bent, monkeypatch, matched_once, proven: bool
) -> None:
    starts, asked = list[Floats](), list[Floats]()

    def are_walls_bent(windows: Windows, nodes: Floats) -> bool:
        asked.append(nodes)
        return True

    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: starts.append(rest[5]))
    monkeypatch.setattr(right_angles, 'are_walls_bent', are_walls_bent)
    if not proven:
        judged = right_angles._judged
        refused = right_angles._Verdict(False, Gain(0.02, 0.01), 'refused')
        monkeypatch.setattr(right_angles, '_judged', lambda *rest: (judged(*rest)[0], refused))
    found = Refiner(Parameters()).run(*bent)
    assert not found.accepted and found.trajectory is bent[1]
    assert found.reason.startswith(BENT)
    assert found.gain == pytest.approx(0.02) if not proven else found.gain > 0.0
    assert len(starts) == 1 and starts[0] is asked[-1]


def test_accuracy_of_sonar_is_asked_before_bent_walls(tour, monkeypatch) -> None:
    monkeypatch.setattr(right_angles, 'are_walls_bent', lambda *rest: True)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.05, 0.01))
    found = Refiner(Parameters()).run(tour.readings, odometry_of(tour))
    assert not found.accepted and 'not more than the accuracy of sonar' in found.reason


@pytest.mark.parametrize('used', [0, 1, 2])
def test_walls_alone_are_named_if_loop_closures_make_it_worse(bent, monkeypatch, solved_once, used: int) -> None:
    accept, attempts = right_angles._accepted, list[Attempt]()
    monkeypatch.setattr(right_angles, '_accepted', lambda *rest: attempts.append(accept(*rest)) or attempts[-1])
    monkeypatch.setattr(right_angles, 'last_not_worse', lambda scans, *trajectories: trajectories[used])
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    found = Refiner(Parameters()).run(*bent)
    assert [attempt.matched for attempt in attempts] == [used == 2]
    assert found.accepted and found.reason.endswith(UNMATCHED) == (used < 2)
    assert used == 2 or not found.loops


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
    monkeypatch.setattr(refinement, 'gain_when_fitted', lambda *rest: Gain(0.0, 0.1))
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


def test_walls_are_no_proof_if_recognised_places_do_not_confirm(bent, monkeypatch, matched_once) -> None:
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
    bent, monkeypatch, matched_once, everywhere: float, nearby: float, accepted: bool
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
    bent, monkeypatch, matched_once, everywhere: float, nearby: float, places: bool, accepted: bool, reason: str
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
    assert ('within a few metres, they are predicted clearly worse' in found.reason) == (nearby < -2.0 and not accepted)


@pytest.mark.parametrize(('gain', 'accepted'), [(-0.2, True), (-0.3, False)])
def test_votes_do_not_suffice_if_readings_as_a_whole_contradict_them(
    bent, monkeypatch, matched_once, gain: float, accepted: bool
) -> None:
    monkeypatch.setattr(refinement, 'match_drive', no_matches)
    let_come_back(monkeypatch, lambda *rest: False)
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'gain_at_revisits', lambda *rest: Gain(0.001, 0.01))
    monkeypatch.setattr(right_angles, 'fits_earlier_visits', lambda *rest: True)
    monkeypatch.setattr(right_angles, 'turns_supported', lambda *rest: True)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    for module in (right_angles, refinement):
        monkeypatch.setattr(module, 'gain_of_objective', lambda *rest: Gain(gain, 0.1))
    assert Refiner(Parameters()).run(*bent).accepted == accepted


@pytest.mark.parametrize(
    ('refused', 'torn', 'given'), [('unproven', False, True), ('unproven', True, False), ('lost', False, True)]
)
def test_matching_may_start_from_a_refused_trajectory_that_comes_back(
    bent, monkeypatch, matched_once, refused: str, torn: bool, given: bool
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


def test_matching_may_start_from_straight_walls_if_the_heading_was_lost(bent, monkeypatch) -> None:
    starts, along_walls, solve = list[Floats | None](), list[Solution](), Solver.along_walls
    monkeypatch.setattr(Solver, 'along_walls', lambda solver: along_walls.append(solve(solver)) or along_walls[-1])
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: starts.append(rest[5]))
    monkeypatch.setattr(right_angles, 'gain_over_drive', lambda *rest: Gain(0.0, 0.01))
    monkeypatch.setattr(right_angles, 'LEAST_VOTE_GAIN', np.inf)
    monkeypatch.setattr(right_angles, 'LEAST_CERTAINTY', 1.1)
    found = Refiner(Parameters()).run(*bent)
    assert not found.accepted and found.lost
    assert 'it may be wrong by a right angle' in found.reason and 'set odometry_noise' in found.reason
    assert [start is solution.nodes for start, solution in zip(starts, along_walls, strict=True)] == [True]


@pytest.mark.parametrize('accepted', [False, True])
def test_turns_that_readings_contradict_are_said_and_changed_before_matching(
    bent, monkeypatch, matched_once, accepted: bool
) -> None:
    starts, changed = list[Floats | None](), list[Floats]()
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: starts.append(rest[5]))
    monkeypatch.setattr(right_angles, 'with_likeliest_turns', lambda scans, nodes: changed.append(nodes) or nodes + 1.0)
    monkeypatch.setattr(right_angles, 'turns_supported', lambda *rest: False)
    monkeypatch.setattr(right_angles, 'accepted_in_folds', lambda *rest: None)
    if not accepted:
        let_come_back(monkeypatch, lambda *rest: True)
        for name in ('gain_over_drive', 'gain_at_revisits', 'gain_within_visits'):
            monkeypatch.setattr(right_angles, name, lambda *rest: Gain(0.0, 0.01))
        monkeypatch.setattr(right_angles, '_is_recognised', lambda *rest: False)
    found = Refiner(Parameters()).run(*bent)
    assert found.accepted == accepted
    assert found.reason.endswith(CONTRADICTED) == accepted
    np.testing.assert_array_equal(starts[0], changed[0] + 1.0)


def let_walls_be_unproven(
    monkeypatch, readings: Readings, odometry: Odometry, turns_contradicted: bool = False
) -> None:
    """Let walls give a trajectory that does not show that odometry is wrong, and let no gain decide."""

    def at_right_angles(drive: Drive, *rest) -> Attempt:
        outcome = Refinement(True, 'walls', readings, odometry, {})
        walls = Attempt(outcome, drive.windows.node * (1.2, 1.0, 1.0), turns_contradicted=turns_contradicted)
        return Attempt(replace(outcome, accepted=False), drive.windows.node, unproven=walls)

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    let_come_back(monkeypatch, lambda *rest: True)
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: True)
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(0.0, 0.1))
    monkeypatch.setattr(refinement, 'gain_when_fitted', lambda *rest: Gain(0.0, 0.1))


def test_walls_whose_turns_are_contradicted_are_not_taken_after_all(bent, monkeypatch) -> None:
    readings, odometry = bent

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, 1.0, scans)

    monkeypatch.setattr(refinement, 'match_drive', matched)
    let_walls_be_unproven(monkeypatch, readings, odometry)
    for sigmas in (50.0, 0.0):
        gains = iter([Gain(5.0, 0.1), Gain(sigmas, 1.0)])
        monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest, gains=gains: next(gains))
        assert Refiner(Parameters()).run(readings, odometry).reason.startswith('walls;') == (sigmas == 0.0)
    let_walls_be_unproven(monkeypatch, readings, odometry, turns_contradicted=True)
    gains = iter([Gain(5.0, 0.1), Gain(0.0, 1.0)])
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: next(gains))
    assert Refiner(Parameters()).run(readings, odometry).reason.startswith('walls are not assumed')


@pytest.mark.parametrize('own_fold', [False, True])
def test_matched_trajectory_is_judged_by_the_windows_that_were_held_out(bent, monkeypatch, own_fold: bool) -> None:
    (readings, odometry), judged_by, after_all = bent, list[Scans](), list[Scans]()

    def matched(odometry: Odometry, scans: Scans, *rest) -> MatchedDrive:
        mine = scans if own_fold else scans.with_held_out(held_out(len(scans.windows), 0))
        return MatchedDrive(scans.windows.node * (1.1, 1.0, 1.0), [], 0.0, 1.0, mine)

    def gain_at_revisits(scans: Scans, before: Floats, after: Floats, *rest) -> Gain:
        (judged_by if before is scans.windows.node else after_all).append(scans)
        return Gain(1.0, 0.1)

    monkeypatch.setattr(refinement, 'match_drive', matched)
    let_walls_be_unproven(monkeypatch, readings, odometry)
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


@pytest.mark.parametrize('contradicted', [False, True])
def test_accepted_walls_limit_matching_unless_corners_contradict_them(bent, monkeypatch, contradicted: bool) -> None:
    readings, odometry = bent
    asked: list[tuple[Floats | None, Floats | None]] = []

    def at_right_angles(drive: Drive, *rest, **options) -> Attempt:
        nodes = drive.windows.node * (1.2, 1.0, 1.0)
        outcome = Refinement(True, 'walls', readings, odometry, {})
        return Attempt(outcome, nodes, turns_contradicted=contradicted)

    def matched(odometry: Odometry, scans: Scans, stage, noise: float, known, start) -> None:
        asked.append((known, start))

    monkeypatch.setattr(refinement, 'at_right_angles', at_right_angles)
    monkeypatch.setattr(refinement, 'start_from', lambda scans, attempt: attempt.nodes * (1.0, 2.0, 1.0))
    monkeypatch.setattr(refinement, 'match_drive', matched)
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and found.reason == 'walls'
    (known, start) = asked[0]
    assert (known is None) == contradicted
    assert (start is not None) == contradicted
