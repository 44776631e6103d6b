"""Drawing of a composed picture; requires matplotlib, and is imported only if a picture is wanted."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from ..core.common.words import counted
from .output_folder import distinguished
from .panels import DRIVES, PATH, UNKNOWN_COLOUR, Box, Picture, coarse, paths_of

# Free is white and unknown a cool tint, so that everyone can distinguish them; values between use a warm scale, so
# that an uncertain cell resembles neither. Path, dots and the path of odometry are blue, vermilion and purple of the
# Okabe-Ito palette.
_FREE, _OCCUPIED, UNKNOWN = '#ffffff', '#14171c', UNKNOWN_COLOUR
DOT, BEFORE = '#d55e00', '#cc79a7'
INK, FRAME = '#22262b', '#8b96a3'
_PROBABILITY = LinearSegmentedColormap.from_list(
    'occupancy', [(0.0, _FREE), (0.2, '#fdf0d2'), (0.5, '#eeb04d'), (0.78, '#8a4a1c'), (1.0, _OCCUPIED)]
)
_DART = Outline([(1.0, 0.0), (-0.8, 0.75), (-0.4, 0.0), (-0.8, -0.75), (1.0, 0.0)])

DPI = 150
# Lengths of the page in inches.
EDGE, HEAD, _FOOT, _LABELS, CAPTION, GAP = 0.3, 0.8, 0.8, 0.55, 0.42, 0.3
# Below this width the longest legend, of a refined drive, would overlap the scale of probabilities.
_MIN_WIDTH = 12.6
# Most drives whose start and end are marked; most drives that are named, and most characters of each name.
_MOST_MARKED, _MOST_NAMED, _NAME = 12, 4, 20
WIDE = 2.6
# Fewest pixels of a cell: in smaller cells, walls of one cell are hardly visible.
_CELL = 2.5
# Dots, or points of a path, per call of matplotlib: a call is not interrupted, and other threads wait.
_AT_ONCE = 2000
# Longest scale bar, as a fraction of the panel's width.
_BAR = 0.2


def draw(path: Path, picture: Picture) -> None:
    """Write the picture to `path`."""
    left, right, bottom, top = picture.view
    aspect = (right - left) / (top - bottom)
    columns, rows, width, height = _layout(len(picture.panels), aspect)
    page_width = 2 * EDGE + _LABELS + columns * width + (columns - 1) * GAP
    page_height = HEAD + _FOOT + _LABELS + rows * (height + CAPTION)
    figure = Figure(figsize=(page_width, page_height), dpi=DPI, facecolor='white')
    FigureCanvasAgg(figure)
    for k, panel in enumerate(picture.panels):
        row, column = divmod(k, columns)
        x = EDGE + _LABELS + column * (width + GAP)
        y = page_height - HEAD - (row + 1) * (height + CAPTION)
        axes = figure.add_axes((x / page_width, y / page_height, width / page_width, height / page_height))
        axes.set_facecolor(UNKNOWN)
        if panel.values.size:
            draw_map(axes, panel.values, panel.extent, (right - left) / (width * DPI))
        draw_scale(axes, picture.view)
        if k == picture.overlay:
            _draw_overlay(axes, picture, (right - left) / (width * DPI))
        _frame(axes, panel.title, picture.view, (column == 0, row == rows - 1))
    _head(figure, picture)
    _foot(figure, picture)
    with warnings.catch_warnings():
        # for names of bags; a box replaces a character that the font lacks
        warnings.filterwarnings('ignore', 'Glyph')
        figure.savefig(path)


def draw_map(axes: Axes, values: NDArray[Any], extent: Box, pixel: float) -> None:
    """Draw a map in cells of at least `_CELL` pixels; `pixel` is the size of a pixel, metres."""
    left, right, bottom, top = extent
    cell = (right - left) / values.shape[1]
    step = max(1, math.ceil(_CELL * pixel / cell - 1e-9))
    if step > 1:
        values = coarse(values, step)
        right, top = left + values.shape[1] * step * cell, bottom + values.shape[0] * step * cell
    box = (left, right, bottom, top)
    axes.imshow(
        values, cmap=_PROBABILITY, vmin=0, vmax=1, extent=box, origin='lower', interpolation='nearest', aspect='auto'
    )


def draw_scale(axes: Axes, view: Box) -> None:
    """Draw a scale bar of a round length in the lower left corner."""
    width, height = view[1] - view[0], view[3] - view[2]
    longest = max(_BAR * width, 1e-3)
    power = 10.0 ** math.floor(math.log10(longest))
    length = next(n * power for n in (5, 2, 1) if n * power <= longest)
    x, y = view[0] + 0.02 * width, view[2] + min(0.05 * height, 0.02 * width)
    halo = [patheffects.withStroke(linewidth=4.5, foreground='white', alpha=0.9)]
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.0, solid_capstyle='butt', path_effects=halo, zorder=6)
    text = f'{length:g} m' if length >= 1 else f'{100 * length:g} cm'
    axes.annotate(
        text,
        (x + length, y),
        (4, 0),
        textcoords='offset points',
        va='center',
        fontsize=8,
        color=INK,
        path_effects=[patheffects.withStroke(linewidth=2.5, foreground='white', alpha=0.9)],
        zorder=6,
    )


def _layout(panels: int, aspect: float) -> tuple[int, int, float, float]:
    """Return columns, rows, and a panel's width and height in inches; wide maps are stacked."""
    if aspect > WIDE:
        columns, width = 1, min(12.0, 3.4 * aspect)
    else:
        columns = panels if panels < 4 or aspect < 0.6 else 2
        width = min(4.8 if aspect < 1.5 else 5.6, 8.0 * aspect)
    width_at_least = (_MIN_WIDTH - 2 * EDGE - _LABELS - (columns - 1) * GAP) / columns
    height = min(max(width, width_at_least) / aspect, 8.0)
    return columns, math.ceil(panels / columns), max(width, width_at_least), max(height, 0.6)


