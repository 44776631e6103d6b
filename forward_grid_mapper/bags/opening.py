"""Opens the storage files of a bag, or raises an error with the reason."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from rosbags import rosbag1, rosbag2

from ..core.common.errors import BagError
from ..core.common.shell import quoted
from . import scan_mcap, scan_rosbag1, scan_sqlite3
from .bounds import LARGEST_METADATA, Budget, bounded, megabytes, most_unpacked
from .interleaved import interleaved
from .mcap_chunks import indexed_messages
from .repair import Problem, reasons_of, remedies_of, repair_hint
from .salvage import Scan
from .source import RosbagsSource, Source, close_all, one_line
from .unpacking import ZSTD_MAGIC, NoSpaceError, UnpackedMessages, open_unpacked

_KINDS: dict[bytes, tuple[str, type[Scan]]] = {
    scan_mcap.MAGIC: ('.mcap', scan_mcap.McapScan),
    scan_sqlite3.MAGIC: ('.db3', scan_sqlite3.Sqlite3Scan),
    scan_rosbag1.MAGIC: ('.bag', scan_rosbag1.Rosbag1Scan),
}

STORAGE_SUFFIXES = ('.mcap', '.db3', '.bag', '.mcap.zstd', '.db3.zstd')
"""Suffixes of storage files."""

MOST_FILES = 100_000
"""Most lines in which a list of files is searched."""


class _Metadata(NamedTuple):
    """Contents of metadata.yaml: names of the storage files, and their compression: '', 'file' or 'message'."""

    files: list[str]
    compression: str


class Opened(NamedTuple):
    """The storage files of a bag that could be opened, and the reasons why others could not.

    `sources` are in the order of recording; files whose log times overlap are one source. `files` has the source of
    each file.
    """

    sources: list[Source]
    files: list[tuple[Path, Source]]
    problems: list[Problem]


def open_sources(path: Path) -> Opened:
    """Open a bag.

    Parameters
    ----------
    path : Path
        Bag folder, its `metadata.yaml`, or a single `.mcap`, `.db3` or `.bag` file.

    Returns
    -------
    Opened

    Raises
    ------
    BagError
        If there is no bag, or nothing of it can be read.
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
        source = _open_single(path)
        return Opened([source], [(path, source)], [])
    except BagError:
        raise
    except PermissionError as error:
        raise BagError(f'No permission to read {error.filename or path}. Change its mode or owner.') from None
    except Exception as error:  # OSError, and errors of storage libraries for damaged bytes
        hint = '' if path.is_dir() else f'; {repair_hint(path)}'
        raise BagError(f'{path} cannot be read ({one_line(error)}){hint}.') from error


def _open_folder(folder: Path) -> Opened:
    metadata = _read_metadata(folder)
    present = storage_files(folder)
    if metadata is None:
        if len(present) == 1:
            source = _open_unlisted(present[0])
            return Opened([source], [(present[0], source)], [])
        if present:
            raise BagError(_of_several(folder, present))
        if (folder / 'maps.npz').exists():
            raise BagError(f'{folder} is not a bag: it contains maps of process_bag or save_maps.')
        inside = sorted(path.parent for path in folder.glob('*/metadata.yaml'))
        hint = f' There is one in it: {inside[0]}' if inside else ''
        if not inside and (deeper := sorted(path.parent.parent for path in folder.glob('*/*/metadata.yaml'))):
            hint = f' There are bags in {deeper[0]}'
        raise BagError(f'{folder} is not a bag: it has neither metadata.yaml nor a .mcap, .db3 or .bag file.{hint}')
    listed = _without_repetition(_packed_or_not(folder / name) for name in metadata.files)
    there = [p for p in listed if p.exists()]
    files, problems = _open_each(there or present, metadata.compression)
    copying = f'copy what is missing into {quoted(folder)}'
    problems += [Problem(f'{p.name} is missing', copying) for p in listed if not p.exists()]
    listing = f'list all files with `ros2 bag reindex {quoted(folder)}`'
    unlisted = _unlisted(present, there)
    problems += [Problem(f'{p.name} is not listed in metadata.yaml and was left out', listing) for p in unlisted]
    if not files:
        why = f'{reasons_of(problems)}{remedies_of(problems)}'
        raise BagError(why or f'{folder} is an empty bag: metadata.yaml lists no file.')
    return Opened(interleaved([source for _, source in files]), files, problems)


def is_storage_file(path: Path) -> bool:
    """Return whether a path has the suffix of a storage file."""
    return path.name.endswith(STORAGE_SUFFIXES)


def plain_name(path: Path) -> str:
    """Return the name of a storage file without the suffix of compression."""
    return path.name.removesuffix('.zstd')


