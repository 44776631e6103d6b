"""Which recordings are meant: paths, patterns such as `monday_*`, and folders of bags."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from ..core.common.errors import BagError
from ..files.journal import drive_file

SUFFIXES = ('.mcap', '.db3', '.bag')

_PART = re.compile(r'_\d+$')
"""How rosbag2 ends the names of the files of one bag."""


def find_recordings(words: Sequence[Path | str]) -> list[Path]:
    """Return the bags and journals that are meant, in the order given, those of a folder by name.

    A word that names nothing, or something else than a bag, is returned as it is: what reads it says best what is
    wrong.

    Raises
    ------
    BagError
        If a pattern fits nothing.
    """
    found: list[Path] = []
    for word in words:
        path = Path(word)
        if not path.exists() and glob.has_magic(str(word)):
            matches = [Path(name) for name in sorted(glob.glob(str(word)), key=_natural)]  # noqa: PTH207 (absolute too)
            if not matches:
                raise BagError(f'no file or folder fits {word}')
            found += [bag for match in matches for bag in _bags_of(match) or [match]]
        else:
            found += _bags_of(path) or [path]
    return found


def _bags_of(path: Path) -> list[Path]:
    """Return the bags in a folder that is no bag itself; empty if `path` is anything else."""
    if not path.is_dir() or (path / 'metadata.yaml').is_file():
        return []
    try:
        if drive_file(path) is not None:
            return []
        inside = sorted(path.iterdir(), key=lambda entry: _natural(entry.name))
    except OSError:
        return []
    files = [entry for entry in inside if entry.suffix in SUFFIXES and entry.is_file()]
    folders = [entry for entry in inside if entry.is_dir() and (entry / 'metadata.yaml').is_file()]
    # files of one bag that lost its metadata are not several drives
    stems = {_PART.sub('', file.stem) for file in files}
    if len(files) == 1 and not folders:
        return []
    if len(files) > 1 and len(stems) == 1:
        return []
    return [*folders, *files]


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sorting key that puts day_10 after day_9."""
    return [(int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'(\d+)', name)]
