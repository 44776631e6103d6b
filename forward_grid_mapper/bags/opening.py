"""From a path to the storage files of a bag, each open for reading, or a message that says why not."""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from rosbags import rosbag1, rosbag2

from ..core.common.errors import BagError
from . import scan_mcap, scan_rosbag1, scan_sqlite3
from .salvage import Scan
from .scan_sqlite3 import has_log, is_cut
from .source import RosbagsSource, Source, one_line

_KINDS: dict[bytes, tuple[str, type[Scan]]] = {
    scan_mcap.MAGIC: ('.mcap', scan_mcap.McapScan),
    scan_sqlite3.MAGIC: ('.db3', scan_sqlite3.Sqlite3Scan),
    scan_rosbag1.MAGIC: ('.bag', scan_rosbag1.Rosbag1Scan),
}
_REPAIR = {
    '.mcap': 'mcap recover {0} -o repaired.mcap',
    '.db3': 'sqlite3 {0} .recover | sqlite3 repaired.db3',
    '.bag': 'rosbag reindex {0}',
}
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


class _Metadata(NamedTuple):
    files: list[str]
    compressed: bool


def repair_hint(path: Path) -> str:
    """Return how to repair a damaged bag."""
    if path.is_dir():
        return f'repair it with `ros2 bag reindex {path.name}`'
    try:
        magic = _magic(path)
    except OSError:  # the suffix will do
        magic = b''
    suffix = next((kind[0] for key, kind in _KINDS.items() if magic.startswith(key)), path.suffix)
    command = _REPAIR.get(suffix, 'ros2 bag reindex {0}').format(path.name)
    return f'repair it with `{command}`'


def open_sources(path: Path) -> tuple[list[Source], str | None]:
    """Open a bag.

    Parameters
    ----------
    path : Path
        Bag folder, its `metadata.yaml`, or a single `.mcap`, `.db3` or `.bag` file.

    Returns
    -------
    sources : list of Source
        One for each storage file, in the order of recording.
    damage : str or None
        Why some of the bag cannot be read.

    Raises
    ------
    BagError
        If there is no bag or nothing of it can be read.
    """
    try:
        if not path.exists():
            raise BagError(f'{path} does not exist. Give a bag folder or a .mcap, .db3 or .bag file.')
        if path.name == 'metadata.yaml':
            path = path.parent
        if path.is_dir():
            return _open_folder(path)
        if not path.is_file():
            raise BagError(f'{path} is neither a file nor a folder. Give a bag folder or a .mcap, .db3 or .bag file.')
        return [_open_single(path)], None
    except BagError:
        raise
    except PermissionError as error:
        raise BagError(f'No permission to read {error.filename or path}. Change its mode or owner.') from None
    except Exception as error:  # OSError and whatever a storage library makes of damaged bytes
        raise BagError(f'{path} cannot be read ({one_line(error)}); {repair_hint(path)}.') from error


def _open_folder(folder: Path) -> tuple[list[Source], str | None]:
    metadata = _read_metadata(folder)
    present = sorted((p for p in folder.iterdir() if p.suffix in ('.mcap', '.db3', '.bag')), key=_natural_order)
    if metadata is None:
        if len(present) == 1:
            return [_open_file(present[0])], None
        if present:
            bags = ', '.join(p.name for p in present[:10])
            raise BagError(
                f'{folder} has no metadata.yaml but several bag files; name one of them ({bags}) '
                f'or run `ros2 bag reindex {folder.name}`.'
            )
        raise BagError(f'{folder} is not a bag: it has neither metadata.yaml nor a .mcap, .db3 or .bag file.')
    if metadata.compressed:
        return [_open_compressed(folder)], None
    listed = [folder / name for name in metadata.files]
    sources, problems = _open_each([p for p in listed if p.exists()] or present)
    problems += [f'{p.name} is missing' for p in listed if not p.exists()]
    if not sources:
        raise BagError('; '.join(problems) or f'{folder} is an empty bag: metadata.yaml lists no file.')
    return sources, '; '.join(problems) or None


