"""`explain`: the evidence of a cell in a saved map, and errors of the arguments."""

from __future__ import annotations

import json
import math
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from drive_samples import code_of, mapped, tape, write_tape

from forward_grid_mapper.commands import explain
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.maps.cell_evidence import cell_evidence
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.map_archive import MapArchive, read_npz
from forward_grid_mapper.files.reading_archive import read_readings


@pytest.fixture(scope='module')
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The maps of a drive past a door."""
    folder = tmp_path_factory.mktemp('explain')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, 'draw', lambda path, picture: None)
        mapped(write_tape(folder / 'bag', tape()), folder / 'maps')
    return folder / 'maps'


def place(archive: MapArchive, state: int) -> tuple[float, float]:
    """The centre of a cell in this state."""
    rows, columns = np.nonzero(archive.ml == state)
    x, y = archive.grid.centers()
    k = len(rows) // 2
    return round(float(x[columns[k]]), 3), round(float(y[rows[k]]), 3)


def test_path_of_the_file_equals_that_of_its_folder(maps: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = []
    for given in (maps, maps / 'maps.npz'):
        assert code_of(explain.main, given, *place(read_npz(maps / 'maps.npz'), 1)) == 0
        words.append(capsys.readouterr().out)
    assert words[0] == words[1]


@pytest.mark.parametrize(('state', 'word'), [(1, 'occupied'), (0, 'free'), (-1, 'not observed')])
def test_explanation_has_the_nats_of_all_readings(
    maps: Path, state: int, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = read_npz(maps / 'maps.npz')
    x, y = place(archive, state)
    assert code_of(explain.main, maps, x, y) == 0
    output = capsys.readouterr().out
    assert output.splitlines()[0].endswith(f': {word}')
    readings, normals = read_readings(maps / 'readings.npz', archive)
    found = cell_evidence(readings, archive.grid, archive.ml, archive.parameters, normals, (x, y))
    total = re.search(r'([+-][\d.]+) nats from (\d+) readings?,', output)
    assert total and (float(total[1]), int(total[2])) == (pytest.approx(found.data, abs=0.051), len(found.readings))
    groups = re.findall(r'^ +([+-][\d.]+)  (\d+) readings? \w+', output, re.MULTILINE)
    assert sum(int(count) for _, count in groups) == len(found.readings)
    assert len(re.findall(r' s  \S+$', output, re.MULTILINE)) == min(explain.MOST_SHOWN, len(found.readings))


def test_explanation_mentions_a_wall_in_between(maps: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive = read_npz(maps / 'maps.npz')
    readings, normals = read_readings(maps / 'readings.npz', archive)
    x, y = archive.grid.centers()
    output: dict[str, str] = {}
    for row, column in np.argwhere(archive.ml == -1):
        place = float(x[column]), float(y[row])
        found = cell_evidence(readings, archive.grid, archive.ml, archive.parameters, normals, place)
        if not len(found.readings):
            continue
        part = 'all' if found.through_wall.all() else 'some' if found.through_wall.any() else 'none'
        if part not in output:
            assert code_of(explain.main, maps, *place, '-n', 0) == 0
            output[part] = capsys.readouterr().out
        if len(output) == 3:
            break
    assert 'a wall blocks all of these' in output['all'] and 'not enough evidence' not in output['all']
    assert re.search(r'not enough evidence.*; a wall blocks \d+ of these', output['some'])
    assert 'not enough evidence' in output['none'] and 'a wall blocks' not in output['none']


def test_readings_and_normals_are_saved_with_the_maps(maps: Path) -> None:
    archive = read_npz(maps / 'maps.npz')
    readings, normals = read_readings(maps / 'readings.npz', archive)
    assert len(readings) > 0
    assert set(readings.sensor_names) == {frame for frame, _ in tape().extrinsics}
    assert normals.known.any()
    lengths = np.hypot(normals.x, normals.y)
    assert lengths == pytest.approx(normals.known.astype(float), abs=1e-6)


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['1000', '0'], 'is not on the map, which spans'),
        (['nan', '0'], 'is not on the map'),
        (['here', '0'], 'invalid float'),
    ],
)
def test_bad_position_is_rejected_with_reason(
    maps: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(explain.main, maps, *words) != 0
    assert message in capsys.readouterr().err


@pytest.mark.parametrize('output', [(), ('--json',)])
def test_negative_number_of_readings_is_refused(
    maps: Path, output: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(explain.main, maps, 0.0, 0.0, '-n', -1, *output) == 1
    assert '--readings must be a positive number or 0' in capsys.readouterr().err


@pytest.mark.parametrize('place', [('-0.4', '-0.2'), ('-4e-1', '-2E-1'), ('-.4', '-.2'), ('-inf', '-1e+2')])
def test_negative_position_is_not_parsed_as_an_option(
    maps: Path, place: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    code_of(explain.main, maps, *place, '-n', 2)
    error = capsys.readouterr().err
    assert error == '' or f'({float(place[0]):g}, {float(place[1]):g}) is not on the map' in error


@pytest.mark.parametrize('state', [1, 0, -1])
def test_json_has_the_same_values(maps: Path, state: int, capsys: pytest.CaptureFixture[str]) -> None:
    archive = read_npz(maps / 'maps.npz')
    x, y = place(archive, state)
    assert code_of(explain.main, maps, x, y, '--json') == 0
    output = json.loads(capsys.readouterr().out)
    readings, normals = read_readings(maps / 'readings.npz', archive)
    found = cell_evidence(readings, archive.grid, archive.ml, archive.parameters, normals, (x, y))
    assert (output['row'], output['column'], output['state']) == (found.row, found.column, explain.STATES[state])
    assert output['nats_of_readings'] == pytest.approx(found.data)
    assert [row['nats'] for row in output['readings']] == pytest.approx(found.nats.tolist())
    assert [row['stamp'] for row in output['readings']] == readings.stamp[found.readings].tolist()
    assert output['number_of_readings'] == len(found.readings)
    assert code_of(explain.main, maps, x, y, '--json', '-n', 1) == 0
    fewer = json.loads(capsys.readouterr().out)
    assert fewer == {**output, 'readings': output['readings'][:1]}


def test_folder_without_maps_or_readings_is_rejected(
    maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(explain.main, tmp_path, 0, 0) == 1
    assert 'maps.npz does not exist' in capsys.readouterr().err
    assert code_of(explain.main, maps / 'ml_map.yaml', 0, 0) == 1
    assert 'give a folder that process_bag or save_maps wrote' in capsys.readouterr().err
    (tmp_path / 'maps.npz').write_bytes((maps / 'maps.npz').read_bytes())
    assert code_of(explain.main, tmp_path, 0, 0) == 1
    error = capsys.readouterr().err
    assert 'readings.npz does not exist' in error and 'without --workers' in error
    for content, reason in ((b'PK\3\4nothing', 'is damaged'), (None, 'does not belong to the maps next to it')):
        if content is None:
            with np.load(maps / 'readings.npz', allow_pickle=False) as data:
                np.savez(tmp_path / 'readings.npz', **{**data, 'log_likelihood': data['log_likelihood'] + 1e-6})
        else:
            (tmp_path / 'readings.npz').write_bytes(content)
        assert code_of(explain.main, tmp_path, 0, 0) == 1
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize('name', ['maps.npz', 'readings.npz'])
def test_file_without_read_permission_is_not_called_damaged(
    maps: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = Path.open

    def refuse(path: Path, *args: Any, **options: Any) -> Any:
        if path.name == name:
            raise PermissionError(13, 'Permission denied', str(path))
        return whole(path, *args, **options)

    monkeypatch.setattr(Path, 'open', refuse)
    assert explain.main([str(maps), '0', '0']) == 1
    assert capsys.readouterr().err == f'explain: error: {maps / name} cannot be read: Permission denied\n'


@pytest.mark.parametrize('resolution', [0.05, 0.1, 0.2])
def test_position_on_the_edge_of_the_map(resolution: float) -> None:
    nothing = np.zeros((3, 27))
    for column in range(-40, 40):
        grid = Grid(resolution, column, 0, 27, 3)
        archive = MapArchive(grid, nothing, nothing, nothing, 0.0, 0.0, Parameters())
        for edge in grid.extent[:2]:
            for x in (edge, round(edge, 6), np.nextafter(edge, -9), np.nextafter(edge, 9)):
                _, (at,) = grid.cells_of(np.array([x]), np.array([0.0]))
                assert explain._on_map(archive, float(x), 0.0) == (0 <= at < grid.width), x
    assert not explain._on_map(archive, math.inf, 0.0)
    assert not explain._on_map(archive, 0.0, 1e300)


@pytest.mark.parametrize('name', ['maps.npz', 'readings.npz'])
def test_pipe_in_place_of_a_file_is_rejected_at_once(
    maps: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'maps.npz').write_bytes((maps / 'maps.npz').read_bytes())
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    assert code_of(explain.main, tmp_path, 0, 0) == 1
    assert f'{name} is not a file' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('words', 'right'),
    [
        (('3,5', '-0.4'), '3.5'),
        (('3.5', '-0,4'), '-0.4'),
        (('-n', 2, '3,5', '0'), '3.5'),
        (('3,5', '0,4', '-n', '-3'), '3.5'),
    ],
)
def test_decimal_comma_is_rejected_with_a_remedy(
    maps: Path, words: Any, right: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(explain.main, maps, *words) == 2
    assert f'write numbers with a point: {right}\n' in capsys.readouterr().err


def test_position_with_a_comma_is_accepted(maps: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(explain.main, maps, 3.0, 4.0) == 0
    apart = capsys.readouterr().out
    assert code_of(explain.main, maps, '3.0,4.0') == 0
    assert capsys.readouterr().out == apart
    for wrong in ('3.0,', '-3.0,4.0', '3.0,nan', 'a,b', '1,2,3'):
        assert code_of(explain.main, maps, wrong) != 0
        assert 'explain: error' in capsys.readouterr().err


@pytest.mark.parametrize(('state', 'sign', 'other'), [(1, 1.0, 'free'), (0, -1.0, 'occupied')])
def test_readings_that_would_change_a_cell_are_like_those_against_it(state: int, sign: float, other: str) -> None:
    nats = sign * np.array([9.0, -0.5, -2.0])
    found: Any = SimpleNamespace(data=sign * 6.5, prior=sign * 0.5, traversed=False, readings=np.arange(3), nats=nats)
    maps: Any = None
    assert explain._decisive_evidence(maps, found, state) == (
        f'to be {other} it takes 7.0 nats more: 4 more readings like the one with the most evidence for {other}'
    )
    found.nats = np.abs(nats) * sign
    assert 'so far no single reading gives' in explain._decisive_evidence(maps, found, state)
