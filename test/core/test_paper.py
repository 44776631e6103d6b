"""The effect of the printed text of the paper where the code differs from it (docs/paper.md lists the differences)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

import naive
from forward_grid_mapper.commands.experiment_maps import ONE_SUM
from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters
from forward_grid_mapper.core.common.parameters import Parameters, find
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.evidence.evidence import Evidence
from forward_grid_mapper.core.evidence.fixed_point import QUANTUM
from forward_grid_mapper.core.learning.model_update import learn
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.log_odds_map import LogOddsMap
from forward_grid_mapper.core.maps.uncertainty import marginals
from forward_grid_mapper.core.search.flips import flip_in_order
from forward_grid_mapper.core.search.flips import gain_of as gain_of_flip
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.search.search import LEAST, Search
from forward_grid_mapper.core.sensor.cone_table import effective_sigma
from forward_grid_mapper.core.sensor.density import CUT
from forward_grid_mapper.core.sensor.forward_model import ForwardModel, expectations, log_likelihood
from forward_grid_mapper.simulation.drive import corridor_drive, door_drive
from forward_grid_mapper.simulation.sonar import NOISY
from samples import PLAIN, FlipsAlone, found_by, plain_model, plain_search, random_readings

LINE = Grid(0.1, 0, 0, 12, 1)
"""One row of cells; cell c is 0.05 + 0.1 c metres in front of a sensor at the origin."""

AREA = Grid(0.1, 0, 0, 12, 9)

PAPER = plain_model(p_hit=0.6, p_rand=0.1, p_lost=0.0, sigma=0.051)

"""The model of the paper, with the tails of the noise."""


def along(*z: float, **columns: object) -> Readings:
    """Readings of a sensor that looks along `LINE`; 1.1 m is no echo."""
    given: dict[str, object] = {'x': 0.0, 'y': 0.05, 'yaw': 0.0, 'z_max': 1.1, 'half_angle': 0.1}
    return Readings.from_columns(z=z, **given | columns)


def line(*occupied: int) -> np.ndarray:
    """The map of `LINE` with these cells occupied."""
    made = np.zeros(LINE.shape, np.uint8)
    made[0, list(occupied)] = 1
    return made


def every_map(grid: Grid) -> np.ndarray:
    return np.array(list(itertools.product((0, 1), repeat=grid.size)), np.uint8).reshape(-1, *grid.shape)


def prepare(readings: Readings, grid: Grid, model: ModelParameters, start: np.ndarray | None = None) -> Evidence:
    made = Evidence(grid, model, start=start)
    made.extend(readings)
    return made


def no_prior(grid: Grid) -> Prior:
    return Prior(np.zeros(grid.size), np.zeros(256))


def whole_normal(z: float, mean: float, sigma: float) -> float:
    return math.exp(-0.5 * ((z - mean) / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)


def search(
    readings: Readings,
    grid: Grid = LINE,
    model: ModelParameters = PAPER,
    start: np.ndarray | None = None,
    prior: float = 0.5,
    kind: type[Search] = Search,
) -> Search:
    return kind(prepare(readings, grid, model, start), plain_search(prior=prior))


def found(*arguments: object, **options: object) -> list[int]:
    """The occupied cells of the map found by the search."""
    return np.flatnonzero(found_by(search(*arguments, **options)).occupied).tolist()


def gain_of(cell: int, readings: Readings, occupied: np.ndarray, model: ModelParameters = PAPER) -> float:
    """The gain of a flip of `cell` of `LINE`, as computed by the search."""
    return gain_of_flip(prepare(readings, LINE, model, occupied).state, no_prior(LINE), cell)


def flipped(occupied: np.ndarray, cell: int) -> np.ndarray:
    changed = occupied.copy()
    changed.ravel()[cell] ^= 1
    return changed


def terms(readings: Readings, t: int, grid: Grid, occupied: np.ndarray, model: ModelParameters) -> list[float]:
    """Density of reading t with each cause: random, lost echo, no obstacle, first obstacle, second, …"""
    sigma = naive.sigma_of(readings, t, grid, model)
    met = naive.obstacles(readings, t, grid, occupied, model)
    return naive.causes(readings.z[t], readings.z_max[t], sigma, met, model)


# The standard map: (1)-(17), Table 1


def test_one_reading_gives_its_inverse_model_and_not_eq_4_as_printed() -> None:
    values = {'resolution': 0.1, 'live_p_occupied': 0.8, 'live_p_free': 0.25}
    live = LogOddsMap(Parameters().varied({**values}))
    live.add(along(0.55))
    p, log_odds = live.probability(LINE)[0], live.log_odds(LINE)[0]
    assert p[2] == pytest.approx(0.25, abs=1e-5)
    assert p[5] == pytest.approx(0.8, abs=1e-5)
    printed = 1 - 1 / np.exp(log_odds)
    assert printed[2] < 0, 'not a probability'


def test_uninformative_readings_keep_the_standard_map_at_its_prior() -> None:
    silent = {'live_p_occupied': 0.5, 'live_p_free': 0.5, 'live_p_free_no_echo': 0.5}
    live = LogOddsMap(Parameters().varied({'resolution': 0.1, **silent}))
    live.add(random_readings(np.random.default_rng(0), AREA, 50))
    p = live.probability()
    assert np.isfinite(p).sum() > 50
    assert p[np.isfinite(p)] == pytest.approx(0.5, abs=1e-3)


def closed_form(each: np.ndarray, prior: float) -> np.ndarray:
    """(16) as it must be meant: the log-odds of all readings, less the prior T times, plus the prior once.

    `each`, shape (T, cells), has the occupancy of the cells given each single reading.
    """
    return np.log(each / (1 - each)).sum(axis=0) - (len(each) - 1) * math.log(prior / (1 - prior))


def test_standard_map_is_the_closed_form_of_eq_16_with_logarithms() -> None:
    parameters = Parameters().varied({'resolution': 0.1, **ONE_SUM})
    readings = random_readings(np.random.default_rng(1), AREA, 40)
    live = LogOddsMap(parameters)
    live.add(readings)
    each = []
    for t in range(len(readings)):
        alone = LogOddsMap(parameters)
        alone.add(readings.select(np.array([t])))
        p = alone.probability(live.grid)
        # a reading keeps cells beside its cone at the prior of one half
        each.append(np.where(np.isnan(p), 0.5, p))
    odds = np.array(each, np.float64)
    known = np.isfinite(live.log_odds())
    assert live.log_odds()[known] == pytest.approx(closed_form(odds, 0.5)[known], abs=1e-4)
    printed = (odds / (1 - odds)).sum(axis=0)
    assert printed[known].min() > 0, 'without logarithms, no cell is ever free'


@pytest.mark.parametrize('prior', [0.2, 0.5, 0.7])
def test_closed_form_subtracts_the_prior_for_each_reading(prior: float) -> None:
    each = np.random.default_rng(2).uniform(0.05, 0.95, (12, 5))
    h = math.log(prior / (1 - prior))
    recursive = np.full(5, h)
    for p in each:
        recursive += np.log(p / (1 - p)) - h
    assert closed_form(each, prior) == pytest.approx(recursive)
    assert closed_form(np.full((12, 5), prior), prior) == pytest.approx(h), 'readings that say nothing leave the prior'


# The forward model: (18)-(28)


def test_sigma_of_eq_22_is_a_standard_deviation() -> None:
    sigma = 0.2
    e = expectations(along(0.55, 0.55 + sigma, sigma=sigma), LINE, line(5), PAPER)
    density = e.hit / e.random * (PAPER.p_rand / 1.1) / ((1 - PAPER.p_rand) * PAPER.p_hit)
    assert density[0] == pytest.approx(1 / (math.sqrt(2 * math.pi) * sigma))
    assert density[1] / density[0] == pytest.approx(math.exp(-0.5))


def test_random_readings_do_not_depend_on_distance_unlike_eq_32() -> None:
    readings = along(*np.arange(0.05, 0.8, 0.05))
    actual = expectations(readings, LINE, line(), PAPER)
    assert actual.log_likelihood == pytest.approx(math.log(PAPER.p_rand / 1.1))
    # so random readings do not increase the learned sigma
    readings = along(*[0.5, 0.6] * 20, *[0.15] * 10)
    assert learn(ForwardModel(readings, LINE, PAPER), line(5)).sigma == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize('occupied', [line(), line(5), line(2, 5, 6)])
def test_density_of_a_reading_integrates_to_one(occupied: np.ndarray) -> None:
    # not so if eq 36 multiplied by the root, or if e_{t,0} lacked (1 - p_rand) as in Table 2
    step = 1e-3
    readings = along(*np.arange(step / 2, 1.1, step))
    below = np.exp(expectations(readings, LINE, occupied, PAPER).log_likelihood).sum() * step
    # half of the normal density around z_max is beyond z_max, where no reading can be
    beyond = (1 - PAPER.p_rand) * (1 - PAPER.p_hit) ** occupied.sum() / 2
    assert below + beyond == pytest.approx(1.0, abs=1e-3)


def test_no_echo_expectation_of_table_2_makes_the_sum_exceed_one() -> None:
    readings, model = along(1.1, 1.08, 1.04), replace(PAPER, p_rand=0.3)
    occupied = line(3)
    e = expectations(readings, LINE, occupied, model)
    assert e.random + e.no_echo + e.hit == pytest.approx(1.0)
    for t in range(len(readings)):
        chance, _, nothing, *hits = terms(readings, t, LINE, occupied, model)
        likelihood = chance + nothing + sum(hits)
        printed = (chance + nothing / (1 - model.p_rand) + sum(hits)) / likelihood
        assert printed > 1.05
        assert e.no_echo[t] == pytest.approx(nothing / likelihood)


def test_all_obstacles_of_the_cone_count() -> None:
    # an echo from behind a missed obstacle is explained by the second obstacle
    readings, occupied = along(0.75), line(3, 7)
    e = expectations(readings, LINE, occupied, PAPER)
    assert e.hit[0] > 0.9
    assert e.rank[0] / e.hit[0] == pytest.approx(2.0, abs=1e-6)
    chance, _, nothing, first, _ = terms(readings, 0, LINE, occupied, PAPER)
    assert first + nothing < 1e-6 * chance
    # otherwise the cell of the echo would never be occupied
    assert gain_of(7, readings, line(3)) == pytest.approx(-math.log(e.random[0]), abs=1e-5)


# EM: (29)-(40), Table 2


def squares(readings: Readings, grid: Grid, occupied: np.ndarray, model: ModelParameters) -> float:
    """The criterion of eq 40: the expected squared errors of the obstacles in units of sigma."""
    e = expectations(readings, grid, occupied, model)
    return float((e.squared_error / effective_sigma(readings, model, grid.resolution) ** 2).sum())


def descend(cost: Callable[[np.ndarray], float], occupied: np.ndarray) -> np.ndarray:
    """Flip the cell that lowers `cost` most until no flip lowers it."""
    while True:
        trials = [flipped(occupied, c) for c in range(occupied.size)]
        costs = [cost(trial) for trial in trials]
        if min(costs) >= cost(occupied):
            return occupied
        occupied = trials[int(np.argmin(costs))]


@pytest.mark.parametrize('seed', range(5))
def test_minimising_eq_40_alone_empties_the_map(seed: int) -> None:
    grid = Grid(0.1, 0, 0, 4, 3)
    readings = random_readings(np.random.default_rng(seed), grid, 25)
    ours = found_by(search(readings, grid)).occupied.reshape(grid.shape)
    assert ours.any()
    assert squares(readings, grid, ours, PAPER) > 0
    assert min(squares(readings, grid, m, PAPER) for m in every_map(grid)) == 0
    assert not descend(lambda m: squares(readings, grid, m, PAPER), ours).any()


def stale_gain(readings: Readings, occupied: np.ndarray, cell: int) -> float:
    """The gain of a flip with the expectations from before, tied to ranks: e_{t,k} weighs the obstacle of rank k."""
    gain = 0.0
    with pytest.MonkeyPatch.context() as patch:
        # no density is zero
        patch.setattr(naive, 'CUT', 40.0)
        for t in range(len(readings)):
            before = terms(readings, t, LINE, occupied, PAPER)
            after = terms(readings, t, LINE, flipped(occupied, cell), PAPER)
            # random measurements do not change, and lost echoes are not a cause here
            for k in range(2, min(len(before), len(after))):
                gain += before[k] / sum(before) * math.log(after[k] / before[k])
    return gain


@pytest.mark.parametrize(
    ('cell', 'before', 'ranges'),
    [(2, line(5), [0.55] * 3 + [0.25] * 3), (2, line(2, 5, 7), [0.55] * 5)],
    ids=['occupying', 'freeing'],
)
def test_stale_expectations_reject_a_flip_that_the_exact_e_step_takes(
    cell: int, before: np.ndarray, ranges: Sequence[float]
) -> None:
    readings = along(*ranges)
    truth = naive.log_likelihood(readings, LINE, flipped(before, cell), PAPER)
    truth -= naive.log_likelihood(readings, LINE, before, PAPER)
    assert truth > 1
    assert gain_of(cell, readings, before) == pytest.approx(truth, abs=1e-5)
    assert stale_gain(readings, before, cell) < -20


def test_evidence_is_positive_at_the_echo_and_negative_in_front_of_it() -> None:
    for start in (line(), line(2), line(5)):
        actual = found_by(search(along(0.55, 0.55, 0.55), start=start, prior=0.2)).evidence
        assert actual[5] > 5
        assert actual[:4].max() < -2


def test_unseen_cells_stay_unchanged_although_table_2_fills_them() -> None:
    readings = along(0.35, 0.35)
    result = found_by(search(readings, start=line(9), prior=0.2))
    assert (result.evidence >= 0)[7:].all(), 'which Table 2 takes for occupied'
    assert np.flatnonzero(result.occupied).tolist() == [3, 9]
    assert found(readings, prior=0.2) == [3]


def test_tie_keeps_the_state() -> None:
    # the echo is between two cells: both explain it equally, and moving from one to the other gains nothing
    readings = along(0.5, 0.5, 0.5)
    truth = [naive.log_likelihood(readings, LINE, line(c), PAPER) for c in (4, 5)]
    assert truth[0] == pytest.approx(truth[1], abs=1e-9)
    assert [found(readings, prior=0.05, start=line(c)) for c in (4, 5)] == [[4], [5]]


Order = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(cells that gain, gain of each cell) → the same cells in the order of a sweep"""


