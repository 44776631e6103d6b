"""`drive.rrd`: the drive for the viewer Rerun: the standard map as it grows, the cones, and the readings.

Rerun opens it without a network, an account or ROS. The package rerun-sdk is imported only here, and only if such a
file is wanted.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.common.errors import MapperError
from ..core.common.grid import UNKNOWN, Grid
from ..core.common.readings import Readings
from ..core.maps.map_set import MapSet
from ..core.maps.moments import moments
from ..core.maps.reading_causes import CAUSES, likeliest_causes
from .map_files import occupancy_values
from .output_folder import output_errors
from .panels import DRIVES, Box, paths_of
from .picture import NOWHERE, view_of

RECORDING = 'drive.rrd'

MOST_MOMENTS = 40
"""Most standard maps in a file."""

MOST_CELLS = 40_000_000
"""Most cells of all standard maps together, a byte each before compression; for larger maps there are fewer maps."""

MOST_READINGS = 100_000
"""Most readings in a file, evenly selected from more: each needs about 100 bytes."""

STEPS = 200
"""Number of parts into which the readings are divided; the dots of a part appear together."""

DATES_FROM = 10**17
"""Nanoseconds: smaller stamps are simulated time, which starts at zero."""

TIME = 'time'
ARC_POINTS = 6
WIDE = 2.8
"""Approximate ratio of width to height of a view if two are stacked."""

ABOVE = 0.01
"""Height of lines and dots over the map, metres."""

COLOURS = {'hit': (0, 158, 115), 'random': (213, 94, 0), 'lost': (204, 121, 167), 'no_echo': (86, 180, 233)}
"""The same as in `report.html`."""

DOTS = {'hit': -1.2}
"""Radii of dots in pixels, which Rerun expects as negative numbers; echoes of walls must not hide the walls."""

ODOMETRY, CONE = '#cc79a7', (0, 158, 115)

FAR = 10_000.0
"""Metres from the origin beyond which coordinates of the recording are relative to a corner of the map: Rerun uses
single precision, with errors of half a metre in UTM coordinates."""

Points = NDArray[np.float32]


def check_rerun() -> None:
    """Check that a recording can be written, before the work.

    Raises
    ------
    MapperError
        If rerun-sdk is not installed, or is another version; names the extra.
    """
    try:
        import rerun

        rerun.GridMap  # noqa: B018 (missing in older versions)
    except (ImportError, AttributeError) as error:
        raise MapperError(
            f'--rerun needs rerun-sdk ({error}): pip install "forward_grid_mapper[rerun]", or .[rerun] in a checkout, '
            f'with Python 3.11 or newer and numpy 2 or newer'
        ) from None


def write_rerun(
    path: Path,
    maps: MapSet,
    report: str,
    title: str,
    path_xy: NDArray[np.float64] = NOWHERE,
    odometry_xy: NDArray[np.float64] = NOWHERE,
) -> None:
    """Write the recording.

    Parameters
    ----------
    path : Path
        With the suffix `.rrd`.
    maps : MapSet
    report : str
        The report as text.
    title : str
    path_xy, odometry_xy : float64, shape (P, 2)
        As in `write_page`.

    Raises
    ------
    MapperError
        If rerun-sdk is not installed.
    OutputError
        If the file cannot be written.
    """
    check_rerun()
    import rerun as rr

    # written only when complete, so that a full disk is reported as for other files
    recording = rr.RecordingStream('forward_grid_mapper')
    stream = recording.binary_stream()
    recording.send_recording_name(title)
    readings, causes = _bounded(maps)
    x, y = _origin(maps.grid)
    if x or y:
        report = f'Coordinates are relative to x = {x:.0f} m, y = {y:.0f} m of the map frame.\n\n{report}'
    _log_maps(recording, maps)
    _log_paths(recording, path_xy - (x, y), odometry_xy - (x, y))
    entities = _log_readings(recording, replace(readings, x=readings.x - x, y=readings.y - y), causes)
    recording.log('report', rr.TextDocument(report), static=True)
    everywhere = np.concatenate([path_xy.reshape(-1, 2), odometry_xy])
    left, right, bottom, top = view_of(maps, everywhere[np.isfinite(everywhere).all(axis=1)])
    recording.send_blueprint(_blueprint((left - x, right - x, bottom - y, top - y), entities))
    data = stream.read()
    recording.disconnect()
    with output_errors(path):
        path.write_bytes(data or b'')


def _origin(grid: Grid) -> tuple[float, float]:
    """Return the origin of coordinates, in whole metres: (0, 0) unless the map is `FAR` from there."""
    x, y = grid.origin
    return (float(round(x)), float(round(y))) if max(abs(x), abs(y)) > FAR else (0.0, 0.0)


def _bounded(maps: MapSet) -> tuple[Readings, NDArray[np.uint8]]:
    """Return at most `MOST_READINGS` readings in order of time, and their causes on the map."""
    readings = maps.readings
    if not len(readings):
        return readings, np.zeros(0, np.uint8)
    order = np.argsort(readings.stamp, kind='stable')
    step = -(-len(order) // MOST_READINGS)
    return readings.select(order[::step]), likeliest_causes(maps)[order[::step]]


def _log_maps(recording: Any, maps: MapSet) -> None:
    if len(maps.readings):
        # from the beginning there is a map, with all cells unknown
        _set_time(recording, int(maps.readings.stamp.min()) - 1)
        recording.log('map/standard', _grid_map(maps.grid, np.full(maps.grid.shape, UNKNOWN, np.int8)))
    count = min(MOST_MOMENTS, max(MOST_CELLS // max(maps.grid.size, 1), 1))
    for moment in moments(maps, count):
        _set_time(recording, moment.stamp)
        recording.log('map/standard', _grid_map(maps.grid, moment.live))
    for name, values in (('maximum_likelihood', maps.ml), ('uncertainty', maps.uncertainty)):
        recording.log(f'map/{name}', _grid_map(maps.grid, values), static=True)


def _grid_map(grid: Grid, values: NDArray[Any]) -> Any:
    """Return a map in the format of Rerun: occupancy in percent, -1 unknown, the row with the largest y first."""
    import rerun as rr

    return rr.GridMap(
        data=occupancy_values(values)[::-1].tobytes(),
        format=rr.components.ImageFormat(width=grid.width, height=grid.height, color_model='L', channel_datatype='U8'),
        cell_size=grid.resolution,
        translation=[*np.subtract(grid.origin, _origin(grid)), 0.0],
        colormap=rr.components.Colormap.RvizMap,
    )


def _log_paths(recording: Any, path_xy: NDArray[np.float64], odometry_xy: NDArray[np.float64]) -> None:
    import rerun as rr

    kinds = (('path', path_xy, DRIVES), ('odometry', odometry_xy, (ODOMETRY,)))
    for name, xy, colours in kinds:
        kept = [(_lifted(part), colours[k % len(colours)]) for k, part in enumerate(paths_of(xy)) if len(part) > 1]
        if kept:
            lines = rr.LineStrips3D(
                [line for line, _ in kept], colors=[list(bytes.fromhex(colour[1:])) for _, colour in kept], radii=[-1.5]
            )
            recording.log(f'robot/{name}', lines, static=True)


def _log_readings(recording: Any, readings: Readings, causes: NDArray[np.uint8]) -> list[str]:
    """Log cones, ranges and dots of each sensor; return the entities whose dots remain once they have appeared."""
    import rerun as rr

    entities = []
    reach = np.minimum(readings.z, readings.z_max)
    ends = np.stack([readings.x + reach * np.cos(readings.yaw), readings.y + reach * np.sin(readings.yaw)], axis=1)
    for sensor in np.unique(readings.sensor).tolist():
        mine = readings.sensor == sensor
        part = rr.escape_entity_path_part(readings.sensor_names[sensor] or 'a sensor without a name')
        stamps = readings.stamp[mine]
        cone = f'sonar/{part}'
        recording.log(cone, rr.LineStrips3D.from_fields(colors=[CONE], radii=[-1.0]), static=True)
        strips = rr.LineStrips3D.columns(strips=list(_outlines(readings.select(mine))))
        recording.send_columns(cone, [_times(stamps)], strips)
        recording.send_columns(f'range/{part}', [_times(stamps)], rr.Scalars.columns(scalars=reach[mine]))
        for cause in np.unique(causes[mine]).tolist():
            these = mine & (causes == cause)
            entity = f'readings/{CAUSES[cause]}/{part}'
            entities.append(entity)
            look = rr.Points3D.from_fields(colors=[COLOURS[CAUSES[cause]]], radii=[DOTS.get(CAUSES[cause], -2.0)])
            recording.log(entity, look, static=True)
            _send_dots(recording, entity, readings.stamp[these], ends[these])
    return entities


def _send_dots(recording: Any, entity: str, stamps: NDArray[np.int64], ends: NDArray[np.float64]) -> None:
    """Send dots, in order of time, in parts that appear at once: a view of thousands of rows would be slow."""
    import rerun as rr

    parts = np.array_split(np.arange(len(stamps)), min(len(stamps), STEPS))
    last = np.array([stamps[part[-1]] for part in parts])
    columns = rr.Points3D.columns(positions=_lifted(ends)).partition([len(part) for part in parts])
    recording.send_columns(entity, [_times(last)], columns)


def _outlines(readings: Readings) -> Points:
    """Return the outline of each cone up to its range, closed, shape (N, ARC_POINTS + 2, 3)."""
    angle = readings.yaw[:, None] + readings.half_angle[:, None] * np.linspace(-1, 1, ARC_POINTS)
    reach = np.minimum(readings.z, readings.z_max)[:, None]
    apex = np.stack([readings.x, readings.y], axis=1)[:, None]
    arc = apex + np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=2)
    return _lifted(np.concatenate([apex, arc, apex], axis=1))


def _lifted(xy: NDArray[np.float64]) -> Points:
    height = np.full((*xy.shape[:-1], 1), ABOVE)
    return np.concatenate([xy, height], axis=-1).astype(np.float32)


def _set_time(recording: Any, stamp: int) -> None:
    if stamp < DATES_FROM:
        recording.set_time(TIME, duration=np.timedelta64(stamp, 'ns'))
    else:
        recording.set_time(TIME, timestamp=np.datetime64(stamp, 'ns'))


def _times(stamps: NDArray[np.int64]) -> Any:
    import rerun as rr

    if len(stamps) and stamps[0] >= DATES_FROM:
        return rr.TimeColumn(TIME, timestamp=stamps.astype('datetime64[ns]'))
    return rr.TimeColumn(TIME, duration=stamps.astype('timedelta64[ns]'))


def _blueprint(view: Box, entities: list[str]) -> Any:
    """Return the initial views: two maps from above, the ranges over time, and the report."""
    import rerun.blueprint as rrb

    left, right, bottom, top = view
    width, height = right - left, top - bottom
    wide = width > height
    x, y = (left + right) / 2, (bottom + top) / 2
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=[x, y, 1.1 * max(width / (WIDE if wide else 1.0), height)],
        look_target=[x, y, 0.0],
        eye_up=[0.0, 1.0, 0.0],
    )
    # all dots so far are shown, but only the last cone
    begin, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative(seconds=0.0)
    until_now = rrb.VisibleTimeRanges([rrb.VisibleTimeRange(TIME, start=begin, end=now)])
    hidden = ('/readings/lost', '/readings/no_echo')
    overrides: dict[str, Any] = {f'/{entity}': [until_now] for entity in entities}
    overrides |= {name: [rrb.EntityBehavior(visible=False)] for name in hidden}

    def above(name: str, shown: str) -> Any:
        return rrb.Spatial3DView(
            name=name,
            origin='/',
            contents=[f'/map/{shown}', '/robot/**', '/sonar/**', '/readings/**'],
            background=[255, 255, 255],
            line_grid=False,
            eye_controls=eye,
            overrides=overrides,
        )

    maps = [
        above('standard map as it grows', 'standard'),
        rrb.Tabs(
            above('maximum likelihood map of the whole drive', 'maximum_likelihood'),
            above('uncertainty map of the whole drive', 'uncertainty'),
        ),
    ]
    beside = rrb.Tabs(
        rrb.TimeSeriesView(name='ranges in metres', origin='/range'),
        rrb.TextDocumentView(name='report', origin='/report'),
    )
    if wide:
        shown = rrb.Horizontal(rrb.Vertical(*maps), beside, column_shares=[3, 1])
    else:
        shown = rrb.Vertical(rrb.Horizontal(*maps), beside, row_shares=[3, 1])
    panels = (rrb.SelectionPanel(state='hidden'), rrb.BlueprintPanel(state='hidden'))
    return rrb.Blueprint(shown, *panels, rrb.TimePanel(state='collapsed', timeline=TIME))
