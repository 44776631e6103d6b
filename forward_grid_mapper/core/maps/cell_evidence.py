"""Why a cell is what it is: what every reading says for and against an obstacle there, the rest of the map as it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.constants import STANDS_OFF
from ..common.grid import Grid
from ..common.parameters import Parameters
from ..common.readings import Floats, Readings
from ..evidence.pairs import Lattice
from ..search.prior import odds_given_neighbours, wall_prior
from ..sensor.cone_table import cone_table
from ..sensor.forward_model import ForwardModel
from ..sensor.surface_normals import SurfaceNormals
from .free_ways import on_free_way
from .traversed import traversed_cells

NOTHING = 1e-9
"""Nats, either way, that are rounding: a reading that says no more says nothing."""

MARGIN = 3.0
"""Cells around the cell within which a cone is looked at: its neighbours, and rounding."""

HERE = 2.0
"""σ between the range of a reading and a cell for the reading to end there."""


@dataclass(frozen=True)
class CellEvidence:
    """What the readings and the prior say of one cell.

    Attributes
    ----------
    row, column : int
        Of the cell in its grid.
    traversed : bool
        Whether a sensor was moved over it, which no obstacle survives.
    readings : int64, shape (N,)
        Which readings say something of it, those first that say most.
    nats : float64, shape (N,)
        γ [log p(z | obstacle in the cell, rest of the map) − log p(z | none, rest of the map)] of each.
    distance : float64, shape (N,)
        From the sensor to the surface that an obstacle in the cell would have, metres.
    ends_here : bool, shape (N,)
        Whether the range lies within `HERE` σ of that; other readings reach farther, or end before it.
    silent : bool, shape (N,)
        Max-range readings.
    through_wall : bool, shape (N,)
        Whether an occupied cell stands on the way to the cell: behind walls, what sound seems to tell does not count.
    prior : float
        Log prior odds of an obstacle given the neighbours of the cell, nats.
    wall : float
        What all readings say for obstacles in the cell and in those of its eight neighbours that are occupied, against
        none in any of them, nats. A reading that one cell of a wall explains needs no other one.
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
        """What all readings together say for an obstacle, nats."""
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
    """Return what is known of the cell at a place.

    Parameters
    ----------
    readings : Readings
        Those that the map was made from.
    grid : Grid
    ml : int8, shape `grid.shape`
        1 where occupied; anything else counts as free.
    parameters : Parameters
    normals : SurfaceNormals
        That the map was made with.
    place : tuple of float
        x and y in the map frame, metres, on the grid.
    """
    (row,), (column,) = grid.cells_of(np.array(place[:1]), np.array(place[1:]))
    model = parameters.model
    cones = cone_table(readings, grid, model)
    u, v = column + 0.5 - cones['x'], row + 0.5 - cones['y']
    distance = np.hypot(u, v)
    along, across = u * cones['axis_x'] + v * cones['axis_y'], u * cones['axis_y'] - v * cones['axis_x']
    # whose cones may hold the cell or a neighbour; the cells that the axis passes belong to a cone, however narrow
    near = (along >= cones['cosine'] * distance) | (np.abs(across) <= MARGIN) | (distance <= MARGIN)
    outside = np.maximum(cones['cosine'] * np.abs(across) - cones['sine'] * along, 0.0)
    which = np.flatnonzero((near | (outside <= MARGIN)) & (distance <= cones['reach'] + MARGIN))
    forward = ForwardModel(readings.select(which), grid, model, normals, cones[which])
    occupied = (ml == 1).astype(np.int8)
    occupied[row, column] = 1
    with_it = forward.expectations(occupied).log_likelihood
    occupied[row, column] = 0
    nats = model.likelihood_exponent * (with_it - forward.expectations(occupied).log_likelihood)
    occupied[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 0
    wall = model.likelihood_exponent * float((with_it - forward.expectations(occupied).log_likelihood).sum())
    order = np.argsort(-np.abs(nats), kind='stable')
    order = order[np.abs(nats[order]) > NOTHING]
    which, nats = which[order], nats[order]
    traversed = traversed_cells(readings, grid)
    lattice, walls = Lattice(grid.height, grid.width, grid.resolution), (ml == 1).ravel()
    until = distance - STANDS_OFF / grid.resolution
    blocked = [not on_free_way(cones[i], u[i], v[i], until[i], walls, lattice) for i in which]
    error = np.abs(cones['z'][which] - distance[which])
    return CellEvidence(
        row=int(row),
        column=int(column),
        traversed=bool(traversed[row, column]),
        readings=which,
        nats=nats,
        distance=(distance[which] - model.surface_offset) * grid.resolution,
        ends_here=(error <= HERE * cones['sigma'][which]) & readings.echo[which],
        silent=~readings.echo[which],
        through_wall=np.array(blocked, np.bool_),
        wall=wall,
        prior=float(prior_odds(grid, ml, parameters)[row, column]),
    )
