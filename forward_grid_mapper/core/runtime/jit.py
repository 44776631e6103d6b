"""Compilation of kernels with numba: they release the GIL, and are cached on disk if there is a writable folder."""

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
"""Machine code of other sources is removed this many seconds after its last use at a start; a process that runs longer
has all its kernels in memory."""


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _cache_folder() -> str:
    """Return the folder for the machine code of exactly these sources.

    Numba compiles a kernel again if its own file changes, but not if a kernel that it calls does. So the name of the
    folder depends on all sources. It is beside them, or in the user's cache if they are read-only, or in a temporary
    folder if that is read-only, too; this still saves the compilation at later starts.
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
    # machine code is executed without checks, so other users must not be able to write there
    if owner.st_uid != os.getuid() or owner.st_mode & 0o077 or shared.is_symlink():
        shared = Path(tempfile.mkdtemp(prefix='forward_grid_mapper_'))
    return str(shared / name)


def _remove_unused(cache: Path) -> None:
    """Remove the machine code of other sources beside `cache` that no process has started with for a day."""
    with suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        # numba only reads, which does not change the time of the folder
        os.utime(cache)
        for other in cache.parent.glob(f'{PREFIX}*'):
            if other != cache and time.time() - other.stat().st_mtime > UNUSED:
                shutil.rmtree(other, ignore_errors=True)


CACHE = _cache_folder()
_remove_unused(Path(CACHE))


def _compiled(function: F, **options: Any) -> F:
    # without C wrappers, since kernels are not called from C
    options = {'cache': True, 'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, **options}
    before, config.CACHE_DIR = config.CACHE_DIR, CACHE
    try:
        compiled: Any = numba.njit(**options)(function)
    finally:
        config.CACHE_DIR = before
    return cast(F, compiled)


def kernel(function: F) -> F:
    """Compile `function` at its first call, without the GIL; the machine code is cached on disk.

    A kernel borrows the arrays of its caller: it allocates none and counts no references. Counting would take longer
    than the work if a tuple of many arrays is passed to a function for each reading. It may return arrays only to other
    kernels of this kind.
    """
    return _compiled(function, _nrt=False)


def inlined_kernel(function: F) -> F:
    """Do the same as `kernel`, for a function that the compiler inserts into the kernels that call it.

    For functions that are called for each reading or cell: passing them a tuple of dozens of arrays takes longer than
    their work. Numba makes a type of its own of a literal, and compiles a function again for it; so callers pass
    `np.int64(0)` in place of 0, where this would happen.
    """
    return _compiled(function, _nrt=False, forceinline=True)


def allocating_kernel(function: F) -> F:
    """Do the same as `kernel`, for a function that allocates arrays."""
    return _compiled(function)