def _frame(axes: Axes, title: str, view: tuple[float, float, float, float], outer: tuple[bool, bool]) -> None:
    """Set limits, caption and scale; `outer` is whether the panel has labels of the y and of the x axis."""
    axes.set_xlim(view[0], view[1])
    axes.set_ylim(view[2], view[3])
    axes.set_aspect('equal', adjustable='datalim')
    axes.set_title(title, loc='left', fontsize=11.5, color=INK, pad=5)
    span = max(view[1] - view[0], view[3] - view[2])
    for axis, length in ((axes.xaxis, view[1] - view[0]), (axes.yaxis, view[3] - view[2])):
        ticks = 4 + 6 * length / span if span == length else max(2.0, 10 * length / span)
        axis.set_major_locator(MaxNLocator(nbins=int(ticks), steps=[1, 2, 5, 10]))
    axes.tick_params(labelsize=8.5, color=FRAME, labelcolor=INK, length=3, width=0.7)
    axes.tick_params(labelleft=outer[0], labelbottom=outer[1])
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.7)
    if outer[0]:
        axes.set_ylabel('y in m', fontsize=9, color=INK)
    if outer[1]:
        axes.set_xlabel('x in m', fontsize=9, color=INK)


def _draw_overlay(axes: Axes, picture: Picture, pixel: float) -> None:
    dots, paths = picture.unexplained_xy, _coloured(picture)
    if len(dots):
        # together, dots cover at most 1 % of the panel, so that the map remains visible
        extent, points = axes.get_window_extent(), 72.0 / axes.figure.dpi
        size = float(np.clip(0.01 * extent.width * extent.height * points**2 / len(dots), 0.8, 9.0))
        for x, y in (dots[k : k + _AT_ONCE].T for k in range(0, len(dots), _AT_ONCE)):
            axes.scatter(x, y, s=size, color=DOT, linewidths=0, alpha=0.85, zorder=3)
    if not paths:
        return
    before = _thinned(picture.odometry_xy, pixel)
    if len(before):
        axes.plot(before[:, 0], before[:, 1], color=BEFORE, linewidth=1.1, linestyle=(0, (4, 2)), zorder=3.5)
    for path, _ in paths:
        _draw_path(axes, _thinned(path, pixel), 3.9, color='white', linewidth=2.4, alpha=0.9)
    for path, colour in paths:
        _draw_path(axes, _thinned(path, pixel), 4.0, color=colour, linewidth=1.4)
    # with many drives, the marks would hide the map
    for path, colour in paths if len(paths) <= _MOST_MARKED else []:
        for marker, xy in zip(_path_markers(_heading(path)), (path[0], path[-1]), strict=True):
            axes.add_line(_marker_line(marker, xy[0], xy[1], colour))


def _draw_path(axes: Axes, path: NDArray[np.float64], order: float, **style: Any) -> None:
    for k in range(0, max(len(path) - 1, 1), _AT_ONCE):
        x, y = path[k : k + _AT_ONCE + 1].T
        axes.plot(x, y, zorder=order, solid_capstyle='round', solid_joinstyle='round', **style)


def _thinned(path: NDArray[np.float64], pixel: float) -> NDArray[np.float64]:
    """Return a path without points in the same quarter of a pixel as the one before; the last point is kept."""
    moved = np.any(np.diff(np.floor(4 * path / pixel), axis=0), axis=1)
    return path[np.r_[True, moved[:-1], True]] if len(path) > 2 else path


def _coloured(picture: Picture) -> list[tuple[NDArray[np.float64], str]]:
    """Return the paths that are not empty, each with the colour of its drive."""
    paths = paths_of(picture.path_xy)
    return [(path, DRIVES[k % len(DRIVES)]) for k, path in enumerate(paths) if len(path)]