def _packed_or_not(file: Path) -> Path:
    """Return a file of the metadata, or its decompressed or compressed form if only that exists."""
    others = (file.with_name(plain_name(file)), file.with_name(f'{file.name}.zstd'))
    return file if file.exists() else next(filter(Path.exists, others), file)


def storage_files(folder: Path) -> list[Path]:
    """Return the storage files in a folder by name; without compressed ones whose decompressed file is there."""
    files = sorted(filter(is_storage_file, folder.iterdir()), key=lambda file: natural_order(file.name))
    names = {file.name for file in files}
    return [file for file in files if file.name == plain_name(file) or plain_name(file) not in names]


def _of_several(folder: Path, present: Sequence[Path]) -> str:
    bags = ', '.join(p.name for p in present[:10])
    packed = [quoted(file) for file in present if file.name != plain_name(file)]
    unpack = f'unpack with `zstd -d --rm {" ".join(packed)}` and ' if packed else ''
    return (
        f'{folder} has no metadata.yaml but several bag files; name one of them ({bags}) '
        f'or {unpack}run `ros2 bag reindex {quoted(folder)}`.'
    )


def _unlisted(present: Sequence[Path], listed: Sequence[Path]) -> list[Path]:
    """Return the storage files of a folder that are not listed, also under other names; none if none is listed."""
    names = {plain_name(file) for file in listed}
    both = _without_repetition([*listed, *present])
    return [file for file in both[len(listed) :] if listed and plain_name(file) not in names]


def _without_repetition(files: Iterable[Path]) -> list[Path]:
    """Return the files in their order without repetitions under any name: a repeated reading is wrong evidence."""
    found: dict[object, Path] = {}
    for file in files:
        try:
            status = file.stat()
            found.setdefault((status.st_dev, status.st_ino), file)
        except OSError:
            found.setdefault(file, file)
    return list(found.values())


def _open_each(files: list[Path], compression: str) -> tuple[list[tuple[Path, Source]], list[Problem]]:
    sources, problems = [], []
    for file in files:
        try:
            sources.append((file, _open_listed(file, compression)))
        except BaseException as error:
            # the other files of a split bag are still used
            if isinstance(error, BagError) and not isinstance(error, NoSpaceError):
                problems.append(Problem(str(error).rstrip('.')))
                continue
            # decompressed files must not remain in the temporary folder
            close_all(source for _, source in sources)
            raise
    return sources, problems


def _open_single(file: Path) -> Source:
    metadata = _read_metadata(file.parent)
    if metadata is None or file.name not in metadata.files:
        return _open_unlisted(file)
    return _open_listed(file, metadata.compression)


def _open_unlisted(file: Path) -> Source:
    # only metadata state whether messages are compressed, but compressed ones can be recognised
    return UnpackedMessages(_open_file(file), marked=True)


def _open_listed(file: Path, compression: str) -> Source:
    # some tools that decompress a bag do not change its metadata
    if compression == 'file' and not _is_plain(file):
        return open_unpacked(file, _open_file)
    source = _open_file(file)
    return UnpackedMessages(source) if compression == 'message' else source


def _is_plain(file: Path) -> bool:
    return file.is_file() and any(map(_magic(file).startswith, _KINDS))


def _open_file(file: Path) -> Source:
    if not file.is_file():
        # reading a pipe would wait, and a device may have no end
        raise BagError(f'{file} is not a regular file; give a bag folder or a .mcap, .db3 or .bag file.')
    magic = _magic(file)
    suffix, scanner = next((kind for key, kind in _KINDS.items() if magic.startswith(key)), ('', None))
    if scanner is None:
        if not magic:
            raise BagError(f'{file} is empty (0 bytes); nothing was recorded.')
        if magic.startswith(ZSTD_MAGIC):
            raise BagError(f'{file} is compressed; unpack it with `zstd -d {quoted(file)}` or open its bag folder.')
        raise BagError(f'{file} is not a bag: it is neither an MCAP, nor a sqlite3, nor a ROS 1 bag file.')
    reason = ''
    if file.suffix == suffix and suffix != '.db3':
        try:
            with bounded(file.stat().st_size):
                source = _open_by_index(file, suffix, lambda: scanner(file))
            if source is not None:
                return source
        except PermissionError:
            raise
        except Exception as error:  # rosbags does not catch struct, zstd and assertion errors
            reason = one_line(error)
    scan = scanner(file)
    if not scan.channels and (scan.damage or reason):
        raise BagError(f'{file} is damaged or cut off ({scan.damage or reason}); {repair_hint(file)}.')
    return scan