def _open_each(files: list[Path]) -> tuple[list[Source], list[str]]:
    sources, problems = [], []
    for file in files:
        try:
            sources.append(_open_file(file))
        except BagError as error:  # the other files of a split bag are still worth having
            problems.append(str(error).rstrip('.'))
    return sources, problems


def _open_single(file: Path) -> Source:
    metadata = _read_metadata(file.parent)
    if metadata and metadata.compressed and file.name in metadata.files:
        # Only the folder's metadata say how its files, or the messages in them, are compressed.
        if len(metadata.files) == 1:
            return _open_compressed(file.parent)
        raise BagError(f'{file} is one of several compressed files; open the whole folder {file.parent}.')
    return _open_file(file)


def _open_file(file: Path) -> Source:
    magic = _magic(file)
    suffix, scanner = next((kind for key, kind in _KINDS.items() if magic.startswith(key)), ('', None))
    if scanner is None:
        if not magic:
            raise BagError(f'{file} is empty (0 bytes); the recording has nothing to read.')
        if magic.startswith(_ZSTD_MAGIC):
            raise BagError(f'{file} is compressed; unpack it with `zstd -d {file.name}` or open its bag folder.')
        raise BagError(f'{file} is not a bag: it is neither an MCAP, nor a sqlite3, nor a ROS 1 bag file.')
    try:
        if _rosbags_can_read(file, suffix):
            reader: Any = rosbag1.Reader(file) if suffix == '.bag' else rosbag2.Reader(file)
            reader.open()
            if suffix != '.mcap' or _has_full_index(reader):
                return RosbagsSource(reader, 'ros1' if suffix == '.bag' else 'cdr', lambda: scanner(file))
            reader.close()
        reason = ''
    except PermissionError:
        raise
    except Exception as error:  # rosbags lets struct, zstd, sqlite and assertion errors through
        reason = one_line(error)
    scan = scanner(file)
    if not scan.channels and (scan.damage or reason):
        raise BagError(f'{file} is damaged or cut off ({scan.damage or reason}); {repair_hint(file)}.')
    return scan


def _rosbags_can_read(file: Path, suffix: str) -> bool:
    """Return False where rosbags would be misled: it goes by the suffix, and makes a bare URI of a sqlite3 path."""
    if file.suffix != suffix:
        return False
    return suffix != '.db3' or not (set('?#%') & set(str(file)) or has_log(file) or is_cut(file))


def _has_full_index(reader: Any) -> bool:
    """Return whether rosbags finds all messages of an MCAP file by its index, and can so sort them by time."""
    chunks = reader.storage.chunks
    return bool(chunks) and all(chunk.channel_count for chunk in chunks)


def _open_compressed(folder: Path) -> Source:
    reader = rosbag2.Reader(folder)
    try:
        reader.open()
    except PermissionError:
        raise
    except Exception as error:  # as above; scanners cannot read through this compression
        raise BagError(
            f'{folder} is damaged or cut off ({one_line(error)}); unpack its files with `zstd -d`, '
            f'delete metadata.yaml and run `ros2 bag reindex {folder.name}`.'
        ) from error
    return RosbagsSource(reader, 'cdr', None)


def _read_metadata(folder: Path) -> _Metadata | None:
    """Return what metadata.yaml says, None if there is none.

    The file is made by a program, and only two of its keys matter: looked for line by line, they are found in a file
    that is damaged elsewhere too.
    """
    try:
        text = (folder / 'metadata.yaml').read_text('utf-8', errors='replace')
    except OSError:  # absent or locked; the storage files can do without
        return None
    mode = re.search(r'^\s*compression_mode:\s*["\']?(file|message)\b', text, re.IGNORECASE | re.MULTILINE)
    listed = re.search(r'^\s*relative_file_paths:[ \t]*(\[[^]]*\]|(?:\s*\n\s*- [^\n]*)+)', text, re.MULTILINE)
    entries = re.split(r'\n\s*-|,', listed[1].strip('[]')) if listed else []
    names = [PurePath(entry.strip().strip('"\'')).name for entry in entries]
    return _Metadata([name for name in names if name], mode is not None)


def _magic(file: Path) -> bytes:
    with file.open('rb') as stream:
        return stream.read(16)


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Return a sorting key that puts bag_10 after bag_9."""
    return [(int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'(\d+)', file.name)]
