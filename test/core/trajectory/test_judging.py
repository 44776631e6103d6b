"""The judgement compares a third of the blocks first, and the others only if these do not clearly decide."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import judging
from forward_grid_mapper.core.trajectory.holding_out import EVERY, FEWEST_BLOCKS, gain, held_out
from forward_grid_mapper.core.trajectory.judging import CLEAR, FIRST, HELD_OUT, JUDGED_ON, gain_over_drive
from forward_grid_mapper.core.trajectory.passes import BLOCK, Progress
from forward_grid_mapper.core.trajectory.scans import Scans

WINDOWS = EVERY * HELD_OUT


class Prediction:
    """Stands for `predicted`: the value of a block is the x coordinate of its first node."""

    held_out = held_out(WINDOWS)

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.blocks: set[int] = set()
        monkeypatch.setattr(judging, 'predicted', self.predicted)

    def predicted(
        self, scans: object, nodes: Floats, blocks: list[NDArray[np.int64]], span: float, watch: Progress
    ) -> Floats:
        for done in range(2):
            watch(done / 2)
        self.blocks.update(int(block[0]) for block in blocks)
        return np.array([nodes[block[0], 0] for block in blocks])

    @property
    def scans(self) -> Scans:
        return cast(Scans, self)


def nodes_of(values: Floats) -> Floats:
    return np.stack([values, np.zeros(len(values)), np.zeros(len(values))], axis=1)


def values_of(sigmas: float, seed: int, count: int = WINDOWS) -> Floats:
    """Return values of windows whose mean is this many standard errors of JUDGED_ON of them above 0."""
    return np.random.default_rng(seed).normal(sigmas / np.sqrt(JUDGED_ON), 1.0, count)


def quietly(part: float) -> None:
    pass


@pytest.mark.parametrize('sigmas', [-12.0, 12.0])
def test_clear_gain_needs_a_third_of_the_blocks(monkeypatch: pytest.MonkeyPatch, sigmas: float) -> None:
    prediction = Prediction(monkeypatch)
    better = gain_over_drive(prediction.scans, nodes_of(np.zeros(WINDOWS)), nodes_of(values_of(sigmas, 1)), quietly)
    assert len(prediction.blocks) == JUDGED_ON // FIRST
    assert abs(better.sigmas) > 4.0
    assert np.sign(better.sigmas) == np.sign(sigmas)


@pytest.mark.parametrize('sigmas', [-1.0, 0.0, 2.3])
def test_gain_near_a_threshold_is_that_of_all_blocks(monkeypatch: pytest.MonkeyPatch, sigmas: float) -> None:
    for seed in range(5):
        prediction, values = Prediction(monkeypatch), values_of(sigmas, seed)
        before, after = nodes_of(np.zeros(WINDOWS)), nodes_of(values)
        better = gain_over_drive(prediction.scans, before, after, quietly)
        assert len(prediction.blocks) == JUDGED_ON
        starts = sorted(prediction.blocks)
        assert better == gain(np.zeros(JUDGED_ON), values[starts])


@pytest.mark.parametrize(('sigmas', 'compared'), [(3.3, JUDGED_ON // FIRST), (2.7, JUDGED_ON)])
def test_gain_of_a_third_counts_for_its_expectation_over_all(
    monkeypatch: pytest.MonkeyPatch, sigmas: float, compared: int
) -> None:
    # the threshold is 2.3; of s standard errors, all blocks are expected to have 1.73 s, and 2 σ are 2.83
    starts = [int(block[0]) for block in judging.blocks_of(WINDOWS, BLOCK, JUDGED_ON)]
    signs = np.where(np.arange(JUDGED_ON) // FIRST % 2, 1.0, -1.0)
    values = np.zeros(WINDOWS)
    values[starts] = signs + sigmas * signs[::FIRST].std(ddof=1) / np.sqrt(JUDGED_ON // FIRST)
    prediction = Prediction(monkeypatch)
    gain_over_drive(prediction.scans, nodes_of(np.zeros(WINDOWS)), nodes_of(values), quietly)
    assert len(prediction.blocks) == compared


def test_few_blocks_are_all_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    count = BLOCK * (3 * judging.FEWEST_FIRST - 3)
    prediction = Prediction(monkeypatch)
    gain_over_drive(prediction.scans, nodes_of(np.zeros(count)), nodes_of(np.full(count, 1.0)), quietly)
    assert len(prediction.blocks) == count // BLOCK


def test_blocks_without_a_value_do_not_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    values = values_of(12.0, 1)
    starts = [int(block[0]) for block in judging.blocks_of(WINDOWS, BLOCK, JUDGED_ON)]
    values[starts[::FIRST][FEWEST_BLOCKS - 1 :]] = np.nan
    prediction = Prediction(monkeypatch)
    better = gain_over_drive(prediction.scans, nodes_of(np.zeros(WINDOWS)), nodes_of(values), quietly)
    assert len(prediction.blocks) == JUDGED_ON
    assert np.isfinite(better.error)


def test_decision_by_a_third_is_seldom_another_than_by_all(monkeypatch: pytest.MonkeyPatch) -> None:
    # beyond 2 σ on one side is one case of 40
    assert CLEAR == 2.0
    prediction = Prediction(monkeypatch)
    first = nodes_of(np.zeros(WINDOWS))
    chosen = np.flatnonzero(prediction.held_out)
    differ = 0
    for seed in range(200):
        values = values_of(-1.0, seed)
        taken = judging.last_not_worse(prediction.scans, first, nodes_of(values)) is not first
        differ += taken != (gain(np.zeros(HELD_OUT), values[chosen]).sigmas > -judging.MOST_WORSE)
    assert differ <= 200 // 40


def test_progress_of_the_judgement_grows_from_0_to_1(monkeypatch: pytest.MonkeyPatch) -> None:
    prediction, told = Prediction(monkeypatch), list[float]()
    before, after = nodes_of(np.zeros(WINDOWS)), nodes_of(values_of(1.0, 1))
    gain_over_drive(prediction.scans, before, after, told.append)
    # of a third of the blocks, which do not decide, and then of all
    np.testing.assert_allclose(told, [0.0, 1 / 12, 1 / 6, 1 / 4, 1 / 3, 1 / 3, 1 / 2, 3 / 4])
    told.clear()
    judging.gain_at_revisits(prediction.scans, before, after, told.append)
    assert told == [0.0, 0.25, 0.5, 0.75]
