"""Cancelling of long work from another thread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.errors import Cancelled

NEVER = np.zeros(1, np.uint8)
"""A `stop` that is never set."""


def check(stop: NDArray[np.uint8]) -> None:
    """Raise `Cancelled` if `stop` is set."""
    if stop[0]:
        raise Cancelled('the work was cancelled; nothing was changed')
