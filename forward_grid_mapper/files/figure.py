"""A table of small maps, for comparing many at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..core.common.errors import OutputError
from .output_folder import output_errors
from .panels import Box, Tile


def write_figure(path: Path | str, title: str, rows: Sequence[Sequence[Tile]], view: Box) -> None:
    """Draw rows of maps of the same place, each showing the box `view` (left, right, bottom, top in metres).

    Raises
    ------
    OutputError
        If the file cannot be written, or matplotlib is not installed.
    """
    path = Path(path)
    try:
        from .drawing import draw_table
    except ImportError as error:
        raise OutputError(f'the figure needs matplotlib ({error}); install it with pip install matplotlib') from error
    with output_errors(path):
        draw_table(path, title, rows, view)
