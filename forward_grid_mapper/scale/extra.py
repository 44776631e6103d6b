"""The packages that `scale` requires, and how to install them."""

from __future__ import annotations

import importlib

from ..core.common.errors import ParameterError

PACKAGES = ('dask', 'distributed', 'pyarrow', 'zarr')


def installed(name: str) -> bool:
    """Return whether a package can be imported."""
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def need() -> None:
    """Check that the extra *scale* is installed.

    Raises
    ------
    ParameterError
        Otherwise; the message is how to install it.
    """
    for name in PACKAGES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ParameterError(
                f"workers need {name}, which cannot be imported ({error}): pip install 'forward_grid_mapper[scale]', "
                f'or .[scale] in a checkout. Without it, --tiles maps in one process'
            ) from error
