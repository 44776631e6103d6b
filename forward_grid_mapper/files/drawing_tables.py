"""Drawing of tables of maps, and of a density; requires matplotlib, like `drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Wedge

from ..core.common.readings import Readings
from .drawing import BEFORE, CAPTION, DOT, DPI, EDGE, FRAME, GAP, HEAD, INK, UNKNOWN, WIDE, draw_map, draw_scale
from .panels import PATH, Curve, FigureTile


def draw_table(
    path: Path, title: str, rows: Sequence[Sequence[FigureTile]], view: tuple[float, float, float, float]
) -> None:
    """Write a table of maps, all in the box `view`, to `path`."""
    aspect = (view[1] - view[0]) / (view[3] - view[2])
    width = 3.0 if aspect < WIDE else 13.0
    height, columns = width / aspect, max(len(row) for row in rows)
    page = 2 * EDGE + columns * width + (columns - 1) * GAP, EDGE + HEAD + len(rows) * (height + CAPTION)
    figure = Figure(figsize=page, dpi=DPI, facecolor='white')
    FigureCanvasAgg(figure)
    figure.text(EDGE / page[0], 1 - 0.45 / page[1], title, fontsize=14, fontweight='bold', color=INK)
    for r, row in enumerate(rows):
        for c, tile in enumerate(row):
            x, y = EDGE + c * (width + GAP), page[1] - HEAD - (r + 1) * (height + CAPTION) + 0.1
            axes = figure.add_axes((x / page[0], y / page[1], width / page[0], height / page[1]))
            axes.set_facecolor(UNKNOWN)
            shown = np.where(np.asarray(tile.values) < 0, np.nan, tile.values)
            draw_map(axes, shown, tile.grid.extent, (view[1] - view[0]) / (width * DPI))
            if tile.marked is not None:
                at_y, at_x = np.nonzero(tile.marked)
                centers_x, centers_y = tile.grid.centers()
                axes.scatter(centers_x[at_x], centers_y[at_y], s=9.0, marker='s', color=DOT, linewidths=0)
            axes.set(xlim=view[:2], ylim=view[2:], xticks=[], yticks=[])
            draw_scale(axes, view)
            if tile.readings is not None:
                _draw_cones(axes, tile.readings)
            _draw_ways(axes, tile)
            axes.set_title(tile.title, loc='left', fontsize=9.5, color=INK, pad=4)
            for spine in axes.spines.values():
                spine.set(color=FRAME, linewidth=0.7)
    figure.savefig(path)


def draw_density(path: Path, title: str, tile: FigureTile, curve: Curve) -> None:
    """Write a map with a cone, and the density below it on the same scale of metres, to `path`."""
    figure = Figure(figsize=(9.0, 8.8), dpi=DPI, facecolor='white')
    FigureCanvasAgg(figure)
    figure.text(0.05, 0.955, title, fontsize=14, fontweight='bold', color=INK)
    left, right, bottom, top = tile.grid.extent
    width = 0.88
    height = width * 9.0 * (top - bottom) / (right - left) / 8.8
    above = figure.add_axes((0.09, 0.91 - height, width, height))
    draw_map(above, np.asarray(tile.values, np.float64), tile.grid.extent, (right - left) / (width * 9.0 * DPI))
    above.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    above.set_title(tile.title, loc='left', fontsize=9.5, color=INK, pad=4)
    if tile.readings is not None:
        _draw_cones(above, tile.readings)
    below = figure.add_axes((0.09, 0.08, width, 0.80 - height), sharex=above)
    below.plot(curve.x, curve.y, color=PATH, linewidth=1.5)
    below.set_ylim(0.0, 1.08 * float(curve.y.max()))
    below.set_xticks(np.arange(0.0, right, 0.5))
    below.set_xlabel('range z in m', fontsize=9, color=INK)
    below.set_ylabel('p(z | m) in 1/m', fontsize=9, color=INK)
    for axes in (above, below):
        axes.tick_params(labelsize=8.5, color=FRAME, labelcolor=INK)
        for spine in axes.spines.values():
            spine.set(color=FRAME, linewidth=0.7)
    above.tick_params(labelbottom=False)
    figure.savefig(path)


def _draw_ways(axes: Axes, tile: FigureTile) -> None:
    if tile.odometry_xy is not None:
        axes.plot(*tile.odometry_xy.T, color=BEFORE, linewidth=1.1, linestyle=(0, (4, 2)), label='odometry')
    if tile.path_xy is not None:
        axes.plot(*tile.path_xy.T, color=PATH, linewidth=1.1, label='path')
    if tile.path_xy is not None and tile.odometry_xy is not None:
        axes.legend(loc='lower right', fontsize=7.5, framealpha=0.9, borderpad=0.3)


def _draw_cones(axes: Axes, readings: Readings) -> None:
    """Draw faint cones, with arcs at the range of echoes."""
    degrees = np.degrees(np.stack([readings.yaw - readings.half_angle, readings.yaw + readings.half_angle], axis=1))
    rows = zip(readings.x, readings.y, readings.z, degrees, readings.echo, strict=True)
    sectors, arcs = [], []
    for x, y, z, (first, last), echo in rows:
        sectors.append(Wedge((x, y), z, first, last))
        if echo:
            arcs.append(Wedge((x, y), z, first, last, width=min(0.04, z)))
    faint = min(max(20.0 / max(len(sectors), 1), 0.03), 0.2)
    axes.add_collection(PatchCollection(sectors, facecolor=PATH, alpha=faint, linewidths=0))
    axes.add_collection(PatchCollection(arcs, facecolor=PATH, alpha=0.5, linewidths=0))
