"""Reads text files that people write: at most as many bytes as such a file can have, for any path."""

from __future__ import annotations

from pathlib import Path

from ..core.common.errors import MapperError

MOST_BYTES = 1_000_000
"""Most bytes of a parameter file or the YAML of a map; ours have 12 000, and YAML takes a second for the bound."""


def read_text(path: Path, error: type[MapperError]) -> str:
    """Return the text of a UTF-8 file.

    Raises
    ------
    error
        Naming the file, if it is larger than `MOST_BYTES`, or not UTF-8.
    OSError
        If it cannot be read.
    """
    with path.open('rb') as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise error(f'{path} has more than {MOST_BYTES:,} bytes; it is not a file of this kind')
    try:
        return content.decode('utf-8')
    except UnicodeDecodeError as reason:
        raise error(f'{path} is not text in UTF-8, from byte {reason.start} on; save it in this encoding') from reason
