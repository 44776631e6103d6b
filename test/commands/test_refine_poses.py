"""`process_bag --refine-poses`, on a drive whose odometry drifts and on one that is too short."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drive_samples import FILES, assert_same_maps, code_of, mapped, tape, write_tape

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.simulate import write_recording
from forward_grid_mapper.core.trajectory.poses import rms_after_alignment
from forward_grid_mapper.simulation.drift import LEVELS, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

REFINED = FILES | {'trajectory.tum', 'odometry.tum'}


@pytest.fixture(scope='module')
def exact() -> Recording:
    return drive(building_world(), building_tour()[:20], 0.15, sonar_ring(16), NOISY, seed=3)


def test_drift_is_taken_out_of_a_bag(tmp_path: Path, exact: Recording) -> None:
    folder = tmp_path / 'drive'
    folder.mkdir()
    bag = write_recording(folder, with_drift(exact, LEVELS['high'], 6))
    report = mapped(bag, tmp_path / 'maps', '--refine-poses')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == REFINED
    assert report['input']['trajectory']['refined']
    assert report['input']['trajectory']['odometry_off_m'] > 0.5
    true = np.array([m.pose for m in exact.odometry])
    for name, low, high in (('odometry', 0.7, 9.0), ('trajectory', 0.0, 0.2)):
        lines = np.loadtxt(tmp_path / 'maps' / f'{name}.tum')
        assert len(lines) == len(true)
        assert low < rms_after_alignment(lines[:, 1:3], true) < high


def test_a_drive_that_is_left_alone_gives_the_same_maps(tmp_path: Path) -> None:
    write_tape(tmp_path / 'bag', tape())
    mapped(tmp_path / 'bag', tmp_path / 'plain')
    report = mapped(tmp_path / 'bag', tmp_path / 'maps', '--refine-poses')
    assert not report['input']['trajectory']['refined']
    assert report['input']['trajectory']['reason']
    assert_same_maps(tmp_path / 'maps', tmp_path / 'plain')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES
    assert 'not refined' in (tmp_path / 'maps' / 'report.txt').read_text()


def test_without_the_option_nothing_is_said(tmp_path: Path) -> None:
    write_tape(tmp_path / 'bag', tape())
    assert 'trajectory' not in mapped(tmp_path / 'bag', tmp_path / 'maps')['input']
    assert code_of(process_bag.main, tmp_path / 'bag', '-o', tmp_path / 'maps', '--refine-poses') != 0