def _open_by_index(file: Path, suffix: str, scan: Callable[[], Source]) -> Source | None:
    """Open an MCAP file or a ROS 1 bag with rosbags, by the suffix; None if its index cannot be used."""
    size = file.stat().st_size
    reader: Any = rosbag1.Reader(file) if suffix == '.bag' else rosbag2.Reader(file)
    reader.open()
    with ExitStack() as unused:
        unused.callback(reader.close)
        if suffix == '.bag':
            budget = Budget(size)
            reader.chunks = {
                at: chunk._replace(decompressor=budget.metered(chunk.decompressor))
                for at, chunk in reader.chunks.items()
            }
            source = RosbagsSource(reader, 'ros1', scan)
        elif _has_full_index(reader) and _is_bounded(reader, size):
            source = RosbagsSource(reader, 'cdr', scan, indexed_messages)
        else:
            return None
        # the source closes it
        unused.pop_all()
        return source


def _has_full_index(reader: Any) -> bool:
    """Return whether rosbags finds all messages of an MCAP file by its index, and so can sort them by time."""
    chunks = reader.storage.chunks
    return bool(chunks) and all(chunk.channel_count for chunk in chunks)


def _is_bounded(reader: Any, size: int) -> bool:
    """Return whether the chunks in an MCAP file's index are distinct, and not larger than allowed when decompressed."""
    chunks = reader.storage.chunks
    different = len({chunk.chunk_start_offset for chunk in chunks}) == len(chunks)
    return different and sum(chunk.uncompressed_size for chunk in chunks) <= most_unpacked(size)


def _read_metadata(folder: Path) -> _Metadata | None:
    """Return the contents of metadata.yaml, None if there is none.

    A program made the file, and only two of its keys are needed: a search line by line finds them even if the file is
    damaged elsewhere.

    Raises
    ------
    BagError
        If it is far too large.
    """
    path = folder / 'metadata.yaml'
    if not path.is_file():
        return None
    try:
        with path.open('rb') as file:
            content = file.read(LARGEST_METADATA + 1)
    except OSError:  # not readable; the storage files suffice
        return None
    if len(content) > LARGEST_METADATA:
        raise BagError(f'{path} has more than {megabytes(LARGEST_METADATA)}; it is not the metadata of a bag.')
    lines = content.decode('utf-8', errors='replace').split('\n')
    modes = (re.match(r'[ \t]*compression_mode:[ \t]*["\']?(file|message)\b', line, re.IGNORECASE) for line in lines)
    mode = next((match[1].lower() for match in modes if match), '')
    key = re.compile(r'[ \t]*relative_file_paths:(.*)')
    first, listed = next(((n, match[1]) for n, line in enumerate(lines) if (match := key.match(line))), (0, ''))
    names = _flow_items(lines, first, listed) if listed.strip().startswith('[') else _block_items(lines[first + 1 :])
    return _Metadata([PurePath(name).name for name in names if PurePath(name).name], mode)


def _block_items(lines: list[str]) -> Iterator[str]:
    """Yield the items of a YAML list with each item on its own lines, the first of which begins with a dash."""
    item = ''
    depth = -1
    for line in lines:
        text = line.strip()
        indent = len(line) - len(line.lstrip())
        if text.startswith('- ') and indent >= max(depth, 0):
            if item:
                yield _unquoted(item)
            item, depth = text[2:].strip(), indent
        elif text and item and indent > depth:
            # a long name is wrapped at a space
            item = f'{item} {text}'
        elif text:
            break
    if item:
        yield _unquoted(item)


def _flow_items(lines: list[str], first: int, begin: str) -> Iterator[str]:
    """Yield the items of a YAML list in brackets that begins with `begin` and may continue after the line `first`."""
    text = ' '.join([begin.strip()[1:], *lines[first + 1 : first + 1 + MOST_FILES]])
    for match in re.finditer(r'("(?:[^"\\]|\\.)*"|\'(?:[^\']|\'\')*\'|[^],"\'][^],]*)|(\])', text):
        if match[2]:
            return
        if match[1].strip():
            yield _unquoted(match[1].strip())


def _unquoted(item: str) -> str:
    """Return the value of a YAML scalar; the only escapes are those of quotes, backslashes and character codes."""
    if item[:1] == "'" and item[-1:] == "'" and len(item) > 1:
        return item[1:-1].replace("''", "'")
    if item[:1] == '"' and item[-1:] == '"' and len(item) > 1:
        codes = re.compile(r'\\(?:x([0-9a-fA-F]{2})|u([0-9a-fA-F]{4})|U([0-9a-fA-F]{8})|(.))')

        def plain(match: re.Match[str]) -> str:
            code = match[1] or match[2] or match[3]
            return chr(min(int(code, 16), 0x10FFFF)) if code else match[4]

        return codes.sub(plain, item[1:-1])
    return item


def _magic(file: Path) -> bytes:
    with file.open('rb') as stream:
        return stream.read(16)


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sorting key that puts bag_10 after bag_9."""
    return [(int(part), '') if part.isdecimal() else (-1, part) for part in re.split(r'(\d+)', name)]
