"""Pictures of the maps of `quality.py`: the truth, the standard map, the paper's maximum likelihood map and ours."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from quality_scores import Figures, Standard, score
from quality_worlds import Case

from forward_grid_mapper.commands.experiment_maps import GAINS
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.files.figure import write_figure
from forward_grid_mapper.files.panels import FigureTile

SHOWN = ('corridor 15°', 'office 15°', 'clutter 30°', 'office_a', 'office_b')
MARGIN = 0.3
WIDE = 2.6
"""Ratio of width to height from which maps are stacked."""


def draw_pictures(
    folder: Path, groups: dict[str, list[Case]], base: dict[str, Any], paper: dict[str, Any], tool: ModuleType | None
) -> None:
    """Draw the first case of each group in `SHOWN`, if it exists."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in SHOWN:
        if name in groups:
            _draw(folder / f'quality_{name.split()[0]}.png', groups[name][0], base, paper, tool)


def _label(title: str, f: Figures) -> str:
    return f'{title}\nF1 {f.f1:.2f}, nav_iou {f.nav_iou:.2f}, {f.dots:.0f} false dots'


def _draw(path: Path, case: Case, base: dict[str, Any], paper: dict[str, Any], tool: ModuleType | None) -> None:
    standard = Standard(case, tool)
    gains = max(GAINS, key=standard.f1)
    grid, ml = standard.map(gains)
    tiles = [FigureTile(_label('standard map, gains of the best F1', standard.figures(gains)), grid, ml)]
    for title, flat in (("paper's plain ML", paper), ('default', base)):
        maps = Mapper(Parameters().varied(flat)).run(case.readings)
        tiles.append(FigureTile(_label(title, score(maps.ml, maps.grid, case, tool)), maps.grid, maps.ml))
    tiles.append(FigureTile('default: probability of an obstacle', maps.grid, maps.uncertainty))
    height, width = case.truth.shape
    column, row = (round(v / case.resolution) for v in case.origin)
    truth = FigureTile('truth', Grid(case.resolution, column, row, width, height), case.truth)
    rows, columns = np.nonzero(case.truth > 0.5)
    left, right = case.origin[0] + case.resolution * np.array([columns.min(), columns.max() + 1])
    bottom, top = case.origin[1] + case.resolution * np.array([rows.min(), rows.max() + 1])
    view = (left - MARGIN, right + MARGIN, bottom - MARGIN, top + MARGIN)
    if (view[1] - view[0]) / (view[3] - view[2]) > WIDE:
        table = [[truth], *([tile] for tile in tiles)]
    else:
        table = [[truth, tiles[0], tiles[1]], [tiles[2], tiles[3]]]
    write_figure(path, case.group, table, view)
