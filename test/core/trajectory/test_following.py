"""Following: better than the last correction, independent of portions, and never against predicted readings."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core import warm_up
from forward_grid_mapper.core.common.errors import Cancelled
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory import following, likelihood, walls, windows
from forward_grid_mapper.core.trajectory.correction import Correction
from forward_grid_mapper.core.trajectory.following import LATE, LONGEST, SETTLED, Follower, direction_of_walls
from forward_grid_mapper.core.trajectory.pose_graph import Edges, no_edges
from forward_grid_mapper.core.trajectory.poses import axes_at, compose, relative, wrapped
from forward_grid_mapper.core.trajectory.tail import edges_from, from_step, window_coordinate
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

KNOWN = 10.0
"""Metres of the drive with known trajectory."""


class Sample:
    """A drive of 25 m with odometry that drifts; the trajectory of the first ten metres is known."""

    def __init__(self) -> None:
        exact = drive(building_world(), building_tour()[:10], 0.15, sonar_ring(16), NOISY, seed=3)
        bent = with_drift(exact, LEVELS['high'], 6)
        self.readings, self.odometry, self.true = bent.readings, odometry_of(bent), odometry_of(exact)
        self.known = int(np.searchsorted(self.odometry.travel, KNOWN))
        begun = slice(0, self.known + 1)
        stamp = self.odometry.stamp[begun]
        self.correction = Correction(Odometry(stamp, self.odometry.pose[begun]), Odometry(stamp, self.true.pose[begun]))

    def off(self, correction: Correction) -> np.ndarray:
        """Errors in metres of the poses after the known ones, with the final correction."""
        corrected = correction.extended(self.odometry.stamp, self.odometry.pose).pose
        return np.hypot(*(corrected - self.true.pose)[self.known :, :2].T)

    def until(self, stamp: int) -> tuple[Readings, Odometry]:
        """The input until the newest reading has this stamp."""
        o = self.odometry
        end = int(np.searchsorted(o.stamp, stamp, side='right'))
        return self.readings.select(self.readings.stamp <= stamp), Odometry(o.stamp[:end], o.pose[:end])

    @property
    def half(self) -> int:
        """The stamp in the middle of the part after the known one."""
        return int(self.odometry.stamp[(self.known + len(self.odometry.stamp)) // 2])


@pytest.fixture(scope='module')
def sample() -> Sample:
    return Sample()


def follower_of(sample: Sample) -> Follower:
    return Follower(sample.correction, {}, Parameters())


@pytest.fixture(scope='module')
def followed_by_block(sample: Sample) -> tuple[Follower, dict[str, list[float]]]:
    """A follower of the whole drive, and what `note_blocks` noted."""
    follower, metres = follower_of(sample), {'_judge': [], '_recognised': []}
    with pytest.MonkeyPatch.context() as patch:
        note_blocks(patch, metres)
        assert follower.follow(sample.readings, sample.odometry)
    return follower, metres


@pytest.fixture(scope='module')
def followed(followed_by_block: tuple[Follower, dict[str, list[float]]]) -> Follower:
    return followed_by_block[0]


@pytest.fixture(scope='module')
def blocks(followed_by_block: tuple[Follower, dict[str, list[float]]]) -> dict[str, list[float]]:
    return followed_by_block[1]


def note_blocks(patch: pytest.MonkeyPatch, metres: dict[str, list[float]]) -> None:
    """Note the progress at the end of each block that a follower judges or recognises."""

    def noting(name: str) -> Any:
        real = getattr(Follower, name)

        def noted(self: Follower, scans: Any, nodes: Any, block: Any) -> Any:
            metres[name].append(float(scans.windows.node_progress[block[-1]]))
            return real(self, scans, nodes, block)

        return noted

    for name in metres:
        patch.setattr(Follower, name, noting(name))


def test_memory_of_following_is_bounded(sample: Sample, followed: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that follows one run for days keeps no more readings and poses than other parts of the node."""
    readings, poses = 250, len(sample.correction.odometry.stamp)
    assert len(followed._past) > readings + readings // 8
    assert len(followed.correction.odometry.stamp) > poses + 1000
    monkeypatch.setattr(following, 'MOST_POSES', poses)
    follower = Follower(sample.correction, {}, Parameters().varied({'max_readings': readings}))
    follower.follow(sample.readings, sample.odometry)
    assert 0 < len(follower._past) <= readings + readings // 8
    assert len(follower._settled.odometry.stamp) <= poses
    assert follower.correction.end == followed.correction.end
    path = follower.correction.trajectory
    assert np.hypot(*(path.pose - sample.true.at(path.stamp))[:, :2].T).max() < 0.3


