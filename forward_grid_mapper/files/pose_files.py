"""Poses of a robot from text files: the format of the TUM benchmark, and CSV with a header."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import InputError
from ..core.messages.quaternions import yaw_of

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Stamps in seconds, shape (M,), and x, y in metres and yaw in radians, shape (M, 3)."""

NAMES = {
    'stamp': (('stamp', 's', 'time', 't', 'timestamp', 'seconds'), 1.0),
    'stamp_ns': (('stamp_ns', 'time_ns', 't_ns', 'timestamp_ns', 'nanoseconds'), 1e-9),
    'x': (('x', 'pos_x', 'position_x'), 1.0),
    'y': (('y', 'pos_y', 'position_y'), 1.0),
    'yaw': (('yaw', 'theta', 'heading', 'yaw_rad', 'theta_rad', 'heading_rad'), 1.0),
    'yaw_deg': (('yaw_deg', 'theta_deg', 'heading_deg'), math.pi / 180.0),
    'qx': (('qx', 'q_x', 'orientation_x'), 1.0),
    'qy': (('qy', 'q_y', 'orientation_y'), 1.0),
    'qz': (('qz', 'q_z', 'orientation_z'), 1.0),
    'qw': (('qw', 'q_w', 'orientation_w'), 1.0),
}
"""Accepted names of columns, in any case, and the factor of their values."""

QUATERNION = ('qx', 'qy', 'qz', 'qw')
MOST_YAW = 100.0
"""Largest yaw, radians; a larger one must be in degrees, since no robot turns that often."""

_TUM_COLUMNS = 8


def poses_from_tum(path: Path | str) -> Poses:
    """Read a trajectory in the format of the TUM benchmark, which evo and most SLAM tools write.

    Returns
    -------
    stamps : float64, shape (M,)
        Seconds.
    poses : float64, shape (M, 3)
        x, y in metres and yaw in radians: the trajectory projected on the plane.

    Raises
    ------
    InputError
        If a line does not have the eight numbers `stamp x y z qx qy qz qw`, or the orientation of a robot on a floor.
    """
    stamps, poses = [], []
    for number, line in enumerate(_lines(path), 1):
        words = line.partition('#')[0].split()
        if not words:
            continue
        row = _numbers(words)
        if len(row) != _TUM_COLUMNS or not all(map(math.isfinite, row)):
            raise InputError(f'{path}, line {number}: not the eight numbers "stamp x y z qx qy qz qw"')
        poses.append((row[1], row[2], _yaw(path, number, row[4:])))
        stamps.append(row[0])
    return np.array(stamps), np.array(poses).reshape(-1, 3)


def poses_from_csv(path: Path | str) -> Poses:
    """Read poses from a CSV file whose first line names its columns, separated by commas or semicolons.

    Required are a stamp in seconds (`stamp`, or `stamp_ns` in nanoseconds), `x`, `y`, and `yaw` in radians (`yaw_deg`
    in degrees) or `qx`, `qy`, `qz`, `qw`; `NAMES` contains further accepted names. Other columns are ignored.

    Returns
    -------
    stamps : float64, shape (M,)
        Seconds.
    poses : float64, shape (M, 3)
        x, y in metres and yaw in radians.

    Raises
    ------
    InputError
        If it is not CSV, a column is missing, or a required column has something else than finite numbers.
    """
    lines = _lines(path)
    start = next((k for k, line in enumerate(lines) if line.strip()), None)
    if start is None:
        raise InputError(f'{path} is empty')
    comma = ';' if lines[start].count(';') > lines[start].count(',') else ','
    try:
        rows = list(csv.reader(lines[start:], delimiter=comma))
    except csv.Error as error:
        raise InputError(f'{path} is not CSV: {error}') from None
    header = [name.strip().lstrip('#').strip().lower() for name in rows[0]]
    columns = _columns(path, header)
    stamps, poses = [], []
    for number, row in enumerate(rows[1:], start + 2):
        if not any(word.strip() for word in row):
            continue
        found = {}
        for name, column in columns.items():
            value = _numbers(row[column : column + 1])
            if not value or not math.isfinite(value[0]):
                raise InputError(f'{path}, line {number}: no number for {header[column]!r}')
            found[name] = value[0] * NAMES[name][1]
        yaw = found.get('yaw', found.get('yaw_deg'))
        if yaw is None:
            yaw = _yaw(path, number, [found[name] for name in QUATERNION])
        elif abs(yaw) > MOST_YAW and 'yaw' in found:
            raise InputError(f'{path}, line {number}: yaw {yaw:g} rad; if these are degrees, name the column yaw_deg')
        poses.append((found['x'], found['y'], yaw))
        stamps.append(found.get('stamp', found.get('stamp_ns', math.nan)))
    return np.array(stamps, np.float64), np.array(poses, np.float64).reshape(-1, 3)


def _columns(path: Path | str, header: Sequence[str]) -> dict[str, int]:
    """Return the index of each required column."""
    found = {}
    for name, (words, _) in NAMES.items():
        which = [k for k, word in enumerate(header) if word in words]
        if len(which) > 1:
            raise InputError(f'{path}: the columns {header[which[0]]!r} and {header[which[1]]!r} are both {name}')
        if which:
            found[name] = which[0]
    for choice in (('stamp', 'stamp_ns'), ('x',), ('y',), ('yaw', 'yaw_deg', 'qw')):
        if not any(name in found for name in choice):
            raise InputError(f'{path} has no column {" or ".join(choice)}; its first line names {", ".join(header)}')
    if 'yaw' in found or 'yaw_deg' in found:
        return {name: column for name, column in found.items() if name not in QUATERNION}
    if missing := [name for name in QUATERNION if name not in found]:
        raise InputError(f'{path} has no column {missing[0]}, without which the quaternion is incomplete')
    return found


def _lines(path: Path | str) -> list[str]:
    try:
        return Path(path).read_text(encoding='utf-8-sig').splitlines()
    except OSError as error:
        raise InputError(f'{path} cannot be read: {error.strerror or error}') from None
    except UnicodeDecodeError as error:
        raise InputError(f'{path} cannot be read: {error}') from None


def _numbers(words: Sequence[str]) -> list[float]:
    """Return words as numbers; an empty list if one is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _yaw(path: Path | str, number: int, quaternion: Sequence[float]) -> float:
    x, y, z, w = quaternion
    yaw = yaw_of(x, y, z, w)
    if yaw is None:
        raise InputError(
            f'{path}, line {number}: the quaternion is not normalised, or the robot is tilted too far or upside down'
        )
    return yaw
