"""Forward and backward passes, compared with sums over all sequences of states."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.trajectory.hidden_markov import forward, move, smooth


def sequences(likelihood: np.ndarray, densities: np.ndarray, others: np.ndarray, start: np.ndarray):
    """Yield each sequence of (kind, value) and its probability together with all votes."""
    places, kinds, size = likelihood.shape
    for states in itertools.product(itertools.product(range(kinds), range(size)), repeat=places):
        (kind, value) = states[0]
        p = start[value] / kinds * likelihood[0, kind, value]
        for k, ((d0, i), (d1, j)) in enumerate(itertools.pairwise(states)):
            stays = (1 - others[k]) * (d0 == d1) + others[k] / kinds
            p *= stays * densities[k, (j - i) % size] * likelihood[k + 1, d1, j]
        yield states, p


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(4, 1, 4), (3, 2, 3), (1, 2, 5), (5, 1, 3)]), st.booleans())
def test_passes_equal_sums_over_all_sequences(seed: int, shape: tuple[int, int, int], stays: bool) -> None:
    rng = np.random.default_rng(seed)
    places, _, size = shape
    likelihood, densities, start = rng.random(shape), rng.random((places - 1, size)), rng.random(size)
    densities /= densities.sum(1, keepdims=True)
    others = np.zeros(places - 1) if stays else rng.random(places - 1)
    total, marginals = 0.0, np.zeros(shape)
    for states, p in sequences(likelihood, densities, others, start):
        total += p
        for k, (kind, value) in enumerate(states):
            marginals[k, kind, value] += p
    log_likelihood, _ = forward(likelihood, densities, others, start)
    assert log_likelihood == pytest.approx(math.log(total), abs=1e-9)
    again, beliefs = forward(likelihood, densities, others, start, keep=True)
    assert again == log_likelihood
    assert beliefs[-1] == pytest.approx(marginals[-1] / total, abs=1e-12)
    smoothed = smooth(likelihood, densities, others, start)
    assert smoothed == pytest.approx(marginals / total, abs=1e-12)


def test_certain_votes_override_the_motion() -> None:
    likelihood = np.zeros((2, 1, 8))
    likelihood[0, 0, 0] = likelihood[1, 0, 5] = 1.0
    still = np.zeros((1, 8))
    still[0, 0] = 1.0
    _, beliefs = forward(likelihood, still, np.zeros(1), np.full(8, 0.125), keep=True)
    assert beliefs[1, 0, 5] == 1.0


def test_motion_by_one_step_shifts_the_circle() -> None:
    belief, density, out = np.array([[0.1, 0.2, 0.7]]), np.array([0.0, 1.0, 0.0]), np.empty((1, 3))
    move(belief, density, 0.0, out)
    assert out.tolist() == [[0.7, 0.1, 0.2]]
