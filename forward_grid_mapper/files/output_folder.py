"""Folders and files that appear complete or not at all, and errors with a remedy."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.common.errors import OutputError


class TakenError(OutputError):
    """Another run writes the folder, or has made it meanwhile."""


_STAGING = re.compile(r'\.(?P<name>.+)\.[0-9a-f]{8}\.partial')
_FULL = {errno.ENOSPC, errno.EDQUOT}
# Errors that only writing can cause, so that they are always errors of the output.
_WRITE_ONLY = _FULL | {errno.EFBIG, errno.EROFS}


def readable(path: Path | str) -> str:
    """Return a path of any bytes as text that can be drawn and written as UTF-8."""
    try:
        return os.fsencode(path).decode('utf-8', 'backslashreplace')
    except UnicodeEncodeError:
        # already such text, with characters that file names of this locale cannot have
        return str(path).encode('utf-8', 'backslashreplace').decode('utf-8')


def distinguished(paths: Sequence[str]) -> list[str]:
    """Return the shortest end of each path that distinguishes it from the others: two `bag` get their folders."""
    parts = [Path(path).parts or (path,) for path in paths]
    names = []
    for mine in parts:
        others = {other for other in parts if other != mine}
        size = next((k for k in range(1, len(mine)) if all(other[-k:] != mine[-k:] for other in others)), len(mine))
        names.append(str(Path(*mine[-size:])))
    return names


def expanded(path: Path | str) -> Path:
    """Return a path with a `~` at its beginning replaced by the home folder.

    Raises
    ------
    OutputError
        If there is no such user.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise OutputError(f'{readable(path)}: there is no user {Path(path).parts[0][1:]}') from None


def unwritable(folder: Path | str) -> str:
    """Return the reason why a folder, which need not exist yet, cannot be written; '' if it seems possible."""
    try:
        path = expanded(folder).absolute()
    except OutputError as error:
        return str(error)
    # Path.exists raises if a parent cannot be searched
    there = next(parent for parent in (path, *path.parents) if os.access(parent, os.F_OK))
    if not there.is_dir():
        return f'{readable(there)} is not a folder'
    return '' if os.access(there, os.W_OK | os.X_OK) else f'{readable(there)} is not writable'


@contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Turn an `OSError` from writing `path` into an `OutputError`.

    Raises
    ------
    OutputError
        Instead of every `OSError` of the block.
    """
    try:
        yield
    except OSError as error:
        raise _output_error(path, error) from error


@contextmanager
def output_folder(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder to write into, which is renamed to `path` when the block succeeds.

    Before that, nothing exists under the final name, and the temporary folder is removed if the block fails; that of a
    run that was killed is removed by the next one with the same `path`. Missing parents are made. An empty folder that
    exists already is filled, not replaced: it may be a mount point or the shell's working directory.

    Parameters
    ----------
    path : Path or str
        The folder to make; it must not exist, or must be empty.

    Yields
    ------
    Path
        The temporary folder.

    Raises
    ------
    OutputError
        If the folder is not empty, cannot be made, or the disk is full.
    TakenError
        If another run writes it now, or has made it when the block has succeeded.
    """
    final = Path(os.path.abspath(path))  # noqa: PTH100 (links are kept, so no resolve)
    with output_errors(final):
        _remove_abandoned(final)
        exists = _is_empty_folder(final)
        made = [] if exists else _make_parents(final.parent)
        try:
            staging, lock = _locked_folder(final, final if exists else final.parent)
        except OSError:
            _remove_empty(made)
            raise
    done = False
    try:
        yield staging
        with output_errors(final):
            if exists:
                for entry in sorted(staging.iterdir()):
                    entry.rename(final / entry.name)
                staging.rmdir()
            else:
                staging.rename(final)
        done = True
    except OutputError as error:
        # users do not know the temporary name
        raise type(error)(str(error).replace(str(staging), str(final))) from error
    except OSError as error:
        if error.errno in _WRITE_ONLY:
            raise _output_error(final, error) from error
        raise
    finally:
        if not done:
            shutil.rmtree(staging, ignore_errors=True)
        os.close(lock)
        if not done:
            # NFS keeps a removed folder until it is closed
            _remove_empty(made)


