"""The scale of trajectories that were matched with themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import scale
from forward_grid_mapper.core.trajectory.poses import compose, relative
from forward_grid_mapper.core.trajectory.scale import CHANGE, ScaleError, at_likeliest_scale, enlarged, scale_error
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import Recording


@pytest.fixture(scope='module')
def true(exact: Recording, scans: Scans) -> Floats:
    return odometry_of(exact).at(scans.windows.node_stamp)


def size(nodes: Floats) -> float:
    return float(np.hypot(*(nodes[:, :2] - nodes[:, :2].mean(0)).T).sum())


@pytest.mark.parametrize('factor', [0.9, 0.94, 0.97, 1.03, 1.06, 1.1])
def test_scale_error_is_found(scans, true, factor: float) -> None:
    at_truth, error = scale_error(scans, true), scale_error(scans, enlarged(true, true[0], factor))
    assert at_truth.value == pytest.approx(0.0, abs=0.015)
    expected = np.clip(1.0 / factor - 1.0 + at_truth.value + scale.AT_TRUE_SCALE, -CHANGE, CHANGE)
    assert error.value + scale.AT_TRUE_SCALE == pytest.approx(expected, abs=0.01)
    assert abs(error.value) > 3 * error.sigma


def test_scale_error_does_not_depend_on_threads_or_on_where_the_drive_lies(scans, true, monkeypatch) -> None:
    error = scale_error(scans, true)
    monkeypatch.setattr(scans, 'threads', 1)
    assert scale_error(scans, true) == error
    moved = compose(np.array([7.3, -4.1, 2.0]), true)
    assert scale_error(scans, moved).value == pytest.approx(error.value, abs=3 * error.sigma)


class Parabolas:
    """J of each place is a parabola of its scale, with the maximum at a change of its own; the last is 0."""

    def __init__(self, monkeypatch, tops: list[float], curvature: float = 1e4) -> None:
        def objectives(scans: Scans, nodes: Floats, middle: float, seed: int) -> list[float] | None:
            if seed >= len(tops):
                return None
            return [-curvature * (change - tops[seed]) ** 2 for change in (-CHANGE, 0.0, CHANGE)]

        monkeypatch.setattr(scale, '_objectives', objectives)


def test_error_is_that_of_the_mean_over_places(scans, true, monkeypatch) -> None:
    tops = [0.03, 0.05, 0.01, 0.04, 0.02]
    Parabolas(monkeypatch, tops)
    error = scale_error(scans, true)
    assert error.value == pytest.approx(np.mean(tops) - scale.AT_TRUE_SCALE)
    assert error.sigma == pytest.approx(np.std(tops) / 2, rel=0.15)


@pytest.mark.parametrize(
    ('tops', 'curvature', 'change'),
    [([0.09] * 6, 1e4, CHANGE), ([-0.09] * 6, 1e4, -CHANGE), ([0.03] * 6, -1e4, -CHANGE), ([-0.03] * 6, -1e4, CHANGE)],
)
def test_far_from_the_maximum_the_side_counts(scans, true, monkeypatch, tops, curvature: float, change: float) -> None:
    Parabolas(monkeypatch, tops, curvature)
    assert scale_error(scans, true) == pytest.approx((change - scale.AT_TRUE_SCALE, 0.0), abs=1e-9)


def test_places_that_contradict_each_other_leave_the_scale_open(scans, true, monkeypatch) -> None:
    Parabolas(monkeypatch, [0.03, -0.03, 0.03, -0.03, 0.03], -1e4)
    assert scale_error(scans, true).sigma > 0.03
    nodes, factor = at_likeliest_scale(scans, true)
    assert nodes is true
    assert factor == 1.0


def test_from_few_places_nothing_is_known(scans, true, monkeypatch) -> None:
    Parabolas(monkeypatch, [0.03] * (scale.FEWEST_PLACES - 1))
    assert scale_error(scans, true) == ScaleError(0.0, math.inf)
    nodes, factor = at_likeliest_scale(scans, true)
    assert nodes is true
    assert factor == 1.0


def test_places_are_bounded_and_all_over_the_drive(scans, true, monkeypatch) -> None:
    middles = list[float]()
    monkeypatch.setattr(scans, 'threads', 1)
    monkeypatch.setattr(scale, '_objectives', lambda scans, nodes, middle, seed: middles.append(middle))
    scale_error(scans, true)
    assert np.diff(middles) == pytest.approx(scale.EVERY)
    number = len(middles)
    monkeypatch.setattr(scale, 'MOST_PLACES', 5)
    scale_error(scans, true)
    assert len(middles) == number + 5
    assert middles[number] == middles[0]
    assert middles[-1] == pytest.approx(middles[number - 1])


@pytest.mark.parametrize('factor', [0.9, 1.1])
def test_wrong_scale_of_a_drive_is_corrected(scans, true, factor: float) -> None:
    nodes, by = at_likeliest_scale(scans, enlarged(true, true[0], factor))
    assert by == pytest.approx(1.0 / factor, rel=0.02)
    assert size(nodes) / size(true) == pytest.approx(1.0, abs=0.02)
    assert np.array_equal(nodes[0], true[0])


def test_right_scale_of_a_drive_is_kept(scans, true) -> None:
    nodes, factor = at_likeliest_scale(scans, true)
    assert nodes is true
    assert factor == 1.0


class Steps:
    """Errors that are found one after the other, for trajectories that fit their maps as they are.

    Parameters
    ----------
    errors : list of float, float
        With their standard errors.
    values : list of float
        J of the trajectory that was fitted, and of those that were scaled as well; otherwise it grows.
    """

    def __init__(self, monkeypatch, errors: list[tuple[float, float]], values: list[float] | None = None) -> None:
        self.errors, self.values = iter(errors), iter(values or range(scale.ROUNDS + 1))
        self.fitted: list[Floats] = []
        monkeypatch.setattr(scale, 'scale_error', lambda *rest: ScaleError(*next(self.errors)))
        monkeypatch.setattr(scale, 'fitted', self._fitted)
        monkeypatch.setattr(Scans, 'objective', lambda *rest: next(self.values))

    def _fitted(self, scans: Scans, nodes: Floats) -> Floats:
        self.fitted.append(nodes.copy())
        return self.fitted[-1]


@pytest.mark.parametrize(
    ('errors', 'factor'),
    [
        # too small, and not clear
        ([(0.007, 0.001)], 1.0),
        ([(0.02, 0.011)], 1.0),
        ([(-0.02, 0.011)], 1.0),
        ([(0.02, 0.009), (0.0, 0.01)], 1.02),
        ([(-0.02, 0.009), (0.0, 0.01)], 0.98),
        # what remains is changed if it is larger than its standard error
        ([(0.02, 0.001), (0.003, 0.002), (0.0015, 0.001)], 1.02 * 1.003),
        ([(0.02, 0.001), (0.003, 0.004)], 1.02),
        ([(0.01, 0.001)] * scale.ROUNDS, 1.01**scale.ROUNDS),
    ],
)
def test_scale_is_changed_until_it_is_right(monkeypatch, scans, true, errors, factor: float) -> None:
    steps = Steps(monkeypatch, errors)
    nodes, by = at_likeliest_scale(scans, true)
    assert by == pytest.approx(factor)
    assert nodes == pytest.approx(enlarged(true, true[0], factor))
    assert next(steps.errors, None) is None


def test_scale_is_not_changed_if_the_whole_map_contradicts_it(monkeypatch, scans, true) -> None:
    errors = [(0.02, 0.001)] * 4 + [(0.0, 0.001)]
    # the last one whose J is larger than that of the trajectory that was only fitted
    steps = Steps(monkeypatch, errors, [1.0, 0.5, 3.0, 2.0, 0.9])
    nodes, by = at_likeliest_scale(scans, true)
    assert by == pytest.approx(1.02**3)
    assert nodes is steps.fitted[3]
    np.testing.assert_array_equal(steps.fitted[0], true)


def test_scale_is_kept_if_its_map_would_be_too_large(monkeypatch, scans, true) -> None:
    steps, asked = Steps(monkeypatch, [(0.02, 0.001)] * 2), list[Floats]()

    def limited(scans: Scans, nodes: Floats) -> float:
        asked.append(nodes)
        if len(asked) == 3:
            raise InputError('the map would be too large')
        return float(len(asked))

    monkeypatch.setattr(Scans, 'objective', limited)
    nodes, by = at_likeliest_scale(scans, true)
    assert by == pytest.approx(1.02)
    assert nodes is steps.fitted[1]


def test_scale_is_kept_if_the_map_of_a_place_would_be_too_large(monkeypatch, scans, true) -> None:
    Steps(monkeypatch, [])

    def too_large(*rest) -> ScaleError:
        raise InputError('the map would be too large')

    monkeypatch.setattr(scale, 'scale_error', too_large)
    nodes, by = at_likeliest_scale(scans, true)
    assert nodes is true
    assert by == 1.0


def test_enlarged_nodes_keep_their_directions_and_the_shape(true) -> None:
    larger = enlarged(true, true[5], 1.1)
    np.testing.assert_array_equal(larger[5], true[5])
    motion, before = relative(larger[:-1], larger[1:]), relative(true[:-1], true[1:])
    np.testing.assert_allclose(motion, before * [1.1, 1.1, 1.0], atol=1e-12)


def test_progress_grows_to_the_end_of_a_round(monkeypatch, scans, true) -> None:
    reported = list[float]()
    at_likeliest_scale(scans, enlarged(true, true[0], 0.97), reported.append)
    assert reported == sorted(reported)
    assert 1.0 / scale.ROUNDS <= reported[-1] <= 1.0
