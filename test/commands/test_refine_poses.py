"""`process_bag --refine-poses`: drives with drift, drives that are too short, one drive and several."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from drive_samples import FILES, assert_same_maps, code_of, error_of, mapped, report_in, tape, write_tape

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.simulate import write_recording
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import in_canonical_order
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.trajectory.certainty import CalibrationEstimate
from forward_grid_mapper.core.trajectory.odometry_model import calibrated
from forward_grid_mapper.core.trajectory.poses import rms_after_alignment
from forward_grid_mapper.core.trajectory.windows import Odometry
from forward_grid_mapper.files.calibration_file import calibration_text
from forward_grid_mapper.files.journal import Journal
from forward_grid_mapper.files.map_archive import read_npz
from forward_grid_mapper.files.reading_archive import read_readings
from forward_grid_mapper.recordings.drives import read_drives
from forward_grid_mapper.simulation.drift import LEVELS, with_drift
from forward_grid_mapper.simulation.drive import Recording, drive
from forward_grid_mapper.simulation.sonar import NOISY, sonar_ring
from forward_grid_mapper.simulation.world import building_tour, building_world

REFINED = FILES | {'trajectory.tum', 'odometry.tum', 'odometry_calibration.yaml'}


class RefinedDrive(NamedTuple):
    """A drive with drift, as a bag and as a journal of the node, and the results of the bag."""

    exact: Recording
    bent: Recording
    bag: Path
    journal: Path
    report: dict[str, Any]
    maps: Path


def drifting(points: int, seed: int, bent: int) -> tuple[Recording, Recording]:
    """A drive through rooms with eight sonars, exact and with odometry that drifts."""
    exact = drive(building_world(), building_tour()[:points], 0.15, sonar_ring(8), NOISY, seed=seed)
    return exact, with_drift(exact, LEVELS['high'], bent)


@pytest.fixture(scope='module')
def refined_drive(tmp_path_factory: pytest.TempPathFactory) -> RefinedDrive:
    folder = tmp_path_factory.mktemp('kept')
    exact, bent = drifting(10, 3, 6)
    journal = Journal(folder / 'journal', print)
    assert not list(journal.restore())
    journal.put(bent.readings, ('odom', 'base_link'), [m.pose[:2] for m in bent.odometry[::5]])
    journal.close()
    bag = write_recording(folder, bent)
    report = mapped(bag, folder / 'maps', '--refine-poses', '-q')
    return RefinedDrive(exact, bent, bag, folder / 'journal', report, folder / 'maps')


def test_drift_of_a_bag_is_removed(refined_drive: RefinedDrive) -> None:
    assert {path.name for path in refined_drive.maps.iterdir()} == REFINED
    assert refined_drive.report['input']['trajectory']['refined']
    assert refined_drive.report['input']['trajectory']['odometry_off_m'] > 0.5
    true = np.array([m.pose for m in refined_drive.exact.odometry])
    for name, low, high in (('odometry', 0.7, 9.0), ('trajectory', 0.0, 0.2)):
        lines = np.loadtxt(refined_drive.maps / f'{name}.tum')
        assert len(lines) == len(true)
        assert low < rms_after_alignment(lines[:, 1:3], true) < high


def test_drive_that_is_not_refined_gives_the_same_maps(tmp_path: Path) -> None:
    write_tape(tmp_path / 'bag', tape())
    mapped(tmp_path / 'bag', tmp_path / 'plain')
    report = mapped(tmp_path / 'bag', tmp_path / 'maps', '--refine-poses')
    assert not report['input']['trajectory']['refined']
    assert report['input']['trajectory']['reason']
    assert_same_maps(tmp_path / 'maps', tmp_path / 'plain')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES
    assert 'not refined' in (tmp_path / 'maps' / 'report.txt').read_text()


def test_without_the_option_the_report_has_no_trajectory(tmp_path: Path) -> None:
    write_tape(tmp_path / 'bag', tape())
    report = mapped(tmp_path / 'bag', tmp_path / 'maps', '--set', 'odometry_noise=2deg')
    assert 'trajectory' not in report['input']
    assert 'odometry_noise has an effect only with --refine-poses, which is not given' in report['warnings']
    assert code_of(process_bag.main, tmp_path / 'bag', '-o', tmp_path / 'maps', '--refine-poses') != 0


def test_given_calibration_is_applied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exact = tape()
    wrong = {'scale': 0.03, 'heading': -0.02, 'bias': 0.03, 'turn_scale': 0.0}
    messages = exact.odometry
    true = Odometry.of(np.array([m.stamp for m in messages]), np.array([m.pose for m in messages], float))
    measured = calibrated(true, -np.array(list(wrong.values())))
    bent = [m._replace(pose=Pose2(*pose)) for m, pose in zip(messages, measured.pose.tolist(), strict=True)]
    write_tape(tmp_path / 'bag', exact)
    write_tape(tmp_path / 'bent', exact._replace(odometry=bent))
    file = tmp_path / 'calibration.yaml'
    file.write_text(
        calibration_text({name: CalibrationEstimate(value, 0.001) for name, value in wrong.items()}, 'another drive')
    )
    mapped(tmp_path / 'bag', tmp_path / 'plain', '-q')
    report = mapped(tmp_path / 'bent', tmp_path / 'maps', '-q', '--odometry-calibration', file)
    assert report['input']['trajectory']['calibrated'] == str(file)
    a, b = (
        in_canonical_order(read_readings(f / 'readings.npz', read_npz(f / 'maps.npz')).readings)
        for f in (tmp_path / 'plain', tmp_path / 'maps')
    )
    assert np.hypot(a.x - b.x, a.y - b.y).max() < 0.06
    assert 'with the calibration of' in ' '.join((tmp_path / 'maps' / 'report.txt').read_text().split())
    capsys.readouterr()
    error = error_of(capsys, tmp_path, tmp_path / 'bag', '-o', tmp_path / 'no', '--odometry-calibration', 'absent')
    assert 'absent cannot be read' in error


# ---- several drives


def drive_of(folder: Path, number: int, points: int, seed: int, bent: int | None) -> tuple[Path, np.ndarray]:
    """Write the bag of a drive on another day; return it and the true poses."""
    exact, recording = drifting(points, seed, bent or 0)
    if bent is None:
        recording = exact
    later = number * 86_400 * 10**9
    recording = replace(
        recording,
        odometry=[m._replace(stamp=m.stamp + later) for m in recording.odometry],
        ranges=[m._replace(stamp=m.stamp + later) for m in recording.ranges],
    )
    (folder / f'day_{number}').mkdir(parents=True)
    return write_recording(folder / f'day_{number}', recording), np.array([m.pose for m in exact.odometry])


@pytest.fixture(scope='module')
def days(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Two drives with drift, a short one without drift between them, and the results."""
    folder = tmp_path_factory.mktemp('days')
    drives = [drive_of(folder, 0, 10, 3, 6), drive_of(folder, 1, 3, 5, None), drive_of(folder, 2, 10, 4, 8)]
    bags = [bag for bag, _ in drives]
    assert code_of(process_bag.main, *bags, '-o', folder / 'maps', '--refine-poses', '-q') == 0
    return {'bags': bags, 'true': [true for _, true in drives], 'maps': folder / 'maps'}


