"""A drive of 26 m with eight sonars through a building, and the same with odometry that drifts."""

from __future__ import annotations

from functools import lru_cache

from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drift import LEVELS, odometry_of, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

TOUR = building_tour()[:10]


@lru_cache
def short_tour() -> Recording:
    return drive(building_world(), TOUR, 0.15, sonar_ring(8), NOISY, seed=3)


@lru_cache
def bent_tour() -> tuple[Readings, Odometry]:
    recording = with_drift(short_tour(), LEVELS['high'], 6)
    return recording.readings, odometry_of(recording)
