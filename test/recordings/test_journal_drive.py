"""process_bag with journals that are empty, damaged or of other versions."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / 'files'))

from journal_samples import FRAMES, Previous

from forward_grid_mapper.commands.learn import main as learn
from forward_grid_mapper.commands.process_bag import main as process_bag
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.files.journal import Journal
from forward_grid_mapper.files.journal_format import ROW, with_mounts
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.recordings.journal_drive import read_journal
from forward_grid_mapper.recordings.refined import odometry_of


def journal(
    folder: Path,
    count: int,
    parameters: dict[str, Any] | None = None,
    path: Sequence[tuple[float, float]] = ((0.0, 0.0),),
    **columns: Any,
) -> Path:
    made = Journal(folder, print)
    assert not list(made.restore())
    number = np.arange(count)
    values = {'x': 0.0, 'y': 0.0, 'yaw': 0.01 * number, 'z_max': 5.0, 'half_angle': 0.1, 'stamp': number, **columns}
    readings = Readings.from_columns(names=('sonar',), z=values.pop('z', 2.0) + 0 * number, **values)
    made.parameters = parameters or {}
    made.put(readings, ('map', 'base'), list(path))
    made.close()
    return folder


def test_journal_without_readings_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'empty', 0)
    assert process_bag([str(folder), '-o', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr().err
    assert 'contains no reading' in said and 'earlier' not in said


def test_after_a_reset_the_earlier_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'reset', 300)
    (journal(tmp_path / 'empty', 0) / 'drive_0001.journal').rename(folder / 'drive_0002.journal')
    assert process_bag([str(folder), '-o', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr().err
    assert 'drive_0002.journal contains no reading; earlier files can be given by name: ' in said
    assert f'{folder / "drive_0001.journal"}' in said


def test_file_that_the_newest_one_continues_is_read_as_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / 'j'
    folder.mkdir()
    old = folder / 'drive_0001.journal'
    old.write_bytes(b'')
    made = Journal(folder, print)
    assert not list(made.restore())
    number = np.arange(40, 340)
    made.put(
        Readings.from_columns(
            names=('left',),
            x=0.01 * number,
            y=0.0,
            yaw=0.0,
            z=np.ones(300),
            z_max=9.0,
            half_angle=0.2,
            stamp=number * 10**8,
        ),
        FRAMES,
    )
    made.close()
    capsys.readouterr()
    for content, expected, said in (
        (b'', 300, f'drive_0002.journal continues drive_0001.journal: {old} is not a journal'),
        (Previous.file(40), 340, ''),
        (Previous.file(40)[:-3], 330, 'drive_0001.journal, which drive_0002.journal continues: its last'),
        (None, 300, 'drive_0001.journal, which drive_0002.journal continues: it was removed'),
    ):
        old.unlink()
        if content is not None:
            old.write_bytes(content)
        output = tmp_path / f'out {expected} {said[:20]}'
        assert process_bag([str(folder), '-q', '-o', str(output), '--set', 'max_iterations=1']) == 0
        assert f'{expected} received, {expected} accepted' in (output / 'report.txt').read_text()
        warnings = capsys.readouterr().err
        assert said in warnings and ('continues' in warnings) == bool(said)


def test_odometry_of_a_journal_is_computed_with_the_poses_of_sensors_in_it(tmp_path: Path) -> None:
    mounts = {'/sonar': Pose2(0.2, 0.0, 0.0), 'left': Pose2(0.0, 0.1, 1.5)}
    (path,) = journal(tmp_path / 'j', 20, with_mounts({}, mounts), yaw=0.0).glob('drive_*.journal')
    drive = read_journal(path, Parameters(), {})
    assert drive.mounts == {'sonar': Pose2(0.2, 0.0, 0.0), 'left': Pose2(0.0, 0.1, 1.5)}
    assert odometry_of(drive).pose[0] == pytest.approx([-0.2, 0.0, 0.0])
    # poses that are given take precedence
    drive = read_journal(path, Parameters(), {'sonar': Pose2(0.3, 0.0, 0.0)})
    assert odometry_of(drive).pose[0] == pytest.approx([-0.3, 0.0, 0.0])


def test_options_without_effect_on_a_journal_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'j', 300)
    assert process_bag([str(folder), '-o', str(tmp_path / 'a'), '--odom-topic', 'odom']) == 1
    assert 'leave out' in capsys.readouterr().err
    assert process_bag([str(folder), '-o', str(tmp_path / 'b'), '-q', '--sensor', 'sonar=0,0,0']) == 0
    assert 'have no effect' in capsys.readouterr().err
    assert learn([str(folder), '-q', '--sensor', 'sonar=0,0,0']) == 0
    assert 'have no effect' in capsys.readouterr().err
    refining = ['--refine-poses', '--sensor', 'sonar=0,0,0']
    assert process_bag([str(folder), '-o', str(tmp_path / 'c'), '-q', *refining]) == 0
    assert 'have no effect' not in capsys.readouterr().err


def test_a_part_has_the_path_of_that_part(tmp_path: Path) -> None:
    """The path in a journal has no stamps."""
    number = np.arange(300)
    way = {'x': 0.05 * number, 'stamp': number * 10**8}
    folder = journal(tmp_path / 'j', 300, path=[(x, 0.0) for x in way['x'].tolist()], **way)
    driven = {}
    for name, options in (('whole', []), ('part', ['--start', '10', '--duration', '10'])):
        assert process_bag([str(folder), '-o', str(tmp_path / name), '-q', *options]) == 0
        driven[name] = json.loads((tmp_path / name / 'report.json').read_text())['input']['path_m']
    assert driven == {'whole': pytest.approx(14.95, abs=0.1), 'part': pytest.approx(5.0, abs=0.1)}


def test_intact_readings_of_a_damaged_journal_are_mapped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'j', 300)
    changed = sqlite3.connect(folder / 'drive_0001.journal')
    rows = np.frombuffer(changed.execute('SELECT rows FROM readings').fetchone()[0], ROW).copy()
    rows['z'][:20] = np.nan
    changed.execute('UPDATE readings SET rows = ?', (rows.tobytes(),))
    changed.commit()
    changed.close()
    assert process_bag([str(folder), '-o', str(tmp_path / 'out'), '-q', '--bag']) == 0
    assert '20 readings are left out, since their range is not' in capsys.readouterr().err
    assert read_npz(tmp_path / 'out' / 'maps.npz').ml.size > 0
    assert (tmp_path / 'out' / 'maps.mcap_bag').is_dir()


def test_readings_outside_the_limits_of_a_map_are_rejected_with_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = np.zeros(300)
    far[[5, 7]] = 1.9e7, -1.9e7
    folder = journal(tmp_path / 'far', 300, x=far)
    assert process_bag([str(folder), '-o', str(tmp_path / 'a'), '-q']) == 0
    assert '2 of 300 readings are refused: the map would have more than max_cells' in capsys.readouterr().err
    folder = journal(tmp_path / 'long', 300, z=1e300, z_max=1e308)
    assert process_bag([str(folder), '-o', str(tmp_path / 'b'), '-q']) == 1
    message = capsys.readouterr().err
    assert '300 are refused: the cone has millions of cells' in message
    assert 'Traceback' not in message


def test_parameters_that_differ_from_the_node_give_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = journal(tmp_path / 'j', 300, {'resolution': 0.05})
    assert process_bag([str(folder), '-o', str(tmp_path / 'a'), '-q']) == 0
    assert 'the node that kept drive_0001.journal mapped with resolution=0.05' in capsys.readouterr().err
    assert process_bag([str(folder), '-o', str(tmp_path / 'b'), '-q', '--set', 'resolution=0.05']) == 0
    assert 'mapped with' not in capsys.readouterr().err


def test_parameters_that_are_ignored_are_not_reported_as_changed(tmp_path: Path) -> None:
    file = tmp_path / 'robot.yaml'
    file.write_text('/**:\n  ros__parameters:\n    resolution: 0.2\n    journal: /var/lib/robot\n')
    folder = journal(tmp_path / 'j', 300)
    assert process_bag([str(folder), '-o', str(tmp_path / 'a'), '-q', '--params', str(file)]) == 0
    assert list(json.loads((tmp_path / 'a' / 'report.json').read_text())['changed_parameters']) == ['resolution']


def test_journal_of_the_previous_format_gives_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'drive_0001.journal').write_bytes(Previous.file(300))
    assert process_bag([str(tmp_path), '-o', str(tmp_path / 'a'), '-q']) == 0
    assert 'has the format of the previous version, which the next version will not read' in capsys.readouterr().err


def test_database_of_another_program_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = sqlite3.connect(tmp_path / 'drive_0001.journal')
    other.execute('CREATE VIEW readings AS WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i FROM n) SELECT i FROM n')
    other.close()
    assert process_bag([str(tmp_path), '-o', str(tmp_path / 'a'), '-q']) == 1
    message = capsys.readouterr().err
    assert 'is not a journal' in message
    assert 'Traceback' not in message
