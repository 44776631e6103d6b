"""The state of a search: arrays for each reading and each cell, on which all kernels work."""

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
"""The state of a reading, besides its cone.

floor, max_range
    The densities that do not depend on the map, 1/m: p_rand / z_max, plus p_lost · N(z; z_max, σ) without echo; and
    N(z; z_max, σ).
blocking, through
    Number of occupied cells in the free zone, and the mixture weight that remains for the band,
    (1 − p_rand − p_lost) (1 − p_hit)^blocking.
stored, at, room, runs, bands
    Whether its pairs are stored; their index in `Pairs`, and the words that they may take; numbers of runs and of band
    pairs.
multiplicity
    Number of equal readings that this one represents.
occupy, release
    Log of the likelihood ratio of occupying, or freeing, a cell of the free zone, in units of `fixed_point.QUANTUM`.
likelihood
    log p(z | m), in the same units.
changed
    The clock at the last evaluation.
"""


class Model(NamedTuple):
    """The values of the sensor model that the kernels need.

    Attributes
    ----------
    p_hit : float
        Probability that an occupied cell returns the echo.
    mixture_weight : float
        Weight of the causes that depend on the map, 1 − p_rand − p_lost.
    nats : float
        Nats of the objective for each unit of evidence: likelihood exponent times `fixed_point.QUANTUM`.
    """

    p_hit: float
    mixture_weight: float
    nats: float


BLOCK_SHIFT = 6
"""Cells whose flips are tested together are a block: 64 in the order of the map."""


class Maps(NamedTuple):
    """The state of the cells.

    Attributes
    ----------
    occupied : uint8
        The map.
    evidence : int64
        Log-likelihood gain of flipping the cell, in units of `fixed_point.QUANTUM`.
    seen : int32
        Number of readings in whose cone the cell is, with their multiplicity, including those that exceed the incidence
        angle there.
    pattern : uint8
        Pattern of its occupied neighbours (`neighbourhood`).
    touched : uint8, shape (blocks,)
        1 for each block of 2 ** `BLOCK_SHIFT` cells in which single flips may have changed the gain of a flip. The
        search sets it to 0 when it has listed the flips that gain.
    """

    occupied: NDArray[np.uint8]
    evidence: NDArray[np.int64]
    seen: NDArray[np.int32]
    pattern: NDArray[np.uint8]
    touched: NDArray[np.uint8]


class State(NamedTuple):
    """All that the kernels work on.

    Attributes
    ----------
    cones, reading_states : records of `CONE` and `READING_STATE`, shape (N,)
    observing : int32, shape (N, 2)
        The readings that observe the current cell, and 1 if it is in their free zone.
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
"""Processes a range of readings, and adds the results to an array."""
