"""A drive through a corridor along a pentagon: a building without right angles."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Floats
from forward_grid_mapper.core.trajectory.holding_out import held_out
from forward_grid_mapper.core.trajectory.local_map import for_matching
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.windows import Odometry, cut
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import Floorplan, World

MIDDLE, RADIUS, HALF = np.array([10.0, 10.0]), 7.0, 0.9
"""Metres: a corridor along the five sides of a pentagon; its walls have five directions modulo a right angle."""


def corners(radius: float) -> Floats:
    angle = np.radians(np.arange(0.0, 360.0, 72.0) + 10.0)
    return MIDDLE + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def pentagon() -> World:
    """Walls of the corridor, with a cupboard on each side."""
    plan = Floorplan('pentagon', 200, 200)

    def closed(places: Floats) -> None:
        cells = [tuple(np.floor(place * 10).astype(int).tolist()) for place in (*places, places[0])]
        for start, end in itertools.pairwise(cells):
            plan.line(start, end)

    inner, outer = (corners(RADIUS + side * HALF / math.cos(math.radians(36.0))) for side in (-1, 1))
    closed(inner)
    closed(outer)
    for k in range(5):
        a, b = outer[k], outer[(k + 1) % 5]
        along = (b - a) / math.dist(a, b)
        inside = np.array([-along[1], along[0]])
        foot = a + (2.0 + 0.8 * k) * along
        closed(np.array([foot, foot + 0.6 * along, foot + 0.6 * along + 0.3 * inside, foot + 0.3 * inside]))
    return plan.world((170, 110))


@lru_cache
def exact_drive() -> Recording:
    """Return a drive along nine sides, with exact odometry."""
    path = corners(RADIUS)
    return drive(pentagon(), np.concatenate([path, path[:4]]), 0.12, sonar_ring(12), NOISY, seed=3)


def bent_by(exact: Recording, level: str, seed: int) -> tuple[Recording, Odometry]:
    recording = with_drift(exact, LEVELS[level], seed)
    return recording, odometry_of(recording)


def scans_of(recording: Recording, odometry: Odometry) -> Scans:
    windows = cut(recording.readings, odometry)
    return Scans(windows, for_matching(Parameters()), np.zeros(1, np.uint8), held_out(len(windows)))


def quietly(part: float) -> None:
    """Ignore the progress."""
