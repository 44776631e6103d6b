"""Sonar occupancy grid maps with forward sensor models (Thrun 2003), for ROS 2 Jazzy.

The packages; each imports only from packages that are earlier in this list (docs/architecture.md has the details):

``core``        from messages to maps: pose association, sensor model, search, learning; numpy and numba only
``files``       map, report, picture, journal and parameter files
``bags``        reading and writing of ROS 1 and ROS 2 bags through rosbags
``simulation``  worlds with a ground truth, simulated sonars, scores
``recordings``  recorded drives, from bags and journals, as readings
``scale``       maps in tiles, by the workers of Dask
``replay``      playing a recorded drive to the node
``node``        the ROS 2 node
``commands``    the command lines

``library`` is for other programs: `make_maps` and related names can be imported from here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .library import Sonar, SonarMaps, make_maps, poses_from_csv, poses_from_tum

__all__ = ['Sonar', 'SonarMaps', '__version__', 'make_maps', 'poses_from_csv', 'poses_from_tum']

__version__ = '0.1.0'


def __getattr__(name: str) -> Any:
    """Import the library when one of its names is used: this takes a second, which command lines do not need."""
    if name in __all__:
        from . import library

        return getattr(library, name)
    raise AttributeError(f'module {__name__} has no attribute {name!r}')
