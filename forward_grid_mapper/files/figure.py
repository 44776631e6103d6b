"""Figures of several maps, for comparison, and of a density."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from ..core.common.errors import OutputError
from .output_folder import output_errors
from .panels import Box, Curve, FigureTile


def write_figure(path: Path | str, title: str, rows: Sequence[Sequence[FigureTile]], view: Box) -> None:
    """Draw rows of maps of the same place, each with the box `view` (left, right, bottom, top in metres).

    Raises
    ------
    OutputError
        If the file cannot be written, or matplotlib is not installed.
    """
    path = Path(path)
    with output_errors(path):
        _drawing().draw_table(path, title, rows, view)


def write_density(path: Path | str, title: str, tile: FigureTile, curve: Curve) -> None:
    """Draw a map with a cone, and below it the density of the measured range.

    Raises
    ------
    OutputError
        If the file cannot be written, or matplotlib is not installed.
    """
    path = Path(path)
    with output_errors(path):
        _drawing().draw_density(path, title, tile, curve)


def _drawing() -> ModuleType:
    try:
        from . import drawing_tables
    except ImportError as error:
        raise OutputError(f'the figure needs matplotlib ({error}); install it with pip install matplotlib') from error
    return drawing_tables
