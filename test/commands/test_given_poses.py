"""Poses from a file in place of odometry give the same readings, and errors are reported."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from drive_samples import Tape, code_of, error_of, report_in, tape, write_tape

from forward_grid_mapper.commands import learn, process_bag
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import NANOSECONDS
from forward_grid_mapper.files import drawing
from forward_grid_mapper.recordings.drives import read_drives
from forward_grid_mapper.recordings.given_poses import read_given_poses
from forward_grid_mapper.simulation.drive import BASE_FRAME

KINDS = ('tum', 'csv', 'ns')


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not draw: it takes most of the time of a run and is not needed here."""
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: None)


def written(path: Path, kind: str, drive: Tape | None = None, later: float = 0.0) -> Path:
    """Write the odometry of the drive as a file of poses, in reverse order."""
    lines = {'tum': ['# stamp x y z qx qy qz qw'], 'csv': ['stamp,x,y,yaw_deg'], 'ns': ['stamp_ns;x;y;theta']}[kind]
    for m in reversed((drive or tape()).odometry):
        assert m.pose is not None
        x, y, yaw = m.pose
        stamp = m.stamp + round(later * NANOSECONDS)
        lines.append(
            {
                'tum': f'{stamp / NANOSECONDS:.9f} {x} {y} 0.3 0 0 {math.sin(yaw / 2)} {math.cos(yaw / 2)}',
                'csv': f'{stamp / NANOSECONDS:.9f},{x},{y},{math.degrees(yaw)}',
                'ns': f'{stamp};{x};{y};{yaw}',
            }[kind]
        )
    path.write_text('\n'.join(lines) + '\n')
    return path


def read(bag: Path, poses: Path | None = None) -> Readings:
    given = None if poses is None else read_given_poses(poses)
    return read_drives([bag], Parameters(), {}, poses=given).readings


@pytest.mark.parametrize('kind', KINDS)
def test_poses_from_a_file_give_the_readings_of_odometry(tmp_path: Path, kind: str) -> None:
    with_odometry = write_tape(tmp_path / 'bag', tape())
    without = write_tape(tmp_path / 'without', tape()._replace(odometry=[]))
    file = written(tmp_path / 'poses', kind)
    whole = read(with_odometry)
    for bag in (with_odometry, without):
        found = read(bag, file)
        assert len(found) == len(whole) > 200
        for name in ('x', 'y', 'z'):
            np.testing.assert_allclose(getattr(found, name), getattr(whole, name), atol=1e-5)
        turn = np.angle(np.exp(1j * (found.yaw - whole.yaw)))
        np.testing.assert_allclose(turn, 0.0, atol=1e-4)


def test_comments_may_have_commas(tmp_path: Path) -> None:
    whole = read_given_poses(written(tmp_path / 'poses', 'tum'))
    (tmp_path / 'noted').write_text('# SLAM, second run\n\n' + (tmp_path / 'poses').read_text())
    np.testing.assert_array_equal(read_given_poses(tmp_path / 'noted').pose, whole.pose)
    (tmp_path / 'named').write_text('# stamp,x,y,yaw\n1,2,3,0\n')
    assert read_given_poses(tmp_path / 'named').pose.tolist() == [[2.0, 3.0, 0.0]]


def test_odometry_of_the_bag_is_ignored(tmp_path: Path) -> None:
    moved = tape()._replace(
        odometry=[m._replace(pose=m.pose._replace(x=m.pose.x + 5)) for m in tape().odometry if m.pose]
    )
    found = read(write_tape(tmp_path / 'bag', moved), written(tmp_path / 'poses', 'csv'))
    np.testing.assert_allclose(found.x, read(write_tape(tmp_path / 'true', tape())).x, atol=1e-5)


def test_base_frame_with_poses_from_a_file(tmp_path: Path) -> None:
    for name, odometry in (('with', tape().odometry), ('without', [])):
        bag = write_tape(tmp_path / name, tape()._replace(odometry=list(odometry)))
        drives = read_drives([bag], Parameters(), {}, poses=read_given_poses(written(tmp_path / 'poses', 'tum')))
        assert drives.source['base_frame'] == BASE_FRAME
        assert drives.source['map_frame'] == 'map'
        assert drives.source['odom_topic'] == str(tmp_path / 'poses')


def test_one_file_of_poses_for_parts_of_several_drives(tmp_path: Path) -> None:
    day = 86_400.0
    later = tape()._replace(
        odometry=[],
        ranges=[m._replace(stamp=m.stamp + round(day * NANOSECONDS), range=0.99 * m.range) for m in tape().ranges],
    )
    bags = [write_tape(tmp_path / 'one', tape()), write_tape(tmp_path / 'two', later)]
    first, second = written(tmp_path / 'a', 'csv'), written(tmp_path / 'b', 'csv', later=day)
    both = tmp_path / 'both.csv'
    both.write_text(first.read_text() + '\n'.join(second.read_text().splitlines()[1:]))
    assert code_of(process_bag.main, *bags, '--poses', both, '-o', tmp_path / 'maps', '--duration', 3, '-q') == 0
    report = report_in(tmp_path / 'maps')
    lengths = [drive['path_m'] for drive in report['drives']]
    assert len(lengths) == 2
    assert 0 < lengths[0] == pytest.approx(lengths[1], rel=0.2)
    assert max(drive['duration_s'] for drive in report['drives']) <= 3.0


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('', 'has no pose'),
        ('stamp,x,y,yaw\n', 'has no pose'),
        ('1.0 2 3\n', 'line 1: not the eight numbers'),
        ('stamp,x,y\n1,2,3\n', 'has no column yaw'),
        ('stamp,x,y,yaw\n1700000000000000000,2,3,0\n', 'name the column stamp_ns'),
        ('stamp,x,y,yaw\n5,2,3,0\n6,2,3,0\n', 'the stamps do not overlap: Range has'),
    ],
)
def test_bad_pose_file_is_rejected_with_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, expected: str
) -> None:
    file = tmp_path / 'poses.txt'
    file.write_text(text)
    bag = write_tape(tmp_path / 'bag', tape())
    error = error_of(capsys, tmp_path, bag, '--poses', file, '-o', tmp_path / 'maps')
    assert expected in error and 'poses.txt' in error


def test_pose_file_without_permission_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(tmp_path / 'poses', 'csv')

    def refuse(path: Path, *unused: object, **options: object) -> None:
        raise PermissionError(13, 'Permission denied', str(path))

    monkeypatch.setattr(Path, 'open', refuse)
    with pytest.raises(InputError, match=r'poses cannot be read: Permission denied$'):
        read_given_poses(file)


def test_path_that_is_no_pose_file_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    options = (bag, '-o', tmp_path / 'maps', '--poses')
    assert 'absent does not exist' in error_of(capsys, tmp_path, *options, tmp_path / 'absent')
    assert 'is not a file with poses' in error_of(capsys, tmp_path, *options, tmp_path)
    file = written(tmp_path / 'poses', 'csv')
    assert 'leave out --odom-topic' in error_of(capsys, tmp_path, *options, file, '--odom-topic', '/odom')


def test_command_printed_by_learn_names_the_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_tape(tmp_path / 'bag', tape()._replace(odometry=[]))
    file, output = written(tmp_path / 'poses', 'csv'), tmp_path / 'learned.yaml'
    assert code_of(learn.main, bag, '--poses', file, '-o', output, '--rounds', 1, '--keep-going') == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(f'--poses {file}')
