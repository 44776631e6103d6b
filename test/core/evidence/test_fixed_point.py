"""Logarithms in fixed point, compared with `math.log`."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forward_grid_mapper.core.evidence.fixed_point import QUANTUM, quantise_logs, ratio_workspace_for
from forward_grid_mapper.core.evidence.updates import LEAST_RATIO
from forward_grid_mapper.core.search.search import ROUNDING

POLYNOMIAL = 2e-9
"""Largest error of the polynomial in nats; rounding adds half a quantum."""


def logs_of(values: np.ndarray) -> np.ndarray:
    ratios, out = ratio_workspace_for(len(values)), np.full(len(values) + 1, 7, np.int32)
    ratios.ratio[: len(values)] = values
    quantise_logs(ratios, len(values), out)
    assert out[-1] == 7, 'written beyond the end'
    return out[:-1]


def test_logs_are_accurate_over_the_whole_range() -> None:
    values = np.geomspace(LEAST_RATIO, 1e6, 200_001).astype(np.float32)
    near_one = np.float32(1) + np.arange(-3000, 3000, dtype=np.float32) * np.float32(2**-24)
    edges = np.ldexp(np.float32(math.sqrt(0.5)), np.arange(-99, 20)).astype(np.float32)
    around = [np.nextafter(edges, np.float32(side)) for side in (0, np.inf)]
    for part in (values, near_one, edges, *around, 2.0 ** np.arange(-99, 20, dtype=np.float32)):
        exact = np.array([math.log(v) for v in part.astype(float)])
        assert np.abs(logs_of(part) * QUANTUM - exact).max() <= QUANTUM / 2 + POLYNOMIAL


@given(st.floats(LEAST_RATIO, 1e6))
def test_error_of_a_log_is_below_the_tolerance_of_the_search(ratio: float) -> None:
    # rounding to float32 included
    error = logs_of(np.array([ratio]))[0] * QUANTUM - math.log(ratio)
    assert abs(error) <= 2**-24 + QUANTUM / 2 + POLYNOMIAL < ROUNDING


def test_log_of_one_is_zero_and_logs_of_powers_of_two_are_multiples() -> None:
    actual = logs_of(2.0 ** np.arange(-90, 21))
    assert actual[90] == 0
    assert (actual == np.floor(np.arange(-90, 21) * (math.log(2) / QUANTUM) + 0.5)).all()


def test_logs_ascend_with_the_ratios() -> None:
    values = np.unique(np.geomspace(LEAST_RATIO, 1e6, 50_000).astype(np.float32))
    assert (np.diff(logs_of(values)) >= 0).all()


@pytest.mark.parametrize('m', [0, 1, 2, 3, 5, 8, 13, 31, 64, 100])
def test_log_of_a_ratio_does_not_depend_on_the_number_of_ratios(m: int) -> None:
    values = np.random.default_rng(m).uniform(1e-6, 50, m)
    assert logs_of(values).tolist() == [int(logs_of(values[k : k + 1])[0]) for k in range(m)]
