"""Commands that are printed for the user to run: they run as they are printed, whatever the files are called."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path


def quoted(word: Path | str) -> str:
    """Return a word as a POSIX shell takes it; what cannot be shown is written as bash, ksh and zsh read it.

    A path that begins with a dash is led by `./`, so that no program takes it for an option.
    """
    text = os.fspath(word)
    if isinstance(word, Path) and text.startswith('-'):
        text = f'./{text}'
    try:
        text.encode(sys.stdout.encoding or 'ascii')
        shown = text.isprintable()
    except UnicodeEncodeError:
        shown = False
    if shown:
        return shlex.quote(text)
    codes = (chr(b) if 32 <= b < 127 and chr(b) not in "'\\" else f'\\x{b:02x}' for b in os.fsencode(text))
    return f"$'{''.join(codes)}'"


def command_line(command: str, *words: Path | str) -> str:
    """Return the line that runs one of our commands with these arguments."""
    return ' '.join(['python3 -m forward_grid_mapper', command, *map(quoted, words)])