def test_without_right_angles_walls_are_not_used(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    follower = Follower(sample.correction, {}, Parameters(), right_angles=False)
    graphs = []

    def graph(self: Follower, *rest: Any) -> Any:
        graphs.append(original(self, *rest))
        return graphs[-1]

    original = Follower._graph
    monkeypatch.setattr(Follower, '_graph', graph)
    follower.follow(sample.readings, sample.odometry)
    assert follower.windows > 20
    for each in graphs:
        assert each.walls.total == 0
        assert (each.yaws.information[SETTLED:] == 0.0).all()


def same(one: Correction, other: Correction) -> bool:
    return np.array_equal(one.trajectory.stamp, other.trajectory.stamp) and np.array_equal(
        one.trajectory.pose, other.trajectory.pose
    )


def test_following_is_better_than_the_last_correction(sample: Sample, followed: Follower) -> None:
    kept, ours = sample.off(sample.correction), sample.off(followed.correction)
    assert np.sqrt((kept**2).mean()) > 0.5
    assert np.sqrt((ours**2).mean()) < 0.15
    assert ours.max() < 0.3
    yaw = followed.correction.trajectory.pose[-1, 2] - sample.true.at(followed.correction.trajectory.stamp[-1:])[0, 2]
    assert abs(wrapped(yaw)) < math.radians(3.0)
    assert followed.windows > LONGEST - SETTLED, 'the tail was shifted'
    assert not followed.kept
    assert not followed.obstacle


def test_known_trajectory_stays_and_all_poses_are_corrected(sample: Sample, followed: Follower) -> None:
    correction, count = followed.correction, sample.known + 1
    assert np.array_equal(correction.trajectory.pose[:count], sample.true.pose[:count])
    stamp = correction.trajectory.stamp
    assert np.array_equal(stamp, correction.odometry.stamp)
    assert (np.diff(stamp) > 0).all()
    assert np.array_equal(stamp, sample.odometry.stamp[: len(stamp)])
    assert np.array_equal(correction.odometry.pose, sample.odometry.pose[: len(stamp)])
    path = correction.trajectory.pose
    assert np.hypot(*np.diff(path[:, :2], axis=0).T).max() < 0.1, 'no jumps'


@pytest.mark.parametrize(
    'every', [pytest.param(1, marks=pytest.mark.slow), 7, pytest.param(150, marks=pytest.mark.slow)]
)
def test_result_does_not_depend_on_portions(sample: Sample, followed: Follower, every: int) -> None:
    stamps = sample.odometry.stamp[sample.known :: every]
    follower, changes = follower_of(sample), 0
    for stamp in [*stamps.tolist(), int(sample.readings.stamp.max())]:
        changes += follower.follow(*sample.until(stamp))
    assert changes >= min(len(stamps) // 2, 10)
    assert follower.windows == followed.windows
    assert same(follower.correction, followed.correction)


def test_result_does_not_depend_on_the_order_of_readings(sample: Sample) -> None:
    straight, shuffled = follower_of(sample), follower_of(sample)
    readings, odometry = sample.until(sample.half)
    order = np.argsort(readings.stamp + np.random.default_rng(1).integers(0, LATE, len(readings)))
    straight.follow(readings, odometry)
    # late readings are there a fifth of a second later
    early = readings.select(order[: len(order) - 40])
    shuffled.follow(early, odometry)
    shuffled.follow(readings.select(order), odometry)
    assert straight.windows == shuffled.windows > 5
    assert same(straight.correction, shuffled.correction)


def test_following_waits_for_complete_windows(sample: Sample) -> None:
    follower = follower_of(sample)
    assert not follower.follow(*sample.until(sample.correction.end))
    assert follower.correction is sample.correction
    readings, _ = sample.until(sample.correction.end)
    # odometry without readings is not sufficient
    assert not follower.follow(readings, sample.odometry)
    assert follower.windows == 0
    assert follower.follow(*sample.until(sample.half))


def with_stand(sample: Sample, seconds: int) -> tuple[Readings, Odometry, int]:
    """The drive with the robot standing for a while after the known part, where it measures and sends odometry; its
    last stamp."""
    r, o, rate = sample.readings, sample.odometry, 20
    begin = int(o.stamp[sample.known + 50])
    times = begin + 10**9 // rate * np.arange(1, rate * seconds + 1)
    end, later = int(times[-1]), o.stamp > begin
    before, near = r.stamp <= begin, np.flatnonzero(r.stamp <= begin)[-16:]
    still = r.select(np.tile(near, len(times)))
    mount = relative(o.at(still.stamp), np.stack([still.x, still.y, still.yaw], 1))
    x, y, yaw = compose(o.at(np.array([begin])), mount).T
    still = replace(still, x=x.copy(), y=y.copy(), yaw=yaw.copy(), stamp=np.repeat(times, 16))
    rest = r.select(~before)
    rest = replace(rest, stamp=rest.stamp + end - begin)
    stamp = np.concatenate([o.stamp[~later], times, o.stamp[later] + end - begin])
    poses = [o.pose[~later], np.repeat(o.at(np.array([begin])), len(times), 0), o.pose[later]]
    readings = following._concatenated(following._concatenated(r.select(before), still), rest)
    return readings, Odometry(stamp, np.concatenate(poses)), end


def test_windows_after_a_stand_take_no_longer(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings at standstill are sorted out once, not in each of the windows that contain them."""
    readings, odometry, end = with_stand(sample, 300)
    sizes: list[tuple[int, int]] = []

    def counting(part: Readings, path: Odometry) -> Any:
        sizes.append((int(path.stamp[-1]), len(part)))
        return cut(part, path)

    monkeypatch.setattr(following, 'cut', counting)
    follower = follower_of(sample)
    follower.follow(readings, odometry)
    after = [size for stamp, size in sizes if stamp > end]
    assert len(after) > 20
    assert after[0] > 90_000, 'the stand is in this window'
    assert max(after[1:]) < 3000
    monkeypatch.undo()
    path = follower.correction.extended(odometry.stamp, odometry.pose)
    late = path.stamp > end
    off = path.pose[late, :2] - sample.true.pose[-np.count_nonzero(late) :, :2]
    assert np.hypot(*off.T).max() < 0.3


def test_waiting_for_a_window_looks_at_new_poses_only(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    readings, odometry, end = with_stand(sample, 300)
    follower = follower_of(sample)
    first = int(np.searchsorted(odometry.stamp, end + 4 * 10**9))
    seen = readings.select(readings.stamp <= odometry.stamp[first - 1])
    follower.follow(seen, Odometry(odometry.stamp[:first], odometry.pose[:first]))
    assert follower.windows > 0
    tail = follower._tail
    assert tail is not None
    assert len(tail.odometry.stamp) > 6000
    sizes: list[int] = []
    of = Odometry.of

    def counting(stamp: np.ndarray, pose: np.ndarray) -> Odometry:
        sizes.append(len(stamp))
        return of(stamp, pose)

    monkeypatch.setattr(Odometry, 'of', staticmethod(counting))
    # the robot has not driven a whole window since
    one = int(np.searchsorted(odometry.stamp, tail.odometry.stamp[-1])) + 2
    follower.follow(seen, Odometry(odometry.stamp[:one], odometry.pose[:one]))
    assert follower._tail is tail
    assert sizes
    assert max(sizes) < 100


def test_calibration_corrects_odometry_without_echoes(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    # without echoes, only the calibration corrects odometry
    monkeypatch.setattr(Follower, '_judge', lambda self, *_: None)
    without_echoes = replace(sample.readings, z=sample.readings.z_max)
    ends = []
    for calibration in ({}, {'bias': 0.05}, {'scale': 0.1}):
        follower = Follower(sample.correction, calibration, Parameters())
        assert follower.follow(without_echoes, sample.odometry)
        ends.append(follower.correction)
    plain, turned, longer = ends
    # settled nodes have the poses of the trajectory, and odometry continues from there
    found, kept = sample.off(plain), sample.off(sample.correction)
    assert abs(found[: len(kept)] - kept).max() < 0.3
    way = plain.trajectory.travel[-1] - plain.trajectory.travel[sample.known]
    off = turned.trajectory.pose[-1, 2] - plain.trajectory.pose[-1, 2]
    assert off == pytest.approx(0.05 * way, rel=0.1)
    more = longer.trajectory.travel[-1] - longer.trajectory.travel[sample.known]
    assert more == pytest.approx(1.1 * way, rel=0.03)


def test_following_continues_after_many_turns() -> None:
    """A turn takes a window, but little progress: there may be no place with votes among the first new windows."""
    tour = building_tour()
    to_and_fro = [tour[3], tour[3] + np.array([0.0, 0.5])] * 3
    turning = drive(building_world(), np.array([*tour[:3], *to_and_fro, tour[4]]), 0.15, sonar_ring(16), NOISY, seed=3)
    odometry = odometry_of(turning)
    known = int(np.searchsorted(odometry.travel, 8.9))
    begun = Odometry(odometry.stamp[: known + 1], odometry.pose[: known + 1])
    follower = Follower(Correction(begun, begun), {}, Parameters())
    assert follower.follow(turning.readings, odometry)
    assert follower.windows > 2
    assert not follower.obstacle


def test_sparse_odometry_is_judged_and_recognised_as_often(
    sample: Sample, blocks: dict[str, list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step of it completes several windows, and so may not end where a block does."""
    sparse: dict[str, list[float]] = {name: [] for name in blocks}
    note_blocks(monkeypatch, sparse)
    o = sample.odometry
    kept = np.union1d(np.arange(0, len(o.stamp), 100), len(o.stamp) - 1)
    begun = kept[kept <= sample.known]
    known = Correction(*(Odometry(o.stamp[begun], path.pose[begun]) for path in (o, sample.true)))
    Follower(known, {}, Parameters()).follow(sample.readings, Odometry(o.stamp[kept], o.pose[kept]))
    counts = [[len(found) for found in metres.values()] for metres in (blocks, sparse)]
    assert min(counts[0]) > 3
    assert np.abs(np.subtract(*counts)).max() <= 1


def test_jump_of_odometry_ends_following(sample: Sample) -> None:
    o = sample.odometry
    pose, at = o.pose.copy(), (sample.known + len(o.stamp)) // 2
    pose[at:, 0] += 3.0
    follower = follower_of(sample)
    assert follower.follow(sample.readings, Odometry(o.stamp, pose))
    assert 'odometry jumped by' in follower.obstacle
    assert follower.correction.end < o.stamp[at]
    before = follower.correction
    assert not follower.follow(sample.readings, Odometry(o.stamp, pose))
    assert follower.correction is before


def test_following_can_be_cancelled(sample: Sample) -> None:
    follower = follower_of(sample)
    follower.cancel()
    with pytest.raises(Cancelled):
        follower.follow(sample.readings, sample.odometry)
    assert follower.correction is sample.correction


def test_correction_that_predicts_worse_is_not_used(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    # wrong walls: they turn the robot by 0.1 rad more from place to place
    real = following.yaws_of_votes

    def astray(votes: Any, yaw: Any, correction: Any) -> Any:
        found, _ = real(votes, yaw, correction)
        return found + 0.1 * np.arange(len(found)), np.full(len(found), 1e5)

    follower = follower_of(sample)
    follower.follow(*sample.until(sample.correction.end))
    monkeypatch.setattr(following, 'yaws_of_votes', astray)
    follower.follow(*sample.until(sample.half))
    assert follower.windows > 5
    assert follower.kept
    assert follower.correction is sample.correction


def test_last_proven_correction_is_used(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    gains = [0.1 + 0.01 * (k % 2) for k in range(6)] + [-0.2 - 0.01 * (k % 2) for k in range(6)] + [0.5] * 20
    ours = iter(gains)
    monkeypatch.setattr(
        Follower, '_judge', lambda self, *_: setattr(self, '_gains', [*self._gains, next(ours)][-following.JUDGED :])
    )
    monkeypatch.setattr(following, 'BLOCK', 2)
    monkeypatch.setattr(following, 'RECOGNISING', 3)
    follower, kept, proven = follower_of(sample), [], []
    for stamp in sample.odometry.stamp[sample.known :].tolist():
        if follower.follow(*sample.until(stamp)):
            kept.append(follower.kept)
            proven.append(follower._proven)
    assert proven[0] is sample.correction
    assert any(each is not sample.correction for each in proven)
    first = kept.index(True)
    assert not all(kept[first:]), 'and it goes on when it predicts better again'
    assert proven[first] is not sample.correction


@pytest.mark.parametrize('angle', [0.0, 0.3, -0.7, 2.0])
def test_direction_of_walls_turns_with_the_map(sample: Sample, angle: float) -> None:
    readings, odometry = sample.until(sample.correction.end)
    windows = cut(readings, odometry)
    nodes = compose(np.array([1.0, -2.0, angle]), sample.correction.trajectory.at(windows.node_stamp))
    off = (direction_of_walls(windows, nodes) - angle + math.pi / 4) % (math.pi / 2) - math.pi / 4
    assert abs(off) < math.radians(1.0)


def test_following_on_a_turned_map_gives_the_turned_result(sample: Sample, followed: Follower) -> None:
    turn = np.array([3.0, -1.0, 0.4])
    base = sample.correction
    turned = Correction(base.odometry, Odometry(base.trajectory.stamp, compose(turn, base.trajectory.pose)))
    follower = Follower(turned, {}, Parameters())
    follower.follow(sample.readings, sample.odometry)
    back = relative(turn, follower.correction.trajectory.pose)[:, :2]
    assert np.abs(back - followed.correction.trajectory.pose[:, :2]).max() < 0.1


@pytest.mark.slow
def test_places_on_the_earlier_map_are_recognised(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot turns and drives back; only recognised places show that the stated size of the wheels is too small."""
    there, path = replaced_by_truth(sample), sample.true
    end, pause = int(path.stamp[-1]), 10**9
    back = path.pose[::-1] + np.array([0.0, 0.0, math.pi])
    stamp = end + pause + (end - path.stamp)[::-1]
    back_path = Odometry.of(stamp, back)
    whole = Odometry.of(np.concatenate([path.stamp, stamp]), np.concatenate([path.pose, back_path.pose]))
    # a ring of sonars sees the same after half a turn, each sonar as the opposite one
    across = {name: k for k, name in enumerate(there.sensor_names)}
    assert len(across) == 16
    sensor = (there.sensor + 8) % 16
    returned = replace(there, stamp=end + pause + (end - there.stamp), sensor=sensor)
    returned = returned.select(np.argsort(returned.stamp, kind='stable'))
    both = following._concatenated(there, returned)
    base = Correction(path, path)
    drifts = []
    for recognises in (True, False):
        follower = Follower(base, {'scale': 0.05}, Parameters())
        if not recognises:
            monkeypatch.setattr(Follower, '_recognised', lambda self, *_: no_edges())
        follower.follow(both, whole)
        assert (follower.places > 3) == recognises
        # the correction that is followed, whether it is used or not
        path_now = follower._followed.trajectory
        drifts.append(np.hypot(*(path_now.pose - whole.at(path_now.stamp))[:, :2].T).max())
    assert drifts[0] < 0.3
    assert drifts[0] < 0.7 * drifts[1]


def replaced_by_truth(sample: Sample) -> Readings:
    o, t = sample.odometry, sample.true
    r = sample.readings
    mount = relative(o.at(r.stamp), np.stack([r.x, r.y, r.yaw], 1))
    x, y, yaw = compose(t.at(r.stamp), mount).T
    return replace(r, x=x.copy(), y=y.copy(), yaw=yaw.copy())


@pytest.mark.parametrize('seed', range(10))
def test_recognised_places_stay_when_the_graph_is_shifted(seed: int) -> None:
    """Residuals and their weights are the same in the frame of another first node."""
    rng = np.random.default_rng(seed)
    old, new, node = rng.normal(0.0, 3.0, (3, 3))
    measured = relative(old, node) + rng.normal(0.0, 0.05, 3)
    half = rng.normal(0.0, 1.0, (3, 3))
    edges = Edges(np.zeros(1, np.int64), np.array([30]), measured[None], (half @ half.T)[None])
    moved = edges_from(edges, relative(new, old), 8, 8 + SETTLED)

    def counted(frame: np.ndarray, e: Edges) -> float:
        r = relative(frame, node) - e.pose[0]
        r[2] = wrapped(r[2])
        return float(r @ e.information[0] @ r)

    assert counted(new, moved) == pytest.approx(counted(old, edges))
    assert (moved.first[0], moved.second[0]) == (0, 22)
    gone = edges._replace(second=np.array([8 + SETTLED - 1]))
    assert not len(edges_from(gone, relative(new, old), 8, 8 + SETTLED).first), 'settled nodes need none'
    assert axes_at(0.0) == pytest.approx(np.eye(3))


def test_windows_from_a_later_begin_are_the_same(sample: Sample) -> None:
    for begin in (0, 1, 7, 20):
        rest = from_step(sample.odometry, begin)
        whole, ours = window_coordinate(sample.odometry), window_coordinate(rest)
        assert ours[-1] == pytest.approx(whole[-1] - begin)
        assert (np.diff(rest.stamp) >= 0).all()
        one = cut(sample.readings.select(sample.readings.stamp > rest.stamp[0]), rest)
        other = cut(sample.readings, sample.odometry)
        assert one.node == pytest.approx(other.node[begin:], abs=1e-6)


def test_following_compiles_no_kernels(sample: Sample) -> None:
    warm_up.warm_up_trajectory()
    kernels = [walls.count_votes, likelihood.score_poses, likelihood._set_unknown, windows.mark_still]
    before = [len(kernel.signatures) for kernel in kernels]
    follower_of(sample).follow(*sample.until(sample.half))
    assert [len(kernel.signatures) for kernel in kernels] == before
