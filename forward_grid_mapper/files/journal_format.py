"""Contents of a journal file: its tables, the layout of a reading, and checks for everything that is read.

A journal file is an SQLite database in WAL mode:

    drive      row 0: map_frame and base_frame (UTF-8), and the parameters of the node that wrote it (JSON), among them
               `MOUNTS`, the poses of the sensors on the robot by frame, [x, y, yaw];
               row 1, if the file continues an earlier one: the name of that file
    sensors    number of a sensor, and its frame_id in UTF-8
    path       points of the robot's path in the map frame: x, y (float64)
    readings   number of the first reading of a block, and the block: rows of `ROW`

Readings are counted from the start of the drive. The count is the key of the table, so that a block that is written
again after a failure is not stored twice.

A file that continues an earlier one lacks the readings of that one, and counts its own from `OWN`. The readings of the
earlier file are inserted before them, and row 1 of `drive` is removed, in one transaction. So at each moment, every
reading is in the file or in the one that it continues, and never in both.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import ParameterError
from ..core.common.parameters import TABLE, Parameters
from ..core.common.readings import Readings
from ..core.messages.map_extent import LARGEST_COORDINATE
from ..core.messages.message_types import NANOSECONDS, Pose2

DRIVE = re.compile(r'drive_(\d{4,})\.journal')
"""Name of a journal file."""

SQLITE = b'SQLite format 3\0'
"""The first bytes of every SQLite database."""

APPLICATION = 0x46474D4A
"""`PRAGMA application_id` of a journal: FGMJ in ASCII. It distinguishes a journal from a rosbag2 file."""

VERSION = 1
"""`PRAGMA user_version`: the version of the tables. A file of another version is refused."""

TABLES = {
    'drive': 'CREATE TABLE drive (number INTEGER PRIMARY KEY, map_frame BLOB, base_frame BLOB, parameters BLOB)',
    'sensors': 'CREATE TABLE sensors (number INTEGER PRIMARY KEY, name BLOB)',
    'path': 'CREATE TABLE path (number INTEGER PRIMARY KEY, points BLOB)',
    'readings': 'CREATE TABLE readings (number INTEGER PRIMARY KEY, rows BLOB)',
}
"""The whole schema. No table has its own index, so that `sqlite_master` has exactly these rows."""

CONTINUES = 1
"""Number of the row of `drive` with the name of the file that is continued."""

OWN = 1 << 39
"""Number of the first own reading, and of the first own points of the path, in a file that continues another one."""

COLUMNS = ('x', 'y', 'yaw', 'z', 'z_max', 'half_angle', 'sigma')
ROW = np.dtype([('stamp', '<i8'), *((name, '<f8') for name in COLUMNS), ('sensor', '<u4')])
"""A reading; 68 bytes."""

BLOCK = 10_000
"""Most readings of a block; 680 kB, so that no row of the database is longer than `LONGEST`."""

CHUNK = 50_000
"""Readings that are yielded at once when a journal is read; 3.4 MB."""

LONGEST = 1 << 20
"""Most bytes of a value in the database. A longer one is damage, and is not loaded."""

MOST_SENSORS = 10_000
"""Most sensors of a drive; ten times as many as the node counts separately."""

LONGEST_NAME = 1020
"""Most bytes of a frame's name: 255 characters of four bytes."""

MOST_POINTS = 200_000
"""Most points of the path in memory while a journal is read; if there are more, every second one is dropped."""

LATEST = (1 << 32) * NANOSECONDS
"""Largest absolute value of a stamp, nanoseconds: that of 32 bits of seconds, so that differences fit into 64 bits."""

MOUNTS = 'sensors'
"""Key of the poses of sensors among the parameters of the node; no parameter has this name."""

Insert = tuple[str, tuple[Any, ...]]
"""A table, and the values of a row."""


def rows_of(readings: Readings, numbers: Mapping[str, int]) -> NDArray[np.void]:
    """Return readings as rows of `ROW`, shape (N,); `numbers` gives the number of each sensor by its name."""
    rows = np.empty(len(readings), ROW)
    for name in ('stamp', *COLUMNS):
        rows[name] = getattr(readings, name)
    rows['sensor'] = np.array([numbers.get(name, 0) for name in readings.sensor_names] or [0])[readings.sensor]
    return rows


def points_of(path: Iterable[tuple[float, float]]) -> NDArray[np.float64]:
    """Return points of the path in the format of the table, shape (P, 2)."""
    return np.array(list(path), '<f8').reshape(-1, 2)


def path_rows(points: list[tuple[float, float]], number: int) -> Iterator[Insert]:
    """Yield the rows of points of the path; `number` is that of the first row."""
    for first in range(0, len(points), BLOCK):
        yield 'path', (number, points_of(points[first : first + BLOCK]).tobytes())
        number += 1


