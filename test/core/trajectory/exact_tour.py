"""A drive with exact odometry, and its heading from walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.trajectory.heading import Heading, heading
from forward_grid_mapper.core.trajectory.holding_out import held_out
from forward_grid_mapper.core.trajectory.local_map import for_matching
from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.walls import wall_votes
from forward_grid_mapper.core.trajectory.windows import Odometry, Windows, cut
from forward_grid_mapper.simulation.drift import odometry_of
from forward_grid_mapper.simulation.drive import drive
from forward_grid_mapper.simulation.sonar import NOISY, SonarArray
from forward_grid_mapper.simulation.world import building_tour, building_world


class Tour(NamedTuple):
    """The arguments of a `Solver`."""

    odometry: Odometry
    windows: Windows
    scans: Scans
    heading: Heading


def tour_with(sonars: SonarArray, path: NDArray[np.float64] | None = None) -> Tour:
    """Return the beginning of the tour through the building, or of another path."""
    recording = drive(building_world(), building_tour()[:20] if path is None else path, 0.1, sonars, NOISY, seed=3)
    odometry = odometry_of(recording)
    windows = cut(recording.readings, odometry)
    scans = Scans(windows, for_matching(Parameters()), np.zeros(1, np.uint8), held_out(len(windows)))
    found = heading(windows, *wall_votes(windows, scans.held_out))
    assert found is not None
    return Tour(odometry, windows, scans, found)


def quietly(stage: str) -> Callable[[float], None]:
    return lambda part: None
