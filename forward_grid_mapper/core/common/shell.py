"""Commands that are printed for the user: quoted so that they run as printed for any file names."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def quoted(word: Path | str) -> str:
    """Return a word quoted for a POSIX shell; unprintable ones in the $'…' syntax of bash, ksh and zsh.

    A path that begins with a dash gets a leading `./`, so that no program takes it for an option.
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


def _interpreter() -> str:
    """Return the command of the running interpreter for a shell in this folder: `python3`, if that is the same one."""
    found = shutil.which('python3')
    if not sys.executable or (found and Path(found).absolute() == Path(sys.executable).absolute()):
        return 'python3'
    path = Path(sys.executable)
    return quoted(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def command_line(command: str, *words: Path | str) -> str:
    """Return the line that runs one of our commands with these arguments, also without an activated environment."""
    return module_line('forward_grid_mapper', command, *words)


def module_line(module: str, *words: Path | str) -> str:
    """Return the line that runs a module with the running interpreter."""
    return ' '.join([_interpreter(), '-m', module, *map(quoted, words)])
