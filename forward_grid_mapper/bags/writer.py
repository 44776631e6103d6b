"""Writes a bag for `ros2 bag play`, RViz, Foxglove or ROS 1."""

from __future__ import annotations

import errno
import math
import shutil
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from ..core.common.errors import OutputError
from ..core.common.grid import Grid
from ..core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2, RangeMessage
from .choice import ODOMETRY, RANGE
from .decoder import TF_MESSAGE, default_stores
from .source import one_line

FORMATS = ('mcap', 'sqlite3', 'ros1')
_GRID = 'nav_msgs/msg/OccupancyGrid'
# The newest version that Jazzy supports.
_METADATA_VERSION: Any = 9
_INFINITE = QosTime(9223372036, 854775807)


def check_bag_path(path: Path, format: str) -> None:
    """Check that a bag of this format can have this path.

    Raises
    ------
    OutputError
        If the format does not allow it.
    """
    if format == 'ros1' and path.suffix != '.bag':
        raise OutputError(f'{path} must end in .bag for ROS 1.')
    # rosbags uses a sqlite3 file's path as an unquoted URI, and would write elsewhere.
    if format == 'sqlite3' and set('?#%') & set(str(path.resolve())):
        raise OutputError(f'{path}: a sqlite3 bag cannot have ?, # or % in its path; rename it or use mcap.')


