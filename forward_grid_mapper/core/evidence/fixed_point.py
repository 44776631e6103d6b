"""Log-likelihood ratios in fixed point, so that sums of them are exact.

Integer sums do not depend on their order, and terms can be subtracted again exactly. So the evidence of a cell equals a
new sum even after millions of updates, and results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inlined_kernel

QUANTUM = 2.0**-24
"""Nats in a unit; a ratio fits in 32 bits with ±128 nats."""

_SCALE = 1.0 / QUANTUM
_ROOT_HALF = np.int32(0x3F3504F3)  # the bits of float32 √½
_EXPONENT = np.int32(23)


class RatioWorkspace(NamedTuple):
    """Workspace for likelihood ratios, as those of a cone, and views of their bits; arrays of the same length."""

    ratio: NDArray[np.float32]
    ratio_bits: NDArray[np.int32]
    mantissa: NDArray[np.float32]
    mantissa_bits: NDArray[np.int32]


def ratio_workspace_for(largest: int) -> RatioWorkspace:
    """Return a workspace for cones of up to `largest` cells: room for as many ratios, and three more."""
    ratio, mantissa = np.empty(largest + 3, np.float32), np.empty(largest + 3, np.float32)
    return RatioWorkspace(ratio, ratio.view(np.int32), mantissa, mantissa.view(np.int32))


@inlined_kernel
def quantise_logs(ratios: RatioWorkspace, m: int, out: Any) -> None:
    """Write the logs of the first m ratios (positive, normal) into `out` (int32), in units of QUANTUM.

    The method is that of Cephes' logf: the number's bits give x = 2ᵉ (1 + f) with 1 + f in [√½, √2), and a polynomial
    gives log(1 + f) to 3e-8. The loops are plain arithmetic, so that the compiler vectorises them.
    """
    for k in range(m):
        bits = ratios.ratio_bits[k]
        exponent = np.int32(np.int32(bits - _ROOT_HALF) >> _EXPONENT)
        out[k] = exponent
        ratios.mantissa_bits[k] = np.int32(bits - np.int32(exponent << _EXPONENT))
    for k in range(m):
        f = ratios.mantissa[k] - 1.0
        y = 7.0376836292e-2 * f - 1.1514610310e-1
        y = y * f + 1.1676998740e-1
        y = y * f - 1.2420140846e-1
        y = y * f + 1.4249322787e-1
        y = y * f - 1.6668057665e-1
        y = y * f + 2.0000714765e-1
        y = y * f - 2.4999993993e-1
        y = y * f + 3.3333331174e-1
        y = f + f * f * (y * f - 0.5) + 0.6931471805599453 * out[k]
        # np.floor returns a float: vector instructions for 64-bit integers are not available on all processors
        out[k] = np.int32(np.floor(y * _SCALE + 0.5))
