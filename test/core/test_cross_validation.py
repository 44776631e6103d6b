"""Held-out readings: how they are chosen and judged, and that learning does not use them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from forward_grid_mapper.core import cross_validation as module
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.cross_validation import (
    FOLDS,
    blocks_of,
    cross_validated,
    folds_of,
    log_likelihoods,
    only_if_validated,
    standard_error,
)
from forward_grid_mapper.core.joint_learning import CrossValidation, learn_jointly
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array

READINGS = door_drive(1, NOISY, 0, front_array()).readings


def test_each_reading_is_held_out_once_together_with_its_block() -> None:
    fold = folds_of(READINGS)
    assert set(fold.tolist()) == set(range(FOLDS))
    blocks = (READINGS.stamp - READINGS.stamp.min()) // 2_000_000_000
    for block in np.unique(blocks):
        assert len(set(fold[blocks == block].tolist())) == 1


def test_drive_with_pauses_has_all_folds() -> None:
    """Readings of 2 s, ten times, with pauses of 8 s."""
    stamp = READINGS.stamp.min() + np.arange(1000) // 100 * 10_000_000_000 + np.arange(1000) % 100 * 19_000_000
    fold = folds_of(dataclasses.replace(READINGS.select(slice(1000)), stamp=stamp))
    assert np.bincount(fold).tolist() == [200] * FOLDS


def test_held_out_readings_are_not_used_in_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    learned_from: list[set[int]] = []
    judged: list[set[int]] = []

    def learn(readings: Readings, *args: object, **options: object) -> object:
        learned_from.append(set(readings.stamp.tolist()))
        return learn_jointly(readings, *args, **options)  # type: ignore[arg-type]

    def judge(held: Readings, *args: object) -> object:
        judged.append(set(held.stamp.tolist()))
        return np.zeros(len(held))

    made: list[tuple[int, object]] = []
    run = Mapper.run

    def map_of(self: Mapper, readings: Readings, *args: object, **options: object) -> object:
        made.append((int(readings.stamp.sum()), self._parameters))
        return run(self, readings, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Mapper, 'run', map_of)
    monkeypatch.setattr(module, 'learn_jointly', learn)
    monkeypatch.setattr(module, 'log_likelihoods', judge)
    assert cross_validated(READINGS, Parameters(), 1) == CrossValidation(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert len(learned_from) == FOLDS and len(judged) == 4 * FOLDS
    for k, stamps in enumerate(learned_from):
        assert all(not stamps & held for held in judged[4 * k : 4 * k + 4])
    assert set().union(*judged) == set(READINGS.stamp.tolist())
    assert len(made) == len(set(made)) == 2 * FOLDS, 'a map is made twice'


def test_likelihood_does_not_depend_on_the_grid() -> None:
    maps = Mapper(Parameters()).run(READINGS)
    whole = log_likelihoods(READINGS, maps, maps.parameters.model)
    assert whole.sum() == pytest.approx(maps.log_likelihood, abs=1e-6)
    part = Mapper(Parameters()).run(READINGS.select(slice(0, 200)))
    rest = READINGS.select(slice(200, 240))
    alone = [log_likelihoods(rest.select(slice(k, k + 1)), part, part.parameters.model)[0] for k in range(40)]
    np.testing.assert_allclose(log_likelihoods(rest, part, part.parameters.model), alone, atol=1e-9)


def test_standard_error_is_that_of_sums_of_blocks() -> None:
    """If all readings of a block have the same value, more of them do not reduce the error."""
    blocks = blocks_of(READINGS)
    _, number = np.unique(blocks, return_inverse=True)
    count = number.max() + 1
    values = np.random.default_rng(3).normal(size=count)[number]
    found = standard_error(READINGS, values)
    # brute force: the standard deviation of the mean over bootstraps of blocks
    rng, means = np.random.default_rng(4), []
    for _ in range(4000):
        drawn = rng.integers(0, count, count)
        sums = np.bincount(number, values)[drawn].sum()
        means.append(sums / np.bincount(number)[drawn].sum())
    assert found == pytest.approx(float(np.std(means)), rel=0.2)
    twice = READINGS.select(np.repeat(np.arange(len(READINGS)), 2))
    assert standard_error(twice, np.repeat(values, 2)) == pytest.approx(found, rel=1e-9)
    assert standard_error(READINGS.select(blocks == 0), values[blocks == 0]) == np.inf


@pytest.mark.parametrize(
    ('seen', 'better'),
    [
        (CrossValidation(1.0, 1.0, 1.0, 1.0, 0.0, 0.0), False),
        (CrossValidation(1.0, 1.0, 1.1, 1.2, 0.04, 0.04), True),
        (CrossValidation(1.0, 1.0, 1.1, 1.2, 0.11, 0.04), False),
        (CrossValidation(1.0, 1.0, 1.2, 1.1, 0.04, 0.11), False),
        (CrossValidation(1.0, 1.0, 0.9, 3.0, 0.01, 0.01), False),
        (CrossValidation(1.0, 1.0, 3.0, 0.9, 0.01, 0.01), False),
    ],
)
def test_map_must_be_better_by_both_values_beyond_chance(seen: CrossValidation, better: bool) -> None:
    assert seen.better == better


def test_short_drive_gives_a_warning_of_no_test() -> None:
    first = READINGS.select(READINGS.stamp < READINGS.stamp.min() + 5_000_000_000)
    assert cross_validated(first, Parameters(), 1) is None
    found = learn_jointly(first, Parameters(), 1, keep_going=True)
    kept = only_if_validated(found, first, Parameters(), 1)
    assert kept.parameters == found.parameters
    assert 'no readings could be held out' in kept.warnings[-1]


def test_values_are_accepted_only_if_the_first_ones_are_wrong() -> None:
    """The simulated sonar has a noise of 5 cm."""
    readings = door_drive(3, NOISY, 0).readings
    for given, accepted in (({'sigma': 0.6}, True), ({}, False)):
        parameters = Parameters().varied(given)
        found = only_if_validated(learn_jointly(readings, parameters, 2), readings, parameters, 2)
        assert (found.accepted > 0) == accepted
        assert found.cross_validation is not None and found.cross_validation.better == accepted
        assert (found.parameters == parameters) != accepted
        assert (found.maps.parameters == found.parameters) and (len(found.estimates) > 0) == accepted
    why, *others = found.warnings
    assert why.startswith('the learned values are refused')
    assert all(warning.startswith('of the refused values: ') for warning in others)
