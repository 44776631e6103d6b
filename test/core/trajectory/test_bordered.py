"""Equations with full rows, compared with dense ones, and the size of their factors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from forward_grid_mapper.core.trajectory.bordered import Bordered


def chain(count: int, full: int, begin: int, loops: int = 0) -> sparse.csc_matrix:
    """Equations of places in a row, of `loops` pairs of places, and of `full` unknowns that are in all of them."""
    rng = np.random.default_rng(count)
    ends = [(k, k + 1) for k in range(count - 1)]
    ends += [tuple(rng.choice(count, 2, replace=False)) for _ in range(loops)]
    j = sparse.lil_matrix((len(ends), count + full))
    places = np.delete(np.arange(count + full), np.arange(begin, begin + full))
    # the order of numbers differs from the best order of elimination
    places = rng.permutation(places)
    for row, (one, other) in enumerate(ends):
        j[row, places[one]], j[row, places[other]] = -1.0, 1.0
        j[row, begin : begin + full] = rng.normal(0, 1, full)
    return (j.T @ j + 0.1 * sparse.eye(count + full)).tocsc()


@pytest.mark.parametrize(('begin', 'full'), [(0, 2), (17, 4), (40, 3), (40, 0)])
def test_solutions_equal_those_of_dense_equations(begin, full) -> None:
    matrix = chain(40, full, begin, 6)
    factors = Bordered(matrix, slice(begin, begin + full))
    for shape in ((40 + full,), (40 + full, 5)):
        right = np.random.default_rng(1).normal(0, 1, shape)
        assert factors.solve(right) == pytest.approx(np.linalg.solve(matrix.toarray(), right), abs=1e-9)


def test_size_of_factors_is_proportional_to_the_drive() -> None:
    one, other = (Bordered(chain(count, 4, count), slice(count, count + 4)).filled for count in (500, 4000))
    assert other < 9 * one
    # each place is coupled with the next one: two values in each factor
    assert other <= 4 * 4000
