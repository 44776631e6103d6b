"""Distances of straight walls, compared with plain Python and in a corridor with known walls."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.poses import compose
from forward_grid_mapper.core.trajectory.wall_distances import (
    AHEAD,
    FEWEST,
    FIRST_SIGMA,
    LEAST_SIGMA,
    LEAST_TRAVEL,
    WIDTH,
    Distances,
    agreeing,
    noise_of,
    normals_of,
)
from forward_grid_mapper.core.trajectory.walls import DIRECTIONS, beside, wall_votes
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, cut

SIDES = np.radians([-90.0, 0.0, 90.0])
LENGTH, HALF = 16.0, 0.13


def corridor(recess: float = 0.0, noise: float = 0.0, slant: float = 0.0) -> Windows:
    """A straight drive between walls at y = −0.8 and 1.2, the second one set back from 8 m on; the end is at 18 m.

    With a slant, the cones are turned ahead, and the edges of those that look to the sides see the walls.
    """
    rng = np.random.default_rng(2)
    x = np.arange(0.0, LENGTH, 0.1)
    stamp = (np.arange(len(x)) * 1e8).astype(np.int64)
    rows = []
    for at, when in zip(x.tolist(), stamp.tolist(), strict=True):
        left = 1.2 + (recess if at > LENGTH / 2 else 0.0)
        for number, (side, z) in enumerate(zip(SIDES, (0.8, 18.0 - at, left), strict=True)):
            bearing, far = side, z
            if slant and side:
                bearing, far = side - np.sign(side) * (HALF + slant), z / math.cos(slant)
            rows.append((at, bearing, min(far + rng.normal(0, 1) * noise, 6.0), when, number))
    columns = np.array(rows)
    readings = Readings.from_columns(
        x=columns[:, 0],
        y=0.0,
        yaw=columns[:, 1],
        z=columns[:, 2],
        z_max=6.0,
        half_angle=HALF,
        stamp=columns[:, 3].astype(np.int64),
        sensor=columns[:, 4].astype(np.int32),
    )
    return cut(readings, Odometry.of(stamp, np.column_stack([x, np.zeros((len(x), 2))])))


def measured(windows: Windows, nodes: np.ndarray | None = None) -> Distances:
    return Distances(windows, np.zeros(len(windows), bool), windows.node if nodes is None else nodes)


def test_measured_distances_are_those_of_the_walls() -> None:
    windows = corridor(noise=0.01)
    found = measured(windows)
    for direction, wanted in ((1, 1.2), (3, 0.8)):
        mine = found.direction == direction
        assert mine.sum() > 10
        assert found.distance[mine] == pytest.approx(wanted, abs=0.02)
    # the end of the corridor is measured from 5 m on
    ahead = found.direction == 0
    assert found.distance[ahead] == pytest.approx(18.0 - windows.node[found.node[ahead], 0], abs=0.02)
    assert 2.0 < found.distance[ahead].min() < found.distance[ahead].max() < 5.0
    assert not (found.direction == 2).any()


def test_walls_beside_all_cones_are_measured_by_their_edges() -> None:
    found = measured(corridor(noise=0.01, slant=math.radians(20.0)))
    for direction, wanted in ((1, 1.2), (3, 0.8)):
        mine = found.direction == direction
        assert mine.sum() > 10
        assert found.distance[mine] == pytest.approx(wanted, abs=0.02)
    # farther beside the cones nothing is measured
    beyond = measured(corridor(noise=0.01, slant=math.radians(32.0)))
    assert not np.isin(beyond.direction, (1, 3)).any()


def test_wall_that_is_set_back_is_another_wall() -> None:
    for recess, wanted in ((0.0, 3), (0.3, 4)):
        walls = measured(corridor(recess)).walls(strict=True)
        assert walls.total == wanted
        sides = {tuple(normal) for normal in walls.normal.tolist()}
        assert sides == {(0.0, 1.0), (0.0, -1.0), (1.0, 0.0)}
        for number in range(walls.total):
            mine = walls.wall == number
            assert np.ptp(walls.places(corridor(recess).node)[mine]) < 1e-6
            assert walls.along[mine].mean() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize('slant', [0.0, 0.3])
def test_lever_is_the_derivative_by_the_yaw(slant: float) -> None:
    windows = corridor(slant=slant)
    turn = 0.002
    # turn the whole drive about each node: the lever predicts the change of its distances
    one = measured(windows)
    for k in range(len(one.node)):
        middle = windows.node[one.node[k]]
        turned = compose(middle + np.array([0.0, 0.0, turn]), windows.node - middle)
        other = measured(windows, turned)
        same = (other.node == one.node[k]) & (other.direction == one.direction[k])
        assert other.distance[same] - one.distance[k] == pytest.approx(turn * one.lever[k], abs=1e-5)
    assert np.abs(one.lever).max() > 0.1


def test_moved_nodes_measure_the_same_distances() -> None:
    windows = corridor()
    home = np.array([3.0, -1.0, math.pi / 2])
    one, other = measured(windows), measured(windows, compose(home, windows.node))
    first, second = (np.lexsort(((d.direction + more) % 4, d.node)) for d, more in ((one, 1), (other, 0)))
    assert np.array_equal((one.direction[first] + 1) % 4, other.direction[second])
    assert one.distance[first] == pytest.approx(other.distance[second], abs=1e-9)


def bent_drive(bearings: np.ndarray, halves: np.ndarray, seed: int) -> Windows:
    """A drive along a bend in a room of 9 m by 5 m; each cone has its range to the nearest point of the rough walls."""
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, 1.0, 0.01)
    pose = np.column_stack([1.0 + 6.0 * along, 1.2 + 1.5 * along**2, 0.1 + 0.4 * along])
    robot = np.repeat(pose, len(bearings), axis=0)
    mounts = np.column_stack([0.2 * np.cos(bearings), 0.1 * np.sin(bearings) - 0.03, bearings])
    sensor = compose(robot, np.tile(mounts, (len(pose), 1)))
    half = np.tile(halves, len(pose))
    ray = sensor[:, 2:] + half[:, None] * np.linspace(-1.0, 1.0, 41)
    with np.errstate(divide='ignore'):
        x, y = (
            np.where(part > 0, size - at, -at) / part
            for at, size, part in ((sensor[:, :1], 9.0, np.cos(ray)), (sensor[:, 1:2], 5.0, np.sin(ray)))
        )
    z = np.minimum(np.abs(x), np.abs(y)).min(1) + rng.normal(0.0, 0.01, len(ray))
    stamp = (np.arange(len(pose)) * 1e8).astype(np.int64)
    readings = Readings.from_columns(
        x=sensor[:, 0],
        y=sensor[:, 1],
        yaw=sensor[:, 2],
        z=np.minimum(z, 6.0),
        z_max=6.0,
        half_angle=half,
        stamp=np.repeat(stamp, len(bearings)),
        sensor=np.tile(np.arange(len(bearings), dtype=np.int32), len(pose)),
    )
    return cut(readings, Odometry.of(stamp, pose))


def mirrored(windows: Windows) -> Windows:
    """The drive with left and right exchanged."""
    w, flip = windows, np.array([1.0, -1.0, -1.0])
    readings = dataclasses.replace(w.readings, y=-w.readings.y, yaw=-w.readings.yaw)
    return dataclasses.replace(w, readings=readings, robot=w.robot * flip, mount=w.mount * flip, node=w.node * flip)


@pytest.mark.parametrize('seed', range(8))
def test_mirrored_drive_has_mirrored_votes_and_distances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # sensors in all directions except straight to a side, or in any; some have wide cones
    bearings = np.radians(rng.choice([-150, -118, -60, -35, 10, 25, 62, 125, 170] if seed < 6 else np.arange(360), 6))
    windows = bent_drive(bearings, np.radians(rng.uniform(5.0, 12.0 if seed < 6 else 50.0, 6)), seed)
    other, everywhere = mirrored(windows), np.zeros(len(windows), bool)
    past = beside(windows.mount[:, 2], windows.readings.half_angle)
    assert past.any() or seed >= 6
    assert np.array_equal(past, beside(other.mount[:, 2], windows.readings.half_angle)[:, ::-1])
    at, votes = wall_votes(windows, everywhere)
    same_at, seen = wall_votes(other, everywhere)
    assert np.array_equal(at, same_at) and np.ptp(votes) > 1.0
    assert seen == pytest.approx(votes[:, -np.arange(DIRECTIONS) % DIRECTIONS], rel=1e-6)
    tables = []
    for found, sign in ((measured(windows), 1), (measured(other), -1)):
        rows = [found.node, sign * found.direction % 4, found.distance, sign * found.lever, sign * found.yaw]
        table = np.column_stack(rows)
        tables.append(table[np.lexsort(table.T[2::-1])])
    assert len(tables[0]) > 5
    assert tables[0] == pytest.approx(tables[1], abs=1e-9)


def test_held_out_windows_measure_nothing() -> None:
    windows = corridor()
    assert len(Distances(windows, np.ones(len(windows), bool), windows.node).node) == 0
    assert Distances(windows, np.ones(len(windows), bool), windows.node).walls(strict=False).total == 0


def test_agreeing_echoes_are_those_of_the_twin() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        distance = np.round(rng.choice([1.0, 2.0, 2.1], 14) + rng.normal(0, 0.04, 14), 4)
        progress = rng.uniform(0, 1, 14)
        first = agreeing(distance, progress)
        best = max(int(((distance >= d) & (distance <= d + WIDTH)).sum()) for d in distance)
        if best < FEWEST:
            assert first == []
        for same in first:
            assert len(same) >= FEWEST
            assert np.ptp(distance[same]) <= WIDTH
            assert np.ptp(progress[same]) >= LEAST_TRAVEL
        if first and len(first) == 2:
            assert len(first[0]) == best
            assert not set(first[0]) & set(first[1])


def test_noise_is_estimated_from_deviations_within_walls() -> None:
    rng = np.random.default_rng(6)
    wall = np.repeat(np.arange(40), 8)
    place = wall * 1.7 + rng.normal(0, 0.03, len(wall))
    place[::25] += 1.0
    assert noise_of(wall, place) == pytest.approx(0.03, rel=0.2)
    assert noise_of(wall, wall * 1.0) == LEAST_SIGMA
    assert noise_of(np.arange(5), np.arange(5.0)) == FIRST_SIGMA


def test_normals_are_at_right_angles() -> None:
    angle = np.arange(4) * math.pi / 2
    for wall_angle in (np.zeros(4), np.array([0.1, -0.2, 0.3, 1.4])):
        wanted = np.stack([np.cos(angle + wall_angle), np.sin(angle + wall_angle)], 1)
        assert normals_of(np.arange(4), wall_angle) == pytest.approx(wanted)


def ahead(*bearings: float, yaw: float = 0.0) -> Windows:
    """A drive straight towards a rough wall at x = 8 m; sonars that look at it or to a side have no echo."""
    half, x = math.radians(7.5), np.arange(0.0, 6.0, 0.1)
    stamp, count = (np.arange(len(x)) * 1e8).astype(np.int64), len(bearings)
    bearing, at = np.tile(bearings, len(x)), np.repeat(x, count)
    # the edge of the cone sees the wall first
    deaf = (bearing == 0.0) | (np.abs(bearing) > 1.0)
    z = np.where(deaf, np.inf, (8.0 - at) / np.cos(np.maximum(np.abs(bearing) - half, 0.0)))
    readings = Readings.from_columns(
        x=at,
        y=0.0,
        yaw=bearing,
        z=np.minimum(z, 6.0),
        z_max=6.0,
        half_angle=half,
        stamp=np.repeat(stamp, count),
        sensor=np.tile(np.arange(count, dtype=np.int32), len(x)),
    )
    return cut(readings, Odometry.of(stamp, np.column_stack([x, np.zeros(len(x)), np.full(len(x), yaw)])))


@pytest.mark.parametrize(('past', 'heard'), [(5.0, True), (10.0, True), (10.4, True), (12.0, False)])
def test_wall_ahead_is_measured_by_cones_beside_it(past, heard) -> None:
    sides = math.radians(past), -math.radians(past)
    windows = ahead(*sides, math.pi / 2)
    found = measured(windows)
    assert set(found.direction.tolist()) == ({0} if heard else set())
    assert found.distance == pytest.approx(8.0 - windows.node[found.node, 0], abs=1e-6)
    walls = found.walls(strict=True)
    assert walls.total == heard
    # beside the robot only cones that contain the normal are used, also with a sensor that looks ahead
    yaw = AHEAD + 0.1
    for other in (ahead(*sides, math.pi / 2 + yaw, yaw=yaw), ahead(*sides, math.pi / 2, 0.0)):
        assert len(measured(other).node) == (len(found.node) if past < 7.5 else 0)


def test_without_sensors_to_a_side_walls_far_beside_cones_are_measured() -> None:
    for past, heard in ((12.0, True), (36.0, True), (39.0, False)):
        assert bool(len(measured(ahead(math.radians(past), -math.radians(past))).node)) == heard


def test_wall_beside_one_cone_needs_the_cone_on_its_other_side() -> None:
    past = math.radians(20.0)
    both, one = ahead(past, -past), ahead(past, -past)
    silent = np.where(one.mount[:, 2] < 0.0, one.readings.z_max, one.readings.z)
    one = dataclasses.replace(one, readings=dataclasses.replace(one.readings, z=silent))
    assert len(measured(both).node) > 0
    assert len(measured(one).node) == 0
    # without a cone on the other side, there is nothing better
    assert len(measured(ahead(past)).node) > 0


def test_lever_of_a_wall_ahead_is_the_derivative_by_the_yaw() -> None:
    windows, turn = ahead(math.radians(10.0)), 0.002
    one = measured(windows)
    for k in range(len(one.node)):
        middle = windows.node[one.node[k]]
        other = measured(windows, compose(middle + np.array([0.0, 0.0, turn]), windows.node - middle))
        same = (other.node == one.node[k]) & (other.direction == one.direction[k])
        assert other.distance[same] - one.distance[k] == pytest.approx(turn * one.lever[k], abs=2e-5)