def climb(readings: Readings, grid: Grid, order: Order, model: ModelParameters = PAPER) -> np.ndarray:
    """Single flips, sweep by sweep, until no flip gains."""
    state = prepare(readings, grid, model).state
    least = LEAST[0] + LEAST[1] * state.maps.seen
    for _ in range(200):
        gain = state.maps.evidence * QUANTUM
        cells = np.flatnonzero(gain > least)
        if not len(cells):
            return state.maps.occupied.reshape(grid.shape)
        cells = order(cells, gain)
        # gains from before do not matter: no cell waits
        flip_in_order(state, no_prior(grid), LEAST, cells, np.zeros(len(cells)))
    raise AssertionError('the sweeps do not end')


def raster(cells: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return cells


def most_promising_first(cells: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return cells[np.argsort(-gain[cells])]


def shuffled(seed: int) -> Order:
    rng = np.random.default_rng(seed)
    return lambda cells, gain: rng.permutation(cells)


def test_different_orders_of_flips_end_in_different_optima() -> None:
    recording = door_drive(1, NOISY, seed=0)
    readings, grid = recording.readings, recording.world.grid
    model = replace(PAPER, p_hit=0.9, p_rand=0.05)
    ends = [climb(readings, grid, shuffled(seed), model) for seed in range(5)]
    heights = [log_likelihood(readings, grid, end, model) for end in ends]
    assert max(heights) - min(heights) > 5
    for end, other in itertools.combinations(ends, 2):
        assert (end != other).sum() > 0.1 * end.sum()


def test_most_promising_cells_first_ends_higher_than_other_orders() -> None:
    recording = corridor_drive(seed=0)
    readings, grid = recording.readings, recording.world.grid
    orders = (most_promising_first, raster, shuffled(0))
    heights = [log_likelihood(readings, grid, climb(readings, grid, order), PAPER) for order in orders]
    assert heights[0] > max(heights[1:]) + 20


def test_move_leaves_an_optimum_of_single_flips() -> None:
    model = replace(PAPER, p_hit=0.98)
    readings, start = along(0.55, 0.55, 0.55, 0.55), line(4)
    assert found(readings, model=model, start=start, prior=0.2, kind=FlipsAlone) == [4]
    assert found(readings, model=model, start=start, prior=0.2) == [5]


def test_search_starts_from_the_empty_map_since_unseen_cells_stay() -> None:
    recording = door_drive(1, NOISY, seed=0)
    readings, grid = recording.readings, recording.world.grid
    assert not search(readings, grid).evidence.state.maps.occupied.any()
    empty, full = (found_by(search(readings, grid, start=start)) for start in (None, np.ones(grid.shape, np.uint8)))
    heights = [log_likelihood(readings, grid, end.occupied.reshape(grid.shape), PAPER) for end in (empty, full)]
    assert heights[0] == pytest.approx(heights[1], abs=0.01 * abs(heights[0])), 'it finds its way from either'
    assert full.progress.flips > 3 * empty.progress.flips
    unseen = prepare(readings, grid, PAPER).state.maps.seen == 0
    assert (empty.evidence[unseen] == 0).all()
    assert full.occupied[unseen].all(), 'nothing ever frees them'
    assert not empty.occupied[unseen].any()


# Uncertainty: (41)-(45)


def test_mixed_marginal_is_that_of_eq_42_to_45_with_one_prior() -> None:
    readings = along(0.55, 0.62, 0.35, 1.1)
    result = found_by(search(readings, prior=0.3))
    occupied = result.occupied.reshape(LINE.shape)
    alpha, prior = 0.6, 0.2
    q = marginals(result.evidence, plain_search(alpha=alpha, prior=prior))
    for c in range(LINE.size):
        both = [occupied.copy(), occupied.copy()]
        both[0][0, c], both[1][0, c] = 0, 1
        free, full = (math.exp(naive.log_likelihood(readings, LINE, m, PAPER)) for m in both)
        p = full * prior / (full * prior + free * (1 - prior))
        mixed = [p**alpha * prior ** (1 - alpha), (1 - p) ** alpha * (1 - prior) ** (1 - alpha)]
        assert q[c] == pytest.approx(mixed[0] / sum(mixed), abs=1e-5)


def test_marginal_without_evidence_is_the_prior_at_any_alpha() -> None:
    prior = 0.2
    h = math.log(prior / (1 - prior))
    for alpha in (0.0, 0.3, 1.0):
        q = float(marginals(np.zeros(1), plain_search(alpha=alpha, prior=prior))[0])
        assert q == pytest.approx(prior)
        # the last line of Table 2 mixes in the prior as if the likelihood ratio already contained it
        printed = 1 / (1 + math.exp(-(1 - alpha) * h))
        assert alpha == 0.0 or printed > prior + 0.05


def given_likeliest_cause(readings: Readings, occupied: np.ndarray, distances: np.ndarray) -> float:
    """log p(Z | m, C) of eq 26, without the prior of the correspondences C: the most likely cause of each reading."""
    total = 0.0
    for t in range(len(readings)):
        sigma = naive.sigma_of(readings, t, LINE, PAPER)
        cause = int(np.argmax(terms(readings, t, LINE, occupied, PAPER)))
        means = [None, readings.z_max[t], readings.z_max[t], *distances[occupied[0] == 1]]
        mean = means[cause]
        total += math.log(1 / readings.z_max[t] if mean is None else whole_normal(readings.z[t], mean, sigma))
    return total


def test_eq_26_alone_gives_no_evidence_in_front_of_an_obstacle() -> None:
    readings, occupied = along(*[0.55] * 5), line(5)
    distances = LINE.centers()[0]
    alone = given_likeliest_cause(readings, flipped(occupied, 2), distances)
    alone -= given_likeliest_cause(readings, occupied, distances)
    assert alone == pytest.approx(0.0)
    summed = found_by(search(readings, start=occupied)).evidence[2]
    assert summed == pytest.approx(5 * math.log(1 - PAPER.p_hit), abs=0.2)
    q = marginals(np.array([alone, summed]), plain_search(alpha=1.0, prior=0.5))
    assert q[0] == pytest.approx(0.5)
    assert q[1] < 0.02


# Our own choices


def test_readings_without_echo_keep_cells_free() -> None:
    # two random ranges in open space, where ten others have no echo
    readings = along(0.55, 0.55, *[1.1] * 10)
    parameters = replace(Parameters().varied({**PLAIN, 'resolution': 0.1, 'prior': 0.3}), model=PAPER)
    whole, echoes = (Mapper(parameters).run(part) for part in (readings, readings.select(readings.echo)))
    assert (whole.ml[-whole.grid.row, :11] == 0).all()
    assert echoes.ml[-echoes.grid.row, 5] == 1, 'a dot'
    assert echoes.grid.width <= 9, 'and nothing known beyond'


def test_empty_map_is_impossible_without_random_readings() -> None:
    readings = along(0.55, 0.55, 1.1)
    none, least = (replace(PAPER, p_rand=p) for p in (0.0, find('p_rand').low))
    assert log_likelihood(readings, LINE, line(), none) == -math.inf
    assert math.isfinite(log_likelihood(readings, LINE, line(), least))
    assert found(readings, model=least, prior=0.3) == [5]
    with pytest.raises(ParameterError, match='p_rand'):
        Parameters.from_flat({'p_rand': 0.0})


def test_evidence_of_a_reading_without_echo_is_bounded_by_p_rand() -> None:
    readings = along(1.1)
    bound = math.log(PAPER.p_rand / 1.1)
    actual = [log_likelihood(readings, LINE, line(*range(n)), PAPER) for n in range(12)]
    assert min(actual) > bound
    assert actual[11] - bound < 0.01
    unbounded = 11 * math.log(1 - PAPER.p_hit)
    assert actual[11] - actual[0] > unbounded + 3


def test_p_hit_is_below_one_since_freeing_divides_by_the_rest() -> None:
    with pytest.raises(ParameterError, match='p_hit'):
        Parameters.from_flat({'p_hit': 1.0})
    top = replace(PAPER, p_hit=find('p_hit').high, p_rand=find('p_rand').low)
    readings, occupied = along(0.55, 0.55, 0.75, 1.1), line(2, 5, 7)
    for c in range(11):
        truth = naive.log_likelihood(readings, LINE, flipped(occupied, c), top)
        truth -= naive.log_likelihood(readings, LINE, occupied, top)
        assert gain_of(c, readings, occupied, top) == pytest.approx(truth, abs=1e-5)


def test_lost_echoes_do_not_remove_a_smooth_wall() -> None:
    readings = along(*[0.55] * 3, *[1.1] * 12)
    paper, ours = (replace(PAPER, p_hit=0.9, p_rand=0.05, p_lost=p) for p in (0.0, 0.3))
    assert found(readings, model=paper) == []
    assert found(readings, model=ours) == [5]


def test_walls_near_the_largest_range_are_no_lost_echoes() -> None:
    # a robot passes a wall 0.15 m within the largest range, with echoes all along
    readings = Readings.from_columns(
        x=0.2 * np.arange(40), y=0.05, yaw=math.pi / 2, z=np.full(40, 2.85), z_max=3.0, half_angle=0.2
    )
    maps = Mapper(Parameters()).run(readings)
    rows, columns = np.nonzero(maps.ml == 1)
    assert len(set(columns.tolist())) > 70
    assert set((rows + maps.grid.row).tolist()) <= {28, 29}


@pytest.mark.parametrize('seed', range(3))
def test_tails_of_the_noise_hardly_change_gains(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Grid(0.1, 0, 0, 7, 6)
    rng = np.random.default_rng(seed)
    readings, occupied = random_readings(rng, grid, 40), (rng.random(grid.shape) < 0.1).astype(np.uint8)
    maps = np.array([flipped(occupied, c).ravel() for c in range(grid.size)])
    ends = {}
    for cut in (CUT, 40.0):
        monkeypatch.setattr(naive, 'CUT', cut)
        gains = naive.log_likelihoods(readings, grid, maps, PAPER)
        ends[cut] = gains - gains.max()
    assert np.abs(ends[CUT] - ends[40.0]).max() < 0.1


def test_thin_cone_without_a_cell_centre_sees_the_cells_on_its_axis() -> None:
    readings = along(*[0.55] * 3, y=0.02, half_angle=0.01)
    bearings = np.arctan2(0.05 - 0.02, LINE.centers()[0])
    assert (np.abs(bearings) > 0.01).all(), 'no centre lies in the cone'
    assert found(readings, prior=0.3) == [5]


def test_sigma_below_half_a_cell_would_leave_unexplained_ranges() -> None:
    fine = 0.004
    model = replace(PAPER, sigma=fine)
    for z in np.arange(0.505, 0.6, 0.01):
        assert expectations(along(z), LINE, line(5), model).hit[0] > 0.9
    assert naive.normal(0.595, 0.55, fine) == 0.0


def test_surface_may_be_in_front_of_the_centre_of_its_cell() -> None:
    # a wall that fills cell 5 returns the echo at its near face, or anywhere up to its centre
    for offset in (0.0, 0.3, 0.5):
        e = expectations(along(0.55 - 0.1 * offset), LINE, line(5), replace(PAPER, surface_offset=offset))
        assert math.sqrt(e.squared_error[0] / e.hit[0]) == pytest.approx(0.0, abs=1e-7)
    near_face = along(*[0.49] * 3)
    assert found(near_face, prior=0.3) == [4], 'to the centre, a face that is heard a hair short is of the cell before'
    assert found(near_face, prior=0.3, model=replace(PAPER, surface_offset=0.3)) == [5]


def test_prior_removes_the_dot_of_a_stray_reading_and_keeps_the_wall() -> None:
    stray, wall = along(0.25), along(*[0.75] * 3)
    assert 2 in found(stray, prior=0.5)
    assert found(stray, prior=0.001) == []
    assert found(wall, prior=0.001) == [7]
