"""The likelihood of scans in local maps, and their matches, compared with plain Python and with known poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.sensor.density import CUT
from forward_grid_mapper.core.trajectory.likelihood import (
    LANES,
    LEAST_SURVIVAL,
    RAYS,
    SIDE_BY_SIDE,
    SPREAD,
    make_scan,
    scores,
)
from forward_grid_mapper.core.trajectory.local_map import UNKNOWN, LocalMap, at_poses, cells_of, local_map
from forward_grid_mapper.core.trajectory.matching import CURVED, grid_around, measure
from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import rooms_world

MODEL = Parameters().model
NOTHING = UNKNOWN * MODEL.p_hit


def made_map(seed: int, normals: bool) -> LocalMap:
    rng = np.random.default_rng(seed)
    hit = rng.choice([0.01, 0.04, 0.66], (40, 50), p=[0.6, 0.3, 0.1]).astype(np.float32)
    angle = rng.uniform(0, math.pi, hit.shape)
    known = (rng.random(hit.shape) < 0.5) & normals
    x, y = (np.where(known, f(angle), 0).astype(np.float32) for f in (np.cos, np.sin))
    bearing, limit = rng.uniform(-math.pi, math.pi, hit.size), math.cos(0.7) ** 2 if normals else 0.0
    seen = np.where(rng.random(hit.size) < 0.5, [np.cos(bearing), np.sin(bearing)], 0.0).astype(np.float32)
    return LocalMap(-25.0, -20.0, 0.1, hit.shape, cells_of(hit, x, y, seen), limit, NOTHING)


def made_readings(seed: int, count: int = 30) -> Readings:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.2, 4.0, count)
    z[::5] = 4.0
    return Readings.from_columns(
        x=rng.normal(0, 0.3, count),
        y=rng.normal(0, 0.3, count),
        yaw=rng.uniform(-3, 3, count),
        z=z,
        z_max=4.0,
        half_angle=rng.choice([0.13, 0.26], count),
        sigma=rng.choice([0.0, 0.07], count),
    )


def normal(error: float, sigma: float) -> float:
    return math.exp(-0.5 * error * error) / (math.sqrt(2 * math.pi) * sigma) if abs(error) <= CUT else 0.0


def log_likelihood(readings: Readings, t: int, around: LocalMap | None, pose: tuple[float, float, float]) -> float:
    """log p(z | map) of one reading by definition; without a map, of an unknown world."""
    sigma = max(readings.sigma[t] or MODEL.sigma, 0.05)
    offset = 0.1 * MODEL.surface_offset
    z, z_max = readings.z[t] + offset, readings.z_max[t] + offset
    reach = z + CUT * sigma if readings.z[t] + CUT * sigma < readings.z_max[t] else z_max
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c * readings.x[t] - s * readings.y[t], pose[1] + s * readings.x[t] + c * readings.y[t]
    half = SPREAD * readings.half_angle[t]
    survival, hit, rays = 1.0, 0.0, RAYS[0]
    for k in range(math.ceil(reach / 0.1)):
        d = (k + 0.5) * 0.1
        rays = max(rays, next((n for n in RAYS if n >= 1 + 2 * half * d / 0.1), RAYS[-1]))
        best, distance = 0.0, d
        for bearing in np.linspace(-half, half, rays) + pose[2] + readings.yaw[t]:
            # cells outside the map count as unknown
            here, far = NOTHING, distance
            if around is not None:
                column = math.floor((x + d * math.cos(bearing)) / 0.1 - around.column)
                row = math.floor((y + d * math.sin(bearing)) / 0.1 - around.row)
                if 0 <= row < around.shape[0] and 0 <= column < around.shape[1]:
                    here, *n, least = around.cells[row * around.shape[1] + column].tolist()
                    along = math.cos(bearing) * n[0] + math.sin(bearing) * n[1]
                    if along < least:
                        here = NOTHING
                    if d < z - 2 * sigma and not any(np.isnan(n)) and along * along < around.cos2_limit:
                        here = 0.0
                    far = math.hypot((column + 0.5 + around.column) * 0.1 - x, (row + 0.5 + around.row) * 0.1 - y)
            if here > best:
                best, distance = here, far
        hit += survival * best * normal((z - distance) / sigma, sigma)
        survival *= 1 - best
        if survival < LEAST_SURVIVAL:
            break
    silent = normal((z_max - z) / sigma, sigma)
    floor = MODEL.p_rand / readings.z_max[t] + (0 if readings.echo[t] else MODEL.p_lost * silent)
    return math.log(floor + (1 - MODEL.p_rand - MODEL.p_lost) * (hit + survival * silent))


@pytest.mark.parametrize('normals', [False, True])
def test_scores_are_those_of_the_twin(normals: bool) -> None:
    around, readings = made_map(1, normals), made_readings(2)
    scan = make_scan(readings, np.stack([readings.x, readings.y, readings.yaw], 1), MODEL, 0.1, NOTHING)
    poses = np.random.default_rng(3).uniform(-3.0, 3.0, (40, 3))
    poses[:3] = [[0.03, -0.02, 0.1], [0.41, 0.2, -2.0], [30.0, 0.0, 0.0]]
    wanted = [
        sum(
            log_likelihood(readings, t, around, tuple(pose)) - log_likelihood(readings, t, None, tuple(pose))
            for t in range(len(readings))
        )
        for pose in poses
    ]
    assert scores(scan, around, poses) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize('count', [0, 1, SIDE_BY_SIDE + 1, LANES, LANES + 1, 2 * LANES + 5])
def test_scores_of_many_poses_equal_those_of_single_poses(count: int) -> None:
    around, readings, rng = made_map(1, True), made_readings(5), np.random.default_rng(count)
    scan = make_scan(readings, np.stack([readings.x, readings.y, readings.yaw], 1), MODEL, 0.1, NOTHING)
    # some poses are off the map, and some have equal yaws, in any order
    poses = rng.uniform(-4.0, 4.0, (count, 3))
    poses[:, 2] = np.where(rng.random(count) < 0.5, poses[:, 2].round(), poses[:, 2])
    each = [scores(scan, around, pose[None], 2)[0] for pose in poses]
    assert (scores(scan, around, poses, 2) == each).all()


def test_score_in_an_unknown_map_is_zero() -> None:
    readings = made_readings(3)
    scan = make_scan(readings, np.stack([readings.x, readings.y, readings.yaw], 1), MODEL, 0.1, NOTHING)
    assert scores(scan, made_map(1, False), np.array([[90.0, 9.0, 1.0]])) == pytest.approx([0.0], abs=1e-3)


def test_score_of_a_part_of_the_readings_is_scaled_to_all() -> None:
    around, readings = made_map(1, False), made_readings(4)
    both = Readings.from_columns(
        **{
            name: np.repeat(getattr(readings, name), 2)
            for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma')
        }
    )
    scan = make_scan(both, np.stack([both.x, both.y, both.yaw], 1), MODEL, 0.1, NOTHING)
    poses = np.zeros((1, 3))
    assert scores(scan, around, poses, stride=2) == pytest.approx(scores(scan, around, poses))


@pytest.fixture(scope='module')
def room():
    """A map of a room, and a scan taken a little later; both are in the frame of the world."""
    path = np.array([[2.0, 2.0], [4.5, 2.0], [4.5, 5.5], [2.0, 5.5]])
    recording = drive(rooms_world(), path, 0.1, sonar_ring(16), NOISY, seed=1)
    readings, count = recording.readings, len(recording.robot)
    scanned = np.arange(count // 2 * 16, (count // 2 + 3) * 16)
    rest = np.setdiff1d(np.arange(len(readings)), scanned)
    around = local_map(readings.select(rest), Parameters(), np.zeros(1, np.uint8))
    scan = readings.select(scanned)
    return around, make_scan(scan, np.stack([scan.x, scan.y, scan.yaw], 1), MODEL, 0.1, NOTHING)


def test_scan_matches_the_pose_where_it_was_taken(room) -> None:
    around, scan = room
    poses = grid_around(np.zeros(3), np.array([0.2, 0.2, 0.09]))
    found = poses[scores(scan, around, poses).argmax()]
    for _ in range(3):
        match = measure(scan, around, found)
        found = match.pose
    # the scan turns about the origin, several metres away; compare the position of the robot
    robot = np.array([4.5, 4.0, 0.0])
    moved = compose(found, robot) - robot
    assert np.hypot(*moved[:2]) < 0.06
    assert abs(moved[2]) < math.radians(1.5)


def test_parabola_fits_the_scores(room) -> None:
    around, scan = room
    match = measure(scan, around, np.zeros(3), len(scan.readings))
    assert match.score == pytest.approx(scores(scan, around, np.zeros((1, 3)))[0])
    curvature = np.linalg.eigvalsh(match.information * np.outer(CURVED, CURVED))
    assert curvature.min() > -1e-9
    # along the most curved direction: least squares of three values on a line, among others
    assert curvature.max() < 60 * len(scan.readings)


def test_bare_wall_gives_no_information_along_it() -> None:
    hit = np.full((60, 60), 0.01, np.float32)
    hit[40] = 0.66
    none = np.zeros_like(hit)
    around = LocalMap(
        -30.0, -30.0, 0.1, hit.shape, cells_of(hit, none, none, np.zeros((2, hit.size), np.float32)), 0.0, NOTHING
    )
    readings = Readings.from_columns(
        x=np.linspace(-0.2, 0.2, 9), y=0.0, yaw=math.pi / 2, z=np.full(9, 1.02), z_max=4.0, half_angle=0.13
    )
    scan = make_scan(readings, np.stack([readings.x, readings.y, readings.yaw], 1), MODEL, 0.1, NOTHING)
    match = measure(scan, around, np.zeros(3))
    assert match.information[0, 0] < 0.05 * match.information[1, 1]
    assert abs(match.pose[1]) < 0.06


def test_local_map_moves_with_its_readings() -> None:
    readings = drive(rooms_world(), np.array([[2.0, 2.0], [4.5, 2.0]]), 0.1, sonar_ring(16), NOISY, seed=1).readings
    stop = np.zeros(1, np.uint8)
    one = local_map(readings, Parameters(), stop)
    poses = np.stack([readings.x + 3.2, readings.y - 0.7, readings.yaw], 1)
    other = local_map(at_poses(readings, poses), Parameters(), stop)
    assert (other.column, other.row) == (one.column + 32, one.row - 7)
    assert np.mean(other.cells[:, 0] == one.cells[:, 0]) > 0.995