def _heading(path: np.ndarray) -> float:
    """Return the direction of the path's end, degrees; the last few centimetres are ignored as noise."""
    away = path[-1] - path
    far = np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) > 0.1)
    return math.degrees(math.atan2(away[far[-1], 1], away[far[-1], 0])) if len(far) else 0.0


def _path_markers(heading: float) -> tuple[MarkerStyle, MarkerStyle]:
    dart = MarkerStyle(_DART.transformed(Affine2D().rotate_deg(heading)))
    return MarkerStyle('o'), dart


def _marker_line(marker: MarkerStyle, x: float, y: float, colour: str = PATH, **options: Any) -> Line2D:
    start = marker.get_marker() == 'o'
    return Line2D(
        [x],
        [y],
        linestyle='none',
        marker=marker,
        markersize=8 if start else 13,
        markerfacecolor='white' if start else colour,
        markeredgecolor=colour if start else 'white',
        markeredgewidth=2.0 if start else 1.0,
        zorder=5,
        **options,
    )


def _head(figure: Figure, picture: Picture) -> None:
    width, height = figure.get_size_inches()
    most = int((width - 2 * EDGE) * 9.5)
    title = picture.title if len(picture.title) <= most else picture.title[: most - 1] + '…'
    x = (EDGE + 0.05) / width
    # A dollar sign would start a formula.
    figure.text(
        x, 1 - 0.42 / height, title.replace('$', r'\$'), fontsize=15, fontweight='bold', color=INK, va='baseline'
    )
    figure.text(x, 1 - 0.67 / height, picture.figures, fontsize=9.5, color='#4a525c', va='baseline')


def _named(picture: Picture) -> list[Line2D]:
    """Return the legend of the colours of drives; empty for a single drive."""
    count = len(paths_of(picture.path_xy))
    if len(_coloured(picture)) < 2:
        return []
    # a dollar sign would start a formula
    names = [name.replace('$', r'\$') for name in distinguished(picture.drives)[:_MOST_NAMED]]
    names = [name if len(name) <= _NAME else f'…{name[1 - _NAME :]}' for name in names]
    handles = [Line2D([], [], color=DRIVES[k], linewidth=1.6, label=f'{k + 1}: {name}') for k, name in enumerate(names)]
    if count > len(names):
        more = f'and {counted(count - len(names), "more drive")}' if names else f'paths of {count} drives'
        handles.append(Line2D([], [], linestyle='none', label=more))
    return handles


def _row(figure: Figure, handles: Sequence[Patch | Line2D], y: float) -> None:
    """Draw a row of a legend, `y` inches from below."""
    width, height = figure.get_size_inches()
    figure.legend(
        handles=handles,
        loc='center left',
        bbox_to_anchor=((EDGE - 0.05) / width, y / height),
        ncol=max(len(handles), 1),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        handlelength=1.5,
        handletextpad=0.5,
        columnspacing=1.4,
    )


def _foot(figure: Figure, picture: Picture) -> None:
    """Draw the legend and the scale of probabilities below the maps."""
    width, height = figure.get_size_inches()
    start, end = _path_markers(0.0)
    edge: dict[str, Any] = {'edgecolor': FRAME, 'linewidth': 0.7}
    handles: list[Patch | Line2D] = [
        Patch(facecolor=_FREE, label='free', **edge),
        Patch(facecolor=_OCCUPIED, label='occupied', **edge),
        Patch(facecolor=UNKNOWN, label='not observed', **edge),
    ]
    if count := len(_coloured(picture)):
        if count == 1:
            handles.append(Line2D([], [], color=PATH, linewidth=1.6, label='path of the robot'))
        if count <= _MOST_MARKED:
            handles += [_marker_line(start, 0, 0, label='start'), _marker_line(end, 0, 0, label='end')]
    if len(picture.odometry_xy):
        handles.append(Line2D([], [], color=BEFORE, linewidth=1.3, linestyle=(0, (4, 2)), label='by odometry'))
    if count := len(picture.unexplained_xy):
        label = f'random measurement ({count:,})'
        handles.append(Line2D([], [], linestyle='none', marker='o', markersize=4, color=DOT, mew=0, label=label))
    named = _named(picture)
    _row(figure, handles, 0.48 if named else 0.38)
    _row(figure, named, 0.2)
    bar_width = 2.0
    axes = figure.add_axes(((width - EDGE - bar_width) / width, 0.36 / height, bar_width / width, 0.12 / height))
    bar = figure.colorbar(ScalarMappable(Normalize(0, 1), _PROBABILITY), cax=axes, orientation='horizontal')
    bar.set_ticks([0, 0.5, 1], labels=['0', '0.5', '1'])
    axes.tick_params(labelsize=8, color=FRAME, labelcolor=INK, length=2, width=0.7)
    axes.set_title('probability of an obstacle', fontsize=8.5, color=INK, pad=3)
    bar.outline.set(color=FRAME, linewidth=0.7)
