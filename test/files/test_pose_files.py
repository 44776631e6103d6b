"""Poses from text files, and the reasons why others are rejected."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from forward_grid_mapper import poses_from_csv
from forward_grid_mapper.core.common.errors import InputError

HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    'text',
    [
        'stamp,x,y,yaw\n1.5,2,3,0\n2.5,4,5,1.5707963267948966\n',
        '\n# time; Y ;X; theta\n1.5; 3; 2; 0\n\n2.5; 5; 4; 1.5707963267948966\n',
        'x,y,yaw_deg,speed,timestamp_ns\n2,3,0,fast,1500000000\n4,5,90,,2500000000\n',
        f'"t","x","y","z","qx","qy","qz","qw"\n1.5,2,3,9,0,0,0,1\n2.5,4,5,9,0,0,{HALF},{HALF}\n',
        f'stamp,x,y,qz,qw,qx,qy,yaw\n1.5,2,3,1,0,0,0,0\n2.5,4,5,x,,,,{math.pi / 2}\n',
    ],
)
def test_columns_are_found_by_name(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'poses.csv'
    file.write_text(text)
    stamps, poses = poses_from_csv(file)
    np.testing.assert_allclose(stamps, [1.5, 2.5])
    np.testing.assert_allclose(poses, [[2, 3, 0], [4, 5, math.pi / 2]], atol=1e-12)


def test_file_with_only_a_header_has_no_poses(tmp_path: Path) -> None:
    (tmp_path / 'poses.csv').write_text('stamp,x,y,yaw\n')
    stamps, poses = poses_from_csv(tmp_path / 'poses.csv')
    assert (stamps.shape, poses.shape) == ((0,), (0, 3))


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('', 'is empty'),
        ('1.5,2,3,0\n', 'no column stamp or stamp_ns; its first line names 1.5, 2, 3, 0'),
        ('stamp,x,yaw\n', 'no column y;'),
        ('stamp,x,y\n', 'no column yaw or yaw_deg or qw'),
        ('stamp,x,y,qx,qy,qw\n', 'no column qz'),
        ('stamp,time,x,y,yaw\n', "'stamp' and 'time' are both stamp"),
        ('stamp,x,y,yaw\n1,2,3,0\n1,2,far,0\n', "line 3: no number for 'y'"),
        ('stamp,x,y,yaw\n1,2\n', "line 2: no number for 'y'"),
        ('stamp,x,y,yaw\n1,2,inf,0\n', "line 2: no number for 'y'"),
        ('stamp,x,y,yaw\n1,2,3,180\n', 'if these are degrees, name the column yaw_deg'),
        ('stamp,x,y,qx,qy,qz,qw\n1,2,3,0,0,0,2\n', 'line 2: the quaternion is not normalised'),
        (f'stamp,x,y,yaw\n1,2,3,"{"0" * 200_000}"\n', 'is not CSV: field larger than field limit'),
    ],
)
def test_bad_line_is_rejected_with_its_number(tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / 'poses.csv'
    file.write_text(text)
    with pytest.raises(InputError, match='poses') as caught:
        poses_from_csv(file)
    assert reason in str(caught.value)


def test_unreadable_file_is_rejected_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'absent cannot be read: No such file or directory$'):
        poses_from_csv(tmp_path / 'absent')
    (tmp_path / 'poses.csv').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(InputError, match='cannot be read'):
        poses_from_csv(tmp_path / 'poses.csv')


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    file = tmp_path / 'poses.csv'
    file.write_text('stamp,x,y,yaw\n1.5,1,2,0.5\n2.5,2,2,0.5\n', encoding='utf-8-sig')
    stamps, poses = poses_from_csv(file)
    assert stamps.tolist() == [1.5, 2.5]
    assert poses.tolist() == [[1, 2, 0.5], [2, 2, 0.5]]
