"""Readings in the map frame: the columns that everything downstream works on."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Readings:
    """N readings in the map frame, in the order of acceptance.

    Attributes
    ----------
    x, y, yaw : float64, shape (N,)
        Pose of the sensor in the map frame: metres, radians.
    z : float64, shape (N,)
        Measured range in metres; `z_max` where there was no echo.
    z_max : float64, shape (N,)
        Largest range the sensor reports, metres.
    half_angle : float64, shape (N,)
        Half the field of view, radians, in (0, π/2).
    sigma : float64, shape (N,)
        Standard deviation of the range in metres as the message states it; 0 where it does not.
    stamp : int64, shape (N,)
        Nanoseconds.
    sensor : int32, shape (N,)
        Index into `sensor_names`.
    sensor_names : tuple of str
        The `frame_id` of each sensor.
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

    def __len__(self) -> int:
        return len(self.z)

    @property
    def echo(self) -> NDArray[np.bool_]:
        """Whether there was an echo, shape (N,)."""
        return self.z < self.z_max

    def counts(self) -> tuple[list[int], list[int]]:
        """Return how many readings each of `sensor_names` has, and how many of them are without echo."""
        total = np.bincount(self.sensor, minlength=len(self.sensor_names))
        silent = np.bincount(self.sensor[~self.echo], minlength=len(self.sensor_names))
        return total.tolist(), silent.tolist()

    def select(self, which: NDArray[np.generic] | slice) -> Readings:
        """Return the readings that `which` (mask, indices or slice) picks."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        names = columns.pop('sensor_names')
        return Readings(**{k: v[which] for k, v in columns.items()}, sensor_names=names)

    @classmethod
    def from_columns(cls, names: tuple[str, ...] = (), **columns: object) -> Readings:
        """Build from anything array-like; absent `sigma`, `stamp` and `sensor` are zero.

        Raises
        ------
        ValueError
            If a column's shape is not that of `z`.
        """
        z = np.atleast_1d(np.asarray(columns['z'], np.float64))
        types = {'stamp': np.int64, 'sensor': np.int32}
        made = {}
        for field in fields(cls):
            if field.name == 'sensor_names':
                continue
            kind = types.get(field.name, np.float64)
            optional = field.name in ('sigma', 'stamp', 'sensor')
            value = columns.get(field.name, 0 if optional else None)
            if value is None:
                raise ValueError(f'column {field.name} is missing')
            made[field.name] = np.array(np.broadcast_to(np.asarray(value, kind), z.shape))
        return cls(**made, sensor_names=tuple(names))


def in_canonical_order(readings: Readings) -> Readings:
    """Return the readings ordered by stamp, sensor name and values, so that the maps do not depend on arrival.

    Sums of floating point numbers depend on their order; two readings that are still equal are interchangeable.
    """
    rank = np.argsort(np.argsort(np.array(readings.sensor_names or ('',))))
    r = readings
    keys = (r.sigma, r.half_angle, r.z_max, r.yaw, r.y, r.x, r.z, rank[r.sensor], r.stamp)
    return readings.select(np.lexsort(keys))
