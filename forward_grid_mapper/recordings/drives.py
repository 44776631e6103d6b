"""Several drives in the same map frame as the readings of one map, independent of the order of the drives."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bags.opening import is_storage_file
from ..core.common.errors import BagError, InputError, MapperError
from ..core.common.parameters import Parameters
from ..core.common.readings import Readings, in_canonical_order, of_drives
from ..core.maps.log_odds_map import LogOddsMap
from ..core.maps.map_set import MapSet
from ..core.messages.message_types import Pose2
from ..core.messages.reading_buffer import bounded
from ..files.output_folder import readable
from ..files.panels import joined_paths
from ..files.quality_warning import thinned
from .contradictions import Described, check_frames, contradictions, limits_of, listed, shared_echoes
from .drive import WHOLE, Drive, Part, thinning_note
from .finding import find_recordings
from .given_poses import GivenPoses
from .read_drive import read_drive

MOST_ERRORS = 5
"""Most recordings whose errors are shown."""

Watch = Callable[[str], None]
"""Receives a description of the current work."""


@dataclass(frozen=True)
class Drives:
    """Drives for one map, in canonical order: by first stamp, then by contents.

    Attributes
    ----------
    drives : tuple of Drive
        At least one.
    source : dict
        Data for the report: of a single drive, or of several with a list of them, `drives`.
    parameters : Parameters
    """

    drives: tuple[Drive, ...]
    source: dict[str, Any]
    parameters: Parameters

    @property
    def readings(self) -> Readings:
        """The readings to map from: all accepted ones, or `max_readings` of them; unordered."""
        if len(self.drives) == 1:
            return self.drives[0].associator.readings
        return bounded(
            of_drives([drive.associator.buffer.snapshot() for drive in self.drives]),
            self.parameters.association.max_readings,
        )

    @property
    def path_xy(self) -> NDArray[np.float64]:
        """Paths of the robots, shape (P, 2), metres; separated by rows of NaN."""
        return joined_paths([drive.path_xy for drive in self.drives])

    @property
    def map_frame(self) -> str:
        """The frame of all drives."""
        return self.drives[0].associator.map_frame

    def with_live(self, maps: MapSet) -> MapSet:
        """Return the maps with the live map of all readings, if `max_readings` restricts EM to some of them."""
        if len(self.drives) == 1:
            return self.drives[0].live.on(maps)
        if len(maps.readings) == sum(len(drive.associator.buffer) for drive in self.drives):
            return maps
        live = LogOddsMap(self.parameters)
        for drive in self.drives:
            live.add_map(drive.live.complete())
        return maps.with_live(live.grid, live.probability())


def read_drives(
    words: Sequence[Path | str],
    parameters: Parameters,
    extrinsics: Mapping[str, Pose2],
    range_topics: Sequence[str] | None = None,
    odom_topic: str | None = None,
    part: Part = WHOLE,
    progress: Callable[[int, int], None] | None = None,
    say: Watch = lambda text: None,
    poses: GivenPoses | None = None,
) -> Drives:
    """Read all drives given by `words` (see `find_recordings`).

    Parameters
    ----------
    words : sequence of Path or str
    parameters, extrinsics, range_topics, odom_topic
        For every drive, see `read_drive`.
    part : Part
        Of every drive.
    progress : callable, optional
        Called with (done, total) messages of a drive.
    say : callable, optional
        Called with the name of each drive before it is read, if there are several.
    poses : GivenPoses, optional
        For all drives, see `read_drive`.

    Raises
    ------
    BagError, InputError
        If one of them cannot be read or mapped, or they are in different map frames; names it.
    """
    meant = find_recordings(words)
    paths, repeated = without_repetition(meant.paths)
    repeated += meant.skipped
    if len(paths) == 1:
        drive = read_drive(paths[0], parameters, extrinsics, range_topics, odom_topic, progress, part, poses)
        drive.source['warnings'] += repeated
        return Drives((drive,), drive.source, parameters)
    drives, errors = [], []
    for number, path in enumerate(paths, 1):
        say(f'reading {number} of {len(paths)}: {readable(path)}')
        try:
            others = [other for other in paths if other != path]
            drives.append(read_drive(path, parameters, extrinsics, range_topics, odom_topic, None, part, poses, others))
        except (BagError, InputError) as error:
            errors.append((path, error))
    if errors:
        raise unreadable(errors, len(paths))
    return _together(drives, repeated, parameters)


def unreadable(errors: Sequence[tuple[Path, MapperError]], count: int) -> MapperError:
    """Return the error on those of `count` drives that cannot be mapped."""
    lines = [
        '\n  ' + (f'{readable(path)}: ' * (readable(path) not in str(error)) + str(error)).replace('\n', '\n    ')
        for path, error in errors[:MOST_ERRORS]
    ]
    more = f'\n  and {len(errors) - MOST_ERRORS} more' if len(errors) > MOST_ERRORS else ''
    kind = BagError if all(isinstance(error, BagError) for _, error in errors) else InputError
    return kind(
        f'{len(errors)} of {count} drives cannot be mapped; leave them out, or follow these '
        f'messages:{"".join(lines)}{more}'
    )


def without_repetition(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the recordings without repetitions, and a warning for each repeated one, even if the names differ.

    A bag takes precedence over its own files, in any order.
    """
    found: dict[object, Path] = {}
    notes = []
    files = {path: _files(path) for path in paths}
    # bags before recordings that consist of a part of their files
    for path in sorted(paths, key=lambda path: -len(files[path])):
        keys = files[path]
        earlier = next((found[key] for key in keys if key in found), None)
        if earlier is not None:
            again = '' if earlier == path else f' again as {readable(path)}'
            notes.append(f'{readable(earlier)} is given{again or " more than once"}; it is read once')
            continue
        found.update(dict.fromkeys(keys, path))
    kept = set(found.values())
    return [path for path in dict.fromkeys(paths) if path in kept], list(dict.fromkeys(notes))


