"""The link between readings and the journal: new readings are written, and those of an earlier run are restored."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the status is a message of ROS')

from stand_ins import SONAR, PlainNode

from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.files.journal_format import Contents
from forward_grid_mapper.files.journal_reader import read
from forward_grid_mapper.node import journal_keeper
from forward_grid_mapper.node.journal_keeper import CHECK_PERIOD, NOTICE, JournalKeeper

OK, WARN = b'\x00', b'\x01'


class Node(PlainNode):
    def __init__(self, parameters: Parameters) -> None:
        super().__init__()
        self.parameters = parameters
        self.timers: list[tuple[float, Callable[[], None], Any]] = []

    def create_timer(self, period: float, callback: Callable[[], None], clock: Any) -> None:
        self.timers.append((period, callback, clock))


class KeptJournal:
    """A keeper of a journal, with its associator."""

    def __init__(self, folder: Path | str, **values: Any) -> None:
        parameters = Parameters.from_flat(values)
        self.node = Node(parameters)
        self.associator = PoseAssociator(lambda base, frame, stamp: SONAR, parameters)
        self.mounts: dict[str, Pose2 | None] = {}
        self.keeper = JournalKeeper(self.node, str(folder), self.associator, lambda: self.mounts)  # type: ignore[arg-type]
        self.keeper.open()

    def start(self) -> KeptJournal:
        self.keeper.restore()
        self.keeper.begin('the clock')
        return self

    def drive(self, first: int, count: int) -> None:
        """Accept readings; their stamps are their numbers."""
        self.associator.map_frame, self.associator.base_frame = 'odom', 'base_link'
        self.associator.restore(made(np.arange(first, first + count)))

    def settle(self) -> None:
        end = time.monotonic() + 60.0
        journal = self.keeper._journal
        while journal is not None and journal.unwritten:
            assert time.monotonic() < end
            time.sleep(0.002)

    def status(self) -> Any:
        (found,) = self.keeper.statuses('mapper')
        return found

    def values(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.status().values}


def made(numbers: np.ndarray) -> Readings:
    z = np.ones(len(numbers))
    return Readings.from_columns(
        names=('sonar',), x=0.1 * numbers, y=0.0, yaw=0.0, z=z, z_max=4.0, half_angle=0.2, stamp=numbers
    )


def stored(path: Path) -> tuple[list[int], Contents]:
    contents = Contents()
    return [int(stamp) for readings in read(path, contents) for stamp in readings.stamp], contents


def test_without_a_folder_no_journal_is_kept() -> None:
    kept = KeptJournal('').start()
    kept.drive(0, 3)
    kept.keeper.take()
    assert kept.node.timers == [] and kept.associator.buffer.before_thinning == []
    assert kept.keeper.reset() == '' and kept.keeper.statuses('mapper') == []
    kept.keeper.close()


def test_new_readings_are_written_and_restored(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path, sigma=0.07).start()
    ((period, take, clock),) = kept.node.timers
    assert (period, clock) == (CHECK_PERIOD, 'the clock')
    for first in (0, 5):
        kept.drive(first, 5)
        kept.associator.extend_path((float(first), 1.0))
        take()
        take()
    kept.settle()
    kept.drive(10, 2)
    kept.keeper.close()
    found, contents = stored(tmp_path / 'drive_0001.journal')
    assert found == list(range(12)), 'what came last is written at the end'
    assert (contents.map_frame, contents.base_frame) == ('odom', 'base_link')
    assert contents.path == [(0.0, 1.0), (5.0, 1.0)]
    assert contents.parameters['sigma'] == 0.07

    again = KeptJournal(tmp_path).start()
    assert len(again.associator.buffer) == 12
    assert (again.associator.map_frame, again.associator.base_frame) == ('odom', 'base_link')
    assert list(again.associator.path) == [(0.0, 1.0), (5.0, 1.0)]
    assert 'restored 12 readings of an earlier run, in frame odom' in again.node.warned[0]
    assert again.values()['readings restored'] == '12'
    again.drive(12, 3)
    again.keeper.close()
    found, contents = stored(tmp_path / 'drive_0001.journal')
    assert found == list(range(15)), 'none is there twice'
    assert contents.path == [(0.0, 1.0), (5.0, 1.0)]


def test_sensor_that_was_moved_since_earlier_readings_is_named(tmp_path: Path) -> None:
    def run(**mounts: Pose2) -> tuple[list[str], KeptJournal]:
        kept = KeptJournal(tmp_path).start()
        kept.drive(len(kept.associator.buffer), 5)
        kept.mounts.update(mounts)
        kept.keeper.take()
        kept.keeper.close()
        return [text for text in kept.node.warned if 'pose on the robot' in text], kept

    left, right = Pose2(0.1, 0.2, 1.0), Pose2(0.1, -0.2, -1.0)
    assert run(left=left, right=right)[0] == []
    assert run(left=left._replace(yaw=1.0 + 2 * np.pi))[0] == [], 'that of the right one is not known yet'
    (warning,), _ = run(left=left, right=right._replace(yaw=-0.5))
    assert 'robot of right is another one than for earlier readings' in warning and 'call reset' in warning
    assert run(left=left, right=right._replace(yaw=-0.5))[0] == [], 'it is said once'
    kept = KeptJournal(tmp_path).start()
    kept.keeper.reset()
    kept.mounts['left'] = right
    kept.drive(0, 1)
    kept.keeper.take()
    kept.keeper.close()
    assert not any('pose on the robot' in text for text in kept.node.warned), 'a new drive has no earlier readings'


def test_sensor_on_a_turret_is_not_said_to_be_moved_after_a_restart(tmp_path: Path) -> None:
    for first in (0, 10):
        kept = KeptJournal(tmp_path).start()
        # at its first readings, it seems to be fixed
        poses = [Pose2(0.1, 0.0, 0.1 * first), None]
        for k, pose in enumerate(poses):
            kept.mounts['turret'] = pose
            kept.drive(first + k, 1)
            kept.keeper.take()
        kept.keeper.close()
        assert not any('pose on the robot' in text for text in kept.node.warned)
        assert stored(tmp_path / 'drive_0001.journal')[1].mounts == {}


def test_journal_that_continues_a_truncated_one_has_its_poses_of_sensors(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    kept.mounts['sonar'] = SONAR
    for k in range(200):
        kept.drive(20 * k, 20)
        kept.keeper.take()
    kept.keeper.close()
    os.truncate(tmp_path / 'drive_0001.journal', (tmp_path / 'drive_0001.journal').stat().st_size // 2)
    kept = KeptJournal(tmp_path).start()
    kept.settle()
    kept.keeper.close()
    found, contents = stored(tmp_path / 'drive_0002.journal')
    assert len(found) > 100 and contents.earlier is None and contents.mounts == {'sonar': SONAR}


def test_new_journal_has_no_frame(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    assert 'restored 0 readings of an earlier run, in frame (none yet)' in kept.node.warned[0]
    assert len(kept.node.warned) == 1
    kept.keeper.close()


def test_restored_readings_outside_the_map_give_a_warning(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    kept.drive(0, 5)
    kept.drive(100_000, 5)
    kept.keeper.close()
    again = KeptJournal(tmp_path, max_cells=10_000).start()
    assert len(again.associator.buffer) < 10
    assert 'of its readings do not fit into the map (max_cells, resolution)' in again.node.warned[1]
    again.keeper.close()


def test_readings_are_written_before_thinning(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    kept.drive(0, 4)
    for look in kept.associator.buffer.before_thinning:
        look()
    kept.settle()
    assert stored(tmp_path / 'drive_0001.journal')[0] == [0, 1, 2, 3]
    kept.keeper.close()


def test_reset_begins_a_new_file_and_names_the_old_one(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    assert kept.keeper.reset() == '', 'there is nothing to keep'
    kept.drive(0, 4)
    kept.associator.extend_path((1.0, 2.0))
    kept.keeper.take()
    kept.associator.clear()
    assert kept.keeper.reset() == '; the journal keeps them in drive_0001.journal'
    kept.drive(20, 2)
    kept.associator.extend_path((1.0, 2.0))
    kept.keeper.take()
    kept.settle()
    assert kept.values()['file'] == 'drive_0002.journal'
    kept.keeper.close()
    assert stored(tmp_path / 'drive_0001.journal')[0] == [0, 1, 2, 3]
    found, contents = stored(tmp_path / 'drive_0002.journal')
    assert found == [20, 21] and contents.path == [(1.0, 2.0)], 'the robot has not moved'
    again = KeptJournal(tmp_path).start()
    assert again.values()['readings restored'] == '2'
    again.associator.clear()
    again.keeper.reset()
    assert again.values()['readings restored'] == '0'
    again.keeper.close()


def test_deleted_journal_is_written_again_from_memory(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    kept.drive(0, 4)
    kept.associator.extend_path((1.0, 1.0))
    kept.keeper.take()
    kept.settle()
    for path in tmp_path.glob('drive_0001*'):
        path.unlink()
    journal, end = kept.keeper._journal, time.monotonic() + 60.0
    assert journal is not None
    while not journal.gone:
        assert time.monotonic() < end
        time.sleep(0.01)
    kept.drive(4, 1)
    kept.keeper.take()
    kept.drive(5, 2)
    kept.keeper.take()
    kept.settle()
    status = kept.status()
    assert status.level == WARN and status.message == journal.notice != ''
    # the fault is repaired: after some time only a key mentions it
    journal.noticed = time.monotonic() - NOTICE - 0.1
    assert kept.status().level == OK and kept.values()['last fault of a file'] == journal.notice
    journal.noticed = time.monotonic() - NOTICE + 30.0
    assert kept.status().level == WARN
    kept.keeper.close()
    found, contents = stored(tmp_path / 'drive_0002.journal')
    assert found == list(range(7)) and contents.path == [(1.0, 1.0)] and contents.map_frame == 'odom'


def test_changed_parameters_are_written_to_the_file(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    kept.drive(0, 1)
    kept.keeper.take()
    kept.node.parameters = Parameters.from_flat({'sigma': 0.09})
    kept.drive(1, 1)
    kept.keeper.close()
    assert stored(tmp_path / 'drive_0001.journal')[1].parameters['sigma'] == 0.09


def test_status_has_waiting_and_lost_readings(tmp_path: Path) -> None:
    kept = KeptJournal(tmp_path).start()
    status = kept.status()
    assert (status.level, status.message, status.name) == (OK, 'writing', 'mapper: journal')
    values = kept.values()
    assert values['folder'] == str(tmp_path) and values['file'] == 'drive_0001.journal'
    assert (values['readings to be written'], values['readings lost']) == ('0', '0')
    assert values['last fault of a file'] == 'none'
    journal = kept.keeper._journal
    assert journal is not None
    journal.lost = 7
    assert kept.status().level == WARN and kept.values()['readings lost'] == '7'
    assert kept.status().message == '7 readings came while nothing could be written'
    # present faults come before past ones
    journal.trouble = 'the disk is broken'
    assert kept.status().message == 'the disk is broken'
    journal.trouble, journal.lost = '', 0
    kept.keeper.close()


def failing(cause: BaseException | None) -> Callable[..., Any]:
    def fail(folder: str, warn: Any) -> Any:
        raise OutputError('cannot be opened') from cause

    return fail


@pytest.mark.parametrize('number', [errno.ENOSPC, errno.EDQUOT])
def test_node_maps_without_a_journal_if_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(journal_keeper, 'Journal', failing(OSError(number, 'full')))
    kept = KeptJournal(tmp_path).start()
    kept.drive(0, 1)
    kept.keeper.take()
    assert kept.node.warned == ['no journal is kept: cannot be opened'] and kept.node.timers == []
    assert (kept.status().level, kept.status().message) == (WARN, 'cannot be opened')
    assert kept.values() == {'folder': str(tmp_path), 'readings restored': '0'}
    assert kept.keeper.reset() == ''
    kept.keeper.close()


@pytest.mark.parametrize('cause', [OSError(errno.EACCES, 'denied'), ValueError('odd'), None])
def test_other_errors_of_the_journal_end_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: BaseException | None
) -> None:
    monkeypatch.setattr(journal_keeper, 'Journal', failing(cause))
    with pytest.raises(OutputError, match='cannot be opened'):
        KeptJournal(tmp_path)
