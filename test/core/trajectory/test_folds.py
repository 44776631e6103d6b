"""Trajectories that are nearly accepted are estimated again with other windows held out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory import folds, holding_out
from forward_grid_mapper.core.trajectory.attempt import CONTRADICTED, UNMATCHED, Attempt, Drive
from forward_grid_mapper.core.trajectory.folds import NEARLY, OTHERS, accepted_in_folds
from forward_grid_mapper.core.trajectory.holding_out import EVERY, LEAST_SIGMAS, held_out
from forward_grid_mapper.core.trajectory.outcome import Refinement
from forward_grid_mapper.core.trajectory.scans import Scans

ENOUGH = LEAST_SIGMAS / np.sqrt(2.0) + 0.1


class Folds:
    """Solutions of one fold after the other, whose readings are predicted better by given standard errors.

    Each has a larger J than the one before it.

    Parameters
    ----------
    sigmas : list of float
    back : list of bool, optional
        Whether odometry, then each solution, comes back to places.
    nearby : float
        Standard errors by which each solution predicts readings better within a few metres.
    """

    def __init__(
        self, monkeypatch, scans: Scans, sigmas: list[float], back: list[bool] | None = None, nearby: float = 0.0
    ) -> None:
        self.held_out: list[NDArray[np.bool_]] = []
        self._nearby = nearby
        self._sigmas, self._back = sigmas, back or [True] * (1 + len(sigmas))
        windows = scans.windows
        self.drive = Drive(windows.readings, None, windows, scans)  # type: ignore[arg-type]
        monkeypatch.setattr(folds, 'predicted', self.predicted)
        for module in (folds, holding_out):
            monkeypatch.setattr(module, 'has_revisits', lambda scans, nodes: self._back[self._number(nodes)])
        monkeypatch.setattr(Scans, 'objective', lambda scans, nodes: float(nodes[0, 0]))

    def _number(self, nodes: Floats) -> int:
        return round(float(nodes[0, 0] - self.drive.windows.node[0, 0]))

    def attempt(self, number: int) -> Attempt:
        """Return the solution of a fold, counted from 1."""
        outcome = Refinement(True, f'fold {number}', self.drive.readings, None, {})  # type: ignore[arg-type]
        return Attempt(outcome, self.drive.windows.node + np.array([number, 0.0, 0.0]), by_votes=True)

    def solve(self, other: Drive) -> Attempt:
        self.held_out.append(other.scans.held_out)
        return self.attempt(1 + len(self.held_out))

    def predicted(self, scans: Scans, nodes: Floats, blocks: list[NDArray[np.int64]], span: float) -> Floats:
        assert all(scans.held_out[block].all() for block in blocks)
        number, count = self._number(nodes), len(blocks)
        if not number:
            return np.zeros(count)
        noise = np.tile([1.0, -1.0], count)[:count]
        noise -= noise.mean()
        sigmas = self._sigmas[number - 1] if np.isinf(span) else self._nearby
        return noise + sigmas * noise.std(ddof=1) / np.sqrt(count)

    def judged(self) -> Attempt | None:
        return accepted_in_folds(self.drive, self.attempt(1), self.solve)


@pytest.mark.parametrize(
    ('sigmas', 'solved', 'accepted'),
    [
        # two folds of 1.7 standard errors have 2.4 together, three of 1.4 have 2.4
        ([ENOUGH, ENOUGH], 1, True),
        ([1.4, 1.4, 1.4], 2, True),
        ([1.2, 1.2, 1.2], 2, False),
        ([NEARLY - 0.1], 0, False),
        ([ENOUGH, NEARLY - ENOUGH], 1, False),
        ([-3.0], 0, False),
    ],
)
def test_folds_are_added_while_they_may_show_that_odometry_is_wrong(
    scans, monkeypatch, sigmas: list[float], solved: int, accepted: bool
) -> None:
    trial = Folds(monkeypatch, scans, sigmas)
    found = trial.judged()
    assert len(trial.held_out) == solved
    assert (found is not None) == accepted
    if found is not None:
        # that of the largest J, which is no longer accepted by votes
        assert found.nodes[0, 0] == trial.attempt(1 + solved).nodes[0, 0] and not found.by_votes
        reason = f'with other windows held out in each of {1 + solved} trials, readings are predicted better'
        assert found.refinement.reason.startswith(reason)
        assert found.refinement.gain > 0.0


@pytest.mark.parametrize('matched', [True, False])
def test_walls_alone_are_named_by_the_folds_as_well(scans, monkeypatch, matched: bool) -> None:
    trial = Folds(monkeypatch, scans, [ENOUGH, ENOUGH])
    attempt = trial.attempt
    monkeypatch.setattr(trial, 'attempt', lambda number: attempt(number)._replace(matched=matched))
    found = trial.judged()
    assert found is not None and found.refinement.reason.endswith(UNMATCHED) != matched


def test_contradicted_turns_are_named_by_the_folds_as_well(scans, monkeypatch) -> None:
    trial = Folds(monkeypatch, scans, [ENOUGH, ENOUGH])
    attempt = trial.attempt
    monkeypatch.setattr(trial, 'attempt', lambda number: attempt(number)._replace(turns_contradicted=True))
    found = trial.judged()
    assert found is not None and found.refinement.reason.endswith(CONTRADICTED)


def test_first_fold_is_taken_if_the_map_of_the_whole_drive_is_too_large(scans, monkeypatch) -> None:
    trial = Folds(monkeypatch, scans, [ENOUGH, ENOUGH])

    def too_large(*rest) -> float:
        raise InputError

    monkeypatch.setattr(Scans, 'objective', too_large)
    found = trial.judged()
    assert found is not None and found.nodes[0, 0] == trial.attempt(1).nodes[0, 0]


def test_each_fold_holds_out_other_windows(scans, monkeypatch) -> None:
    trial = Folds(monkeypatch, scans, [1.4, 1.4, 1.4])
    trial.judged()
    all_of_them = np.stack([scans.held_out, *trial.held_out])
    assert len(all_of_them) == 1 + len(OTHERS)
    assert all_of_them.sum(0).max() == 1
    for held, begin in zip(trial.held_out, OTHERS, strict=True):
        np.testing.assert_array_equal(held, held_out(len(scans.windows), begin))


def test_readings_of_other_held_out_windows_are_not_used(scans) -> None:
    other = scans.with_held_out(held_out(len(scans.windows), 0))
    np.testing.assert_array_equal(other.count == 0, other.held_out | (np.diff(scans.windows.first) == 0))
    assert scans.held_out[EVERY // 2] and scans.count[EVERY // 2] == 0
    nodes = scans.windows.node
    assert scans.objective(nodes) != other.objective(nodes)
    assert not other.predictions and other.predictions is not scans.predictions


def test_trajectories_that_come_back_to_other_places_are_no_proof(scans, monkeypatch) -> None:
    assert Folds(monkeypatch, scans, [ENOUGH, ENOUGH], [True, True, False]).judged() is None


@pytest.mark.parametrize(
    ('everywhere', 'nearby', 'solved', 'accepted'),
    [
        (ENOUGH, ENOUGH, 1, True),
        (100.0, ENOUGH, 1, True),
        # on maps of all visits, only odometry can contradict itself
        (100.0, NEARLY - 0.1, 0, False),
        (NEARLY - 0.1, 100.0, 0, False),
        (100.0, 1.2, 2, False),
    ],
)
def test_trajectory_that_tears_apart_must_be_better_nearby_as_well(
    scans, monkeypatch, everywhere: float, nearby: float, solved: int, accepted: bool
) -> None:
    trial = Folds(monkeypatch, scans, [everywhere] * 3, [True, False, False, False], nearby)
    found = trial.judged()
    assert (found is not None) == accepted
    assert len(trial.held_out) == solved
    if found is not None:
        assert 0.0 < found.refinement.gain < 2.0, 'that of the less clear comparison is stated'


@pytest.mark.parametrize(('nearby', 'accepted'), [(-1.3, True), (-1.5, False)])
def test_readings_nearby_must_not_be_predicted_worse(scans, monkeypatch, nearby: float, accepted: bool) -> None:
    # in two folds, -1.4 standard errors are -2 together
    found = Folds(monkeypatch, scans, [ENOUGH, ENOUGH], nearby=nearby).judged()
    assert (found is not None) == accepted


def test_fold_without_a_trajectory_is_no_proof(scans, monkeypatch) -> None:
    trial = Folds(monkeypatch, scans, [ENOUGH, ENOUGH])
    refused = Attempt(Refinement(False, 'kept', trial.drive.readings, None, {}), trial.drive.windows.node)  # type: ignore[arg-type]
    assert accepted_in_folds(trial.drive, trial.attempt(1), lambda other: refused) is None