class BagWriter:
    """A bag that is written in a `with` block; it gets its final name when the block ends without an exception.

    Parameters
    ----------
    path : str or Path
        Folder to be created for 'mcap' and 'sqlite3', file ending in '.bag' for 'ros1'.
    format : {'mcap', 'sqlite3', 'ros1'}
        Storage format.
    """

    def __init__(self, path: str | Path, format: str = 'mcap') -> None:
        if format not in FORMATS:
            raise OutputError(f'There is no bag format {format!r}; use one of {", ".join(FORMATS)}.')
        self.path = Path(path)
        self._format = format
        self._ros1 = format == 'ros1'
        self._store = default_stores(ros1=self._ros1)[0]
        self._connections: dict[str, tuple[str, Any]] = {}
        self._sequence: dict[str, int] = {}
        self._staging: Path | None = None
        self._writer: Any = None

    def __enter__(self) -> BagWriter:
        """Begin writing beside the final place.

        Raises
        ------
        OutputError
            If the path exists, cannot be created, or is not allowed for the format.
        """
        if self.path.exists() or self.path.is_symlink():
            raise OutputError(f'{self.path} exists already; choose another path or remove it.')
        check_bag_path(self.path, self._format)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # The metadata name the file after the folder, so the folder has its final name within a temporary one.
            self._staging = Path(tempfile.mkdtemp(prefix=f'.{self.path.name}.', dir=self.path.parent))
            inner = self._staging / self.path.name
            if self._ros1:
                self._writer = rosbag1.Writer(inner)
            else:
                plugin = rosbag2.StoragePlugin[self._format.upper()]
                self._writer = rosbag2.Writer(inner, version=_METADATA_VERSION, storage_plugin=plugin)
            self._writer.open()
        except BaseException as error:  # OSError, sqlite3.Error, errors of rosbags, Ctrl-C
            self._discard()
            if not isinstance(error, Exception):
                raise
            raise self._output_error(error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish and rename the bag, or remove it after an exception.

        Raises
        ------
        OutputError
            If the bag cannot be finished.
        """
        try:
            if kind is None and self._staging is not None:
                self._writer.close()
                self._writer = None
                if self.path.exists():
                    raise OutputError(f'{self.path} exists already; choose another path or remove it.')
                (self._staging / self.path.name).rename(self.path)
        except OutputError:
            raise
        except Exception as problem:  # OSError, sqlite3.Error, errors of rosbags
            raise self._output_error(problem) from problem
        finally:
            self._discard()

    def write_range(self, topic: str, message: RangeMessage, radiation_type: int = 0, time: int | None = None) -> None:
        """Write a `sensor_msgs/Range`; `radiation_type` 0 is ultrasound, `time` the log time in nanoseconds."""
        variance = {} if self._ros1 else {'variance': message.variance}
        content = self._make(
            RANGE,
            header=self._header(topic, message.stamp, message.frame_id),
            radiation_type=radiation_type,
            field_of_view=message.field_of_view,
            min_range=message.min_range,
            max_range=message.max_range,
            range=message.range,
            **variance,
        )
        self._write(topic, RANGE, content, message.stamp if time is None else time)

    def write_odometry(self, topic: str, message: OdometryMessage, time: int | None = None) -> None:
        """Write a `nav_msgs/Odometry` without covariances or twist; a missing pose is written as NaN."""
        zero = self._make('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
        twist = self._make('geometry_msgs/msg/Twist', linear=zero, angular=zero)
        unknown = np.zeros(36)
        pose = message.pose or Pose2(math.nan, math.nan, math.nan)
        content = self._make(
            ODOMETRY,
            header=self._header(topic, message.stamp, message.frame_id),
            child_frame_id=message.child_frame_id,
            pose=self._make('geometry_msgs/msg/PoseWithCovariance', pose=self._pose(pose), covariance=unknown),
            twist=self._make('geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=unknown),
        )
        self._write(topic, ODOMETRY, content, message.stamp if time is None else time)

    def write_static_transforms(
        self, transforms: Iterable[tuple[str, str, Pose2]], stamp: int, time: int | None = None
    ) -> None:
        """Write (parent, child, pose of child in parent) to `/tf_static` in one latched message."""
        topic = '/tf_static'
        items = []
        for parent, child, pose in transforms:
            posed = self._pose(pose)
            offset = self._make('geometry_msgs/msg/Vector3', x=pose.x, y=pose.y, z=0.0)
            transform = self._make('geometry_msgs/msg/Transform', translation=offset, rotation=posed.orientation)
            header = self._header(topic, stamp, parent)
            kind = 'geometry_msgs/msg/TransformStamped'
            items.append(self._make(kind, header=header, child_frame_id=child, transform=transform))
        content = self._make(TF_MESSAGE, transforms=items)
        self._write(topic, TF_MESSAGE, content, stamp if time is None else time, latched=True)

    def write_grid(
        self, topic: str, grid: Grid, values: NDArray[np.int8], frame_id: str, stamp: int, time: int | None = None
    ) -> None:
        """Write a latched `nav_msgs/OccupancyGrid`.

        Parameters
        ----------
        values : int8, shape `grid.shape`
            0–100, or -1 where unknown; row 0 has the smallest y.
        """
        if values.shape != grid.shape:
            raise ValueError(f'values have shape {values.shape}, the grid {grid.shape}')
        information = self._make(
            'nav_msgs/msg/MapMetaData',
            map_load_time=self._time(stamp),
            resolution=grid.resolution,
            width=grid.width,
            height=grid.height,
            origin=self._pose(Pose2(*grid.origin, 0.0)),
        )
        header = self._header(topic, stamp, frame_id)
        data = np.ascontiguousarray(values, np.int8).ravel()
        content = self._make(_GRID, header=header, info=information, data=data)
        self._write(topic, _GRID, content, stamp if time is None else time, latched=True)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _time(self, stamp: int) -> Any:
        seconds, nanoseconds = divmod(stamp, NANOSECONDS)
        return self._make('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)

    def _header(self, topic: str, stamp: int, frame_id: str) -> Any:
        fields = {'stamp': self._time(stamp), 'frame_id': frame_id}
        if self._ros1:
            fields['seq'] = self._sequence[topic] = self._sequence.get(topic, -1) + 1
        return self._make('std_msgs/msg/Header', **fields)

    def _pose(self, pose: Pose2) -> Any:
        kind, half = 'geometry_msgs/msg/Quaternion', pose.yaw / 2
        turn = self._make(kind, x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        point = self._make('geometry_msgs/msg/Point', x=pose.x, y=pose.y, z=0.0)
        return self._make('geometry_msgs/msg/Pose', position=point, orientation=turn)

    def _write(self, topic: str, msgtype: str, content: Any, time: int, *, latched: bool = False) -> None:
        if self._writer is None:
            raise OutputError(f'{self.path} is not open for writing.')
        try:
            if topic not in self._connections:
                options: dict[str, Any] = (
                    {'latching': int(latched), 'callerid': '/forward_grid_mapper'}
                    if self._ros1
                    else {'offered_qos_profiles': [_quality(latched=latched)]}
                )
                added = self._writer.add_connection(topic, msgtype, typestore=self._store, **options)
                self._connections[topic] = msgtype, added
            known, connection = self._connections[topic]
            if known != msgtype:
                raise OutputError(f'Topic {topic} has {known} already; {msgtype} needs a topic of its own.')
            serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
            self._writer.write(connection, time, serialize(content, msgtype))
        except OutputError:
            raise
        except Exception as error:  # OSError, sqlite3.Error, a number that does not fit its field
            raise self._output_error(error, topic) from error

    def _output_error(self, error: Exception, topic: str = '') -> OutputError:
        """Return the output error for an exception while the bag, or a topic of it, was written."""
        number = error.errno if isinstance(error, OSError) else None
        if number in (errno.ENOSPC, errno.EDQUOT) or 'disk is full' in str(error):
            return OutputError(f'{self.path}: the disk is full; free some space, or choose another folder.')
        why = (isinstance(error, OSError) and error.strerror) or one_line(error)
        return OutputError(f'{self.path}{f": {topic}" if topic else ""} cannot be written: {why}.')

    def _discard(self) -> None:
        if self._writer is not None:
            with suppress(Exception):  # the remaining files are deleted with the folder below
                self._writer.abort()
            self._writer = None
        if self._staging is not None:
            shutil.rmtree(self._staging, ignore_errors=True)
            self._staging = None


def _quality(*, latched: bool) -> Qos:
    """Return the QoS profile of a recorder: reliable, and transient local for latched topics."""
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        _INFINITE,
        _INFINITE,
        QosLiveliness.AUTOMATIC,
        _INFINITE,
        False,
    )
