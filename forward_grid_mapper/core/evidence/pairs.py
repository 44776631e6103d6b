"""Pairs of readings and cells for the search: runs of cells in the free zone, and the band sorted by distance.

In the free zone, only the number of occupied cells matters, so rows of cells are stored as runs. Each cell of the band
is stored with its density and its term of the evidence. All data of a reading are in one block of memory, since
readings are accessed in random order: 12 bytes for each band pair, and 8 for each run, which is about one for each free
pair.

If memory is short, only the cone of a reading is stored, and its pairs are made each time that they are needed; this is
slower, and the result is the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.jit import inlined_kernel, kernel
from ..sensor.cone import rows_of, runs_of
from ..sensor.cone_table import Cones, cone_of
from ..sensor.density import density
from ..sensor.surface_normals import SurfaceNormals, exceeds_incidence_angle
from .fixed_point import RatioWorkspace, ratio_workspace_for

WORD = 4
"""Bytes in a word of a block."""

LEAST_SPREAD = 1e-100
"""Smallest range of the keys of a bucket sort, cells; below it, insertion sort alone is used."""

WORDS_PER_RUN = 2
WORDS_PER_BAND_PAIR = 3


class Lattice(NamedTuple):
    """The grid for the kernels: numbers of rows and columns, and cell size, metres."""

    height: int
    width: int
    resolution: float


class Pairs(NamedTuple):
    """The pairs of readings: three views of one array of words. `READING_STATE` has the index of those of each reading.

    A reading with r runs and m band pairs has 2 r words for the first and last cells of its runs, each within one row
    and in ascending order; then, by increasing distance, m cells, m densities N(z; d, σ), 1/m, and m logs of the
    likelihood ratio of flipping the cell, in units of `fixed_point.QUANTUM`.
    """

    cell: NDArray[np.uint32]
    density: NDArray[np.float32]
    log: NDArray[np.int32]


def empty_pairs(words: int) -> Pairs:
    """Return uninitialised pairs of this many words."""
    block = np.empty(words, np.uint32)
    return Pairs(block, block.view(np.float32), block.view(np.int32))


class Workspace(NamedTuple):
    """Arrays for the work on one reading; each thread has its own.

    Attributes
    ----------
    pairs : Pairs
        For its pairs, if they are not stored.
    ratios : RatioWorkspace
        For the likelihood ratios of its cells, and three more (`updates.compute_ratios`).
    new : int32
        For their logs; before that, for the obstacles in its band.
    cell, key, unsorted, unsorted_key, tally, bucket
        For sorting its band; when shifts are tried, `bucket` has the cells to be shifted.
    """

    pairs: Pairs
    ratios: RatioWorkspace
    new: NDArray[np.int32]
    cell: NDArray[np.uint32]
    key: NDArray[np.float64]
    unsorted: NDArray[np.uint32]
    unsorted_key: NDArray[np.float64]
    tally: NDArray[np.int32]
    bucket: NDArray[np.int32]


def workspace_for(largest: int) -> Workspace:
    """Return a workspace for cones of up to `largest` cells."""
    n = largest + 3
    ints = [np.empty(n, np.int32) for _ in range(3)]
    return Workspace(
        pairs=empty_pairs((WORDS_PER_RUN + WORDS_PER_BAND_PAIR) * n),
        ratios=ratio_workspace_for(largest),
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

    Cells at which the reading exceeds the incidence angle are left out, which may divide a run.
    """
    reading = cones[t]
    cone = cone_of(reading)
    n = at
    # always of the same type, so that callees are compiled once
    m: Any = np.int64(0)
    for row in range(*rows_of(cone, lattice.height)):
        runs = runs_of(cone, row, lattice.width)
        v = row + 0.5 - cone.y
        start = row * lattice.width
        for begin, end in ((runs.first, runs.last), (runs.first2, runs.last2)):
            if begin > end:
                continue
            slanted = normals.cos2_limit > 0.0 and normals.before[row, end + 1] > normals.before[row, begin]
            inner, outer = max(begin, runs.inner), min(end, runs.outer)
            if inner > outer:
                inner, outer = end + 1, end
            left = inner
            for column in range(inner if slanted else outer + 1, outer + 2):
                # a run ends at its last column, and before a cell that is left out
                if column > outer or exceeds_incidence_angle(
                    normals, reading, start + column, column + 0.5 - cone.x, v
                ):
                    if left < column:
                        pairs.cell[n] = start + left
                        pairs.cell[n + 1] = start + column - 1
                        n += WORDS_PER_RUN
                    left = column + 1
            for side_first, side_last in ((begin, inner - 1), (outer + 1, end)):
                for column in range(side_first, side_last + 1):
                    u = column + 0.5 - cone.x
                    if not slanted or not exceeds_incidence_angle(normals, reading, start + column, u, v):
                        workspace.unsorted[m] = start + column
                        workspace.unsorted_key[m] = math.sqrt(u * u + v * v)
                        m += 1
    _sort(workspace, m)
    for k in range(m):
        pairs.cell[n + k] = workspace.cell[k]
        error = (reading.z - workspace.key[k]) / reading.sigma
        pairs.density[n + m + k] = density(error, reading.sigma * lattice.resolution)
    return (n - at) // WORDS_PER_RUN, m


@inlined_kernel
def _sort(workspace: Workspace, m: int) -> None:
    """Sort the first m of `unsorted` by key, into `cell` and `key`; equal keys keep their order.

    The keys of a band are distributed evenly, so that after sorting into m buckets little remains for insertion sort.
    """
    if m == 0:
        return
    low, high = math.inf, -math.inf
    for k in range(m):
        low, high = min(low, workspace.unsorted_key[k]), max(high, workspace.unsorted_key[k])
    # avoid an infinite scale
    scale = (m - 1) / (high - low) if high - low > LEAST_SPREAD else 0.0
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
