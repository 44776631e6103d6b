"""Compilation of kernels: always without the GIL, cached on disk wherever a cache can be kept."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

config: Any = numba.config
F = TypeVar('F', bound=Callable[..., Any])

CORE = Path(__file__).parents[1]
"""The folder below which all kernels are."""

PREFIX = 'kernels_'

UNUSED = 24 * 3600
"""Seconds after its last start from which on machine code of other sources is removed; a process that runs longer has
all of its kernels in memory."""


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _cache_folder() -> str:
    """Return the folder for machine code of these very sources.

    Numba renews a kernel when its own file changes, but not when a kernel that it calls does; so the folder's name
    depends on all sources. It lies beside them, in the user's cache where they are read-only, or in a temporary folder
    where the home is as well, which still spares later starts the compilation.
    """
    sources = b''.join(path.read_bytes() for path in sorted(CORE.rglob('*.py')))
    name = f'{PREFIX}{hashlib.sha256(sources).hexdigest()[:16]}'
    home = Path(os.environ.get('XDG_CACHE_HOME') or Path(os.environ.get('HOME', '/')) / '.cache')
    for folder in (config.CACHE_DIR, CORE / '__pycache__', home / 'forward_grid_mapper'):
        if folder and _writable(Path(folder)):
            return str(Path(folder) / name)
    shared = Path(tempfile.gettempdir()) / f'forward_grid_mapper_{os.getuid()}'
    shared.mkdir(mode=0o700, exist_ok=True)
    owner = shared.lstat()
    # machine code is run as it is found, so it must not be possible for others to have put it there
    if owner.st_uid != os.getuid() or owner.st_mode & 0o077 or shared.is_symlink():
        shared = Path(tempfile.mkdtemp(prefix='forward_grid_mapper_'))
    return str(shared / name)


def _remove_unused(cache: Path) -> None:
    """Remove the machine code of other sources beside `cache` that no process has started with for a day."""
    with suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        # numba reads the folder, and does not touch it
        os.utime(cache)
        for other in cache.parent.glob(f'{PREFIX}*'):
            if other != cache and time.time() - other.stat().st_mtime > UNUSED:
                shutil.rmtree(other, ignore_errors=True)


CACHE = _cache_folder()
_remove_unused(Path(CACHE))


def _compiled(function: F, **options: Any) -> F:
    # without wrappers for C, from which nothing calls a kernel
    options = {'cache': True, 'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, **options}
    before, config.CACHE_DIR = config.CACHE_DIR, CACHE
    try:
        compiled: Any = numba.njit(**options)(function)
    finally:
        config.CACHE_DIR = before
    return cast(F, compiled)


def kernel(function: F) -> F:
    """Compile `function` at its first call, free of the GIL; keep the machine code on disk.

    A kernel borrows the arrays of its caller: it neither makes any nor counts references, which would take longer than
    the work where a tuple of many arrays is handed to a function for each reading. If it returns arrays, then only to
    other kernels of this kind.
    """
    return _compiled(function, _nrt=False)


def allocating_kernel(function: F) -> F:
    """Do as `kernel` does, for a function that makes arrays."""
    return _compiled(function)
