"""Finds recordings: paths, patterns such as `monday_*`, and folders of bags."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..bags.opening import natural_order, plain_name, storage_files
from ..core.common.errors import BagError
from ..files.journal import drive_file
from ..files.output_folder import readable

_PART = re.compile(r'_\d+$')
"""End of the names of a split bag's files in rosbag2."""

_UNFINISHED = '.bag.active'
"""Suffix of a bag that `rosbag record` has not finished."""

_RESULTS = 'report.json'
"""A file in folders of results, whose bags contain maps."""


class Recordings(NamedTuple):
    """Paths of bags and journals, and warnings about similar files that are not among them."""

    paths: list[Path]
    skipped: list[str]


def find_recordings(words: Sequence[Path | str]) -> Recordings:
    """Return the bags and journals that are given, in this order; those of a folder are sorted by name.

    A word that is neither a pattern nor a folder of bags is returned unchanged: errors are left to the reader of bags.

    Raises
    ------
    BagError
        If a pattern matches nothing.
    """
    found = Recordings([], [])
    for word in words:
        path = Path(word)
        matches = [path]
        if not path.exists() and glob.has_magic(str(word)):
            matches = [Path(name) for name in sorted(glob.glob(str(word)), key=natural_order)]  # noqa: PTH207 (absolute too)
            if not matches:
                raise BagError(f'no file or folder matches {word}')
        for match in matches:
            bags, skipped = _bags_of(match)
            found.paths.extend(bags or [match])
            found.skipped.extend(skipped)
    return found


def _bags_of(path: Path) -> Recordings:
    """Return the bags in a folder that is not a bag itself; none if `path` is anything else."""
    nothing = Recordings([], [])
    try:
        if not path.is_dir() or (path / 'metadata.yaml').is_file() or drive_file(path) is not None:
            return nothing
        inside = sorted(path.iterdir(), key=lambda entry: natural_order(entry.name))
        files = _files_in(path)
        below = [entry for entry in inside if entry.is_dir() and not entry.name.startswith('.')]
        folders = [entry for entry in below if _is_bag(entry)]
        skipped = [entry for entry in below if entry not in folders and _holds_recordings(entry)]
    except OSError:
        return nothing
    skipped += [entry for entry in inside if entry.name.endswith(_UNFINISHED)]
    warnings = [_left_out(path, skipped)] if skipped else []
    # a single file, or the files of one bag without metadata, are not a folder of drives
    if _is_one(files) and (len(files) > 1 or not folders):
        return Recordings([], warnings)
    return Recordings([*folders, *files], warnings)


def _files_in(folder: Path) -> list[Path]:
    return [entry for entry in storage_files(folder) if entry.is_file()]


def _is_bag(folder: Path) -> bool:
    """Return whether a folder is a bag, with or without metadata; if it cannot be read, the reader of bags says so."""
    try:
        return (folder / 'metadata.yaml').is_file() or _is_one(_files_in(folder))
    except PermissionError:
        return True


def _is_one(files: Sequence[Path]) -> bool:
    """Return whether files belong to the same bag, by their names; each file of ROS 1 can be read by itself."""
    if len(files) > 1 and any(file.suffix == '.bag' for file in files):
        return False
    return len({_PART.sub('', Path(plain_name(file)).stem) for file in files}) == 1


def _holds_recordings(folder: Path) -> bool:
    """Return whether a folder that is not a bag is a journal, or a folder of bags."""
    if (folder / _RESULTS).is_file():
        return False
    return drive_file(folder) is not None or bool(_files_in(folder)) or any(folder.glob('*/metadata.yaml'))


def _left_out(path: Path, skipped: Sequence[Path]) -> str:
    names = ', '.join(entry.name for entry in skipped)
    return f'in {readable(path)} these are left out: {names}; if they are recordings, add them to the command line'
