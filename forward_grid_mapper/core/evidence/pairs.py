"""The cells of every reading, as the search wants them: runs of the free zone, and the band from near to far.

In the free zone it only matters how many occupied cells there are, so rows of cells are kept as runs. Each cell of the
band is kept with its density and with its term of the evidence. Everything of one reading lies together in one block
of memory, since readings are come upon at random: 12 bytes a band pair and 8 a run, which is about one a free pair.

Readings for which there is no memory are kept as nothing but their cone: their pairs are made anew each time that they
are wanted, which takes longer and comes to the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import kernel
from ..sensor.cone import distance, row_runs, within
from ..sensor.cone_table import Cones, cone_of
from ..sensor.surface_normals import SurfaceNormals, exceeds_incidence_angle

WORD = 4
"""Bytes in a word of a block."""

WORDS_PER_RUN = 2
WORDS_PER_BAND_PAIR = 3


class Lattice(NamedTuple):
    """What cones are walked with: cells up and across, the distance's kind, σ at which to cut, metres a cell."""

    height: int
    width: int
    nearest: bool
    cut: float
    resolution: float


class Pairs(NamedTuple):
    """The pairs of readings, one array of words under three names; where those of a reading begin, its `Share` says.

    A reading with r runs and m band pairs has 2 r words for the first and last cells of its runs, each in one row and
    ascending; then, from near to far, m cells, m densities N(z; d, σ) in 1/m, and m logs of the likelihood ratio of
    flipping the cell, in units of `logs.QUANTUM`.
    """

    cell: NDArray[np.uint32]
    density: NDArray[np.float32]
    log: NDArray[np.int32]


def empty_pairs(words: int) -> Pairs:
    """Return room for so many words."""
    block = np.empty(words, np.uint32)
    return Pairs(block, block.view(np.float32), block.view(np.int32))


class Workspace(NamedTuple):
    """Room to work on one reading at a time.

    Attributes
    ----------
    pairs : Pairs
        Room for its pairs, where they are not stored.
    new : int32
        Room for its logs.
    cell, key, unsorted, unsorted_key, tally, bucket
        Room to sort its band in.
    """

    pairs: Pairs
    new: NDArray[np.int32]
    cell: NDArray[np.uint32]
    key: NDArray[np.float64]
    unsorted: NDArray[np.uint32]
    unsorted_key: NDArray[np.float64]
    tally: NDArray[np.int32]
    bucket: NDArray[np.int32]


def workspace_for(largest: int) -> Workspace:
    """Return room for cones of up to `largest` cells."""
    n = largest + 3
    ints = [np.empty(n, np.int32) for _ in range(3)]
    return Workspace(
        pairs=empty_pairs((WORDS_PER_RUN + WORDS_PER_BAND_PAIR) * n),
        new=ints[0],
        cell=np.empty(n, np.uint32),
        key=np.empty(n),
        unsorted=np.empty(n, np.uint32),
        unsorted_key=np.empty(n),
        tally=ints[1],
        bucket=ints[2],
    )


@kernel
def make(
    cones: Cones, lattice: Lattice, normals: SurfaceNormals, t: int, pairs: Pairs, at: int, workspace: Workspace
) -> tuple[int, int]:
    """Write the runs, cells and densities of reading t into `pairs` from `at`; return its runs and band pairs.

    Surfaces that the reading exceeds_incidence_angle are left out, which may cut a run in two.
    """
    reading = cones[t]
    cone = cone_of(reading, lattice.nearest)
    n, m = at, 0
    for row in range(max(cone.bottom, 0), min(cone.top, lattice.height - 1) + 1):
        a, b, c, d = row_runs(cone, row, reading.reach, lattice.width, lattice.nearest)
        v = row + 0.5 - cone.y
        first, last = within(cone.x, v, reading.free, lattice.nearest)
        start = row * lattice.width
        for begin, end in ((a, b), (c, d)):
            if begin > end:
                continue
            slanted = normals.cos2_limit > 0.0 and normals.before[row, end + 1] > normals.before[row, begin]
            inner, outer = max(begin, first), min(end, last)
            if inner > outer:
                inner, outer = end + 1, end
            elif not slanted:
                pairs.cell[n] = start + inner
                pairs.cell[n + 1] = start + outer
                n += 2
            else:
                left = inner
                for column in range(inner, outer + 2):
                    if column > outer or exceeds_incidence_angle(
                        normals, reading, start + column, column + 0.5 - cone.x, v
                    ):
                        if left < column:
                            pairs.cell[n] = start + left
                            pairs.cell[n + 1] = start + column - 1
                            n += 2
                        left = column + 1
            for side_first, side_last in ((begin, inner - 1), (outer + 1, end)):
                for column in range(side_first, side_last + 1):
                    u = column + 0.5 - cone.x
                    if not slanted or not exceeds_incidence_angle(normals, reading, start + column, u, v):
                        workspace.unsorted[m] = start + column
                        workspace.unsorted_key[m] = distance(u, v, lattice.nearest)
                        m += 1
    _sort(workspace, m)
    peak = 1.0 / (math.sqrt(2.0 * math.pi) * reading.sigma * lattice.resolution)
    for k in range(m):
        error = (reading.z - workspace.key[k]) / reading.sigma
        pairs.cell[n + k] = workspace.cell[k]
        pairs.density[n + m + k] = peak * math.exp(-0.5 * error * error) if abs(error) <= lattice.cut else 0.0
    return (n - at) // WORDS_PER_RUN, m


@kernel
def _sort(workspace: Workspace, m: int) -> None:
    """Sort the first m of `unsorted` by key, into `cell` and `key`; equal keys keep their order.

    The keys of a band are spread evenly, so that m buckets leave next to nothing to the insertion sort.
    """
    if m == 0:
        return
    low, high = math.inf, -math.inf
    for k in range(m):
        low, high = min(low, workspace.unsorted_key[k]), max(high, workspace.unsorted_key[k])
    scale = (m - 1) / (high - low) if high > low else 0.0
    workspace.tally[: m + 1] = 0
    for k in range(m):
        bucket = int((workspace.unsorted_key[k] - low) * scale)
        workspace.bucket[k] = bucket
        workspace.tally[bucket + 1] += 1
    for k in range(m):
        workspace.tally[k + 1] += workspace.tally[k]
    for k in range(m):
        at = workspace.tally[workspace.bucket[k]]
        workspace.tally[workspace.bucket[k]] += 1
        workspace.key[at] = workspace.unsorted_key[k]
        workspace.cell[at] = workspace.unsorted[k]
    for k in range(1, m):
        key, cell = workspace.key[k], workspace.cell[k]
        at = k
        while at > 0 and workspace.key[at - 1] > key:
            workspace.key[at] = workspace.key[at - 1]
            workspace.cell[at] = workspace.cell[at - 1]
            at -= 1
        workspace.key[at] = key
        workspace.cell[at] = cell
