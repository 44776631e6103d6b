"""Bags with static transforms of inclined sensors."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rosbags', reason='bags are written with rosbags')

sys.path.insert(0, str(Path(__file__).parents[1] / 'commands'))

from drive_samples import tape, write_tape

from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.static_transforms import StaticTransforms
from forward_grid_mapper.core.common.errors import InputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.recordings.drive import Drive
from forward_grid_mapper.recordings.read_drive import read_drive


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return Path(write_tape(tmp_path / 'bag', tape()))


def read(bag: Path, monkeypatch: pytest.MonkeyPatch, **pitch: float) -> Drive:
    """The drive of a bag with pitched sensors, radians (REP 103: positive looks down)."""
    transforms = StaticTransforms()
    for frame, pose in tape().extrinsics:
        a, b = pose.yaw / 2, pitch.get(frame, 0.0) / 2
        transforms.add(
            'base_link',
            frame,
            (pose.x, pose.y, 0.2),
            (
                *(-math.sin(a) * math.sin(b), math.cos(a) * math.sin(b)),
                *(math.sin(a) * math.cos(b), math.cos(a) * math.cos(b)),
            ),
        )
    monkeypatch.setattr(Bag, 'static_transforms', lambda bag, topics: transforms)
    return read_drive(bag, Parameters(), {})


def readings_of(drive: Drive, frame: str) -> Any:
    readings = drive.associator.readings
    return readings.select(readings.sensor == readings.sensor_names.index(frame))


def test_ranges_of_an_inclined_sensor_are_projected(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, *_ = (frame for frame, _ in tape().extrinsics)
    level, inclined = read(bag, monkeypatch), read(bag, monkeypatch, **{first: 0.5, second: -0.3})
    for frame, pitch in ((first, 0.5), (second, -0.3)):
        before, after = readings_of(level, frame), readings_of(inclined, frame)
        for name in ('z', 'z_max'):
            assert getattr(after, name) == pytest.approx(getattr(before, name) * math.cos(pitch))
        assert (after.half_angle > before.half_angle).all()
        assert after.yaw == pytest.approx(before.yaw)
    assert inclined.source['warnings'] == level.source['warnings']


def test_sensor_that_looks_at_the_floor_is_left_out_and_named(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *others = (frame for frame, _ in tape().extrinsics)
    level, drive = read(bag, monkeypatch), read(bag, monkeypatch, **{first: 1.5})
    lost = len(readings_of(level, first))
    assert drive.source['counts']['rejected'] == {'steep_sensor': lost}
    assert len(drive.associator.readings) == len(level.associator.readings) - lost
    (warning,) = set(drive.source['warnings']) - set(level.source['warnings'])
    assert f"Sensor '{first}' looks down, more than 60° out of the plane" in warning
    assert not any(frame in warning for frame in others)


def test_drive_with_only_steep_sensors_is_rejected(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r'all .* were rejected: .* steep_sensor .*look up, more than 60°'):
        read(bag, monkeypatch, **{frame: -1.3 for frame, _ in tape().extrinsics})


def test_one_fault_of_many_sensors_gives_one_warning(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *others = (frame for frame, _ in tape().extrinsics)
    level, drive = read(bag, monkeypatch), read(bag, monkeypatch, **dict.fromkeys(others, 1.5))
    (warning,) = set(drive.source['warnings']) - set(level.source['warnings'])
    assert warning.startswith(f'Sensors {", ".join(map(repr, others))} look down, more than 60° out of the plane')
    assert f"'{first}'" not in warning
