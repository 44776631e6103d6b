"""Learning of parameters and map together: results, bias, and warnings about lost walls."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
import pytest

from forward_grid_mapper.core import joint_learning
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.grid import Grid, part_of
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.joint_learning import LIKELIHOOD_DROP, Learned, learn_jointly, settle
from forward_grid_mapper.core.learning.lost_walls import lost_walls
from forward_grid_mapper.core.learning.standard_errors import parameter_estimates
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.sensor.forward_model import ForwardModel
from forward_grid_mapper.simulation.drive import Recording, corridor_drive, door_drive
from forward_grid_mapper.simulation.score import score_map, visible_surface
from forward_grid_mapper.simulation.sonar import NoiseModel
from samples import PLAIN, random_readings


@lru_cache(maxsize=2)
def corridor(seed: int) -> Recording:
    return corridor_drive(seed)


def smooth_recall(maps: MapSet, recording: Recording) -> float:
    visible = visible_surface(recording.world, recording.readings, 0.2)
    return score_map(maps.ml, maps.grid, recording.world, visible).smooth_recall


def walls_of(learned: Learned) -> list[str]:
    return [warning for warning in learned.warnings if 'loses walls' in warning]


@pytest.mark.parametrize('seed', [0, 1])
def test_values_that_lose_the_smooth_wall_are_rejected(seed: int) -> None:
    recording = corridor(seed)
    learned = learn_jointly(recording.readings, Parameters().varied(PLAIN))
    last = learned.rounds[-1]
    refused = Mapper(dataclasses.replace(Parameters().varied(PLAIN), model=last.model)).run(recording.readings)
    assert smooth_recall(refused, recording) < 0.5
    (warning,) = walls_of(learned)
    assert 'p_hit rose' in warning and 'refused' in warning and 'smooth walls' in warning
    assert learned.accepted == len(learned.rounds) - 2
    assert last.lost_length > 5 and last.unexplained > learned.rounds[0].unexplained
    # only the smooth wall was lost, and a mirror image of it
    row = np.flatnonzero(recording.world.smooth_cells.any(1))[0]
    smooth = [stretch for stretch in last.lost if abs(stretch.start[1] - (row + 0.5) * 0.1) < 0.25]
    assert last.lost[0] in smooth and sum(stretch.length for stretch in smooth) > 0.9 * last.lost_length
    assert smooth_recall(learned.maps, recording) > 0.9
    assert learned.maps.parameters == learned.parameters
    assert bool(learned.estimates) == (learned.accepted > 0)


def test_rejected_values_are_returned_with_keep_going() -> None:
    learned = learn_jointly(corridor(1).readings, Parameters().varied(PLAIN), 2, keep_going=True)
    assert learned.accepted == 2
    assert learned.parameters.model == learned.rounds[2].model
    assert 'written in any case' in walls_of(learned)[0]
    assert smooth_recall(learned.maps, corridor(1)) < 0.5


def test_without_smooth_walls_values_are_accepted_with_bias() -> None:
    recording = door_drive(3, NoiseModel(sigma=0.07, p_random=0.08, p_lost=0.1), 0)
    readings = recording.readings
    learned = learn_jointly(readings, Parameters().varied(PLAIN), 10)
    assert not walls_of(learned) and learned.accepted == len(learned.rounds) - 1
    model = learned.parameters.model
    world = recording.world
    known = settle(ForwardModel(readings, world.grid, Parameters().varied(PLAIN).model), world.reference)
    sure = parameter_estimates(ForwardModel(readings, world.grid, known), world.reference)
    for name, truth in (('p_rand', 0.08), ('p_lost', 0.1)):
        assert sure[name].low < truth < sure[name].high
    # with cells of 10 cm, distances to their centres have small errors
    assert known.sigma == pytest.approx(0.07, abs=0.01)
    # the map was made from the readings, so it explains random readings and noise by walls
    for name in ('p_rand', 'sigma'):
        assert getattr(model, name) < getattr(known, name) - 2 * learned.estimates[name].error
    assert known.p_rand / 3 < model.p_rand and model.p_lost == pytest.approx(0.1, abs=0.05)
    assert learned.rounds[-1].log_likelihood > learned.rounds[0].log_likelihood


def test_search_that_ends_in_another_optimum_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    class SecondEndsPoorly(Mapper):
        """Its second search has a high cost of walls, so it ends in a map with few of them."""

        def __init__(self, parameters: Parameters) -> None:
            runs.append(parameters)
            poor = dataclasses.replace(parameters, search=dataclasses.replace(parameters.search, wall_cost=90.0))
            super().__init__(poor if len(runs) == 2 else parameters)

    readings = corridor(0).readings
    fair = learn_jointly(readings, Parameters(), 1, keep_going=True)
    assert not any('another local maximum' in warning for warning in fair.warnings)
    monkeypatch.setattr(joint_learning, 'Mapper', SecondEndsPoorly)
    learned = learn_jointly(readings, Parameters(), 1, keep_going=True)
    last = learned.rounds[1]
    drop = last.log_likelihood_before - last.log_likelihood
    assert drop > LIKELIHOOD_DROP * len(readings)
    (warning,) = (warning for warning in learned.warnings if 'another local maximum' in warning)
    assert 'round 1' in warning and f'{drop:.0f} nats' in warning
    # the likelihood of both maps is that of the forward model with the new values and normals
    forward = learned.maps.forward_model()
    assert last.log_likelihood == pytest.approx(forward.log_likelihood(learned.maps.ml), abs=1e-6)
    first = Mapper(Parameters()).run(readings)
    before = forward.log_likelihood(part_of(first.grid, first.ml, forward.grid))
    assert last.log_likelihood_before == pytest.approx(before, abs=1e-6)


def test_uncertain_values_give_a_warning() -> None:
    readings = random_readings(np.random.default_rng(0), Grid(0.1, 0, 0, 30, 30), 150)
    readings.half_angle[:] = 0.1
    learned = learn_jointly(readings, Parameters().varied(PLAIN), 2, keep_going=True)
    warnings = ' '.join(learned.warnings)
    assert 'inform p_hit; it is only a rough estimate' in warnings
    assert 'had not converged' in learn_jointly(readings, Parameters().varied(PLAIN), 1, keep_going=True).warnings[0]


def test_many_random_readings_give_a_warning() -> None:
    recording = door_drive(3, NoiseModel(sigma=0.05, p_random=0.6), 0)
    learned = learn_jointly(recording.readings, Parameters().varied({**PLAIN, 'prior': 0.05}), 3)
    assert any('more than the random measurements of a working sonar' in warning for warning in learned.warnings)


def test_learning_without_readings_raises() -> None:
    with pytest.raises(InputError):
        learn_jointly(
            Readings.from_columns(z=[], x=[], y=[], yaw=[], z_max=[], half_angle=[]), Parameters().varied(PLAIN)
        )


def facing_wall() -> MapSet:
    """A wall of three metres at y = 1, seen from below."""
    x = np.repeat(np.arange(0.05, 3.0, 0.1), 4)
    grid = Grid(0.1, -2, -2, 40, 20)
    ml = np.zeros(grid.shape, np.int8)
    ml[12, 2:32] = 1
    readings = Readings.from_columns(
        ('a',), x=x, y=0.05, yaw=np.pi / 2, z=np.ones(len(x)), z_max=3.0, half_angle=0.1, stamp=np.arange(len(x))
    )
    nothing = np.full(grid.shape, np.nan, np.float32)
    unexplained = np.zeros(len(x), bool)
    return MapSet(grid, nothing, ml, nothing, readings, unexplained, 0.0, 0.0, Parameters().varied(PLAIN))


def test_lost_walls_are_found() -> None:
    before = facing_wall()
    assert lost_walls(before, before) == []
    gone = before.ml.copy()
    gone[12, 12:22] = 0
    # a wall moved by a cell is not lost, nor are ends next to remaining cells
    moved = np.roll(before.ml, 1, axis=0)
    assert lost_walls(before, dataclasses.replace(before, ml=moved)) == []
    (stretch,) = lost_walls(before, dataclasses.replace(before, ml=gone))
    assert stretch.cells == 8 and stretch.length == pytest.approx(0.8)
    assert stretch.start == pytest.approx((1.15, 1.05)) and stretch.end == pytest.approx((1.85, 1.05))
    assert stretch.echoes > 20
    gone[:] = before.ml
    gone[12, 12:17] = 0
    assert lost_walls(before, dataclasses.replace(before, ml=gone)) == [], 'too short to matter'


def test_traversed_cells_are_no_lost_walls() -> None:
    before = facing_wall()
    path = dataclasses.replace(before.readings, y=np.full(len(before.readings), 1.25), z=np.full(120, 3.0))
    both = Readings.from_columns(
        ('a',),
        **{
            name: np.concatenate([getattr(before.readings, name), getattr(path, name)])
            for name in ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma', 'stamp', 'sensor')
        },
    )
    traversed = dataclasses.replace(before, readings=both, unexplained=np.zeros(len(both), bool))
    assert lost_walls(traversed, dataclasses.replace(traversed, ml=np.zeros_like(before.ml))) == []
