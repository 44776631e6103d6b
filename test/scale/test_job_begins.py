"""Checks before a job begins, its work folder and its plan."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from scaled_jobs import Here, code_of, job_in, scaled

sys.path.insert(0, str(Path(__file__).parents[1] / 'files'))

from journal_samples import FRAMES, made, opened

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.core.common.errors import ClusterError, OutputError
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.recordings.drive import WHOLE
from forward_grid_mapper.scale.job import DriveArguments, Job, check_versions, plan_of, versions
from forward_grid_mapper.scale.work_folder import WorkFolder, whole


@scaled
def test_options_without_effect_are_reported_with_workers(drives: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []

    def with_workers(options: Any, parameters: Any, extrinsics: Any, ignored: list[str], *_: Any) -> int:
        reported.extend(ignored)
        return 0

    monkeypatch.setattr(process_bag, 'with_workers', with_workers)
    assert code_of(drives, '--workers', 2, '--set', 'odometry_noise=2deg') == 0
    assert reported == ['odometry_noise has an effect only with --refine-poses, which is not given']


@scaled
def test_workers_map_all_readings_whatever_max_readings_is(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from forward_grid_mapper.scale import cluster, mapping

    given: list[int] = []

    def interrupted(workers: Here, job: Job, *_: object) -> None:
        given.append(job.parameters.association.max_readings)
        raise KeyboardInterrupt

    monkeypatch.setattr(cluster, 'Cluster', lambda *_: Here())
    monkeypatch.setattr(mapping, 'ScaledMapper', interrupted)
    assert code_of(drives, '-o', tmp_path / 'maps', '--workers', 1, '--set', 'max_readings=5000') == 130
    assert given == [0]


@scaled
def test_poses_of_sensors_given_for_a_journal_are_reported(tmp_path: Path) -> None:
    from forward_grid_mapper.scale.placing import place

    journal, _ = opened(tmp_path / 'journal')
    journal.put(made(0, 50), FRAMES, [(0.0, 0.0)])
    journal.close()
    given = DriveArguments((str(tmp_path / 'journal'),), {'left': Pose2(0.0, 0.0, 0.0)}, None, None, WHOLE)
    placed = place(job_in(tmp_path / 'work'), 0, given)
    assert [text for text in placed['source']['warnings'] if 'given poses of sensors have no effect' in text]


def test_missing_extra_is_reported_with_a_remedy(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert code_of(drives, '-o', tmp_path / 'maps', '--workers', 2) == 1
    assert "pip install 'forward_grid_mapper[scale]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@scaled
@pytest.mark.parametrize(
    ('options', 'expected'),
    [
        (('--workers', 0), '--workers'),
        (('--workers', 100_000), 'cores; give at most'),
        (('--scheduler', 'nonsense'), 'is not the address of a scheduler'),
        (('--scheduler', 'http://localhost:8786'), 'is not the address of a scheduler'),
        (('--scheduler', ''), 'is not the address of a scheduler'),
        (('--workers', 2, '--scheduler', 'tcp://a:1'), 'leave out --workers'),
        (('--workers', 2, '--memory-per-worker', 0.1), '--memory-per-worker'),
        (('--workers', 2, '--refine-poses'), '--refine-poses'),
        (('--workers', 2, '--odometry-calibration', 'wheels.yaml'), '--odometry-calibration'),
        (('--workers', 2, '--learn', 1), '--learn'),
        (('--work', 'here'), '--work'),
    ],
)
def test_incompatible_options_are_rejected(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...], expected: str
) -> None:
    assert code_of(drives, '-o', tmp_path / 'maps', *options) == 1
    assert expected in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_other_version_is_rejected_by_name() -> None:
    check_versions(versions())
    with pytest.raises(ClusterError, match=r'numpy .*, not 0\.1.*install the same'):
        check_versions({**versions(), 'numpy': '0.1'})


def test_work_folder_belongs_to_one_job(tmp_path: Path) -> None:
    work = WorkFolder(str(tmp_path / 'work'))
    assert not work.begin({'tiles': 5.0, 'of': (1, 2)})
    assert work.begin({'tiles': 5.0, 'of': (1, 2)})
    with pytest.raises(OutputError, match=r'another job .*differ in tiles.*--work'):
        work.begin({'tiles': 6.0, 'of': (1, 2)})
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'file').touch()
    with pytest.raises(OutputError, match='not empty'):
        WorkFolder(str(tmp_path / 'other')).begin({})
    assert [path.name for path in (tmp_path / 'other').iterdir()] == ['file']


def test_work_folder_is_used_by_one_command_at_a_time(tmp_path: Path) -> None:
    work, same = WorkFolder(str(tmp_path / 'work')), WorkFolder(str(tmp_path / 'work'))
    work.begin({'tiles': 5.0})
    with work.held():
        assert same.begin({'tiles': 5.0})
        with pytest.raises(OutputError, match=r'another process_bag works in .*work; wait .*--work'), same.held():
            pass
        assert same.manifest.exists()
    with same.held():
        shutil.rmtree(same.root)
    with pytest.raises(OutputError, match='another process_bag works in'), work.held():
        pass
    assert not work.root.exists()


@scaled
def test_second_command_leaves_the_work_of_the_first(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before a drive is placed, a command that ends without results removes its own work folder."""
    from forward_grid_mapper.scale import cluster

    work, codes = tmp_path / 'work', []

    def start_again(*_: object) -> None:
        codes.append(code_of(drives, '-o', tmp_path / 'second', '--workers', 1, '--work', work))
        assert (work / 'manifest.json').exists()
        raise ClusterError('no worker')

    monkeypatch.setattr(cluster, 'Cluster', start_again)
    assert code_of(drives, '-o', tmp_path / 'first', '--workers', 1, '--work', work) == 1
    assert codes == [1]
    assert 'another process_bag works in' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_worker_uses_the_plan_of_the_next_job(tmp_path: Path) -> None:
    work = WorkFolder(str(tmp_path))
    for name, width in (('left', 30), ('right', 50)):
        plan = {
            'grid': [0.1, 0, 0, width, 20],
            'widest': 3.0,
            'sensor_names': [name],
            'drives': [0],
            'sensors': {0: [0]},
        }
        work.plan.unlink(missing_ok=True)
        work.plan.write_text(json.dumps(plan))
        found = plan_of(work, 5.0)
        assert (found.sensor_names, found.tiling.grid.width) == ((name,), width)
        assert plan_of(work, 5.0) is found


@pytest.mark.parametrize(('number', 'expected'), [(errno.ENOSPC, 'disk is full'), (errno.EACCES, 'permission')])
def test_file_is_complete_or_unchanged(tmp_path: Path, number: int, expected: str) -> None:
    (tmp_path / 'file').write_text('before')
    with pytest.raises(OutputError, match=expected), whole(tmp_path / 'file') as partial:
        partial.write_text('half of')
        raise OSError(number, os.strerror(number))
    assert (tmp_path / 'file').read_text() == 'before'
    assert [path.name for path in tmp_path.iterdir()] == ['file']
