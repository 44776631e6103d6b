"""Thinning of readings to a bound: of those from the same place and direction, the newest are kept.

Readings of one sensor, from one place and in one direction, are in one *bin*. Each bin keeps its newest `level`
readings, with the same level for all bins, as high as the bound allows. If only some bins can have one more, or one at
all, a hash decides which. So if a robot stands still, or drives the same way again and again, repeated readings are
dropped, and single ones stay. The range does not matter: if bins were by range as well, each random echo would have its
own bin and stay, while those that agree are dropped. Then 12 000 of the 96 000 readings of the simulated corridor give
a map of F1 0.71; without it, 0.81, as good as the 0.80 of all readings.

The result depends on the readings only, not on when they are thinned: thinning twice, with more readings in between,
gives the same as once at the end. (A reading is dropped only if enough others rank before it; more readings can only
lower its rank.) So the node, which thins during the drive, and a run over the whole drive keep the same readings.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
from numpy.typing import NDArray

from ..common.readings import Readings

SQUARE = 0.2
"""Side of the squares within which positions of sensors are one place, metres."""

SECTOR = math.radians(10.0)
"""Width of the sectors within which axes of sensors are one direction, radians."""

Words = NDArray[np.uint64]


def kept(readings: Readings, bound: int) -> NDArray[np.int64]:
    """Return the increasing indices of the readings that are kept, at most `bound`."""
    if len(readings) <= bound:
        return np.arange(len(readings))
    bins = _bins(readings)
    order = np.lexsort((_ties(readings), ~readings.stamp, bins))
    bins = np.take(bins, order)
    first = np.ones(len(bins), np.bool_)
    first[1:] = bins[1:] != bins[:-1]
    # these functions release the GIL, while np.repeat and indexing do not
    number = np.arange(len(bins))
    rank = number - np.maximum.accumulate(np.where(first, number, 0))
    # readings of rank r are the r-th newest of their bins; all of a rank are kept until one does not fit
    remaining = bound - np.cumsum(np.bincount(rank))
    level = int(np.count_nonzero(remaining >= 0))
    stay = rank < level
    last = np.flatnonzero(rank == level)
    free = bound - int(np.count_nonzero(stay))
    # bins are hashes, so the smallest are a random sample, and the same one in each call
    stay[last[np.argsort(bins[last], kind='stable')[:free]]] = True
    return np.sort(order[stay])


def _bins(readings: Readings) -> Words:
    """Return a hash of each reading's bin; two bins have the same one with a probability of 1e-19."""
    r = readings
    turn = np.floor(np.mod(r.yaw, 2 * math.pi) / SECTOR)
    return mixed(name_hashes(r)[r.sensor], np.floor(r.x / SQUARE), np.floor(r.y / SQUARE), turn)


def _ties(readings: Readings) -> Words:
    """Return a hash of the values of each reading, so that equal stamps are not sorted by arrival."""
    return mixed(np.zeros(len(readings), np.uint64), readings.x, readings.y, readings.yaw, readings.z, readings.sigma)


def name_hashes(readings: Readings) -> Words:
    """Return a hash of each sensor's name."""
    names = (name.encode('utf-8', 'surrogatepass') for name in readings.sensor_names)
    digests = [hashlib.blake2b(name, digest_size=8).digest() for name in names]
    return np.array([int.from_bytes(digest, 'little') for digest in digests] or [0], np.uint64)


def mixed(seed: Words, *columns: NDArray[np.float64]) -> Words:
    """Return 64 mixed bits of each row (the finaliser of splitmix64, column after column)."""
    mixed = seed
    for column in columns:
        # + 0.0 maps −0 to 0
        mixed = mixed ^ (column + 0.0).view(np.uint64)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed = mixed ^ (mixed >> np.uint64(31))
    return mixed
