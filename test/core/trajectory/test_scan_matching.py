"""Buildings with walls at any angle: scan matching, and trajectories from matches alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pentagon_drive import quietly

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.trajectory import refinement, right_angles, scan_matching
from forward_grid_mapper.core.trajectory.any_angle import MatchedDrive
from forward_grid_mapper.core.trajectory.attempt import ACCURACY, Attempt, Drive
from forward_grid_mapper.core.trajectory.holding_out import Gain, held_out
from forward_grid_mapper.core.trajectory.judging import gain_of_objective
from forward_grid_mapper.core.trajectory.likelihood import scores
from forward_grid_mapper.core.trajectory.local_map import for_matching
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.poses import compose, relative, rms_after_alignment
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.relocating import LEAST_RECOGNISED
from forward_grid_mapper.core.trajectory.scan_matching import BLOCK, FIRST, TRUSTS, scan_matched
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import Recording

TRUST = TRUSTS[0]


@pytest.fixture(scope='module')
def matched(scans: Scans) -> Floats:
    return scan_matched(scans, TRUST, quietly)


def off_after(nodes: Floats, true: Floats, apart: int = 12) -> Floats:
    """Error of the motion over this many windows: metres, metres and radians."""
    off = relative(relative(true[:-apart], true[apart:]), relative(nodes[:-apart], nodes[apart:]))
    off[:, 2] = (off[:, 2] + math.pi) % (2 * math.pi) - math.pi
    return off


def test_scan_matching_reduces_the_yaw_error_over_five_metres(exact, scans, matched) -> None:
    true = odometry_of(exact).at(scans.windows.node_stamp)
    before, after = (np.sqrt((off_after(nodes, true) ** 2).mean(0)) for nodes in (scans.windows.node, matched))
    assert before[2] > math.radians(5.0)
    assert after[2] < 0.6 * before[2]
    assert np.hypot(*after[:2]) < 0.8 * np.hypot(*before[:2])


def test_first_windows_are_not_moved(scans, matched) -> None:
    np.testing.assert_array_equal(matched[:FIRST], scans.windows.node[:FIRST])


def test_held_out_readings_have_no_effect_on_scan_matching(scans, matched) -> None:
    w = scans.windows
    in_held_out = np.repeat(scans.held_out, np.diff(w.first))
    spoiled = replace(w, readings=replace(w.readings, z=np.where(in_held_out, 0.5, w.readings.z)))
    other = Scans(spoiled, for_matching(Parameters()), np.zeros(1, np.uint8), scans.held_out)
    np.testing.assert_array_equal(scan_matched(other, TRUST, quietly), matched)


def test_moved_drive_is_matched_the_same(bent, matched) -> None:
    recording, odometry = bent
    home = np.array([3.0, -12.0, math.pi / 2])
    r = recording.readings
    x, y, yaw = compose(home, np.stack([r.x, r.y, r.yaw], axis=1)).T
    moved = Odometry.of(odometry.stamp, compose(home, odometry.pose))
    windows = cut(replace(r, x=x, y=y, yaw=yaw), moved)
    scans = Scans(windows, for_matching(Parameters()), np.zeros(1, np.uint8), held_out(len(windows)))
    # maps are made in the frame of a node
    np.testing.assert_allclose(relative(home, scan_matched(scans, TRUST, quietly))[:, :2], matched[:, :2], atol=1e-3)


def test_mean_of_poses_is_that_of_the_twin(scans, matched) -> None:
    k = FIRST + 10 * BLOCK
    block, nodes = np.arange(k, k + BLOCK), matched[:k]
    motion = relative(scans.windows.node[k - 1], scans.windows.node[block])
    got = scan_matching._off(scans, nodes, block, motion, TRUST)
    w = scans.windows
    members = [j for j in range(k) if w.node_progress[k] - w.node_progress[j] < scan_matching.BEHIND]
    around = scans.map(np.array(members), nodes[-1], nodes, scan_matching.ON_MAP)
    joint = scans.joint(block, motion)
    length, turn = (column[k + BLOCK - 1] - column[k - 1] for column in (w.travel, w.turn))
    near, far = scan_matching.ALONG
    yaw = math.sqrt(TRUST.yaw**2 * length + (scan_matching.YAW_OF_TURN * turn) ** 2 + scan_matching.LEAST_YAW**2)
    sigmas = (near + far * length, near + far * length, yaw)
    each, steps = [], range(-int(min(3.0 * yaw, scan_matching.LARGEST_TURN) / math.radians(2.0)), 0)
    turns = [math.radians(2.0) * n for n in (*steps, 0, *(-n for n in reversed(steps)))]
    for x in (-0.1, 0.0, 0.1):
        for y in (-0.1, 0.0, 0.1):
            for t in turns:
                pose = np.array([[x, y, t]])
                fit = float(scores(joint, around, pose, max(len(joint.readings) // scan_matching.EVALUATED, 1))[0])
                against = sum(min(0.5 * (v / s) ** 2, 4.0) for v, s in zip((x, y, t), sigmas, strict=True))
                each.append((TRUST.counts * fit - against, pose[0]))
    best = max(value for value, _ in each)
    weights = [math.exp(value - best) for value, _ in each]
    expected = sum(weight * pose for weight, (_, pose) in zip(weights, each, strict=True)) / sum(weights)
    assert got == pytest.approx(expected, abs=1e-9)
    assert np.abs(got).max() > 1e-3


def test_scan_matching_without_readings_returns_odometry(scans) -> None:
    w = scans.windows
    empty = Scans(w, for_matching(Parameters()), np.zeros(1, np.uint8), np.ones(len(w), np.bool_))
    np.testing.assert_allclose(scan_matched(empty, TRUST, quietly), w.node, atol=1e-9)


@pytest.mark.slow
def test_building_without_right_angles_is_refined(exact, bent) -> None:
    # with five sides taken for four, odometry would be off by 18° at each corner
    (recording, odometry), true = bent, odometry_of(exact)
    outcome = Refiner(Parameters()).run(recording.readings, odometry)
    assert rms_after_alignment(odometry.pose, true.pose) > 0.6
    assert outcome.accepted and not outcome.right_angles
    assert outcome.reason.startswith('walls are not assumed to be at right angles; where the robot came back')
    assert rms_after_alignment(outcome.trajectory.pose, true.pose) < 0.25
    assert outcome.trajectory.pose[0] == pytest.approx(odometry.pose[0], abs=1e-6)
    assert outcome.loops > 0


@pytest.mark.slow
def test_exact_odometry_without_right_angles_is_kept(exact) -> None:
    outcome = Refiner(Parameters()).run(exact.readings, odometry_of(exact))
    assert not outcome.accepted
    assert outcome.readings is exact.readings


def no_walls(windows, scans, odometry_noise, watch) -> tuple[None, float]:
    return None, 0.0


def test_trajectory_not_supported_by_readings_is_rejected(bent, matched, monkeypatch) -> None:
    recording, odometry = bent
    monkeypatch.setattr(right_angles, 'heading_of_walls', no_walls)
    monkeypatch.setattr(
        refinement, 'match_drive', lambda odometry, scans, *rest: MatchedDrive(matched, [], np.inf, 1.0, scans)
    )
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(0.02, 0.01))
    left = Refiner(Parameters()).run(recording.readings, odometry)
    assert not left.accepted and left.trajectory is odometry
    assert left.reason == right_angles.NO_WALLS + refinement.NOR_MATCHES


def test_matching_alone_is_not_tried_with_sparse_poses(bent, matched, monkeypatch) -> None:
    recording, odometry = bent
    monkeypatch.setattr(right_angles, 'heading_of_walls', no_walls)
    monkeypatch.setattr(
        refinement, 'match_drive', lambda odometry, scans, *rest: MatchedDrive(matched, [], np.inf, 1.0, scans)
    )
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(0.1, 0.01))
    assert Refiner(Parameters()).run(recording.readings, odometry).accepted
    # one pose a metre, as in a recording at 0.5 Hz
    kept = np.unique(np.searchsorted(odometry.travel, np.arange(0.0, odometry.travel[-1])))
    sparse = Odometry(odometry.stamp[[*kept, -1]], odometry.pose[[*kept, -1]])
    assert refinement.usual_step(sparse) == pytest.approx(1.0, abs=0.05)
    left = Refiner(Parameters()).run(recording.readings, sparse)
    assert not left.accepted
    assert left.reason == right_angles.NO_WALLS + refinement.too_sparse_words(refinement.usual_step(sparse))


def test_matching_alone_that_hardly_moves_odometry_is_not_called_no_better(bent, monkeypatch) -> None:
    recording, odometry = bent
    monkeypatch.setattr(right_angles, 'heading_of_walls', no_walls)

    def hardly_moved(odometry: Odometry, scans: Scans, *rest: object) -> MatchedDrive:
        nodes = scans.windows.node.copy()
        nodes[::2, 0] += 0.1
        return MatchedDrive(nodes, [], np.inf, 1.0, scans)

    monkeypatch.setattr(refinement, 'match_drive', hardly_moved)
    left = Refiner(Parameters()).run(recording.readings, odometry)
    assert not left.accepted
    assert left.reason.startswith(right_angles.NO_WALLS + '; scan matching alone moves odometry by 0.0')
    assert left.reason.endswith('which is not more than the accuracy of sonar')


def test_trajectory_that_mainly_turns_odometry_is_judged_by_readings(bent, monkeypatch) -> None:
    """A turn of some degrees blurs the map although it hardly moves the robot."""
    recording, odometry = bent
    monkeypatch.setattr(right_angles, 'heading_of_walls', no_walls)
    angle = math.radians(4.5)

    def turned(odometry: Odometry, scans: Scans, *rest: object) -> MatchedDrive:
        nodes = scans.windows.node.copy()
        nodes[len(nodes) // 2 :, 2] += angle
        return MatchedDrive(nodes, [], np.inf, 1.0, scans)

    monkeypatch.setattr(refinement, 'match_drive', turned)
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(0.1, 0.01))
    monkeypatch.setattr(refinement, 'confirmed_by_places', lambda *rest: True)
    monkeypatch.setattr(refinement, 'gain_within_visits', lambda *rest: Gain(0.0, 0.01))
    taken = Refiner(Parameters()).run(recording.readings, odometry)
    assert taken.accepted and taken.moved < 0.15
    assert taken.turned == pytest.approx(angle / 2, rel=0.1)
    angle = math.radians(3.5)
    assert not Refiner(Parameters()).run(recording.readings, odometry).accepted


def test_usual_step_is_weighted_by_distance() -> None:
    # a hundred small steps of a robot that hardly moves, and most of the way in steps of half a metre
    along = np.concatenate([np.arange(101) * 0.01, 1.0 + np.arange(1, 11) * 0.5])
    pose = np.stack([along, np.zeros_like(along), np.zeros_like(along)], axis=1)
    assert refinement.usual_step(Odometry(np.arange(len(along)), pose)) == pytest.approx(0.5)


def test_drive_above_max_cells_keeps_the_trajectory_from_walls(bent, scans) -> None:
    recording, odometry = bent
    drive_of = Drive(recording.readings, odometry, scans.windows, scans)
    attempt = by_walls(scans, recording, odometry)
    small = Scans(
        scans.windows, for_matching(Parameters.from_flat({'max_cells': 10_000})), np.zeros(1, np.uint8), scans.held_out
    )
    assert Refiner(Parameters())._at_any_angle(drive_of._replace(scans=small), attempt, ACCURACY) is attempt.refinement


def test_objective_of_the_true_poses_is_larger_than_of_odometry(exact, bent, scans) -> None:
    windows, true = scans.windows, odometry_of(exact).at(scans.windows.node_stamp)
    right = scans.objective(true)
    assert right > scans.objective(windows.node) + 0.05 * len(windows.readings)
    moved = compose(np.array([3.0, -2.0, 0.0]), true)
    assert scans.objective(moved) == pytest.approx(right, rel=0.02)


def test_objective_is_that_of_the_map_without_held_out_readings(scans) -> None:
    windows = scans.windows
    kept = np.flatnonzero(~np.repeat(scans.held_out, np.diff(windows.first)))
    maps = Mapper(for_matching(Parameters())).run(windows.readings.select(kept))
    assert scans.objective(windows.node) == pytest.approx(maps.statistics['searched_objective'], rel=1e-3)


@pytest.mark.parametrize('again', [True, False])
def test_reason_says_that_the_robot_came_back_only_if_it_did(bent, scans, matched, monkeypatch, again: bool) -> None:
    recording, odometry = bent
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(0.1, 0.01))
    monkeypatch.setattr(refinement, 'gain_when_fitted', lambda *rest: Gain(0.1, 0.01))
    told = MatchedDrive(matched, [], np.inf, 0.0, scans)
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: told)
    monkeypatch.setattr(refinement, 'has_revisits', lambda *rest: again)
    drive_of = Drive(recording.readings, odometry, scans.windows, scans)
    found = Refiner(Parameters())._at_any_angle(drive_of, by_walls(scans, recording, odometry), ACCURACY)
    assert not found.right_angles
    assert ('where the robot came back' in found.reason) == again
    # none of the places is recognised
    assert found.reason.endswith(
        '; 0% of the path through places seen before is recognised: the drive may be bent as a whole'
    )
    lost = told
    for change in ({'part': LEAST_RECOGNISED}, {'agreed': True}):
        told = lost._replace(**change)
        found = Refiner(Parameters())._at_any_angle(drive_of, by_walls(scans, recording, odometry), ACCURACY)
        assert 'bent as a whole' not in found.reason


def by_walls(scans: Scans, recording: Recording, odometry: Odometry) -> Attempt:
    """A trajectory as from walls at right angles: odometry under another name."""
    found = Refinement(True, 'walls', recording.readings, odometry, {})
    return Attempt(found, scans.windows.node)


@pytest.mark.parametrize('sigmas', [5.0, 1.0, -5.0])
def test_matches_alone_replace_walls_only_with_a_much_larger_j(
    bent, scans, matched, monkeypatch, sigmas: float
) -> None:
    recording, odometry = bent
    attempt, told = by_walls(scans, recording, odometry), []
    monkeypatch.setattr(refinement, 'gain_at_revisits', lambda *rest: Gain(0.1, 0.01))
    monkeypatch.setattr(refinement, 'gain_when_fitted', lambda *rest: told.append(rest[1:3]) or Gain(sigmas, 1.0))
    monkeypatch.setattr(refinement, 'match_drive', lambda *rest: MatchedDrive(matched, [], np.inf, 1.0, scans))
    found = Refiner(Parameters())._at_any_angle(
        Drive(recording.readings, odometry, scans.windows, scans), attempt, ACCURACY
    )
    assert (found is attempt.refinement) == (sigmas < 2.3)
    ((before, after),) = told
    assert before is attempt.nodes and after is matched


def test_j_of_a_contradictory_trajectory_is_smaller_by_many_errors(exact, bent, scans) -> None:
    true = odometry_of(exact).at(scans.windows.node_stamp)
    gain_of_true = gain_of_objective(scans, scans.windows.node, true)
    blocks = -(-len(true) // 4)
    assert gain_of_true.sigmas > 4.0
    assert gain_of_true.mean * blocks == pytest.approx(scans.objective(true) - scans.objective(scans.windows.node))
    again = gain_of_objective(scans, true, scans.windows.node)
    assert again.sigmas == pytest.approx(-gain_of_true.sigmas)
    # of two equally good trajectories, chance decides which has the larger J
    near = true + np.array([0.0, 0.0, 1e-3]) * np.sin(np.arange(len(true)))[:, None]
    assert abs(gain_of_objective(scans, true, near).sigmas) < 2.3


def test_objective_of_windows_sums_up_to_all_without_the_prior(scans) -> None:
    value, windows = scans.explained(scans.windows.node)
    assert value == scans.objective(scans.windows.node)
    assert not windows[scans.held_out].any()
    kept = ~np.repeat(scans.held_out, np.diff(scans.windows.first))
    maps = Mapper(for_matching(Parameters())).run(scans.windows.readings.select(kept))
    assert windows.sum() == pytest.approx(maps.statistics['searched_log_likelihood'], rel=1e-3)
    assert windows.sum() != pytest.approx(value, rel=1e-3)


def test_scan_matching_can_be_cancelled(bent, monkeypatch) -> None:
    recording, odometry = bent
    monkeypatch.setattr(right_angles, 'heading_of_walls', no_walls)
    refiner, stages = Refiner(Parameters()), []

    def watch(stage: str, part: float) -> None:
        stages.append(stage)
        if stage == 'scan matching' and part > 0.1:
            refiner.cancel()

    with pytest.raises(Cancelled):
        refiner.run(recording.readings, odometry, watch)
    assert stages[-1] == 'scan matching'
