"""Jumps of odometry: the drive continues where the robot stood if readings fit there, otherwise a warning is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory import after_jumps
from forward_grid_mapper.core.trajectory.correction import Correction
from forward_grid_mapper.core.trajectory.following import Follower
from forward_grid_mapper.core.trajectory.jumps import doubtful_steps, jumps, since_jump, without_outliers
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.poses import compose, relative, rms_after_alignment
from forward_grid_mapper.core.trajectory.refinement import Refiner
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world


def moved(readings: Readings, before: Odometry, after: Odometry) -> Readings:
    """Readings of a drive, placed with other odometry."""
    sensors = np.stack([readings.x, readings.y, readings.yaw], 1)
    x, y, yaw = compose(after.at(readings.stamp), relative(before.at(readings.stamp), sensors)).T
    return replace(readings, x=x.copy(), y=y.copy(), yaw=yaw.copy())


def restarted(
    readings: Readings, odometry: Odometry, part: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Readings, Odometry]:
    """The drive with odometry that restarts at this pose after a part of it."""
    first = int(part * len(odometry.stamp))
    pose = odometry.pose.copy()
    pose[first:] = compose(np.array(at), relative(odometry.pose[first], odometry.pose[first:]))
    other = Odometry.of(odometry.stamp, pose)
    return moved(readings, odometry, other), other


def without_messages(
    readings: Readings, odometry: Odometry, seconds: float, part: float = 0.5
) -> tuple[Readings, Odometry]:
    """The drive with a gap in its messages, after a part of its poses."""
    middle = int(odometry.stamp[int(part * len(odometry.stamp))])
    gone = (odometry.stamp > middle) & (odometry.stamp < middle + seconds * 1e9)
    unread = (readings.stamp > middle) & (readings.stamp < middle + seconds * 1e9)
    return readings.select(~unread), Odometry(odometry.stamp[~gone], odometry.pose[~gone])


def turning_at_once(readings: Readings, odometry: Odometry, true: Odometry) -> tuple[Readings, Odometry]:
    """The drive of a simulated robot that turns on the spot from one message to the next."""
    since = odometry.stamp - odometry.stamp[0]
    still = np.hypot(*np.diff(true.pose[:, :2], axis=0).T) < 1e-6
    inside = np.append(still[:-1] & still[1:], False)
    lasts = np.where(inside, 0, np.where(still, 5e7, np.diff(since)))
    begin, stay = np.r_[0.0, np.cumsum(lasts)], np.r_[True, ~inside]
    stamp = np.interp(readings.stamp - odometry.stamp[0], since, begin)
    return replace(readings, stamp=odometry.stamp[0] + np.round(stamp).astype(np.int64)), Odometry.of(
        odometry.stamp[0] + np.round(begin[stay]).astype(np.int64), odometry.pose[stay]
    )


@pytest.fixture(scope='module')
def exact() -> Recording:
    return drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3)


@pytest.fixture(scope='module')
def bent(exact: Recording) -> tuple[Readings, Odometry]:
    recording = with_drift(exact, LEVELS['high'], 6)
    return recording.readings, odometry_of(recording)


@pytest.fixture(scope='module')
def outcome(bent: tuple[Readings, Odometry]) -> tuple[Readings, Odometry, Refinement]:
    readings, odometry = restarted(*bent, 0.5)
    return readings, odometry, Refiner(Parameters()).run(readings, odometry)


def off(exact: Recording, path: Odometry) -> float:
    return rms_after_alignment(path.pose, odometry_of(exact).at(path.stamp))


def with_few_poses(readings: Readings, odometry: Odometry, metres: float) -> tuple[Readings, Odometry]:
    """The drive with odometry only once in this many metres."""
    travel, stay = odometry.travel, [0]
    for k in range(1, len(travel)):
        if travel[k] - travel[stay[-1]] >= metres or k == len(travel) - 1:
            stay.append(k)
    sparse = Odometry.of(odometry.stamp[stay], odometry.pose[stay])
    return moved(readings, odometry, sparse), sparse


def test_poses_more_than_a_metre_apart_are_no_jumps(bent: tuple[Readings, Odometry]) -> None:
    _, odometry = with_few_poses(*bent, 1.1)
    assert np.median(np.hypot(*np.diff(odometry.pose[:, :2], axis=0).T)) > 1.0
    assert not len(jumps(odometry)) and not len(doubtful_steps(odometry))
    # no jump either after a pause of the robot
    stamp = odometry.stamp.copy()
    stamp[10:] += 60_000_000_000
    assert not len(jumps(Odometry.of(stamp, odometry.pose)))
    pose = odometry.pose.copy()
    pose[10:, 0] += 5.0
    assert jumps(Odometry.of(odometry.stamp, pose)).tolist() == [10]


def test_restart_after_a_full_turn_is_at_zero() -> None:
    """The yaw of odometry is unwrapped, so that of a driver which was restarted may be a multiple of 360 degrees."""
    count, gap = 100, 30 * 10**9
    pose = np.zeros((2 * count, 3))
    pose[:count, 0] = pose[count:, 0] = 0.02 * np.arange(count)
    pose[:count, 2] = np.linspace(0.0, 2 * np.pi, count)
    stamp = np.arange(2 * count) * 10**8
    stamp[count:] += gap
    odometry = Odometry.of(stamp, pose)
    assert odometry.pose[count, 2] == pytest.approx(2 * np.pi)
    assert jumps(odometry).tolist() == [count] and not len(doubtful_steps(odometry))


def straight(count: int, seconds: float, speed: float) -> Odometry:
    """A robot that drives along x."""
    pose = np.zeros((count, 3))
    pose[:, 0] = speed * seconds * np.arange(count)
    return Odometry.of((np.arange(count) * seconds * 1e9).astype(np.int64), pose)


def across_a_gap(odometry: Odometry, at: int, seconds: float, metres: float) -> Odometry:
    """The drive whose messages before pose `at` are missing."""
    later = np.arange(len(odometry.stamp)) >= at
    pose = odometry.pose.copy()
    pose[later, 0] += metres
    return Odometry.of(odometry.stamp + np.where(later, int(seconds * 1e9), 0), pose)


@pytest.mark.parametrize(('speed', 'jumps_there'), [(2.5, False), (3.5, True)])
def test_no_robot_is_faster_than_three_metres_a_second_while_messages_are_missing(
    speed: float, jumps_there: bool
) -> None:
    """Also if it is fast, so that it is slower than twice its usual speed."""
    odometry = across_a_gap(straight(100, 0.1, 2.0), 50, 10.0, 10.0 * speed)
    assert jumps(odometry).tolist() == [50] * jumps_there
    assert not len(doubtful_steps(odometry))


@pytest.mark.parametrize(('at', 'doubtful'), [(1, True), (2, False), (50, False), (98, False), (99, True)])
def test_robot_of_rare_messages_moves_on_if_it_moved_before_and_after_a_gap(at: int, doubtful: bool) -> None:
    """Its poses are farther apart than the moment before the gap, and after it."""
    odometry = across_a_gap(straight(100, 1.5, 0.25), at, 10.0, 2.5)
    assert doubtful_steps(odometry).tolist() == [at] * doubtful
    assert not len(jumps(odometry))


def test_pose_between_two_outliers_at_one_place_stays() -> None:
    odometry = straight(100, 0.05, 0.5)
    pose = odometry.pose.copy()
    pose[[50, 52]] = 30.0, 20.0, 1.0
    found = without_outliers(Odometry.of(odometry.stamp, pose))
    assert np.array_equal(found.stamp, np.delete(odometry.stamp, [50, 52]))
    assert np.array_equal(found.pose, np.delete(odometry.pose, [50, 52], axis=0))


def test_outlier_of_half_a_turn_is_left_out_while_the_robot_turns() -> None:
    """The turns to it and back have the same sign, so that the unwrapped yaw goes on by a full turn."""
    odometry = straight(100, 0.05, 0.5)
    odometry.pose[:, 2] = -0.01 * np.arange(100)
    pose = odometry.pose.copy()
    pose[50] += np.array([30.0, 20.0, np.pi - 0.005])
    assert np.diff(Odometry.of(odometry.stamp, pose).pose[[49, 51], 2]) > 6.0
    found = without_outliers(Odometry.of(odometry.stamp, pose))
    assert np.array_equal(found.stamp, np.delete(odometry.stamp, 50))
    assert found.pose == pytest.approx(np.delete(odometry.pose, 50, axis=0))


def part_of_drive(begin: float, seconds: tuple[float, float]) -> after_jumps.Part:
    """A robot that drives 2 m along x, with one reading at each pose."""
    path = straight(100, (seconds[1] - seconds[0]) / 99, 2.0 / (seconds[1] - seconds[0]))
    path.pose[:, 0] += begin
    path = Odometry.of(path.stamp + int(seconds[0] * 1e9), path.pose)
    x, y, yaw = path.pose.T
    readings = Readings.from_columns(x=x, y=y, yaw=yaw, z=np.ones(100), z_max=2.0, half_angle=0.2, stamp=path.stamp)
    return after_jumps.Part(readings, path, path, False)


@pytest.mark.parametrize(
    ('begin', 'seconds', 'guess'),
    [
        # messages are missing: it drove on in the frame of the restarted odometry, though that before is as near
        (6.0, 5.0, 16.0),
        # odometry returned to the frame before, since it cannot have been so fast otherwise
        (12.5, 0.1, 12.5),
        # neither is possible
        (70.0, 0.1, 80.0),
    ],
)
def test_pose_by_odometry_is_that_of_the_latest_frame_that_is_possible(
    monkeypatch: pytest.MonkeyPatch, begin: float, seconds: float, guess: float
) -> None:
    guesses: list[tuple[float, float, bool]] = []

    def begin_after(part: object, where: tuple[np.ndarray, np.ndarray], fast: bool, *rest: object) -> after_jumps.Begin:
        guesses.append((where[0][0], where[1][0], fast))
        return after_jumps.Begin(where[0], after_jumps.STOOD)

    monkeypatch.setattr(after_jumps, '_begin_after', begin_after)
    parts = [part_of_drive(8.0, (0, 10)), part_of_drive(0.0, (11, 20)), part_of_drive(begin, (20 + seconds, 40))]
    found = after_jumps.begins_of(parts, Parameters(), np.zeros(1, np.uint8))
    assert [each.how for each in found] == ['first', 'stood', 'stood']
    assert found[1].pose[0] == pytest.approx(10.0)
    assert guesses[1] == pytest.approx((12.0, guess, begin > 50.0))


@pytest.mark.parametrize(('count', 'more'), [(2, ''), (3, ''), (4, '; and 1 more'), (6, '; and 3 more')])
def test_three_jumps_are_listed_and_the_others_counted(count: int, more: str) -> None:
    parts = [part_of_drive(9.0 * k, (10 * k, 10 * k + 9)) for k in range(count + 1)]
    words = after_jumps.jump_words([after_jumps.Begin(np.zeros(3), after_jumps.STOOD)] * (count + 1), parts)
    assert words.count('odometry jumps by 7.0 m after') == min(count, 3)
    assert words.endswith(f'continues from that pose{more}')


@pytest.mark.slow
def test_drive_with_few_poses_is_refined(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = with_few_poses(*bent, 1.1)
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.jumps
    assert off(exact, odometry) > 0.7
    assert off(exact, found.trajectory) < 0.2


def test_doubtful_step_longer_than_the_examined_path_is_no_jump(bent: tuple[Readings, Odometry]) -> None:
    readings, _ = bent
    pose = np.array([[0.0, 0.0, 0.0], [after_jumps.LOOKED_BACK + 5.0, 0.0, 0.0]])
    odometry = Odometry.of(readings.stamp.min() + np.array([0, 10_000_000_000]), pose)
    jumped_to = jumps(odometry)
    assert doubtful_steps(odometry).tolist() == [1]
    found = after_jumps.with_doubtful(readings, odometry, jumped_to, Parameters(), np.zeros(1, np.uint8))
    assert found.tolist() == jumped_to.tolist() == []


def test_doubtful_step_is_judged_by_readings_up_to_the_next_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[tuple[int, int]] = []

    class Check:
        """Records the poses of the part after the step, and finds that it does not fit."""

        def __init__(self, part: after_jumps.Part, parameters: Parameters, stop: np.ndarray) -> None:
            judged.append((len(part.odometry.stamp), len(part.readings)))

        def fits(self, around: object, begin: np.ndarray, least: float) -> bool:
            return False

    monkeypatch.setattr(after_jumps, '_FitCheck', Check)
    monkeypatch.setattr(after_jumps, 'OnMap', lambda *arguments: None)
    # 0.01 m and 0.1 s between two poses; a turn that is too fast at 200, and jumps at 350 and 500
    pose = np.zeros((700, 3))
    pose[:, 0] = 0.01 * np.arange(700)
    pose[200:, 2] += 1.0
    pose[350:, 1] += 2.0
    pose[500:, 1] += 2.0
    odometry = Odometry.of(np.arange(700) * 100_000_000, pose)
    assert doubtful_steps(odometry).tolist() == [200] and jumps(odometry).tolist() == [350, 500]
    ranges = Readings.from_columns(
        ('sonar',), x=pose[:, 0], y=0.0, yaw=0.0, z=np.ones(700), z_max=5.0, half_angle=0.1, stamp=odometry.stamp
    )
    after_jumps.with_doubtful(ranges, odometry, jumps(odometry), Parameters(), np.zeros(1, np.uint8))
    assert judged == [(150, 150)]


def test_part_without_readings_at_its_begin_is_not_placed(bent: tuple[Readings, Odometry]) -> None:
    """With `max_readings`, those of a later visit may have been kept."""
    readings, odometry = bent
    half = len(odometry.stamp) // 2
    paths = [Odometry(odometry.stamp[part], odometry.pose[part]) for part in (slice(half), slice(half, None))]
    far = paths[1].travel > after_jumps.OWN_MAP
    begin = readings.stamp < paths[1].stamp[0], readings.stamp > paths[1].stamp[far][0]
    parts = [after_jumps.Part(readings.select(w), path, path, False) for w, path in zip(begin, paths, strict=True)]
    assert len(parts[1].readings) >= after_jumps.FEWEST_READINGS
    found = after_jumps.begins_of(parts, Parameters(), np.zeros(1, np.uint8))
    assert [each.how for each in found] == [after_jumps.FIRST, after_jumps.UNKNOWN]


def test_drive_without_jumps_has_no_jumps(bent: tuple[Readings, Odometry]) -> None:
    _, odometry = bent
    assert not len(jumps(odometry))
    assert since_jump(odometry) is odometry
    nothing = Odometry.of(np.zeros(0, np.int64), np.zeros((0, 3)))
    assert not len(jumps(nothing)) and since_jump(nothing) is nothing


def test_restarted_odometry_continues_where_the_robot_stood(
    exact: Recording, outcome: tuple[Readings, Odometry, Refinement]
) -> None:
    readings, odometry, found = outcome
    assert found.accepted and not found.unplaced
    assert off(exact, odometry) > 2.0
    assert off(exact, found.trajectory) < 0.2
    assert 'the readings fit the pose of the robot before it' in found.jumps
    assert found.jumps in found.reason
    assert np.array_equal(found.trajectory.stamp, odometry.stamp)
    assert np.hypot(*np.diff(found.trajectory.pose[:, :2], axis=0).T).max() < 0.3, 'no jump is left'
    assert found.trajectory.pose[0] == pytest.approx(odometry.pose[0], abs=1e-6)
    expected = moved(readings, odometry, found.trajectory)
    assert found.readings.x == pytest.approx(expected.x, abs=1e-9)
    begin, end = found.stretch
    assert found.noise > 0.0 and odometry.stamp[0] <= begin < end <= odometry.stamp[-1]


def test_restarted_exact_odometry_is_joined_and_otherwise_kept(exact: Recording) -> None:
    true = odometry_of(exact)
    readings, odometry = restarted(exact.readings, true, 0.4, (5.0, -3.0, 2.0))
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.unplaced
    assert off(exact, found.trajectory) < 0.08
    first = int(0.4 * len(true.stamp))
    assert found.trajectory.pose[:first] == pytest.approx(odometry.pose[:first], abs=1e-9)
    steps = relative(found.trajectory.pose[first:-1], found.trajectory.pose[first + 1 :])
    assert steps == pytest.approx(relative(true.pose[first:-1], true.pose[first + 1 :]), abs=1e-6)
    assert found.calibration == {}


@pytest.mark.slow
def test_missing_messages_do_not_change_exact_odometry(exact: Recording) -> None:
    readings, odometry = without_messages(exact.readings, odometry_of(exact), 5.0)
    assert np.hypot(*np.diff(odometry.pose[:, :2], axis=0).T).max() > 1.0
    assert not len(jumps(odometry)) and not len(doubtful_steps(odometry))
    found = Refiner(Parameters()).run(readings, odometry)
    assert not found.accepted and not found.jumps
    assert found.readings is readings and found.trajectory is odometry


@pytest.mark.slow
def test_drift_is_removed_if_messages_are_missing(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    """Across a gap in which the robot drives on, odometry tells where it is, even in rooms that are new."""
    readings, odometry = without_messages(*without_messages(*bent, 10.0, 0.3), 10.0, 0.6)
    assert np.count_nonzero(np.hypot(*np.diff(odometry.pose[:, :2], axis=0).T) > 1.0) == 2
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.jumps
    assert off(exact, odometry) > 0.7
    assert off(exact, found.trajectory) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize('at', [(0.0, 0.0, 0.0), (0.3, 0.1, 0.2)])
def test_driver_restarted_while_messages_are_missing_is_found(
    exact: Recording, bent: tuple[Readings, Odometry], at: tuple[float, float, float]
) -> None:
    """The robot stands for 20 s, and in the 10 s in their middle no messages come."""
    begun = Odometry.of(bent[1].stamp, relative(bent[1].pose[0], bent[1].pose))
    readings, odometry = restarted(moved(*bent, begun), begun, 0.5, at)
    first, lasts, stands = len(odometry.stamp) // 2, 20_000_000_000, np.arange(1, 51) * 100_000_000
    came = odometry.stamp[first - 1]
    readings = replace(readings, stamp=readings.stamp + lasts * (readings.stamp > came))
    stood = np.concatenate([came + stands, came + lasts - stands[::-1]])
    where = np.repeat(odometry.pose[first - 1 : first + 1], len(stands), axis=0)
    odometry = Odometry.of(
        np.concatenate([odometry.stamp[:first], stood, odometry.stamp[first:] + lasts]),
        np.concatenate([odometry.pose[:first], where, odometry.pose[first:]]),
    )
    assert np.diff(odometry.stamp).max() == 10_000_000_000
    # odometry at zero shows that the driver was restarted; elsewhere only readings do
    after = [first + len(stands)]
    assert jumps(odometry).tolist() == ([] if any(at) else after)
    assert doubtful_steps(odometry).tolist() == (after if any(at) else [])
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.unplaced
    assert 'the readings fit the pose of the robot before it' in found.jumps
    drove = ~np.isin(odometry.stamp, stood)
    stamp = odometry.stamp[drove]
    true = odometry_of(exact).at(stamp - lasts * (stamp > came))
    assert rms_after_alignment(odometry.pose[drove], true) > 1.0
    assert rms_after_alignment(found.trajectory.pose[drove], true) < 0.2


@pytest.mark.slow
def test_robot_that_was_carried_away_gives_a_warning(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = bent
    other = drive(building_world(), building_tour()[12:20], 0.15, sonar_ring(16), NOISY, seed=5)
    elsewhere, gap = odometry_of(other), int(odometry.stamp[-1]) + 10**8
    there = replace(other.readings, stamp=other.readings.stamp - elsewhere.stamp[0] + gap)
    stamp = np.concatenate([odometry.stamp, elsewhere.stamp - elsewhere.stamp[0] + gap])
    away = np.array([60.0, 40.0, 0.3])
    sensors = compose(away, np.stack([there.x, there.y, there.yaw], 1))
    there = replace(there, x=sensors[:, 0].copy(), y=sensors[:, 1].copy(), yaw=sensors[:, 2].copy())
    columns = {
        name: np.concatenate([getattr(readings, name), getattr(there, name)])
        for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp', 'sensor', 'drive')
    }
    both = replace(readings, **columns)
    whole = Odometry.of(stamp, np.concatenate([odometry.pose, compose(away, elsewhere.pose)]))
    found = Refiner(Parameters()).run(both, whole)
    assert found.unplaced
    assert 'do not determine the pose of the robot' in found.jumps and 'reset' in found.jumps
    before, after = found.trajectory.between(0, int(odometry.stamp[-1])), found.trajectory.between(gap, stamp[-1])
    assert off(exact, before) < 0.2, 'what came before is refined all the same'
    assert np.hypot(*(after.pose[0] - before.pose[-1])[:2]) > 30.0


@pytest.mark.slow
def test_few_readings_after_a_jump_give_a_warning(bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*bent, 0.98)
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.unplaced and 'do not determine' in found.jumps
    assert found.accepted, 'the part before is refined'
    first = int(0.98 * len(odometry.stamp))
    correction = Correction(
        odometry.between(0, odometry.stamp[first - 1]), found.trajectory.between(0, odometry.stamp[first - 1])
    )
    assert found.trajectory.pose[first:, :2] == pytest.approx(
        correction.extended(odometry.stamp, odometry.pose).pose[first:, :2], abs=1e-6
    ), 'as odometry has it'


@pytest.mark.slow
def test_drive_with_a_jump_after_few_messages_is_refined(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*bent, 0.01, (30.0, 0.0, 0.0))
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted
    first = jumps(odometry)[0]
    assert off(exact, found.trajectory.between(int(odometry.stamp[first]), int(odometry.stamp[-1]))) < 0.2


@pytest.mark.slow
def test_turns_of_a_simulated_robot_at_once_are_no_jumps(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    _, true = turning_at_once(exact.readings, odometry_of(exact), odometry_of(exact))
    readings, odometry = turning_at_once(*bent, odometry_of(exact))
    assert len(doubtful_steps(odometry)) == 8 and not len(jumps(odometry))
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.jumps
    assert rms_after_alignment(odometry.pose, true.pose) > 0.7
    assert rms_after_alignment(found.trajectory.pose, true.pose) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize('at_once', [False, True])
def test_restarted_yaw_is_distinguished_from_turns(
    exact: Recording, bent: tuple[Readings, Odometry], at_once: bool
) -> None:
    readings, odometry, true = *bent, odometry_of(exact)
    if at_once:
        readings, odometry = turning_at_once(*bent, true)
        _, true = turning_at_once(exact.readings, true, true)
    first = int(0.55 * len(odometry.stamp))
    x, y, yaw = odometry.pose[first].tolist()
    readings, odometry = restarted(readings, odometry, 0.55, (x, y, yaw + 1.2))
    assert first in doubtful_steps(odometry) and not len(jumps(odometry))
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and found.jumps.count('the readings fit the pose of the robot before it') == 1
    assert rms_after_alignment(odometry.pose, true.pose) > 1.0
    assert rms_after_alignment(found.trajectory.pose, true.pose) < 0.2


@pytest.mark.parametrize('stood', [False, True])
@pytest.mark.parametrize('turned', [False, True])
def test_turn_is_a_jump_only_if_readings_fit_only_the_pose_before(
    bent: tuple[Readings, Odometry], monkeypatch: pytest.MonkeyPatch, stood: bool, turned: bool
) -> None:
    readings, odometry = bent
    first = len(odometry.stamp) // 2
    before = odometry.pose[first - 1]
    x, y, yaw = odometry.pose[first].tolist()
    readings, odometry = restarted(readings, odometry, 0.5, (x, y, yaw + 1.2))
    where = {tuple(before.tolist()): stood, tuple(odometry.pose[first].tolist()): turned}
    monkeypatch.setattr(after_jumps._FitCheck, 'fits', lambda self, around, begin, least: where[tuple(begin.tolist())])
    nothing, stop = np.zeros(0, np.int64), np.zeros(1, np.uint8)
    found = after_jumps.with_doubtful(readings, odometry, nothing, Parameters(), stop)
    assert found.tolist() == ([first] if stood and not turned else [])


def test_odometry_with_many_jumps_is_not_refined(bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = bent
    pose = odometry.pose.copy()
    pose[np.arange(len(pose)) // (len(pose) // 50) % 2 == 1] += np.array([4.0, 0.0, 0.0])
    left = Refiner(Parameters()).run(readings, replace(odometry, pose=pose))
    assert not left.accepted and 'not wheel odometry' in left.reason
    assert left.readings is readings


@pytest.mark.slow
def test_odometry_that_restarts_twice_is_joined(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*restarted(*bent, 0.4), 0.7)
    assert len(jumps(odometry)) == 2
    found = Refiner(Parameters()).run(readings, odometry)
    assert found.accepted and not found.unplaced
    assert found.jumps.count('the readings fit the pose of the robot before it') == 2
    assert off(exact, found.trajectory) < 0.2


@pytest.mark.slow
def test_odometry_that_jumps_back_has_its_earlier_pose(exact: Recording) -> None:
    readings, true = exact.readings, odometry_of(exact)
    first, second = (int(part * len(true.stamp)) for part in (0.4, 0.6))
    pose = true.pose.copy()
    pose[first:second, 0] += 5.0
    odometry = Odometry.of(true.stamp, pose)
    found = Refiner(Parameters()).run(moved(readings, true, odometry), odometry)
    assert found.accepted and not found.unplaced
    assert off(exact, found.trajectory) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize('count', [1, 3])
def test_outliers_of_odometry_are_left_out(exact: Recording, bent: tuple[Readings, Odometry], count: int) -> None:
    readings, odometry = bent
    pose = odometry.pose.copy()
    for at in np.linspace(20, len(pose) - 20, 30).astype(int).tolist():
        pose[at : at + count] = (50.0, -20.0, 1.0)
    wild = Odometry.of(odometry.stamp, pose)
    sound = without_outliers(wild)
    assert np.isin(odometry.stamp, sound.stamp).sum() == len(sound.stamp) == len(pose) - 30 * count
    assert without_outliers(odometry) is odometry
    found = Refiner(Parameters()).run(moved(readings, odometry, wild), wild)
    assert found.accepted and f'{30 * count} poses of odometry are outliers (jumps and back)' in found.reason
    assert np.array_equal(found.trajectory.stamp, wild.stamp)
    assert off(exact, found.trajectory) < 0.2


def test_drive_with_outliers_that_is_not_refined_is_unchanged(exact: Recording) -> None:
    readings, true = exact.readings, odometry_of(exact)
    pose = true.pose.copy()
    pose[100] += np.array([3.0, 2.0, 1.0])
    wild = Odometry.of(true.stamp, pose)
    came = moved(readings, true, wild)
    found = Refiner(Parameters()).run(came, wild)
    assert not found.accepted and 'one pose of odometry is an outlier' in found.reason
    assert found.readings is came and found.trajectory is wild


def test_placing_of_parts_can_be_cancelled(bent: tuple[Readings, Odometry], monkeypatch: pytest.MonkeyPatch) -> None:
    refiner = Refiner(Parameters())
    monkeypatch.setattr(
        refiner, '_whole', lambda readings, odometry, least: Refinement(False, '', readings, odometry, {})
    )
    place = after_jumps.OnMap

    def cancels(*arguments: object) -> object:
        refiner.cancel()
        return place(*arguments)

    monkeypatch.setattr(after_jumps, 'OnMap', cancels)
    with pytest.raises(Cancelled):
        refiner.run(*restarted(*bent, 0.5))


def test_following_begins_after_the_last_jump(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*bent, 0.3)
    true = odometry_of(exact)
    known = int(np.searchsorted(true.travel, 0.75 * true.travel[-1]))
    begun = Correction(
        Odometry(odometry.stamp[:known], odometry.pose[:known]), Odometry(odometry.stamp[:known], true.pose[:known])
    )
    follower = Follower(begun, {}, Parameters(), 0.03)
    assert follower.follow(readings, odometry)
    assert not follower.obstacle and follower.windows > 5
    corrected = follower.correction.extended(odometry.stamp, odometry.pose).pose
    assert np.hypot(*(corrected - true.pose)[known:, :2].T).max() < 0.35
    assert follower._past.stamp.min() < odometry.stamp[jumps(odometry)[0]], 'what was driven before it is a place, too'


def test_following_continues_if_messages_are_missing(exact: Recording, bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = without_messages(*bent, 10.0, 0.8)
    true = odometry_of(exact).at(odometry.stamp)
    known = int(np.searchsorted(odometry.travel, 0.6 * odometry.travel[-1]))
    begun = Correction(
        Odometry(odometry.stamp[:known], odometry.pose[:known]), Odometry(odometry.stamp[:known], true[:known])
    )
    follower = Follower(begun, {}, Parameters(), 0.03)
    assert follower.follow(readings, odometry)
    assert not follower.obstacle
    corrected = follower.correction.extended(odometry.stamp, odometry.pose).pose
    assert np.hypot(*(corrected - true)[known:, :2].T).max() < 0.35


def test_following_needs_some_metres_after_a_jump(bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*bent, 0.9)
    follower = Follower(Correction(odometry, odometry), {}, Parameters())
    assert not follower.follow(readings, odometry)
    assert 'odometry jumped, and the robot drove only' in follower.obstacle


def test_following_ends_at_a_jump_of_odometry(bent: tuple[Readings, Odometry]) -> None:
    readings, odometry = restarted(*bent, 0.7)
    half = odometry.between(0, int(odometry.stamp[len(odometry.stamp) // 2]))
    follower = Follower(Correction(half, half), {}, Parameters())
    follower.follow(readings, odometry)
    assert follower.obstacle.startswith('odometry jumped by ')
    assert follower.correction.end < odometry.stamp[jumps(odometry)[0]]
