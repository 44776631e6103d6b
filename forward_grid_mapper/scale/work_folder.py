"""The folder of a job: all data that workers exchange, in files that are complete or do not exist.

manifest.json                                   description of the job; the folder of another job is refused
lock                                            locked while a command works in the folder
drives/0007.json                                data of a drive, once it is placed
readings/row=3/column=-1/drive_0007.parquet     readings of a drive that touch a tile or come near it
ground/row=3/column=-1/drive_0007.parquet       cells of a tile that the drive traversed
plan.json                                       the grid and the order of drives, once all are placed
tiles/3_-1/                                     data of a tile: see `tile_work`

A file is written under another name and renamed. So a worker that dies leaves no incomplete file, and an existing one
need not be made again: tasks check for it first.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import os
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import OutputError
from ..files.output_folder import output_errors
from ..files.report import json_text

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class WorkFolder:
    """The paths of the files of a job."""

    path: str

    @property
    def root(self) -> Path:
        """The folder."""
        return Path(self.path)

    @property
    def manifest(self) -> Path:
        """The description of the job."""
        return self.root / 'manifest.json'

    @property
    def plan(self) -> Path:
        """The grid and the order of drives."""
        return self.root / 'plan.json'

    @property
    def placed(self) -> bool:
        """Return whether any drive has been placed."""
        return any((self.root / 'drives').glob('*.json'))

    def drive(self, number: int) -> Path:
        """Return the path of a drive's data."""
        return self.root / 'drives' / f'{number:04d}.json'

    def parts(self, kind: str, row: int, column: int) -> Path:
        """Return the folder of the drives' data for a tile; `kind` is readings or ground."""
        return self.root / kind / f'row={row}' / f'column={column}'

    def tile(self, row: int, column: int, name: str) -> Path:
        """Return the path of a file of a tile."""
        return self.root / 'tiles' / f'{row}_{column}' / name

    def begin(self, job: Mapping[str, Any]) -> bool:
        """Create the folder for a job, or continue in it; return whether it existed before.

        Raises
        ------
        OutputError
            If the folder belongs to another job, contains anything else, or cannot be written.
        """
        described = json.loads(json_text(job))
        if self.manifest.exists():
            before = read_json(self.manifest)
            if before != described:
                differ = ', '.join(key for key in {**before, **described} if before.get(key) != described.get(key))
                raise OutputError(
                    f'{self.path} contains the work of another job (they differ in {differ}): remove it, or choose '
                    'another folder with --work'
                )
            return True
        with output_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            if any(entry for entry in self.root.iterdir() if not entry.name.endswith(PARTIAL)):
                raise OutputError(f'{self.path} is not empty, and contains no job; choose another folder with --work')
        write_json(self.manifest, described)
        return False

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder, after `begin`, for a block: another command would remove it while this one works in it.

        Raises
        ------
        OutputError
            If another command works in it.
        """
        path = self.root / 'lock'
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:  # the other command has removed it since `begin`
            raise OutputError(self._in_use()) from None
        except OSError as error:
            raise OutputError(f'{path} cannot be written: {error.strerror}') from error
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OutputError(self._in_use()) from None
            except OSError as error:
                # some network file systems have no locks
                if error.errno not in _NO_LOCKS:
                    raise OutputError(f'{path} cannot be locked: {error.strerror}') from error
            if not (path.exists() and os.path.samestat(path.stat(), os.fstat(file))):
                raise OutputError(self._in_use())
            yield
        finally:
            os.close(file)
            # NFS keeps a removed file, and so its folder, until it is closed
            with contextlib.suppress(OSError):
                self.root.rmdir()

    def _in_use(self) -> str:
        return (
            f'another process_bag works in {self.path}; wait until it has ended, or choose another folder with -o or '
            '--work'
        )


PARTIAL = '.partial'
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a name to write to, which is renamed to `path` when the block succeeds; if it fails, no file remains.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    partial = path.with_name(f'.{path.name}.{uuid.uuid4().hex[:8]}{PARTIAL}')
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            partial.replace(path)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a mapping; an existing file is kept until the new one is on the disk."""
    with whole(path) as partial, partial.open('w', encoding='utf-8') as file:
        file.write(json_text(data))
        file.flush()
        os.fsync(file.fileno())


def read_json(path: Path) -> dict[str, Any]:
    """Read a file of `write_json`.

    Raises
    ------
    OutputError
        If it cannot be read.
    """
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise OutputError(f'{path} cannot be read ({error}); remove the work folder to start the job again') from error
    return found


def write_arrays(path: Path, arrays: Arrays, outcome: Mapping[str, Any]) -> None:
    """Write arrays, and a mapping of plain values."""
    packed = io.BytesIO()
    np.savez(packed, outcome=np.array(json_text(outcome)), **arrays)  # type: ignore[arg-type]
    with whole(path) as partial:
        partial.write_bytes(packed.getbuffer())


def read_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """Return some of the arrays of a file."""
    with np.load(path, allow_pickle=False) as data:
        return [data[name] for name in names]


def outcome_in(path: Path) -> dict[str, Any] | None:
    """Return the mapping in a file of arrays; None if there is no such file."""
    try:
        (text,) = read_arrays(path, 'outcome')
    except FileNotFoundError:
        return None
    found: dict[str, Any] = json.loads(str(text))
    return found
