"""Sparse symmetric equations with a few dense rows: those of a pose graph whose calibration is linked to all nodes.

    ⎡ A   B ⎤ ⎡ x ⎤   ⎡ f ⎤        S = D − Bᵀ A⁻¹ B        y = S⁻¹ (g − Bᵀ A⁻¹ f)
    ⎣ Bᵀ  D ⎦ ⎣ y ⎦ = ⎣ g ⎦        x = A⁻¹ f − A⁻¹ B y

Dense rows spoil the elimination order: SuperLU orders by the pattern of A + Aᵀ or AᵀA, and the latter would be dense.
So the sparse part is factorised by itself, in minimum degree order of A + Aᵀ with pivots on the diagonal, which is
stable because it is positive definite. The size of the factors grows linearly with the drive, if places are visited
a few times.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse.linalg import splu

from ..common.readings import Floats


class Bordered:
    """The factors of a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : scipy.sparse matrix in CSC, shape (n, n)
    full : slice
        Its dense rows and columns.
    """

    def __init__(self, matrix: Any, full: slice) -> None:
        n = matrix.shape[0]
        self._full = np.arange(n)[full]
        self._rest = np.delete(np.arange(n), self._full)
        columns = matrix[:, self._full].toarray()
        sparse_part = matrix[self._rest][:, self._rest].tocsc()
        self._factors = splu(
            sparse_part, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options={'SymmetricMode': True}
        )
        self._border = columns[self._rest]
        self._solved = self._factors.solve(self._border)
        self._schur = columns[self._full] - self._border.T @ self._solved

    def solve(self, right: Floats) -> Floats:
        """Return the solution for one right-hand side, shape (n,), or several, shape (n, S)."""
        out = np.empty_like(right)
        rest = self._factors.solve(np.ascontiguousarray(right[self._rest]))
        out[self._full] = np.linalg.solve(self._schur, right[self._full] - self._border.T @ rest)
        out[self._rest] = rest - self._solved @ out[self._full]
        return out

    @property
    def filled(self) -> int:
        """Number of nonzeros in the factors of the sparse part."""
        return int(self._factors.L.nnz + self._factors.U.nnz)
