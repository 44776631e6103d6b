"""What of a bag could not be read, and what can be done about it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..core.common.shell import quoted
from . import scan_mcap, scan_rosbag1, scan_sqlite3

_SUFFIXES = {scan_mcap.MAGIC: '.mcap', scan_sqlite3.MAGIC: '.db3', scan_rosbag1.MAGIC: '.bag'}
_REPAIR = {
    '.mcap': 'mcap recover {0} -o repaired.mcap',
    # .recover needs an extension that Debian and Ubuntu leave out
    '.db3': 'sqlite3 {0} .dump | sed "s/^ROLLBACK.*/COMMIT;/" | sqlite3 repaired.db3',
    '.bag': 'rosbag reindex {0}',
}


class Problem(NamedTuple):
    """The reason why a part of a bag cannot be read, and a remedy; '' if there is none, or the reason names it."""

    reason: str
    remedy: str = ''


def reasons_of(problems: Sequence[Problem]) -> str:
    """Return the reasons, without repetitions."""
    return '; '.join(dict.fromkeys(problem.reason for problem in problems))


def remedies_of(problems: Sequence[Problem]) -> str:
    """Return the remedies, without repetitions, each after a semicolon; '' if there is none."""
    return ''.join(f'; {remedy}' for remedy in dict.fromkeys(problem.remedy for problem in problems) if remedy)


def repair_hint(file: Path) -> str:
    """Return a hint on the repair of a damaged storage file, which reindexing its folder would not change."""
    suffix = file.suffix
    try:
        with file.open('rb') as stream:
            magic = stream.read(16)
        suffix = next((name for key, name in _SUFFIXES.items() if magic.startswith(key)), suffix)
    except OSError:  # the suffix is used instead
        pass
    if suffix == '.zstd':
        # to standard output, since zstd deletes the file it has made from one that is cut off
        plain = file.with_suffix('')
        return f'unpack it with `zstd -dc {quoted(file)} > {quoted(plain)}`, and {repair_hint(plain)}'
    return f'repair it with `{_REPAIR[suffix].format(quoted(file))}`' if suffix in _REPAIR else 'copy it again'
