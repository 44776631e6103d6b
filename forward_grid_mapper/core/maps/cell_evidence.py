"""Why a cell is occupied or free: the evidence of each reading for an obstacle there, given the rest of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.constants import SAME_WALL
from ..common.grid import Grid
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..evidence.pairs import Lattice
from ..search.prior import odds_given_neighbours, wall_prior
from ..sensor.cone_table import cone_table
from ..sensor.forward_model import ForwardModel
from ..sensor.surface_normals import SurfaceNormals
from .line_of_sight import in_line_of_sight
from .traversed import traversed_cells

ROUNDING = 1e-9
"""Log-likelihood ratios up to this, nats, are rounding errors."""

MARGIN_CELLS = 3.0
"""Cells around the cell within which cones are examined: its neighbours, and rounding."""

END_SIGMAS = 2.0
"""Largest distance between the range of a reading and the cell in which it ends, σ."""


@dataclass(frozen=True)
class CellEvidence:
    """The evidence of readings and prior about one cell.

    Attributes
    ----------
    row, column : int
        Of the cell in its grid.
    traversed : bool
        Whether the robot traversed it, so that no obstacle can be there.
    readings : int64, shape (N,)
        Indices of the readings that have evidence about it, in decreasing order of |nats|.
    nats : float64, shape (N,)
        γ [log p(z | obstacle in the cell, rest of the map) − log p(z | none, rest of the map)] of each.
    distance : float64, shape (N,)
        From the sensor to the surface that an obstacle in the cell would have, metres.
    ends_here : bool, shape (N,)
        Whether the range is within `END_SIGMAS` σ of that; other readings reach farther, or end before it.
    silent : bool, shape (N,)
        Max-range readings.
    through_wall : bool, shape (N,)
        Whether an occupied cell is on the line of sight to the cell: free space and echoes behind walls are not
        trusted.
    prior : float
        Log prior odds of an obstacle given the neighbours of the cell, nats.
    wall : float
        Log-likelihood ratio of all readings for obstacles in the cell and in its occupied neighbours to no obstacle in
        any of these nine cells, nats. It matters because a reading that one cell of a wall explains does not need
        another one.
    """

    row: int
    column: int
    traversed: bool
    readings: NDArray[np.int64]
    nats: Floats
    distance: Floats
    ends_here: NDArray[np.bool_]
    silent: NDArray[np.bool_]
    through_wall: NDArray[np.bool_]
    prior: float
    wall: float

    @property
    def data(self) -> float:
        """Sum of `nats` over all readings."""
        return float(self.nats.sum())


def prior_odds(grid: Grid, ml: NDArray[np.int8], parameters: Parameters) -> Floats:
    """Return the log prior odds of an obstacle in each cell given its neighbours, nats, shape `grid.shape`."""
    prior = wall_prior(parameters.search, np.zeros(grid.size, np.bool_), grid.resolution)
    return odds_given_neighbours(prior, ml == 1).reshape(grid.shape)


def cell_evidence(
    readings: Readings,
    grid: Grid,
    ml: NDArray[np.int8],
    parameters: Parameters,
    normals: SurfaceNormals,
    place: tuple[float, float],
) -> CellEvidence:
    """Return the evidence about the cell at a place.

    Parameters
    ----------
    readings : Readings
        The readings that the map was made from.
    grid : Grid
    ml : int8, shape `grid.shape`
        1 if occupied; anything else counts as free.
    parameters : Parameters
    normals : SurfaceNormals
        Those that the map was made with.
    place : tuple of float
        x and y in the map frame, metres, on the grid.
    """
    (row,), (column,) = grid.cells_of(np.array(place[:1]), np.array(place[1:]))
    model = parameters.model
    cones = cone_table(readings, grid, model)
    u, v = column + 0.5 - cones['x'], row + 0.5 - cones['y']
    distance = np.hypot(u, v)
    along, across = u * cones['axis_x'] + v * cones['axis_y'], u * cones['axis_y'] - v * cones['axis_x']
    # cones that may contain the cell or a neighbour; a cone contains the cells on its axis, however narrow it is
    near = (along >= cones['cosine'] * distance) | (np.abs(across) <= MARGIN_CELLS) | (distance <= MARGIN_CELLS)
    outside = np.maximum(cones['cosine'] * np.abs(across) - cones['sine'] * along, 0.0)
    which = np.flatnonzero((near | (outside <= MARGIN_CELLS)) & (distance <= cones['reach'] + MARGIN_CELLS))
    forward = ForwardModel(readings.select(which), grid, model, normals, cones[which])
    occupied = (ml == 1).astype(np.int8)
    occupied[row, column] = 1
    with_it = forward.expectations(occupied).log_likelihood
    occupied[row, column] = 0
    nats = model.likelihood_exponent * (with_it - forward.expectations(occupied).log_likelihood)
    occupied[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
    wall = model.likelihood_exponent * float((with_it - forward.expectations(occupied).log_likelihood).sum())
    order = np.argsort(-np.abs(nats), kind='stable')
    order = order[np.abs(nats[order]) > ROUNDING]
    which, nats = which[order], nats[order]
    traversed = traversed_cells(readings, grid)
    lattice, walls = Lattice(grid.height, grid.width, grid.resolution), (ml == 1).ravel()
    until = distance - SAME_WALL / grid.resolution
    blocked = [not in_line_of_sight(cones[i], u[i], v[i], until[i], walls, lattice) for i in which]
    error = np.abs(cones['z'][which] - distance[which])
    return CellEvidence(
        row=int(row),
        column=int(column),
        traversed=bool(traversed[row, column]),
        readings=which,
        nats=nats,
        distance=(distance[which] - model.surface_offset) * grid.resolution,
        ends_here=(error <= END_SIGMAS * cones['sigma'][which]) & readings.echo[which],
        silent=~readings.echo[which],
        through_wall=np.array(blocked, np.bool_),
        wall=wall,
        prior=float(prior_odds(grid, ml, parameters)[row, column]),
    )
