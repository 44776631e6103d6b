"""Bags that rosbag2 compressed: file by file, or message by message."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from backports import zstd

from ..core.common.errors import BagError
from .bounds import LARGEST_MESSAGE, megabytes, most_unpacked, unpack
from .repair import repair_hint
from .source import RawMessage, Source, one_line

_PIECE = 1 << 20
"""Bytes that are decompressed at once."""

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a full disk, or an exhausted quota."""


class NoSpaceError(BagError):
    """The contents of a compressed bag do not fit into the temporary folder; the bag is not damaged."""


class UnpackedMessages:
    """A source whose messages are compressed one by one.

    Parameters
    ----------
    source : Source
    marked : bool
        Whether only messages that begin with the mark of zstd are compressed, because no metadata state it.
    """

    def __init__(self, source: Source, *, marked: bool = False) -> None:
        self._source = source
        self.channels, self.span = source.channels, source.span
        # a message in CDR begins with 0, while one of ROS 1 may begin with any number
        self._plain = {channel.key for channel in source.channels if channel.encoding != 'cdr'} if marked else set()
        self._mark = ZSTD_MAGIC if marked else b''

    @property
    def damage(self) -> str | None:
        """The reason why not everything could be read, as far as known."""
        return self._source.damage

    @damage.setter
    def damage(self, damage: str | None) -> None:
        self._source.damage = damage

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        """Yield the messages of these channels by log time; empty, which is invalid, if they cannot be decompressed."""
        for key, time, data in self._source.messages(keys):
            if key in self._plain or not data.startswith(self._mark):
                yield key, time, data
                continue
            try:
                raw = unpack('zstd', data, LARGEST_MESSAGE)
            except Exception:  # too large, or errors of the library for damaged bytes
                raw = b''
            yield key, time, raw

    def close(self) -> None:
        """Release the file."""
        self._source.close()


class _InFolder:
    """A source in a temporary folder, which is deleted with it; `cut` is why the source is not complete, or None."""

    def __init__(self, source: Source, folder: Path, cut: str | None) -> None:
        self._source, self._folder, self._cut = source, folder, cut
        self.channels, self.span = source.channels, source.span

    @property
    def damage(self) -> str | None:
        # what the source itself lacks follows from it
        return self._cut or self._source.damage

    @damage.setter
    def damage(self, damage: str | None) -> None:
        self._source.damage = damage

    def messages(self, keys: Collection[int]) -> Iterator[RawMessage]:
        return self._source.messages(keys)

    def close(self) -> None:
        try:
            self._source.close()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)


def open_unpacked(file: Path, open_file: Callable[[Path], Source]) -> Source:
    """Decompress a storage file, such as bag_0.db3.zstd, into a temporary folder and open it there.

    Of a file that is damaged or cut off, the part before the damage is read.

    Raises
    ------
    NoSpaceError
        If it does not fit into the temporary folder.
    BagError
        Naming the file, if nothing of it can be read, or if it is larger than allowed when decompressed.
    """
    if not file.is_file():
        raise BagError(f'{file} is not a regular file; give a bag folder or a .mcap, .db3 or .bag file.')
    folder = _temporary_folder(file)
    try:
        unpacked = folder / file.stem
        cut = _unpack(file, unpacked)
        return _InFolder(open_file(unpacked), folder, cut)
    except (PermissionError, NoSpaceError):
        shutil.rmtree(folder, ignore_errors=True)
        raise
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if not isinstance(error, Exception):
            raise
        # users do not know the temporary name
        reason = one_line(error).replace(str(unpacked), 'what it holds')
        raise BagError(f'{file} is damaged or cut off ({reason}); {repair_hint(file)}.') from error


def _temporary_folder(file: Path) -> Path:
    try:
        return Path(tempfile.mkdtemp(prefix='forward_grid_mapper_'))
    except OSError as error:
        raise NoSpaceError(
            f'{file} is compressed, and there is no temporary folder to unpack it in ({one_line(error)}); set TMPDIR '
            f'to a folder that you can write.'
        ) from error


def _unpack(packed: Path, unpacked: Path) -> str | None:
    """Decompress a file; return why only its beginning could be decompressed, or None.

    Raises
    ------
    NoSpaceError
        If there is not enough space.
    BagError
        If it is larger than allowed.
    Exception
        Of the library, if nothing could be decompressed.
    """
    most, free = most_unpacked(packed.stat().st_size), shutil.disk_usage(unpacked.parent).free
    done = 0
    try:
        with zstd.open(packed, 'rb') as source, unpacked.open('wb') as target:
            while piece := _piece(source):
                if isinstance(piece, Exception):
                    if not done:
                        raise piece
                    return one_line(piece)
                done += len(piece)
                if done > most:
                    raise BagError(f'it unpacks to more than {megabytes(most)}')
                if done > free:
                    raise _no_space(packed, free)
                target.write(piece)
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise _no_space(packed, free) from error
    return None


def _piece(source: zstd.ZstdFile) -> bytes | Exception:
    """Return the next decompressed bytes, or the exception for damaged ones."""
    try:
        # read would lose what it has decompressed before the damage
        return source.read1(_PIECE)
    except (EOFError, zstd.ZstdError) as error:
        return error


def _no_space(packed: Path, free: int) -> NoSpaceError:
    return NoSpaceError(
        f'{packed} is compressed, and its content does not fit into {tempfile.gettempdir()}, where {megabytes(free)} '
        'were free; set TMPDIR to a folder on a disk with more space.'
    )
