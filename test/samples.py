"""Models, searches and readings that several folders of tests use."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameter_groups import ModelParameters, SearchParameters
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.search.prior import Prior
from forward_grid_mapper.core.search.search import Progress, Search

PLAIN_MODEL: dict[str, Any] = {
    'max_incidence_angle': math.pi / 2,
    'surface_offset': 0.0,
    'likelihood_exponent': 1.0,
}
"""Whole cones, obstacles at the centres of their cells, and independent readings."""

PLAIN_SEARCH: dict[str, Any] = {
    'end_cost': 0.0,
    'least_passed': 0.0,
}
"""Independent cells, and no post-processing of the map found by the search."""

PLAIN: dict[str, Any] = {**PLAIN_MODEL, **PLAIN_SEARCH}
"""The model and the search of the paper, independent of the defaults."""


def plain_model(**values: Any) -> ModelParameters:
    return ModelParameters(**{**PLAIN_MODEL, **values})


def plain_search(**values: Any) -> SearchParameters:
    return SearchParameters(**{**PLAIN_SEARCH, **values})


class Found(NamedTuple):
    """The map that a search found, the evidence of its cells, and data about the search."""

    occupied: np.ndarray
    evidence: np.ndarray
    prior: Prior
    log_prior: float
    progress: Progress
    converged: bool


def found_by(search: Search, how: str = 'run', **arguments: Any) -> Found:
    """The result of `run`, or of another method of the search."""
    result, evidence = getattr(search, how)(**arguments), search.evidence
    occupied = evidence.state.maps.occupied
    return Found(occupied, evidence.of_occupancy(), *(getattr(result, name) for name in Found._fields[2:]))


class FlipsAlone(Search):
    """A search without shifts."""

    def _shift(self, watch: object) -> int:
        return 0


def random_readings(rng: np.random.Generator, grid: Grid, count: int, z_max: float = 0.0) -> Readings:
    """Readings from random places of the grid in random directions; one in four has no echo."""
    left, right, bottom, top = grid.extent
    z_max = z_max or 1.2 * max(right - left, top - bottom)
    z = rng.uniform(0.05, 1.0, count) * z_max
    return Readings.from_columns(
        names=('sonar',),
        x=rng.uniform(left, right, count),
        y=rng.uniform(bottom, top, count),
        yaw=rng.uniform(-7, 7, count),
        z=np.where(rng.random(count) < 0.25, z_max, z),
        z_max=z_max,
        half_angle=rng.uniform(0.03, 1.2, count),
        sigma=np.where(rng.random(count) < 0.5, 0.0, rng.uniform(0.02, 0.2, count)),
        stamp=np.arange(count),
    )


def associated(
    extrinsics: Mapping[str, Pose2], odometry: Iterable[OdometryMessage], ranges: Iterable[RangeMessage], **values: Any
) -> PoseAssociator:
    """The associator after a recording of these messages, in the order of their stamps."""
    parameters = Parameters.from_flat(values)
    made = PoseAssociator(lambda base, frame, stamp: extrinsics.get(frame), parameters, patient=True)
    for message in sorted([*odometry, *ranges], key=lambda m: m.stamp):
        if isinstance(message, RangeMessage):
            made.add_range(message)
        else:
            made.add_odometry(message)
    made.finish()
    return made