@pytest.mark.slow
def test_each_drive_is_judged_separately(days: dict[str, Any]) -> None:
    report = report_in(days['maps'])
    trajectories = [drive['trajectory'] for drive in report['drives']]
    assert [found['refined'] for found in trajectories] == [True, False, True]
    assert 'm long' in trajectories[1]['reason']
    files = {f'{kind}_{number}.tum' for kind in ('trajectory', 'odometry') for number in (1, 3)}
    files |= {f'odometry_calibration_{number}.yaml' for number in (1, 3)}
    assert {path.name for path in days['maps'].iterdir()} == FILES | files
    assert [found['file'] for found in trajectories] == ['trajectory_1.tum', '', 'trajectory_3.tum']
    text = ' '.join((days['maps'] / 'report.txt').read_text().split())
    assert '2 of 3 refined, see the drives' in text
    assert "trajectory odometry's, not refined: the drive is" in text
    assert '(trajectory_3.tum)' in text


@pytest.mark.slow
def test_refined_drives_fit_those_that_are_not_refined(days: dict[str, Any]) -> None:
    found = [np.loadtxt(days['maps'] / f'trajectory_{number}.tum')[:, 1:3] for number in (1, 3)]
    for poses, true in zip(found, (days['true'][0], days['true'][2]), strict=True):
        # no alignment: the short drive determines the position of the map
        off = np.hypot(*(poses - true[:, :2]).T)
        assert np.sqrt((off**2).mean()) < 0.15
    plain = read_drives(days['bags'], Parameters(), {}).readings
    readings = read_readings(days['maps'] / 'readings.npz', read_npz(days['maps'] / 'maps.npz')).readings
    for number, stay in ((0, False), (1, True), (2, False)):
        one, other = (in_canonical_order(each.select(each.drive == number)) for each in (readings, plain))
        assert np.array_equal(one.x, other.x) == stay
        assert np.array_equal(one.z, other.z)


@pytest.mark.slow
def test_drives_that_are_all_not_refined_give_the_same_maps(days: dict[str, Any], tmp_path: Path) -> None:
    other = drive_of(tmp_path, 4, 3, 8, None)[0]
    bags = [days['bags'][1], other]
    for name, options in (('plain', []), ('maps', ['--refine-poses'])):
        assert code_of(process_bag.main, *bags, '-o', tmp_path / name, '-q', *options) == 0
    assert_same_maps(tmp_path / 'maps', tmp_path / 'plain')
    assert {path.name for path in (tmp_path / 'maps').iterdir()} == FILES
    assert '0 of 2 refined' in (tmp_path / 'maps' / 'report.txt').read_text()


# ---- journals


@pytest.mark.slow
def test_journal_is_refined_like_the_bag(tmp_path: Path, refined_drive: RefinedDrive) -> None:
    sensors = [f'--sensor={frame}={x},{y},{yaw}' for frame, (x, y, yaw) in refined_drive.bent.extrinsics]
    of_journal = mapped(refined_drive.journal, tmp_path / 'journal', '--refine-poses', '-q', *sensors)
    trajectories = [report['input']['trajectory'] for report in (refined_drive.report, of_journal)]
    assert all(found['refined'] for found in trajectories)
    assert trajectories[1]['odometry_off_m'] == pytest.approx(trajectories[0]['odometry_off_m'], abs=0.05)
    a, b = (np.loadtxt(folder / 'trajectory.tum') for folder in (refined_drive.maps, tmp_path / 'journal'))
    assert len(a) > len(b) == len(np.unique(refined_drive.bent.readings.stamp))
    at = np.stack([np.interp(b[:, 0], a[:, 0], a[:, k]) for k in (1, 2)], 1)
    # near its start a trajectory may vary a little
    assert rms_after_alignment(b[:, 1:3], at) < 0.1
    assert not any('poses of sensors have no effect' in warning for warning in of_journal['warnings'])


def test_journal_without_sensor_poses_is_not_refined(tmp_path: Path, refined_drive: RefinedDrive) -> None:
    found = mapped(refined_drive.journal, tmp_path / 'maps', '--refine-poses', '-q')['input']['trajectory']
    assert not found['refined']
    assert 'give their poses with --sensor' in found['reason']
