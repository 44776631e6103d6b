"""Readings that are held out: which they are, what they are asked, and that they have no part in learning."""

from __future__ import annotations

import numpy as np
import pytest

from forward_grid_mapper.core import foresight as module
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.foresight import FOLDS, folds_of, foresight, log_likelihood_of, only_if_foreseen
from forward_grid_mapper.core.joint_learning import Foresight, learn_jointly
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array

READINGS = door_drive(1, NOISY, 0, front_array()).readings


def test_every_reading_is_held_out_once_with_those_about_it() -> None:
    fold = folds_of(READINGS)
    assert set(fold.tolist()) == set(range(FOLDS))
    blocks = (READINGS.stamp - READINGS.stamp.min()) // 2_000_000_000
    for block in np.unique(blocks):
        assert len(set(fold[blocks == block].tolist())) == 1


def test_readings_held_out_have_no_part_in_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    learned_from: list[set[int]] = []
    judged: list[set[int]] = []

    def learn(readings: Readings, *args: object, **options: object) -> object:
        learned_from.append(set(readings.stamp.tolist()))
        return learn_jointly(readings, *args, **options)  # type: ignore[arg-type]

    def judge(held: Readings, *args: object) -> float:
        judged.append(set(held.stamp.tolist()))
        return 0.0

    monkeypatch.setattr(module, 'learn_jointly', learn)
    monkeypatch.setattr(module, 'log_likelihood_of', judge)
    assert foresight(READINGS, Parameters(), 1) == Foresight(0.0, 0.0, 0.0, 0.0)
    assert len(learned_from) == FOLDS and len(judged) == 4 * FOLDS
    for k, stamps in enumerate(learned_from):
        assert all(not stamps & held for held in judged[4 * k : 4 * k + 4])
    assert set().union(*judged) == set(READINGS.stamp.tolist())


def test_the_likelihood_is_that_of_a_map_on_any_grid() -> None:
    maps = Mapper(Parameters()).run(READINGS)
    assert log_likelihood_of(READINGS, maps, maps.parameters.model) == pytest.approx(maps.log_likelihood, abs=1e-6)
    part = Mapper(Parameters()).run(READINGS.select(slice(0, 200)))
    rest = READINGS.select(slice(200, None))
    found = log_likelihood_of(rest, part, part.parameters.model)
    one_by_one = sum(log_likelihood_of(rest.select(slice(k, k + 1)), part, part.parameters.model) for k in range(40))
    first = log_likelihood_of(rest.select(slice(0, 40)), part, part.parameters.model)
    assert one_by_one == pytest.approx(first, abs=1e-6)
    assert found < 0 or found > first


@pytest.mark.parametrize(
    ('seen', 'better'),
    [
        (Foresight(1.0, 1.0, 1.0, 1.0), True),
        (Foresight(1.0, 1.0, 1.1, 1.2), True),
        (Foresight(1.0, 1.0, 0.9, 3.0), False),
        (Foresight(1.0, 1.0, 3.0, 0.9), False),
    ],
)
def test_a_map_has_to_be_no_worse_by_either_values(seen: Foresight, better: bool) -> None:
    assert seen.better == better


def test_a_short_drive_is_told_of() -> None:
    first = READINGS.select(READINGS.stamp < READINGS.stamp.min() + 5_000_000_000)
    assert foresight(first, Parameters(), 1) is None
    found = learn_jointly(first, Parameters(), 1, keep_going=True)
    kept = only_if_foreseen(found, first, Parameters(), 1)
    assert kept.parameters == found.parameters
    assert 'no readings could be held out' in kept.warnings[-1]


def test_values_are_accepted_where_the_first_ones_are_wrong_and_refused_where_they_are_good() -> None:
    """The simulated sonar has 5 % of random readings and noise of 5 cm."""
    readings = door_drive(3, NOISY, 0).readings
    for given, accepted in (({'p_rand': 0.01, 'p_lost': 0.0}, True), ({}, False)):
        parameters = Parameters.from_flat(given)
        found = only_if_foreseen(learn_jointly(readings, parameters, 3), readings, parameters, 3)
        assert (found.accepted > 0) == accepted
        assert found.foresight is not None and found.foresight.better == accepted
        assert (found.parameters == parameters) != accepted
        assert (found.maps.parameters == found.parameters) and (len(found.estimates) > 0) == accepted
    assert 'the learned values are refused' in found.warnings[-1]
