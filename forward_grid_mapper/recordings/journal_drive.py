"""The readings of a journal in the map frame, as from a bag."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.common.errors import InputError, ParameterError
from ..core.common.parameters import TABLE, Parameters
from ..core.common.readings import Readings
from ..core.common.words import counted
from ..core.messages.message_types import NANOSECONDS, Pose2
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rep117 import REASONS
from ..files.journal_format import Contents
from ..files.journal_reader import read
from ..files.output_folder import readable
from .drive import WHOLE, Drive, FullLiveMap, Part, length_of, thinning_note

MOST_NAMED = 10
"""Most parameters that a warning names."""

MOST_FILES = 3
"""Most earlier files that an error names, the latest ones."""

MOUNTS_FROM = 'the journal'
"""Where the poses of the sensors come from, in the data of a drive."""


def poses_unused(source: Mapping[str, Any], extrinsics: Mapping[str, Pose2]) -> list[str]:
    """Return a warning if poses of sensors are given for a journal; with a refined trajectory, they are used."""
    if not extrinsics or MOUNTS_FROM not in source['mounts_from']:
        return []
    return [
        'a journal contains readings in the map frame: given poses of sensors have no effect, except with '
        '--refine-poses and --odometry-calibration, where they are used to compute odometry from the readings'
    ]


def read_journal(
    path: Path,
    parameters: Parameters,
    extrinsics: Mapping[str, Pose2],
    range_topics: Sequence[str] | None = None,
    odom_topic: str | None = None,
    part: Part = WHOLE,
) -> Drive:
    """Read a journal file; its readings are already in the map frame.

    Raises
    ------
    BagError
        If the file cannot be read.
    InputError
        If it has no reading that can be mapped.
    ParameterError
        If topics are given.
    """
    if range_topics or odom_topic:
        raise ParameterError(f'{path} is a journal, which has no topics; leave out --range-topics and --odom-topic')
    associator = PoseAssociator(lambda base, frame, stamp: None, parameters, patient=True)
    live = FullLiveMap(associator, parameters)
    contents = Contents()
    first, last, names = math.inf, -math.inf, set()
    held: Iterable[Readings] = read(path, contents)
    if not part.whole:
        held = _cut(list(held), path, part)
        # the path in the file has no stamps
        contents.path[:] = _path_of(held)
    for readings in held:
        associator.restore(readings)
        first, last = min(first, int(readings.stamp.min())), max(last, int(readings.stamp.max()))
        names |= set(readings.sensor_names)
    if not len(associator.buffer):
        reasons = [
            f'{count} {"is" if count == 1 else "are"} refused: {REASONS[reason]}'
            for reason, count in associator.rejected.items()
        ]
        why = '; '.join(filter(None, [contents.harm, *reasons]))
        # a reset begins a new file
        earlier = sorted(str(other) for other in path.parent.glob('drive_*.journal') if other.name < path.name)
        hint = f'; earlier files can be given by name: {", ".join(earlier[-MOST_FILES:])}' if earlier else ''
        raise InputError(f'the journal {path} contains no reading{f" to map: {why}" if why else ""}{hint}')
    associator.map_frame, associator.base_frame = contents.map_frame, contents.base_frame
    for point in contents.path:
        associator.extend_path(point)
    warnings = _warnings(path, contents, associator, parameters)
    source = {
        'bag': readable(path),
        'odom_frame': associator.map_frame,
        'map_frame': associator.map_frame,
        'base_frame': associator.base_frame,
        'mounts_from': MOUNTS_FROM,
        'stamps': [int(first), int(last)],
        'duration_s': (last - first) / NANOSECONDS,
        'path_m': length_of(associator),
        'counts': {
            'received': associator.received,
            'accepted': len(associator.buffer),
            'rejected': dict(associator.rejected),
        },
        'warnings': warnings + thinning_note(associator),
    }
    # those that are given take precedence, as in the node
    mounts = {frame.lstrip('/'): pose for poses in (contents.mounts, extrinsics) for frame, pose in poses.items()}
    return Drive(associator, source, live, mounts)


def _cut(held: Sequence[Readings], path: Path, part: Part) -> list[Readings]:
    """Return the readings of a part of the drive."""
    first = min((int(readings.stamp.min()) for readings in held if len(readings)), default=0)
    last = max((int(readings.stamp.max()) for readings in held if len(readings)), default=0)
    begin, end = part.bounds(first)
    chosen = [readings.select((begin <= readings.stamp) & (readings.stamp < end)) for readings in held]
    chosen = [readings for readings in chosen if len(readings)]
    if held and not chosen:
        raise InputError(f'{path} has no reading in the part {part}; it spans {(last - first) / NANOSECONDS:.1f} s')
    return chosen


def _path_of(held: Sequence[Readings]) -> list[tuple[float, float]]:
    """Return the path of the sensor with the most readings, which is close to that of the robot."""
    if not held:
        return []
    names = np.concatenate([np.array(readings.sensor_names)[readings.sensor] for readings in held])
    stamp, x, y = (np.concatenate([getattr(readings, name) for readings in held]) for name in ('stamp', 'x', 'y'))
    frames, counts = np.unique(names, return_counts=True)
    which = np.flatnonzero(names == frames[counts.argmax()])
    which = which[np.argsort(stamp[which], kind='stable')]
    return list(zip(x[which].tolist(), y[which].tolist(), strict=True))


def _warnings(path: Path, contents: Contents, associator: PoseAssociator, parameters: Parameters) -> list[str]:
    warnings = []
    if contents.harm:
        warnings.append(f'{path.name}: {contents.harm}')
    for earlier, its in contents.earlier_files(path):
        if its.harm:
            warnings.append(f'{earlier.name}, which {path.name} continues: {its.harm}')
    if contents.earlier is not None and contents.earlier.unread:
        warnings.append(f'{path.name} continues {contents.continues}: {contents.earlier.unread}')
    if contents.note:
        warnings.append(f'{path.name}: {contents.note}; a node that starts with this journal continues in a new file')
    for reason, count in associator.rejected.items():
        of_all = counted(associator.received, 'reading')
        warnings.append(f'{count} of {of_all} {"is" if count == 1 else "are"} refused: {REASONS[reason]}')
    ours = parameters.flat()
    other = {
        row.name: contents.parameters.get(row.name, row.default)
        for row in TABLE
        if row.group != 'node' and contents.parameters.get(row.name, row.default) != ours[row.name]
    }
    # a file of the previous format has no parameters
    if other and not contents.note:
        named = ', '.join(f'{name}={value}' for name, value in list(other.items())[:MOST_NAMED])
        warnings.append(f'the node that kept {path.name} mapped with {named}; use --set for the same values here')
    return warnings
