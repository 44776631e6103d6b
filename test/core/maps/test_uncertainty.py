"""The uncertainty map: marginals of the paper, calibrated marginals, and cells without a value."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from forward_grid_mapper.core.common.constants import LEAST_EVIDENCE, LEAST_NOTICING
from forward_grid_mapper.core.common.parameter_groups import SearchParameters
from forward_grid_mapper.core.maps import uncertainty
from forward_grid_mapper.core.maps.free_space import Passes
from forward_grid_mapper.core.maps.uncertainty import calibrated, discounted, marginals, uncertainty_map
from samples import plain_search

SHAPE = (7, 9)
NOWHERE = np.zeros(SHAPE, bool)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random evidence, passes and map; multiples of 1/64, so that sums are exact."""
    rng = np.random.default_rng(seed)
    evidence = np.round(rng.normal(0, 5, SHAPE) * 64) / 64
    passed = np.round(rng.exponential(3, SHAPE) * (rng.random(SHAPE) < 0.8) * 64) / 64
    return evidence, passed, rng.choice(np.array([-1, 0, 1], np.int8), SHAPE, p=(0.2, 0.4, 0.4))


def test_marginals_without_passes_mix_evidence_with_the_prior() -> None:
    evidence, _, ml = drawn(0)
    actual = uncertainty_map(evidence.ravel(), None, ml, NOWHERE, plain_search(alpha=0.7, prior=0.3))
    odds = np.exp(evidence) ** 0.7 * 0.3 / 0.7
    known = ~np.isnan(actual)
    assert actual[known] == pytest.approx((odds / (1 + odds))[known], abs=1e-6)
    assert np.array_equal(known, (ml >= 0) | (np.abs(evidence) >= LEAST_EVIDENCE))
    far = marginals(np.array([-1e9, 1e9]), plain_search())
    assert far.tolist() == [pytest.approx(0.0), 1.0]


@pytest.mark.parametrize('x', [0.0, 0.3, 2.0, 40.0])
def test_discounted_evidence_is_the_mean_over_the_share_of_repetition(x: float) -> None:
    share = (np.arange(400_000) + 0.5) * 1e-4
    left = float((np.exp(-share * x) * np.exp(-share)).sum() * 1e-4)
    assert discounted(np.array([-x, x])) == pytest.approx([math.log(left), -math.log(left)], abs=1e-6)


@pytest.mark.parametrize('block', [1, 20, 50_000])
@pytest.mark.parametrize('seed', range(5))
def test_calibrated_marginals_are_those_of_the_twin(seed: int, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uncertainty, 'BLOCK', block)
    evidence, passed, ml = drawn(seed)
    actual = calibrated(evidence, passed, ml, SearchParameters(alpha=0.8))
    assert actual == pytest.approx(naive.calibrated(evidence, passed, ml, 0.8), abs=1e-7)


@pytest.mark.parametrize('seed', range(3))
def test_turned_or_mirrored_drive_has_the_same_marginals(seed: int) -> None:
    given_maps = drawn(seed)
    expected = calibrated(*given_maps, SearchParameters())
    for turn in range(4):
        evidence, passed, ml = (np.rot90(values, turn) for values in given_maps)
        assert np.array_equal(calibrated(evidence, passed, ml, SearchParameters()), np.rot90(expected, turn))
    evidence, passed, ml = (values[:, ::-1] for values in given_maps)
    assert np.array_equal(calibrated(evidence, passed, ml, SearchParameters()), expected[:, ::-1])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 100))
def test_more_evidence_raises_and_more_passes_lower_the_probability(seed: int, more: float) -> None:
    evidence, passed, ml = drawn(seed)
    before = calibrated(evidence, passed, ml, SearchParameters())
    assert (calibrated(evidence + more, passed, ml, SearchParameters()) > before).all()
    # no readings pass beyond the edge
    inner = np.s_[1:-1, 1:-1]
    assert (calibrated(evidence, passed + more, ml, SearchParameters())[inner] < before[inner]).all()


def test_cells_without_evidence_have_no_probability() -> None:
    ml = np.array([[1, 0, -1, -1, -1], [1, 0, -1, -1, -1]], np.int8)
    evidence = np.array([0.0, 0.0, -5.0, 0.9, 2.0, 0.0, 0.0, -5.0, -0.9, -2.0]) * LEAST_EVIDENCE
    noticing = np.array([0.0, 0.0, 0.9, 5.0, 0.0, 0.0, 0.0, 1.1, 5.0, 0.0]) * LEAST_NOTICING
    passes = Passes(np.full(10, 3.0), noticing)
    traversed = np.zeros(ml.shape, bool)
    traversed[0, 1] = True
    actual = uncertainty_map(evidence, passes, ml, traversed, SearchParameters())
    assert actual.dtype == np.float32
    assert np.isnan(actual).tolist() == [[False, False, True, True, False], [False, False, False, True, True]]
    assert actual[0, 1] == 0.0
    known = ~np.isnan(actual) & ~traversed
    expected = calibrated(evidence.reshape(ml.shape), np.full(ml.shape, 3.0), ml, SearchParameters())
    assert actual[known] == pytest.approx(expected[known], abs=1e-6)
