"""Readings in the map frame, as columns: the input of all mapping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""An array of float64, of any shape."""


@dataclass(frozen=True)
class Readings:
    """N readings in the map frame, in the order of acceptance.

    Attributes
    ----------
    x, y, yaw : float64, shape (N,)
        Pose of the sensor in the map frame: metres, radians.
    z : float64, shape (N,)
        Measured range in metres; `z_max` without echo.
    z_max : float64, shape (N,)
        Largest range the sensor reports, metres.
    half_angle : float64, shape (N,)
        Half the field of view, radians, in (0, π/2).
    sigma : float64, shape (N,)
        Standard deviation of the range by the message, metres; 0 if not stated.
    stamp : int64, shape (N,)
        Nanoseconds.
    sensor : int32, shape (N,)
        Index into `sensor_names`.
    sensor_names : tuple of str
        The `frame_id` of each sensor.
    drive : int32, shape (N,)
        Number of the drive; 0 if there is only one.
    """

    x: Floats
    y: Floats
    yaw: Floats
    z: Floats
    z_max: Floats
    half_angle: Floats
    sigma: Floats
    stamp: NDArray[np.int64]
    sensor: NDArray[np.int32]
    sensor_names: tuple[str, ...] = ()
    drive: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        if len(self.drive) not in (0, len(self.z)):
            raise ValueError(f'{len(self.z)} readings cannot have the drives of {len(self.drive)}')
        if len(self.drive) != len(self.z):
            # a broadcast view takes no memory
            object.__setattr__(self, 'drive', np.broadcast_to(np.int32(0), self.z.shape))

    def __len__(self) -> int:
        return len(self.z)

    @property
    def echo(self) -> NDArray[np.bool_]:
        """Whether there was an echo, shape (N,)."""
        return self.z < self.z_max

    def counts(self) -> tuple[list[int], list[int]]:
        """Return the number of readings of each of `sensor_names`, and of those without echo."""
        total = np.bincount(self.sensor, minlength=len(self.sensor_names))
        silent = np.bincount(self.sensor[~self.echo], minlength=len(self.sensor_names))
        return total.tolist(), silent.tolist()

    def select(self, which: NDArray[np.generic] | slice) -> Readings:
        """Return the readings selected by `which` (mask, indices or slice)."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        names = columns.pop('sensor_names')
        return Readings(**{k: v[which] for k, v in columns.items()}, sensor_names=names)

    @classmethod
    def from_columns(cls, names: tuple[str, ...] = (), **columns: object) -> Readings:
        """Build from array-like columns; missing `sigma`, `stamp`, `sensor` and `drive` are zero.

        Raises
        ------
        ValueError
            If a column is missing or unknown, or its shape is not that of `z`.
        """
        known = [column.name for column in fields(cls) if column.name != 'sensor_names']
        if unknown := sorted(columns.keys() - set(known)):
            raise ValueError(f'there is no column {", ".join(unknown)}; there are: {", ".join(known)}')
        if 'z' not in columns:
            raise ValueError('column z is missing')
        z = np.atleast_1d(np.asarray(columns['z'], np.float64))
        types = {'stamp': np.int64, 'sensor': np.int32, 'drive': np.int32}
        made = {}
        for name in known:
            value = columns.get(name, 0 if name in ('sigma', 'stamp', 'sensor', 'drive') else None)
            if value is None:
                raise ValueError(f'column {name} is missing')
            made[name] = np.array(np.broadcast_to(np.asarray(value, types.get(name, np.float64)), z.shape))
        return cls(**made, sensor_names=tuple(names))


def in_canonical_order(readings: Readings) -> Readings:
    """Return the readings sorted by stamp, sensor name, values and drive, so that maps do not depend on arrival.

    The order matters because sums of floating point numbers depend on it. Readings with equal keys are identical.
    """
    rank = np.argsort(np.argsort(np.array(readings.sensor_names or ('',))))
    r = readings
    keys = (r.drive, r.sigma, r.half_angle, r.z_max, r.yaw, r.y, r.x, r.z, rank[r.sensor], r.stamp)
    return readings.select(np.lexsort(keys))


def of_drives(drives: Sequence[Readings]) -> Readings:
    """Return the readings of several drives, which are numbered in order; sensors with the same name are the same."""
    names = tuple(sorted({name for readings in drives for name in readings.sensor_names or ('',)})) or ('',)
    number = {name: k for k, name in enumerate(names)}
    columns: dict[str, list[NDArray[np.generic]]] = {}
    for k, readings in enumerate(drives):
        sensors = np.array([number[name] for name in readings.sensor_names or ('',)], np.int32)
        of = replace(readings, sensor=sensors[readings.sensor], drive=np.full(len(readings), k, np.int32))
        for column in fields(Readings):
            if column.name != 'sensor_names':
                columns.setdefault(column.name, []).append(getattr(of, column.name))
    return Readings.from_columns(names, **{name: np.concatenate(parts) for name, parts in columns.items()})


def drives_of(readings: Readings) -> list[Readings]:
    """Return the readings of each drive, in the order of the drives' numbers; empty ones are left out."""
    if not readings.drive.any():
        return [readings]
    order = np.argsort(readings.drive, kind='stable')
    at = np.flatnonzero(np.diff(readings.drive[order])) + 1
    return [readings.select(part) for part in np.split(order, at)]
