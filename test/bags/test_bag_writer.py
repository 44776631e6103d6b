"""Writing bags: messages, quality of service, and no incomplete bags."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from bag_samples import EXTRINSICS, START, SUFFIXES, write_sample
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage

RANGE = RangeMessage(START, 'sonar_0', 1.0, 0.125, 5.0, 0.25)
GRID = Grid(0.25, -3, 5, 4, 2)
VALUES = np.array([[0, 100, -1, 50], [-1, -1, 7, 8]], np.int8)
KINDS = sorted(SUFFIXES)


def final_path(folder: Path, kind: str) -> Path:
    return folder / ('out.bag' if kind == 'ros1' else 'out')


@pytest.mark.parametrize('kind', KINDS)
def test_written_grid_and_latched_topics(tmp_path: Path, kind: str) -> None:
    path = final_path(tmp_path, kind)
    with BagWriter(path, kind) as writer:
        writer.write_static_transforms(EXTRINSICS, START)
        writer.write_range('/sonar', RANGE, radiation_type=1, time=START + 5)
        writer.write_grid('/map', GRID, VALUES, 'odom', START + 7)
    with AnyReader([path]) as reader:
        found = {c.topic: (c, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()}
    _, time, grid = found['/map']
    assert time == START + 7
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (4, 2, 0.25)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-0.75, 1.25)
    assert (grid.info.origin.orientation.w, grid.header.frame_id) == (1.0, 'odom')
    assert grid.data.tolist() == VALUES.ravel().tolist()
    assert found['/sonar'][1] == START + 5
    assert found['/sonar'][2].radiation_type == 1
    assert [t.child_frame_id for t in found['/tf_static'][2].transforms] == ['sonar_0', 'sonar_1']
    for topic, (connection, _, _) in found.items():
        latched = topic != '/sonar'
        if kind == 'ros1':
            assert connection.ext.latching == latched
        else:
            (quality,) = connection.ext.offered_qos_profiles
            assert quality.reliability == QosReliability.RELIABLE
            assert (quality.durability == QosDurability.TRANSIENT_LOCAL) == latched


@pytest.mark.parametrize('kind', KINDS)
def test_existing_path_is_rejected(tmp_path: Path, kind: str) -> None:
    path = write_sample(tmp_path, kind, count=2)
    with pytest.raises(OutputError, match='exists already'), BagWriter(path, kind):
        pass
    with Bag(path) as bag:
        assert bag.topics()['/odom'][1] == 2


@pytest.mark.parametrize('kind', KINDS)
def test_exception_leaves_no_files(tmp_path: Path, kind: str) -> None:
    path = final_path(tmp_path, kind)
    with pytest.raises(KeyboardInterrupt), BagWriter(path, kind) as writer:
        writer.write_range('/sonar', RANGE)
        assert not path.exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('kind', KINDS)
def test_interrupt_at_the_start_leaves_no_files(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*unused: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(rosbag1.Writer, 'open', interrupted)
    monkeypatch.setattr(rosbag2.Writer, 'open', interrupted)
    with pytest.raises(KeyboardInterrupt), BagWriter(final_path(tmp_path, kind), kind):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('when', ['open', 'write', 'close'])
def test_full_disk_is_reported(tmp_path: Path, kind: str, when: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = sqlite3.OperationalError('database or disk is full') if kind == 'sqlite3' else OSError(28, 'No space')

    def full(*unused: object) -> None:
        raise problem

    for writer in (rosbag1.Writer, rosbag2.Writer):
        monkeypatch.setattr(writer, when, full)
    path = final_path(tmp_path, kind)
    with pytest.raises(OutputError) as caught, BagWriter(path, kind) as writer:
        writer.write_range('/sonar', RANGE)
    assert str(caught.value) == f'{path}: the disk is full; free some space, or choose another folder.'
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('kind', KINDS)
def test_path_created_meanwhile_is_not_overwritten(tmp_path: Path, kind: str) -> None:
    path = final_path(tmp_path, kind)
    with pytest.raises(OutputError, match='exists already'), BagWriter(path, kind) as writer:
        writer.write_range('/sonar', RANGE)
        path.write_text('mine')
    assert path.read_text() == 'mine'
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('kind', KINDS)
def test_parent_folders_are_made_and_a_file_in_place_is_reported(tmp_path: Path, kind: str) -> None:
    with BagWriter(final_path(tmp_path / 'new' / 'folder', kind), kind) as writer:
        writer.write_range('/sonar', RANGE)
    assert final_path(tmp_path / 'new' / 'folder', kind).exists()
    (tmp_path / 'file').touch()
    with pytest.raises(OutputError, match='cannot be written'), BagWriter(final_path(tmp_path / 'file', kind), kind):
        pass


def test_wrong_arguments_are_rejected_with_reason(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match='mcap, sqlite3, ros1'):
        BagWriter(tmp_path / 'bag', 'hdf5')
    with pytest.raises(OutputError, match=r'must end in \.bag'), BagWriter(tmp_path / 'bag', 'ros1'):
        pass
    with pytest.raises(OutputError, match='cannot have'), BagWriter(tmp_path / '100%', 'sqlite3'):
        pass
    with pytest.raises(OutputError, match='not open'):
        BagWriter(tmp_path / 'bag').write_range('/sonar', RANGE)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_range('/sonar', RANGE)
        with pytest.raises(ValueError, match='shape'):
            writer.write_grid('/map', GRID, VALUES.T, 'odom', START)
        with pytest.raises(OutputError, match='a topic of its own'):
            writer.write_grid('/sonar', GRID, VALUES, 'odom', START)
        with pytest.raises(OutputError, match='cannot be written'):
            writer.write_range('/sonar', RANGE._replace(stamp=2**80))


@pytest.mark.parametrize('kind', KINDS)
def test_bag_with_spaces_and_accents_in_its_name_is_read(tmp_path: Path, kind: str) -> None:
    path = write_sample(tmp_path, kind, count=2, name='Büro 1 – Süd')
    with Bag(path) as bag:
        assert len(list(bag.messages(bag.choose_topics()))) == 4


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('yaw', [-3.0, -0.5, 0.0, 1.0, 2.5])
def test_written_pose_has_its_yaw(tmp_path: Path, kind: str, yaw: float) -> None:
    path, message = final_path(tmp_path, kind), OdometryMessage(START, 'odom', 'base_link', Pose2(1.0, -2.0, yaw))
    with BagWriter(path, kind) as writer:
        writer.write_odometry('/odom', message)
        writer.write_range('/sonar', RANGE)
    with Bag(path) as bag:
        (read,) = (each for each in bag.messages(bag.choose_topics()) if isinstance(each, OdometryMessage))
    assert read.pose == pytest.approx((1.0, -2.0, yaw))
