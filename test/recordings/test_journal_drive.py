"""process_bag on a journal that is not what it should be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from forward_grid_mapper.commands.process_bag import main as process_bag
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.files.journal import Journal
from forward_grid_mapper.files.map_archive import read_npz


def journal(folder: Path, count: int) -> Path:
    made = Journal(folder, print)
    assert not list(made.restore())
    number = np.arange(count)
    readings = Readings.from_columns(
        names=('sonar',),
        x=0.0,
        y=0.0,
        yaw=0.01 * number,
        z=2.0 + 0 * number,
        z_max=5.0,
        half_angle=0.1,
        stamp=number,
    )
    made.put(readings, ('map', 'base'), [(0.0, 0.0)])
    made.close()
    return folder


def test_a_journal_without_readings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'empty', 0)
    assert process_bag([str(folder), '-o', str(tmp_path / 'out')]) == 1
    assert 'holds no reading' in capsys.readouterr().err


def test_options_that_a_journal_has_no_use_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'j', 300)
    assert process_bag([str(folder), '-o', str(tmp_path / 'a'), '--odom-topic', 'odom']) == 1
    assert 'leave out' in capsys.readouterr().err
    assert process_bag([str(folder), '-o', str(tmp_path / 'b'), '-q', '--sensor', 'sonar=0,0,0']) == 0
    assert 'change nothing' in capsys.readouterr().err


def test_a_damaged_journal_is_mapped_as_far_as_it_goes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = journal(tmp_path / 'j', 300)
    path = folder / 'drive_0001.journal'
    with path.open('ab') as file:
        file.write(b'\xf5FGMtorn')
    assert process_bag([str(folder), '-o', str(tmp_path / 'out'), '-q', '--bag']) == 0
    assert 'cut off' in capsys.readouterr().err
    assert read_npz(tmp_path / 'out' / 'maps.npz').ml.size > 0
    assert (tmp_path / 'out' / 'maps.mcap_bag').is_dir()
