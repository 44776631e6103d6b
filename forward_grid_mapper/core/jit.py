"""Compilation of kernels: always without the GIL, cached on disk wherever a cache can be kept."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

config: Any = numba.config
F = TypeVar('F', bound=Callable[..., Any])


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _place_cache() -> None:
    """Give numba a cache folder where neither the package nor the home can be written.

    Numba looks for one beside the source and then in the user's cache, and refuses to load a cached kernel when it
    finds none. A temporary folder of the user's own still spares later starts the compilation.
    """
    if config.CACHE_DIR or _writable(Path(__file__).parent / '__pycache__'):
        return
    home = Path(os.environ.get('XDG_CACHE_HOME') or Path(os.environ.get('HOME', '/')) / '.cache')
    if not _writable(home / 'numba'):
        config.CACHE_DIR = str(Path(tempfile.gettempdir()) / f'forward_grid_mapper_{os.getuid()}')


_place_cache()


def kernel(function: F) -> F:
    """Compile `function` at its first call, free of the GIL; keep the machine code on disk."""
    compiled: Any = numba.njit(cache=True, nogil=True, error_model='numpy')(function)
    return cast(F, compiled)
