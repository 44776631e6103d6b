"""The recording for Rerun: it contains the maps and readings, is bounded, and needs an extra."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from made_maps import made_maps

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.reading_causes import CAUSES, likeliest_causes
from forward_grid_mapper.files import rerun_recording
from forward_grid_mapper.files.map_files import occupancy_values
from forward_grid_mapper.files.rerun_recording import write_rerun
from forward_grid_mapper.simulation.drive import corridor_drive

PATH = np.array([[0.0, 0.0], [1.0, 0.5], [np.nan, np.nan], [2.0, 0.0], [3.0, 0.0]])


@cache
def drive() -> MapSet:
    """A drive along a corridor with smooth walls."""
    return Mapper(Parameters()).run(corridor_drive(0).readings)


def written(folder: Path, maps: MapSet, path: Any = PATH) -> dict[str, dict[str, list[Any]]]:
    """The content of the recording of these maps: columns by entity."""
    rerun = pytest.importorskip('rerun', reason='the extra rerun is not installed')
    from rerun.chunk import RrdReader

    rerun.set_strict_mode(True)
    file = folder / 'drive.rrd'
    write_rerun(file, maps, 'the report\n', 'a drive', path)
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(file).store().stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            values = batch[name]
            stamped = name in ('time', 'log_time')
            columns.setdefault(name, []).extend(values.cast('int64').to_pylist() if stamped else values.to_pylist())
    return found


def column(entity: dict[str, list[Any]], end: str) -> list[Any]:
    """The rows of the component whose name ends with `end`."""
    (name,) = [name for name in entity if name.endswith(end)]
    return [row for row in entity[name] if row is not None]


def grid(entity: dict[str, list[Any]], row: int, shape: tuple[int, int]) -> Any:
    """A map of an entity as cells; the first row has the smallest y."""
    return np.array(column(entity, 'GridMap:data')[row][0], np.uint8).astype(np.int8).reshape(shape)[::-1]


def test_recording_contains_the_maps(tmp_path: Path) -> None:
    maps = drive()
    found = written(tmp_path, maps)
    for name, values in (('maximum_likelihood', maps.ml), ('uncertainty', maps.uncertainty)):
        np.testing.assert_array_equal(grid(found[f'/map/{name}'], 0, maps.grid.shape), occupancy_values(values))
    standard = found['/map/standard']
    order = np.argsort(standard['time'])
    assert len(order) == rerun_recording.MOST_MOMENTS + 1
    assert (grid(standard, order[0], maps.grid.shape) == -1).all()
    np.testing.assert_array_equal(grid(standard, order[-1], maps.grid.shape), occupancy_values(maps.live))
    assert column(standard, 'cell_size')[0][0] == pytest.approx(maps.grid.resolution)
    assert column(standard, 'translation')[0][0][:2] == pytest.approx(maps.grid.origin, abs=1e-6)
    assert len(column(found['/robot/path'], 'strips')[0]) == 2
    assert column(found['/report'], 'text') == [['the report\n']]


def test_recording_has_readings_by_sensor_and_cause(tmp_path: Path) -> None:
    maps = drive()
    readings, causes, found = maps.readings, likeliest_causes(maps), written(tmp_path, maps)
    for k, name in enumerate(readings.sensor_names):
        mine = readings.sensor == k
        strips = column(found[f'/sonar/{name}'], 'strips')
        assert len(strips) == mine.sum()
        ranges = [row[0] for row in column(found[f'/range/{name}'], 'scalars')]
        np.testing.assert_allclose(ranges, readings.z[mine])
        first = readings.select(mine)
        np.testing.assert_allclose(strips[0][0][0][:2], [first.x[0], first.y[0]], atol=1e-5)
        reach = [np.hypot(x - first.x[0], y - first.y[0]) for x, y, _ in strips[0][0][1:-1]]
        np.testing.assert_allclose(reach, first.z[0], atol=1e-4)
        for number, cause in enumerate(CAUSES):
            these = readings.select(mine & (causes == number))
            dots = column(found.get(f'/readings/{cause}/{name}', {':positions': []}), ':positions')
            dots = [dot for row in dots for dot in row]
            assert len(dots) == len(these)
            if dots:
                np.testing.assert_allclose(
                    [dot[:2] for dot in dots],
                    np.stack([these.x + these.z * np.cos(these.yaw), these.y + these.z * np.sin(these.yaw)], 1),
                    atol=1e-4,
                )


def test_maps_far_from_the_origin_are_exact(tmp_path: Path) -> None:
    far, near = np.array([500_000.0, 5_200_000.0]), corridor_drive(0).readings
    maps = Mapper(Parameters()).run(dataclasses.replace(near, x=near.x + far[0], y=near.y + far[1]))
    found, home = written(tmp_path, maps, path=PATH + far), np.round(maps.grid.origin)
    assert found['/report'] and f'x = {home[0]:.0f} m, y = {home[1]:.0f} m' in column(found['/report'], 'text')[0][0]
    origin = column(found['/map/standard'], 'translation')[0][0][:2]
    np.testing.assert_allclose(origin + home, maps.grid.origin, atol=1e-4)
    path = np.array(column(found['/robot/path'], 'strips')[0][0])[:, :2]
    np.testing.assert_allclose(path + home, PATH[:2] + far, atol=1e-4)
    name = maps.readings.sensor_names[0]
    mine = maps.readings.select(maps.readings.sensor == 0)
    places = [strip[0][0][:2] for strip in column(found[f'/sonar/{name}'], 'strips')]
    np.testing.assert_allclose(places + home, np.stack([mine.x, mine.y], 1), atol=1e-4)


def coordinates(folder: Path, monkeypatch: pytest.MonkeyPatch, shift: Any) -> dict[str, Any]:
    """Data that a stand-in for Rerun receives of a short drive, moved by `shift`: x and y, by kind."""
    rr = MagicMock()
    rr.RecordingStream.return_value.binary_stream.return_value.read.return_value = b'recording'
    monkeypatch.setitem(sys.modules, 'rerun', rr)
    monkeypatch.setitem(sys.modules, 'rerun.blueprint', rr.blueprint)
    # on maps that differ by rounding, a few readings have other causes
    monkeypatch.setattr(rerun_recording, 'likeliest_causes', lambda maps: np.zeros(len(maps.readings), np.uint8))
    near = corridor_drive(0).readings.select(slice(0, 1200))
    maps = Mapper(Parameters()).run(dataclasses.replace(near, x=near.x + shift[0], y=near.y + shift[1]))
    write_rerun(folder / 'drive.rrd', maps, 'the report', 'a drive', PATH + shift, PATH + shift + 0.25)
    (eye,) = rr.blueprint.EyeControls3D.call_args_list
    path, odometry = (np.concatenate(call.args[0])[:, :2] for call in rr.LineStrips3D.call_args_list)
    found = {
        'origin': np.array(maps.grid.origin),
        'maps': np.array([call.kwargs['translation'][:2] for call in rr.GridMap.call_args_list]),
        'path': path,
        'odometry': odometry,
        'cones': np.array(rr.LineStrips3D.columns.call_args_list[0].kwargs['strips'])[..., :2],
        'dots': np.array(rr.Points3D.columns.call_args_list[0].kwargs['positions'])[..., :2],
        'view from': np.array(eye.kwargs['position'][:2]),
        'view to': np.array(eye.kwargs['look_target'][:2]),
    }
    found['report'] = rr.TextDocument.call_args.args[0]
    return found


def test_all_coordinates_far_from_the_origin_are_relative_to_the_same_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift = np.array([500_000.0, 5_200_000.0])
    near, far = (coordinates(tmp_path, monkeypatch, offset) for offset in (np.zeros(2), shift))
    assert near.pop('report') == 'the report'
    home = np.round(far['origin'])
    assert far.pop('report').startswith(f'Coordinates are relative to x = {home[0]:.0f} m, y = {home[1]:.0f} m')
    np.testing.assert_allclose(near.pop('origin'), far.pop('origin') - shift, atol=1e-6)
    for kind, expected in near.items():
        np.testing.assert_allclose(far[kind], expected + shift - home, atol=1e-3, err_msg=kind)


def test_size_of_the_recording_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = drive()
    assert len(maps.readings) == 12_000
    written(tmp_path, maps)
    assert (tmp_path / 'drive.rrd').stat().st_size < 5_000_000
    monkeypatch.setattr(rerun_recording, 'MOST_READINGS', 500)
    monkeypatch.setattr(rerun_recording, 'MOST_CELLS', 3 * maps.grid.size)
    found = written(tmp_path, maps)
    assert len(found['/map/standard']['time']) == 3 + 1
    shown = sum(len(column(entity, 'strips')) for name, entity in found.items() if name.startswith('/sonar/'))
    assert 400 < shown <= 500


@pytest.mark.parametrize('readings', [0, 10])
def test_recording_with_few_readings_and_odd_names(tmp_path: Path, readings: int) -> None:
    maps = made_maps(readings=readings)
    odd = dataclasses.replace(maps.readings, sensor_names=('a/b c\n', ''))
    found = written(tmp_path, dataclasses.replace(maps, readings=odd))
    cones = [name for name in found if name.startswith('/sonar/')]
    assert len(cones) == (2 if readings else 0)


def test_without_rerun_the_message_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)
    with pytest.raises(MapperError, match=r'pip install "forward_grid_mapper\[rerun\]"'):
        write_rerun(tmp_path / 'drive.rrd', made_maps(), '', '')
    assert not list(tmp_path.iterdir())


def test_rerun_is_imported_only_if_used() -> None:
    program = 'import sys, forward_grid_mapper.commands.process_bag; sys.exit("rerun" in sys.modules)'
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0
