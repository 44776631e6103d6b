"""The final maps: obstacles that are unlikely by the uncertainty map are removed."""

from __future__ import annotations

import time

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.maps.final_maps import LEAST_PROBABILITY, final_maps, unlikely_obstacles
from forward_grid_mapper.core.search.search import Search


def unlikely_by_flooding(ml: np.ndarray, probability: np.ndarray) -> set[tuple[int, int]]:
    height, width = ml.shape
    left, found = set(zip(*(axis.tolist() for axis in np.nonzero(ml == 1)), strict=True)), set()
    while left:
        obstacle, edge = set(), [left.pop()]
        while edge:
            row, column = edge.pop()
            obstacle.add((row, column))
            near = {(row + i, column + k) for i in (-1, 0, 1) for k in (-1, 0, 1)} & left
            left -= near
            edge += near
        inside = all(0 < row < height - 1 and 0 < column < width - 1 for row, column in obstacle)
        if inside and not any(probability[cell] >= LEAST_PROBABILITY for cell in obstacle):
            found |= obstacle
    return found


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 12, 2))
    ml = rng.choice([-1, 0, 1], shape, p=[0.2, 0.5, 0.3]).astype(np.int8)
    probability = rng.uniform(0.0, rng.choice([0.5, 0.6, 1.0]), shape).astype(np.float32)
    probability[rng.random(shape) < 0.1] = np.nan
    return ml, probability


@settings(deadline=None)
@given(st.integers(0, 2**32))
def test_unlikely_obstacles_are_those_of_the_twin(seed: int) -> None:
    ml, probability = drawn(seed)
    found = unlikely_obstacles(ml, probability)
    assert set(map(tuple, np.argwhere(found).tolist())) == unlikely_by_flooding(ml, probability)
    for turned in (np.flipud, np.fliplr, np.transpose):
        assert np.array_equal(unlikely_obstacles(turned(ml), turned(probability)), turned(found))


def test_long_unlikely_wall_takes_no_time() -> None:
    ml, probability = np.zeros((2, 1500, 1500))
    ml[700, 5:-5] = 1.0
    probability[700, 5] = 1.0
    begun = time.process_time()
    assert not unlikely_obstacles(ml.astype(np.int8), probability.astype(np.float32)).any()
    assert time.process_time() - begun < 1.0, 'the whole map is gone through for each cell of the wall'


def test_unlikely_obstacle_is_removed() -> None:
    """A search that ended with one more obstacle, 1.5 m in front of a wall."""
    rng = np.random.default_rng(1)
    readings = Readings.from_columns(
        ('',),
        x=rng.normal(0.0, 0.2, 400),
        y=0.0,
        yaw=np.pi / 2,
        z=rng.normal(3.0, 0.01, 400),
        z_max=4.0,
        half_angle=0.13,
    )
    parameters, grid = Parameters(), Grid(0.1, -20, -5, 40, 60)
    evidence = Evidence(grid, parameters.model)
    evidence.extend(readings)
    nowhere = np.zeros(grid.shape, bool)
    Search(evidence, parameters.search, nowhere.ravel()).run(lambda progress: None)
    row, column = 20, 20
    cell = row * grid.width + column
    assert not evidence.state.maps.occupied[cell]
    evidence.flip(np.array([cell]))
    final = final_maps(evidence, parameters.search, nowhere)
    assert final.ml[row, column] == 0
    rows, _ = np.nonzero(final.ml == 1)
    assert len(rows) > 8 and (rows >= 34).all() and (rows <= 37).all(), 'the wall stays, and nothing else'