def _files(path: Path) -> list[object]:
    """Return keys that identify a recording: its files, or its name if there are none."""
    folder = path.parent if path.name == 'metadata.yaml' else path
    try:
        if folder.is_dir():
            files = [entry for entry in folder.iterdir() if is_storage_file(entry) or entry.suffix == '.journal']
        else:
            files = [folder]
        states = [file.stat() for file in files]
        return [(state.st_dev, state.st_ino) for state in states] or [path.resolve()]
    except OSError:
        return [path]


def digest_of(readings: Readings) -> bytes:
    """Return a digest of readings that does not depend on their order."""
    r = in_canonical_order(readings)
    digest = hashlib.blake2b(repr(sorted(r.sensor_names)).encode('utf-8', 'surrogatepass'), digest_size=16)
    for column in (r.stamp, r.z, r.x, r.y, r.yaw, r.z_max, r.half_angle, r.sigma):
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.digest()


def _together(drives: Sequence[Drive], repeated: list[str], parameters: Parameters) -> Drives:
    """Put drives into canonical order, leave out copies, and add warnings about contradictions."""
    held = [drive.associator.buffer.snapshot() for drive in drives]
    keys = [(int(readings.stamp.min()), digest_of(readings)) for readings in held]
    order = sorted(range(len(drives)), key=lambda k: (keys[k], drives[k].source['bag']))
    described = [_described(drives[k], held[k]) for k in order]
    check_frames(described)
    left_out, notes = _copies(described, [held[k] for k in order])
    warnings = [*repeated, *notes]
    kept = [k for k in range(len(order)) if k not in left_out]
    warnings += contradictions([described[k] for k in kept])
    chosen = tuple(drives[order[k]] for k in kept)
    if len(chosen) == 1:
        chosen[0].source['warnings'] += warnings
        return Drives(chosen, chosen[0].source, parameters)
    for drive in chosen:
        # the note of thinning is made again for all drives together
        own = [text for text in drive.source['warnings'] if text not in thinning_note(drive.associator)]
        warnings += [f'{drive.source["bag"]}: {text}' for text in own]
    source = source_of_all([drive.source for drive in chosen], warnings)
    accepted = source['counts']['accepted']
    used = min(accepted, parameters.association.max_readings or accepted)
    source['warnings'] += filter(None, [thinned(used, accepted)])
    return Drives(chosen, source, parameters)


def same_drive(others: Sequence[str], one: str) -> str:
    """Return the warning about copies of a drive."""
    verb, it = ('is', 'it is') if len(others) == 1 else ('are', 'they are')
    return f'{listed(others)} {verb} the same drive as {one} (same sensors, stamps and ranges); {it} left out'


def _copies(drives: Sequence[Described], readings: Sequence[Readings]) -> tuple[set[int], list[str]]:
    """Return the drives that are copies of an earlier one, and warnings about them and about partial copies."""
    pairs = shared_echoes(readings)
    copies: dict[int, list[int]] = {}
    left_out: set[int] = set()
    # in order of numbers, so that all copies refer to the first one
    for pair in pairs:
        if pair.same and pair.one not in left_out:
            copies.setdefault(pair.one, []).append(pair.other)
            left_out.add(pair.other)
    notes = []
    for one, others in copies.items():
        notes.append(same_drive([drives[k].name for k in others], drives[one].name))
    for pair in pairs:
        if not {pair.one, pair.other} & left_out:
            names = drives[pair.one].name, drives[pair.other].name
            part, whole = names if pair.echoes[0] <= pair.echoes[1] else names[::-1]
            notes.append(
                f'{pair.shared} of {min(pair.echoes)} echoes of {part} are in {whole} as well: {part} is a part of '
                f'{whole}, and the evidence of these echoes counts twice; leave out {part}'
            )
    return left_out, notes


def _described(drive: Drive, readings: Readings) -> Described:
    source = drive.source
    poses = source.get('extrinsics') or {}
    return Described(source['bag'], source['map_frame'], source['base_frame'], poses, limits_of(readings))


def source_of_all(sources: Sequence[Mapping[str, Any]], warnings: list[str]) -> dict[str, Any]:
    """Return the report's data of several drives together, and of each; `sources` are those of drives."""
    stamps = [source['stamps'] for source in sources]
    topics = sorted({topic for source in sources for topic in source.get('range_topics') or ()})
    odometry = sorted({source['odom_topic'] for source in sources if source.get('odom_topic')})
    return {
        'bag': f'{len(sources)} drives',
        'drives': [{key: value for key, value in source.items() if key != 'warnings'} for source in sources],
        'range_topics': topics,
        'odom_topic': listed(odometry),
        'odom_frame': sources[0]['map_frame'],
        'map_frame': sources[0]['map_frame'],
        'mounts_from': ', '.join(sorted({source['mounts_from'] for source in sources})),
        'stamps': [min(first for first, _ in stamps), max(last for _, last in stamps)],
        'duration_s': sum(source['duration_s'] for source in sources),
        'path_m': sum(source['path_m'] for source in sources),
        'counts': _summed([source['counts'] for source in sources]),
        'rejected_by_frame': _summed([source.get('rejected_by_frame') or {} for source in sources]),
        'warnings': list(warnings),
    }


def _summed(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the sum of tables of counts, which may be nested."""
    total: dict[str, Any] = {}
    for name in dict.fromkeys(name for table in tables for name in table):
        values = [table[name] for table in tables if name in table]
        nested = isinstance(values[0], Mapping)
        total[name] = _summed(values) if nested else sum(values)
    return total
