"""`simulate`: the recording, the true map and path, and wrong options."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from drive_samples import code_of, everything_in, in_turn, mapped, tape

from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.commands import simulate
from forward_grid_mapper.core.common.errors import ClusterError
from forward_grid_mapper.core.messages.message_types import OdometryMessage
from forward_grid_mapper.files.map_files import read_map
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from forward_grid_mapper.simulation.world import door_world

SMALL = ('door', '--seen', 1, '--sonars', 'front')


@pytest.mark.parametrize(('kind', 'name'), [('mcap', 'bag'), ('sqlite3', 'bag'), ('ros1', 'drive.bag')])
def test_recording_with_map_and_trajectory_is_written(
    tmp_path: Path, kind: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / 'drive'
    assert code_of(simulate.main, *SMALL, '-o', folder, '--format', kind) == 0
    assert {path.name for path in folder.iterdir()} == {name, 'reference.yaml', 'reference.pgm', 'trajectory.csv'}
    out, _ = capsys.readouterr()
    assert f'{len(tape().ranges)} readings' in out and f'process_bag {folder / name}' in out
    with Bag(folder / name) as bag:
        assert list(bag.messages(bag.choose_topics())) == [message for _, message in in_turn(tape())]
        transforms = bag.static_transforms()
    for frame, pose in tape().extrinsics:
        assert transforms.lookup('base_link', frame) == pytest.approx(pose)
    grid, cells = read_map(folder / 'reference.yaml')
    world = door_world()
    assert grid == world.grid
    np.testing.assert_array_equal(np.nan_to_num(cells, nan=-1.0), world.reference)
    path_xy = np.loadtxt(folder / 'trajectory.csv', delimiter=',')
    robot = door_drive(1, NOISY, 0, front_array()).robot
    np.testing.assert_allclose(path_xy, robot[:, :2], atol=1e-4)


def test_drift_writes_the_true_trajectory_as_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / 'drive'
    assert code_of(simulate.main, *SMALL, '--drift', 'high', '-o', folder) == 0
    assert 'reference.tum, the true trajectory for evo' in capsys.readouterr().out
    true = np.loadtxt(folder / 'reference.tum')
    with Bag(folder / 'bag') as bag:
        messages = [m for m in bag.messages(bag.choose_topics()) if isinstance(m, OdometryMessage)]
    assert len(true) == len(messages)
    np.testing.assert_allclose(true[:, 0], [m.stamp * 1e-9 for m in messages], atol=1e-6)
    exact = np.array([m.pose for m in tape().odometry])
    np.testing.assert_allclose(true[:, 1:3], exact[:, :2], atol=1e-6)
    off = np.hypot(*(true[:, 1:3] - np.array([m.pose[:2] for m in messages])).T)
    assert off[0] < 1e-6 and off.max() > 0.02


def test_each_option_changes_the_recording(tmp_path: Path) -> None:
    recordings = {}
    for options in ((), ('--seed', 1), ('--noise-free',), ('--seen', 2), ('--sonars', 'ring')):
        folder = tmp_path / '-'.join(map(str, ('drive', *options)))
        assert code_of(simulate.main, *SMALL, *options, '-q', '-o', folder) == 0
        with Bag(folder / 'bag') as bag:
            recordings[options] = list(bag.messages(bag.choose_topics()))
    first = recordings.pop(())
    assert all(other != first for other in recordings.values())
    assert code_of(simulate.main, *SMALL, '-q', '-o', tmp_path / 'again') == 0
    with Bag(tmp_path / 'again' / 'bag') as bag:
        assert list(bag.messages(bag.choose_topics())) == first


def test_simulated_corridor_can_be_mapped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(simulate.main, 'corridor', '--sonars', 'front', '-q', '-o', tmp_path / 'drive') == 0
    assert capsys.readouterr() == ('', '')
    report = mapped(tmp_path / 'drive' / 'bag', tmp_path / 'maps')
    assert report['counts']['accepted'] == 4000
    assert report['input']['path_m'] == pytest.approx(59.2, abs=0.5)


@pytest.mark.parametrize(
    ('options', 'code', 'expected'),
    [
        (('door', '--seen', 0), 1, '--seen'),
        (('corridor', '--passes', -1), 1, '--passes'),
        (('door', '--seed', -1), 1, '--seed'),
        (('door', '--drives', 3), 1, '--drives is an option of the world campus'),
        (('campus', '--passes', 1), 1, '--passes is an option of the world corridor'),
        (('office',), 2, 'door'),
        (('door', '--format', 'zip'), 2, 'mcap'),
    ],
)
def test_wrong_option_is_rejected_with_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...], code: int, expected: str
) -> None:
    assert code_of(simulate.main, *options, '-o', tmp_path / 'drive') == code
    out, err = capsys.readouterr()
    assert out == '' and 'simulate: error: ' in err and expected in err and 'Traceback' not in err
    assert everything_in(tmp_path) == []


@pytest.mark.parametrize(
    ('world', 'option', 'work', 'advice'),
    [
        ('door', '--seen', 'door_drive', 'a drive of this length; lower --seen'),
        ('corridor', '--passes', 'corridor_drive', 'a drive of this length; lower --passes'),
        (
            'campus',
            '--buildings',
            'campus_world',
            'lower --buildings or --readings, or simulate fewer drives in parallel',
        ),
    ],
)
def test_lack_of_memory_is_reported_with_a_remedy(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    world: str,
    option: str,
    work: str,
    advice: str,
) -> None:
    """The usual advice for maps, a coarser resolution, does not help here."""

    def too_large(*unused: object, **options: object) -> None:
        raise MemoryError

    monkeypatch.setattr(simulate, work, too_large)
    for number, expected in ((1_000_000, advice), (10**30, f'{option} must be at most')):
        assert code_of(simulate.main, world, option, number, '-o', tmp_path / 'drive') == 1
        err = capsys.readouterr().err
        assert err.startswith('simulate: error: ') and err.count('\n') == 1
        assert expected in err and 'resolution' not in err
    assert everything_in(tmp_path) == []


def test_output_folder_is_required(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(simulate.main, 'door') == 2
    assert '--output' in capsys.readouterr().err


def test_existing_files_are_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'mine.txt').write_text('mine')
    for path in (tmp_path, tmp_path / 'mine.txt', tmp_path / 'mine.txt' / 'drive'):
        assert code_of(simulate.main, *SMALL, '-q', '-o', path) == 1
        err = capsys.readouterr().err
        assert err.startswith(f'simulate: error: {path}') and '-o' in err
    assert everything_in(tmp_path) == [str(tmp_path / 'mine.txt')]


def test_sqlite3_bag_with_a_bad_path_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(simulate.main, *SMALL, '--format', 'sqlite3', '-o', tmp_path / 'what?') == 1
    err = capsys.readouterr().err
    assert 'cannot have ?, # or %' in err
    assert err.startswith(f'simulate: error: {tmp_path / "what?" / "bag"}: ')
    assert everything_in(tmp_path) == []


CAMPUS = ('campus', '--buildings', 1, '--drives', 2, '--readings', 160, '--sonars', 'front', '-q')


def test_drives_of_a_campus_do_not_depend_on_the_number_of_jobs(tmp_path: Path) -> None:
    for jobs in (1, 2):
        assert code_of(simulate.main, *CAMPUS, '--jobs', jobs, '-o', tmp_path / str(jobs)) == 0
    assert sorted(path.name for path in (tmp_path / '1' / 'drives').iterdir()) == ['drive_0000', 'drive_0001']
    for number in range(2):
        bags = []
        for jobs in '12':
            with Bag(tmp_path / jobs / 'drives' / f'drive_{number:04d}') as bag:
                bags.append(list(bag.messages(bag.choose_topics())))
        assert bags[0] == bags[1]
    report = mapped(tmp_path / '1' / 'drives', tmp_path / 'maps')
    assert [drive['counts']['accepted'] for drive in report['drives']] == [160, 160]
    assert report['warnings'] == []


@pytest.mark.parametrize('option', [('--drives', 0), ('--buildings', 0), ('--readings', -1), ('--jobs', 0)])
def test_campus_without_buildings_drives_or_readings_is_rejected(tmp_path: Path, option: tuple[str, int]) -> None:
    assert code_of(simulate.main, *CAMPUS, *option, '-o', tmp_path / 'campus') == 1
    assert not (tmp_path / 'campus').exists()


def test_killed_process_is_reported() -> None:
    with pytest.raises(ClusterError, match=r'fewer drives in parallel \(--jobs\)'):
        list(simulate.at_once(os._exit, [1, 1], 2))
