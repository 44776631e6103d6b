"""What is kept for every reading and every cell while a map is searched: the arrays that all kernels work on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sensor.cone_table import Cones
from ..sensor.surface_normals import SurfaceNormals
from .pairs import Lattice, Pairs, Workspace
from .tile_index import Tiles

READING_STATE = np.dtype(
    [
        ('floor', np.float64),
        ('max_range', np.float64),
        ('through', np.float64),
        ('at', np.int64),
        ('changed', np.int64),
        ('stored', np.int32),
        ('room', np.int32),
        ('runs', np.int32),
        ('bands', np.int32),
        ('blocking', np.int32),
        ('multiplicity', np.int32),
        ('occupy', np.int32),
        ('release', np.int32),
        ('likelihood', np.int32),
    ],
    align=True,
)
"""What is kept for a reading beside its cone.

floor, max_range
    The densities p_rand / z_max, with p_lost · N(z; z_max, σ) where there is no echo, and N(z; z_max, σ) in 1/m, which
    no map changes.
blocking, through
    Occupied cells in the free zone, and the mixture weight that they leave to the band,
    (1 − p_rand − p_lost) (1 − p_hit)^blocking.
stored, at, room, runs, bands
    Whether its pairs are stored, where in `Pairs`, how many words they may take there, and how many runs and band pairs
    there are.
multiplicity
    How many equal readings this one stands for.
occupy, release
    Log of the likelihood ratio of occupying, or freeing, a cell of the free zone, in units of `fixed_point.QUANTUM`.
likelihood
    log p(z | m), in the same units.
changed
    The clock when it was last recomputed.
"""


class Model(NamedTuple):
    """What the kernels need of the sensor model.

    Attributes
    ----------
    p_hit : float
        Probability that an occupied cell returns the echo.
    mixture_weight : float
        That of the causes that the map explains, 1 − p_rand − p_lost.
    nats : float
        What one unit of evidence (`fixed_point.QUANTUM`) counts in the objective: the likelihood exponent times it.
    """

    p_hit: float
    mixture_weight: float
    nats: float


class Maps(NamedTuple):
    """What is kept for every cell.

    Attributes
    ----------
    occupied : uint8
        The map.
    evidence : int64
        Log-likelihood gain of flipping the cell, in units of `fixed_point.QUANTUM`.
    seen : int32
        Number of readings in whose cone the cell is. Merged ones count as often as they came; those that exceed the
        incidence angle there count as well.
    pattern : uint8
        Which of its neighbours are occupied (`neighbourhood`).
    """

    occupied: NDArray[np.uint8]
    evidence: NDArray[np.int64]
    seen: NDArray[np.int32]
    pattern: NDArray[np.uint8]


class State(NamedTuple):
    """All that the kernels work on.

    Attributes
    ----------
    cones, reading_states : records of `CONE` and `READING_STATE`, shape (N,)
    observing : int32, shape (N, 2)
        The readings that see the cell at hand, and 1 if it is in their free zone.
    clock : int64, shape (1,)
        Counts flips.
    stop : uint8, shape (1,)
        Set to 1 from any thread to cancel.
    """

    lattice: Lattice
    normals: SurfaceNormals
    model: Model
    cones: Cones
    reading_states: NDArray[np.void]
    pairs: Pairs
    tiles: Tiles
    maps: Maps
    workspace: Workspace
    observing: NDArray[np.int32]
    clock: NDArray[np.int64]
    stop: NDArray[np.uint8]


Work = Callable[[State, int, int, NDArray[np.int64]], None]
"""Takes the readings from one to another, and adds to an array."""