def reading_rows(readings: Readings, numbers: Mapping[str, int], number: int) -> Iterator[Insert]:
    """Yield the rows of readings; `number` is that of the first reading, `numbers` are those of the sensors."""
    for first in range(0, len(readings), BLOCK):
        part = readings.select(slice(first, first + BLOCK))
        yield 'readings', (number + first, rows_of(part, numbers).tobytes())


def encoded(name: str) -> bytes:
    """Return a frame's name, with any characters, as bytes."""
    return name.encode('utf-8', 'surrogatepass')


def stated(parameters: Parameters) -> dict[str, Any]:
    """Return the parameters that affect maps and are not the defaults, by name, in the format of a journal."""
    values = parameters.flat()
    return {row.name: values[row.name] for row in TABLE if row.group != 'node' and values[row.name] != row.default}


def with_mounts(parameters: Mapping[str, Any], mounts: Mapping[str, Pose2]) -> dict[str, Any]:
    """Return parameters in the format of a journal, with the poses of sensors on the robot, by frame."""
    poses = {MOUNTS: {frame: list(pose) for frame, pose in mounts.items()}} if mounts else {}
    return {**parameters, **poses}


@dataclass
class Contents:
    """Contents of a journal file besides its readings, complete once these were read, and its faults.

    Attributes
    ----------
    map_frame, base_frame : str
    parameters : dict
        Those of the node that wrote the file which are not the defaults.
    mounts : dict of str → Pose2
        Poses of the sensors on the robot when their latest readings were placed, by frame, as far as they are fixed.
    sensors : dict of int → str
        Names by number.
    path : list of (x, y)
        Metres, in the map frame.
    next, next_points : int
        Numbers of the next reading, and of the next points of the path.
    faults : list of str
        Faults of the file as a whole.
    left_out : Counter of str
        Number of invalid readings by fault; they are not yielded.
    note : str
        A note to the user on a valid file; '' if none.
    continues : str
        Name of the file that has the earlier readings of the drive; '' if the file has all of them.
    earlier : Contents or None
        Contents of that file, once it was read.
    unread : str
        Reason why readings were not read that may be readable later; '' if there are none. Also that of earlier files.
    """

    map_frame: str = ''
    base_frame: str = ''
    parameters: dict[str, Any] = field(default_factory=dict)
    mounts: dict[str, Pose2] = field(default_factory=dict)
    sensors: dict[int, str] = field(default_factory=dict)
    path: list[tuple[float, float]] = field(default_factory=list)
    next: int = 0
    next_points: int = 0
    faults: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    note: str = ''
    continues: str = ''
    earlier: Contents | None = None
    unread: str = ''

    @property
    def harm(self) -> str:
        """The faults of the file, in words; '' if none."""
        counts = [
            f'{count} readings are left out, since {reason}'
            if count > 1
            else f'1 reading is left out, since {reason.replace("their", "its", 1)}'
            for reason, count in self.left_out.items()
        ]
        return '; '.join(self.faults + counts)

    def fault(self, text: str) -> None:
        """Add a fault of the file, each only once."""
        if text not in self.faults:
            self.faults.append(text)

    def add_sensor(self, number: int, name: object) -> None:
        """Add a sensor's name, if it is valid."""
        text = _name(name)
        if text is None or not 0 <= number < 1 << 32:
            self.fault('the name of a sensor is damaged')
        elif len(self.sensors) >= MOST_SENSORS and number not in self.sensors:
            self.fault(f'it names more than {MOST_SENSORS} sensors')
        else:
            self.sensors[number] = text

    def set_frames(self, map_frame: object, base_frame: object) -> None:
        """Set the frames of the drive, if their names are valid."""
        names = _name(map_frame), _name(base_frame)
        if names[0] is None or names[1] is None:
            self.fault('the frames of the drive are damaged')
        else:
            self.map_frame, self.base_frame = names[0], names[1]

    def set_parameters(self, data: object) -> None:
        """Set the parameters of the node. Those that this version does not accept are ignored."""
        try:
            values = json.loads(data) if isinstance(data, bytes) else None
        except (ValueError, RecursionError):
            values = None
        if not isinstance(values, dict):
            self.fault('the parameters of the node are damaged')
            return
        for row in TABLE:
            if row.name in values:
                with suppress(ParameterError):
                    self.parameters[row.name] = row.check(values[row.name])
        mounts = values.get(MOUNTS)
        for frame, pose in mounts.items() if isinstance(mounts, dict) else ():
            with suppress(TypeError, ValueError, OverflowError):
                x, y, yaw = map(float, pose)
                if np.isfinite([x, y, yaw]).all():
                    self.mounts[frame] = Pose2(x, y, yaw)

    def set_continued(self, name: object) -> None:
        """Set the file that is continued, if it is one of a journal's folder."""
        text = _name(name)
        if text is None or not DRIVE.fullmatch(text):
            self.fault('the name of the file that it continues is damaged')
        else:
            self.continues = text

    def put_before(self, earlier: Contents) -> None:
        """Add what the file lacks and `earlier`, which it continues, has."""
        self.earlier = earlier
        self.path[:0] = earlier.path
        self._thin_path()
        self.unread = self.unread or earlier.unread
        # not yet stated by the node that continues
        if not self.map_frame:
            self.map_frame, self.base_frame = earlier.map_frame, earlier.base_frame
            self.parameters, self.mounts = dict(earlier.parameters), dict(earlier.mounts)

    def earlier_files(self, path: Path) -> Iterator[tuple[Path, Contents]]:
        """Yield the files that `path` continues, the latest one first, and their contents."""
        contents = self
        while contents.earlier is not None:
            path, contents = path.with_name(contents.continues), contents.earlier
            yield path, contents

    def add_path(self, data: object) -> None:
        """Add points of the path, if they are on Earth."""
        if not isinstance(data, bytes) or len(data) % 16:
            self.fault('points of the path are damaged')
            return
        points = np.frombuffer(data, '<f8').reshape(-1, 2)
        good = (np.abs(points) < LARGEST_COORDINATE).all(axis=1)
        if not good.all():
            self.fault('points of the path are not finite')
        self.path += [(x, y) for x, y in points[good].tolist()]
        self._thin_path()

    def _thin_path(self) -> None:
        while len(self.path) > MOST_POINTS:
            del self.path[1::2]

    def sound(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Return the rows that are valid readings; the others are counted by fault."""
        good = np.ones(len(rows), bool)
        for reason, bad in _wrong(rows, self.sensors):
            count = int(np.count_nonzero(bad & good))
            if count:
                self.left_out[reason] += count
                good &= ~bad
        return rows if good.all() else rows[good]

    def readings(self, rows: NDArray[np.void]) -> Readings:
        """Return `sound` rows as readings."""
        known, sensor = np.unique(rows['sensor'], return_inverse=True)
        names = tuple(self.sensors[int(number)] for number in known)
        return Readings.from_columns(names=names, sensor=sensor, **{name: rows[name] for name in ('stamp', *COLUMNS)})


def _name(data: object) -> str | None:
    if not isinstance(data, bytes) or len(data) > LONGEST_NAME:
        return None
    try:
        return data.decode('utf-8', 'surrogatepass')
    except UnicodeDecodeError:
        return None


def _wrong(rows: NDArray[np.void], sensors: Mapping[int, str]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield possible faults of readings, and the mask of readings that have them.

    Comparisons are written so that NaN fails them.
    """
    z, z_max = rows['z'], rows['z_max']
    on_earth = (
        (np.abs(rows['x']) < LARGEST_COORDINATE) & (np.abs(rows['y']) < LARGEST_COORDINATE) & np.isfinite(rows['yaw'])
    )
    yield 'their pose is not finite or impossibly far away', ~on_earth
    yield 'their range is not between 0 and the largest range', ~((z > 0) & (z <= z_max) & (z_max < np.inf))
    yield (
        'their field of view is not between 0 and 180 degrees',
        ~((rows['half_angle'] > 0) & (rows['half_angle'] < np.pi / 2)),
    )
    yield 'their standard deviation is negative or not finite', ~((rows['sigma'] >= 0) & (rows['sigma'] < np.inf))
    yield 'their stamp is not possible', ~((rows['stamp'] > -LATEST) & (rows['stamp'] < LATEST))
    yield 'their sensor has no name', ~np.isin(rows['sensor'], np.fromiter(sensors, np.int64, len(sensors)))


def in_chunks(blocks: Iterable[NDArray[np.void]], contents: Contents) -> Iterator[Readings]:
    """Yield the valid readings of blocks of rows, about `CHUNK` at a time."""
    waiting: list[NDArray[np.void]] = []
    count = 0
    for rows in blocks:
        waiting.append(rows)
        count += len(rows)
        if count >= CHUNK:
            yield from _joined(waiting, contents)
            waiting, count = [], 0
    yield from _joined(waiting, contents)


def _joined(waiting: Sequence[NDArray[np.void]], contents: Contents) -> Iterator[Readings]:
    rows = contents.sound(np.concatenate([np.empty(0, ROW), *waiting]))
    if len(rows):
        yield contents.readings(rows)
