"""Maps as `nav_msgs/OccupancyGrid`."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from ..core.common.grid import Grid
from ..files.map_files import occupancy_values


def grid_message(grid: Grid, values: NDArray[Any], frame_id: str, stamp: Time) -> OccupancyGrid:
    """Return a map as a message: 0 to 100, -1 not observed, row by row from the corner of cell (0, 0).

    Parameters
    ----------
    grid : Grid
    values : array of shape `grid.shape`
        Probabilities with NaN, or cells 1, 0 and -1, where not observed.
    frame_id : str
    stamp : Time
    """
    message = OccupancyGrid()
    message.header.frame_id = frame_id
    message.header.stamp = stamp
    message.info.map_load_time = stamp
    message.info.resolution = grid.resolution
    message.info.width = grid.width
    message.info.height = grid.height
    message.info.origin.position.x, message.info.origin.position.y = grid.origin
    message.info.origin.orientation.w = 1.0
    message.data = array.array('b', np.ascontiguousarray(occupancy_values(values)).tobytes())
    return message