def _locked_folder(final: Path, parent: Path) -> tuple[Path, int]:
    """Make a temporary folder for `final`; return it with a descriptor that holds its lock until it is closed."""
    while True:
        staging = parent / f'.{final.name}.{uuid.uuid4().hex[:8]}.partial'
        staging.mkdir()
        # another run that began at the same time may lock it first, and remove it
        try:
            lock = os.open(staging, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue
        # some network file systems have no locks
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        if staging.is_dir():
            return staging, lock
        os.close(lock)


def _remove_abandoned(final: Path) -> None:
    """Remove the temporary folders for `final` that runs left when they were killed.

    Raises
    ------
    TakenError
        If one is of a run that still writes.
    """
    for parent in (final, final.parent):
        if final.name in remove_abandoned(parent, re.compile(re.escape(final.name))):
            raise TakenError(f'another run writes {final} now; wait until it has ended, or choose another folder')


def remove_abandoned(parent: Path, names: re.Pattern[str]) -> set[str]:
    """Remove the temporary folders in `parent` that runs left when they were killed.

    Parameters
    ----------
    parent : Path
    names : pattern
        Final names of the folders to remove.

    Returns
    -------
    set of str
        Final names of those that other runs write now.
    """
    in_use: set[str] = set()
    try:
        entries = os.listdir(parent)  # noqa: PTH208 (names of any bytes, and few of them)
    except OSError:
        # not made yet, or not a folder, or the reason why it cannot be written is found next
        return in_use
    for entry in entries:
        match = _STAGING.fullmatch(entry)
        if match is None or not names.fullmatch(match['name']):
            continue
        try:
            lock = os.open(parent / entry, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(parent / entry, ignore_errors=True)
        except BlockingIOError:
            in_use.add(match['name'])
        except OSError:  # some network file systems have no locks, so it may be in use
            pass
        finally:
            os.close(lock)
    return in_use


def free_name(parent: Path | str, stem: str) -> Path:
    """Return the first of `stem`, `stem_2`, `stem_3`, … that does not exist in `parent`, and that no run writes.

    The temporary folders of these names that runs left when they were killed are removed.

    Raises
    ------
    OutputError
        If `parent` cannot be searched.
    """
    parent = Path(parent)
    with output_errors(parent):
        taken = remove_abandoned(parent, re.compile(rf'{re.escape(stem)}(_\d+)?'))
        # a name that is in use above may be complete by now, so that this look comes second
        taken |= set(os.listdir(parent)) if parent.exists() else set()  # noqa: PTH208 (one look, not one per name)
    names = itertools.chain([stem], (f'{stem}_{n}' for n in itertools.count(2)))
    return parent / next(name for name in names if name not in taken)


def _is_empty_folder(path: Path) -> bool:
    """Return True for an empty folder, False for an unused name; raise otherwise."""
    if not os.path.lexists(path):
        return False
    if not path.is_dir():
        raise OutputError(f'{path} is a file; choose another folder')
    if any(path.iterdir()):
        raise OutputError(f'{path} exists and is not empty; choose another folder, or remove it first')
    return True


def _make_parents(folder: Path) -> list[Path]:
    """Make `folder` with its parents; return those that were missing, innermost first."""
    missing = list(itertools.takewhile(lambda p: not p.exists(), (folder, *folder.parents)))
    if not missing and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        _remove_empty(missing)
        raise
    return missing


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _output_error(path: Path, error: OSError) -> OutputError:
    path = _as_asked_for(path)
    if error.errno in _FULL:
        return OutputError(f'{path}: the disk is full; free some space, or choose another folder')
    if error.errno == errno.ENOTDIR:
        return OutputError(f'{path}: a part of this path is a file, not a folder; choose another folder')
    if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
        # another run used the name meanwhile
        return TakenError(f'{path} has been created meanwhile, perhaps by another run; choose another folder')
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return OutputError(f'{path}: no permission to write there; choose another folder')
    return OutputError(f'{path} cannot be written: {error.strerror or error}')


def _as_asked_for(path: Path) -> Path:
    """Return a path with temporary folders of `output_folder` replaced by their final names."""
    parts: list[str] = []
    for part in path.parts:
        if match := _STAGING.fullmatch(part):
            # a nested one has the same final name as its parent
            if not (parts and parts[-1] == match['name']) and not _STAGING.fullmatch(match['name']):
                parts.append(match['name'])
        else:
            parts.append(part)
    return Path(*parts)
