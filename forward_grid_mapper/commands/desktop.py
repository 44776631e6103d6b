"""Opens a result with the desktop's viewer, or prints its path."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path


def show(path: Path) -> None:
    """Open a file with the desktop's viewer; without a desktop, print on stderr how to open it."""
    where = path.resolve()
    opener = _opener()
    if opener is not None:
        with open(os.devnull, 'r+b') as nothing:  # noqa: PTH123 (Path has no name for it)
            try:
                # the viewer continues after this process
                subprocess.Popen([opener, str(where)], stdin=nothing, stdout=nothing, stderr=nothing)
                return
            except OSError as error:
                print(f'{opener} does not start: {error}', file=sys.stderr)
    print(f'no desktop was found; open {where.as_uri()} in a browser', file=sys.stderr)


def _opener() -> str | None:
    """Return the program that opens files on this desktop; None without one."""
    if sys.platform == 'darwin':
        return shutil.which('open')
    if not os.environ.get('DISPLAY') and not os.environ.get('WAYLAND_DISPLAY'):
        return None
    return shutil.which('xdg-open')
