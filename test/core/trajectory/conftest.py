"""The drive along a pentagon, for all tests of trajectories."""

from __future__ import annotations

import pytest
from pentagon_drive import bent_by, exact_drive, scans_of

from forward_grid_mapper.core.trajectory.scans import Scans
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.simulation.drive import Recording


@pytest.fixture(scope='module')
def exact() -> Recording:
    return exact_drive()


@pytest.fixture(scope='module')
def bent() -> tuple[Recording, Odometry]:
    return bent_by(exact_drive(), 'high', 5)


@pytest.fixture(scope='module')
def scans(bent: tuple[Recording, Odometry]) -> Scans:
    return scans_of(*bent)
