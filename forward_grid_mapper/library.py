"""Mapping without ROS: arrays of poses and ranges to the three maps, by the same code as for the node and bags."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import arrays
from .core.common.errors import InputError
from .core.common.parameters import TABLE, Parameters
from .core.common.words import counted
from .core.mapping import Mapper, Watch
from .core.maps.map_set import MapSet
from .core.messages.extrinsics import Mount
from .core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from .core.messages.mounts import FARTHEST_MOUNT, more_than_a_turn
from .core.messages.pose_association import PoseAssociator
from .core.messages.rejections import (
    odometry_rejections,
    of_dead_sensors,
    rejection_warnings,
    sensor_rejections,
)
from .core.messages.rep117 import (
    REASONS,
)
from .files.pose_files import poses_from_csv, poses_from_tum
from .files.quality_warning import data_warnings
from .files.results import write_results
from .recordings.drive import FullLiveMap, alternation_note, thinning_note

__all__ = ['Sonar', 'SonarMaps', 'make_maps', 'poses_from_csv', 'poses_from_tum']


@dataclass(frozen=True)
class Sonar:
    """A sensor: its pose on the robot, and values of its data sheet.

    Attributes
    ----------
    x, y : float
        Of the sensor in the robot's base frame (REP 103: x ahead, y to the left), metres.
    yaw : float
        Direction of its axis, radians, counter-clockwise from x.
    field_of_view : float
        The full angle of its cone, radians.
    max_range, min_range : float
        Metres. A range that is infinite, or not below `max_range`, means that there was no echo.
    pitch : float
        Downward angle of its axis, negative if upward (REP 103), radians; readings are projected on the plane.
    """

    x: float
    y: float
    yaw: float
    field_of_view: float
    max_range: float
    min_range: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        try:
            finite = all(map(math.isfinite, (self.x, self.y, self.yaw, self.max_range, self.min_range, self.pitch)))
            self.field_of_view / 1.0
        except (TypeError, OverflowError) as error:
            raise InputError(f'{self}: not a number: {error}') from None
        if not finite:
            raise InputError(f'{self}: pose and limits must be finite')
        if more_than_a_turn(self.yaw):
            raise InputError(f'yaw = {self.yaw:g} rad is more than a full turn; did you mean radians({self.yaw:g})?')
        if math.hypot(self.x, self.y) > FARTHEST_MOUNT:
            raise InputError(
                f'x = {self.x:g} m and y = {self.y:g} m are more than {FARTHEST_MOUNT:g} m from the middle of the '
                'robot; both are in metres'
            )
        if abs(self.pitch) > math.pi / 2:
            raise InputError(
                f'pitch = {self.pitch:g} rad is beyond straight down; did you mean radians({self.pitch:g})?'
            )
        if not 0.0 < self.field_of_view < math.pi:
            degrees = f'; did you mean radians({self.field_of_view:g})?' if 4 < self.field_of_view < 180 else ''
            raise InputError(f'field_of_view = {self.field_of_view:g} is not an angle between 0 and pi rad{degrees}')
        if not 0.0 <= self.min_range < self.max_range:
            raise InputError(
                f'min_range = {self.min_range:g} m and max_range = {self.max_range:g} m leave no valid range'
            )


@dataclass(frozen=True)
class SonarMaps:
    """The result of `make_maps`.

    Attributes
    ----------
    maps : MapSet
        The three maps, `maps.live`, `maps.ml` and `maps.uncertainty`, on the grid `maps.grid`.
    received : int
        Number of ranges given.
    rejected : dict of str to int
        Number of ranges that were not used, by reason (`core.messages.rep117.REASONS` describes them).
    warnings : tuple of str
        Faults of the input that are no errors, each with a remedy.
    path : float64, shape (P, 2)
        Path of the robot, metres.
    source : dict
        The report's data on the input.
    judged : tuple of str
        Those of the warnings that follow from the maps.
    """

    maps: MapSet
    received: int
    rejected: dict[str, int]
    warnings: tuple[str, ...]
    path: NDArray[np.float64]
    source: dict[str, Any]
    judged: tuple[str, ...]

    def save(self, folder: Path | str, title: str = 'Sonar maps') -> dict[str, Any]:
        """Write maps for map_server, archive, picture and report into a new folder; return the report.

        Raises
        ------
        OutputError
            If the folder exists, or cannot be written.
        """
        return write_results(folder, self.maps, self.source, self.path, title, judged=self.judged)


def make_maps(
    pose_stamps: ArrayLike,
    poses: ArrayLike,
    range_stamps: ArrayLike,
    ranges: ArrayLike,
    sensors: Mapping[str, Sonar],
    sensor_of: Sequence[str] | str,
    parameters: Mapping[str, Any] | None = None,
    watch: Watch = lambda stage, progress: None,
) -> SonarMaps:
    """Make the three maps of the readings of sonars on a robot.

    Poses are interpolated between stamps. Ranges follow REP 117: +inf, or at least `max_range`, is "no echo"; NaN and
    values below `min_range` are rejected and counted.

    Parameters
    ----------
    pose_stamps : float, shape (M,)
        Seconds, of any clock that the ranges share, in any order; or datetime64, or timedelta64.
    poses : float, shape (M, 3)
        x and y of the robot's base in metres and its yaw in radians, in the map frame (REP 103).
    range_stamps : float, shape (N,)
        Seconds, or as `pose_stamps`.
    ranges : float, shape (N,)
        Metres.
    sensors : mapping of str to Sonar
    sensor_of : str or sequence of str, length N
        Name of the sensor of each range, or of all.
    parameters : mapping, optional
        Values of `docs/parameters.md` by name, such as `{'resolution': 0.05}`.
    watch : callable, optional
        Called with stage and progress during the work, see `core.mapping.Mapper.run`.

    Returns
    -------
    SonarMaps

    Raises
    ------
    InputError
        If shapes, units or names are inconsistent, or no range could be used; names the reason.
    ParameterError
        For an unknown name or a value out of range.
    """
    if not isinstance(sensors, Mapping) or not all(isinstance(sensor, Sonar) for sensor in sensors.values()):
        raise InputError('sensors must be a mapping from the name of each sensor to its Sonar')
    if odd := [name for name in sensors if not isinstance(name, str)]:
        raise InputError(f'the names of sensors must be strings, such as {str(odd[0])!r} in place of {odd[0]!r}')
    if not isinstance(parameters or {}, Mapping) or not all(isinstance(name, str) for name in parameters or {}):
        raise InputError('parameters must be a mapping from names to values, such as {"resolution": 0.05}')
    if not isinstance(sensor_of, (str, Sequence)):
        # a column of a table is an array as well
        sensor_of = np.asarray(sensor_of).tolist()
        if not isinstance(sensor_of, (str, list)):
            raise InputError('sensor_of must be the name of a sensor, or one name for each range')
    if of_sensors := [name for name in parameters or {} if name.partition('.')[0] in ('sensors', 'sensor')]:
        raise InputError(f'{of_sensors[0]} is no parameter here: give poses of sensors in `sensors`')
    chosen = Parameters.from_flat(parameters or {})
    odometry = arrays.poses_of(_set(arrays.stamps('pose_stamps', pose_stamps)), poses)
    stamps = _set(arrays.stamps('range_stamps', range_stamps))
    values = arrays.column('ranges', ranges, len(stamps))
    names = [sensor_of] * len(values) if isinstance(sensor_of, str) else [str(name) for name in sensor_of]
    if len(names) != len(values):
        raise InputError(f'sensor_of has {counted(len(names), "name")} for {counted(len(values), "range")}')
    if unknown := sorted(set(names) - set(sensors)):
        raise InputError(f'no sensor is called {", ".join(unknown[:6])}; there are: {", ".join(sorted(sensors))}')
    if not odometry or not len(values):
        raise InputError(
            f'there are {counted(len(odometry), "pose")} and {counted(len(values), "range")}; both are needed'
        )
    mounted: dict[str, Pose2] = {name: Mount(s.x, s.y, s.yaw, -s.pitch) for name, s in sensors.items()}
    associator = PoseAssociator(lambda base, frame, stamp: mounted.get(frame), chosen, patient=True)
    live = FullLiveMap(associator, chosen)
    for pose in odometry:
        associator.add_odometry(pose)
    for i in np.argsort(stamps, kind='stable').tolist():
        s = sensors[names[i]]
        associator.add_range(
            RangeMessage(int(stamps[i]), names[i], float(values[i]), s.min_range, s.max_range, s.field_of_view)
        )
    associator.finish()
    refused = odometry_rejections(associator.odometry_rejected, associator.odometry_received, what='poses')
    if not len(associator.buffer):
        reasons = '; '.join(f'{n} {reason} ({REASONS[reason]})' for reason, n in associator.rejected.most_common())
        reasons += ''.join(f'; {text}' for text in refused)
        spans = f'poses span {odometry[0].stamp / 1e9:.3f} … {odometry[-1].stamp / 1e9:.3f} s'
        reasons += _unit_of_stamps(odometry, chosen)
        raise InputError(
            f'none of {len(values)} ranges could be used: {reasons}; {spans}, ranges '
            f'{stamps.min() / 1e9:.3f} … {stamps.max() / 1e9:.3f} s'
        )
    maps = live.on(Mapper(chosen).run(associator.readings, watch))
    by_frame, accepted = associator.rejected_by_frame, associator.buffer.counts()
    before = [
        *_of_the_node(chosen),
        *arrays.ambiguous_stamps(odometry),
        *alternation_note(associator),
        *refused,
        *associator.message_warnings(),
        *rejection_warnings(associator.rejected, len(values), 'ranges', dead=of_dead_sensors(by_frame, accepted)),
        *sensor_rejections(by_frame, accepted),
        *thinning_note(associator),
    ]
    judged = tuple(data_warnings(maps, {'extrinsics': mounted}))
    path = np.array(associator.path, np.float64).reshape(-1, 2)
    rejected = dict(associator.rejected)
    counts = {'received': len(values), 'accepted': len(associator.buffer), 'rejected': rejected}
    source = {'counts': counts, 'warnings': before, 'extrinsics': mounted}
    return SonarMaps(maps, len(values), rejected, (*before, *judged), path, source, judged)


def _set(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return stamps without 0, which is no stamp in a message: a nanosecond later."""
    return np.where(stamps == 0, 1, stamps)


def _unit_of_stamps(odometry: Sequence[OdometryMessage], parameters: Parameters) -> str:
    """Return a hint, after a semicolon, if poses are so far apart that stamps may have another unit; otherwise ''."""
    apart = np.median(np.diff([pose.stamp for pose in odometry])) / NANOSECONDS if len(odometry) > 1 else 0.0
    if apart <= parameters.association.max_pose_gap:
        return ''
    return f'; poses are {apart:g} s apart: are the stamps in milliseconds? They must be in seconds'


def _of_the_node(parameters: Parameters) -> list[str]:
    """Return a warning about parameters that have no effect here."""
    values = parameters.flat()
    names = [row.name for row in TABLE if row.group == 'node' and values[row.name] != row.default]
    return [f'these parameters are only for the node and are ignored: {", ".join(names)}'] if names else []
