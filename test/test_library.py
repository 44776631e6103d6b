"""The library: maps from arrays are those of the node and of bags, and errors have clear messages."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import forward_grid_mapper
from forward_grid_mapper import Sonar, SonarMaps, arrays, library, make_maps, poses_from_tum
from forward_grid_mapper.core.common.errors import InputError, OutputError, ParameterError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.files.parameter_file import parse_sensor
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.sonar import NOISY, front_array
from samples import associated

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'library.md'


def given() -> dict[str, Any]:
    """A drive past a door, as arrays."""
    drive = door_drive(1, NOISY, 0, front_array())
    first = {m.frame_id: m for m in reversed(drive.ranges)}
    sensors = {
        name: Sonar(*pose, first[name].field_of_view, first[name].max_range, first[name].min_range)
        for name, pose in drive.extrinsics
    }
    return {
        'pose_stamps': [m.stamp / 1e9 for m in drive.odometry],
        'poses': [m.pose for m in drive.odometry],
        'range_stamps': [m.stamp / 1e9 for m in drive.ranges],
        'ranges': [m.range for m in drive.ranges],
        'sensors': sensors,
        'sensor_of': [m.frame_id for m in drive.ranges],
    }


def expected() -> Any:
    """The maps of the same drive as messages."""
    drive = door_drive(1, NOISY, 0, front_array())
    associator = associated(dict(drive.extrinsics), drive.odometry, drive.ranges)
    return Mapper(Parameters()).run(associator.readings)


@pytest.mark.parametrize('shuffled', [False, True])
def test_arrays_give_the_maps_of_messages(shuffled: bool) -> None:
    arrays, maps = given(), expected()
    if shuffled:
        for names in (('pose_stamps', 'poses'), ('range_stamps', 'ranges', 'sensor_of')):
            order = np.random.default_rng(0).permutation(len(arrays[names[0]]))
            for name in names:
                arrays[name] = [arrays[name][i] for i in order]
    found = make_maps(**arrays)
    assert found.received == len(arrays['ranges'])
    assert sum(found.rejected.values()) == found.received - len(found.maps.readings)
    assert found.maps.grid == maps.grid
    assert np.array_equal(found.maps.ml, maps.ml)
    assert np.array_equal(found.maps.live, maps.live, equal_nan=True)
    assert np.array_equal(found.maps.uncertainty, maps.uncertainty, equal_nan=True)


def test_ranges_follow_rep_117() -> None:
    arrays = given()
    arrays['ranges'][:4] = [math.nan, -1.0, math.inf, 1e9]
    found = make_maps(**arrays)
    assert (found.rejected['nan_range'], found.rejected['below_min_range']) == (1, 1)
    assert found.received == len(found.maps.readings) + sum(found.rejected.values())


def test_results_are_saved_with_counts(tmp_path: Path) -> None:
    arrays = given()
    arrays['ranges'][0] = math.nan
    report = make_maps(**arrays).save(tmp_path / 'maps')
    assert report['counts']['rejected']['nan_range'] == 1
    assert {path.name for path in (tmp_path / 'maps').iterdir()} >= {'ml_map.pgm', 'maps.npz', 'report.txt'}


def test_existing_folder_is_rejected_without_naming_options(tmp_path: Path) -> None:
    (tmp_path / 'mine.txt').write_text('mine')
    found = make_maps(**given())
    for taken in (tmp_path, tmp_path / 'mine.txt'):
        with pytest.raises(OutputError, match=r'choose another\b') as caught:
            found.save(taken)
        assert str(caught.value).startswith(str(taken)) and '-o' not in str(caught.value).replace(str(taken), '')
    assert [path.name for path in tmp_path.iterdir()] == ['mine.txt']


def test_ranges_in_millimetres_give_a_warning() -> None:
    arrays = given()
    arrays['sensors'] = {
        name: Sonar(s.x, s.y, s.yaw, s.field_of_view, s.max_range * 1000) for name, s in arrays['sensors'].items()
    }
    arrays['ranges'] = [1000 * z for z in arrays['ranges']]
    # only a few readings: a map of kilometres takes long
    for name in ('range_stamps', 'ranges', 'sensor_of'):
        arrays[name] = arrays[name][::4]
    assert any('mm' in warning or 'millimetre' in warning for warning in make_maps(**arrays).warnings)


def test_readings_above_max_readings_give_a_warning() -> None:
    arrays = given()
    whole = make_maps(**arrays)
    most = len(whole.maps.readings) // 2
    part = make_maps(**arrays, parameters={'max_readings': most})
    assert len(part.maps.readings) <= most
    assert any('max_readings' in warning for warning in part.warnings)
    assert not any('max_readings' in warning for warning in whole.warnings)
    # the live map has all readings
    assert np.array_equal(part.maps.live, whole.maps.live, equal_nan=True)


def test_report_has_the_warnings_of_the_result(tmp_path: Path) -> None:
    arrays = given()
    poses = np.array(arrays['poses'])
    poses[len(poses) // 2 :, 0] = 1e8
    found = make_maps(**{**arrays, 'poses': poses})
    assert any('poses were rejected' in warning for warning in found.warnings)
    assert any('ranges were rejected as' in warning for warning in found.warnings)
    assert tuple(found.save(tmp_path / 'maps')['warnings']) == found.warnings
    with pytest.raises(InputError, match='poses were rejected'):
        make_maps(**{**arrays, 'poses': poses * [0, 0, 0] + [1e8, 0, 0]})


def test_sensor_poses_are_checked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[Any] = []

    def turned(maps: Any, source: Any) -> list[str]:
        checked.append(source['extrinsics'])
        return ['sensors are turned']

    monkeypatch.setattr(library, 'data_warnings', turned)
    arrays = given()
    found = make_maps(**arrays)
    assert 'sensors are turned' in found.warnings
    assert 'sensors are turned' in found.save(tmp_path / 'maps')['warnings']
    assert checked == [{name: (s.x, s.y, s.yaw) for name, s in arrays['sensors'].items()}]


class Column:
    """A column of a table like in pandas, which is an array but no sequence."""

    def __init__(self, values: list[str]) -> None:
        self._values = values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self._values, dtype or object)


def test_sensor_names_may_be_a_column_of_a_table() -> None:
    arrays = given()
    names = arrays.pop('sensor_of')
    np.testing.assert_array_equal(make_maps(**arrays, sensor_of=Column(names)).maps.ml, expected().ml)
    with pytest.raises(InputError, match='no sensor is called sonar'):
        make_maps(**arrays, sensor_of=np.array('sonar'))


def test_parameters_may_be_numpy_scalars() -> None:
    chosen = {'resolution': np.float64(0.2), 'max_iterations': np.int64(50), 'p_hit': np.float32(0.5)}
    assert make_maps(**given(), parameters=chosen).maps.grid.resolution == 0.2


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'sensors': [Sonar(0.0, 0.0, 0.0, 0.5, 3.0)]}, 'sensors must be a mapping'),
        ({'sensors': {'f': (0, 0, 0, 0.5, 3)}}, 'sensors must be a mapping'),
        ({'sensor_of': 5}, 'sensor_of must be'),
        ({'sensor_of': {'sonar'}}, 'sensor_of must be'),
        ({'pose_stamps': [10**400, 1]}, 'pose_stamps must be numbers'),
        ({'parameters': 'resolution=0.1'}, 'parameters must be a mapping'),
        ({'parameters': {1: 2}}, 'parameters must be a mapping'),
        ({'ranges': np.array([1j])}, 'ranges must be real numbers'),
        ({'poses': np.zeros((3, 2))}, 'poses has the shape (3, 2), not'),
        ({'ranges': [1.0]}, 'ranges has the shape (1,), not'),
        ({'ranges': 'far'}, 'ranges must be numbers'),
        ({'pose_stamps': [[0.0, 1.0]]}, 'pose_stamps has the shape (1, 2), not (N,)'),
        ({'sensor_of': ['sonar']}, 'sensor_of has 1 name for'),
        ({'sensor_of': 'sonar'}, 'no sensor is called sonar; there are: '),
        ({'pose_stamps': [], 'poses': np.zeros((0, 3))}, 'there are 0 poses'),
        ({'sensors': {0: Sonar(0.0, 0.0, 0.0, 0.5, 3.0)}}, "must be strings, such as '0' in place of 0"),
        ({'ranges': np.ma.array([1.0, 2.0], mask=[0, 1])}, 'ranges has 1 masked values; fill those with nan'),
        ({'range_stamps': np.ma.array([1.0, 2.0], mask=[0, 1])}, 'range_stamps has 1 masked values; leave them out'),
        ({'poses': np.ma.array(np.zeros((3, 3)), mask=np.eye(3))}, 'poses has 3 masked values; leave them out'),
        (
            {'range_stamps': np.array([1.7e9, 1.7e9], np.float32)},
            'float32, in which numbers of this size are 128 s apart',
        ),
        ({'range_stamps': np.array([3.0, 40.0], np.float16)}, 'float16, in which numbers'),
        ({'range_stamps': [1.0, math.nan, math.inf]}, 'range_stamps has 2 stamps that are not finite; leave them out'),
        ({'parameters': {'sensors.f.pose': [0, 0, 0]}}, 'sensors.f.pose is no parameter here: give poses of sensors'),
        ({'range_stamps': np.array(['NaT'], 'M8[ns]')}, 'range_stamps has 1 times that are NaT'),
        ({'range_stamps': np.array([5], 'm8')}, 'range_stamps has the type timedelta64, which is not a type of stamps'),
        ({'range_stamps': np.array(['9999-01-01'], 'M8[D]')}, 'which is not a type of stamps'),
        ({'poses': np.zeros((3, 3), 'm8[s]')}, 'poses must be numbers, not of the type timedelta64[s]'),
    ],
)
def test_bad_array_is_rejected_with_reason(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        make_maps(**{**given(), **change})


@pytest.mark.parametrize('unit', ['M8[ns]', 'M8[us]', 'm8[ns]', 'm8[ms]'])
def test_numpy_times_are_converted_to_stamps(unit: str) -> None:
    given_ms = np.array([1_700_000_000_123, 1_700_000_000_250, -5])
    times = (np.array(0, 'M8[ms]') + given_ms.astype('m8[ms]')).astype(unit) if unit[0] == 'M' else None
    exact = arrays.stamps('t', given_ms.astype('m8[ms]').astype(unit) if times is None else times)
    assert exact.tolist() == (given_ms * 1_000_000).tolist()


def test_stamps_of_any_type_are_accepted_if_precise() -> None:
    assert arrays.stamps('t', np.array([0.5, 100.25], np.float32)).tolist() == [500_000_000, 100_250_000_000]
    assert arrays.stamps('t', [1, 2]).tolist() == [1_000_000_000, 2_000_000_000]
    assert arrays.column('ranges', np.ma.array([1.0, 2.0], mask=[0, 0])).tolist() == [1.0, 2.0]
    assert arrays.stamps('t', np.array([], np.float32)).tolist() == []


def test_two_poses_with_one_stamp_give_a_warning() -> None:
    twice = given()
    stamps, poses = np.repeat(twice['pose_stamps'], 2), np.repeat(np.array(twice['poses']), 2, axis=0)
    same = make_maps(**{**twice, 'pose_stamps': stamps, 'poses': poses})
    assert not any('two different poses' in text for text in same.warnings)
    poses[1::2] += [0.3, 0.4, 2 * math.pi]
    found = make_maps(**{**twice, 'pose_stamps': stamps, 'poses': poses})
    assert any(
        text.startswith(f'{len(stamps) // 2} stamps have two different poses, which differ by up to 0.50 m and 0°')
        for text in found.warnings
    )


def test_parameters_of_the_node_give_a_warning() -> None:
    found = make_maps(**given(), parameters={'refine_poses': True, 'journal': '/tmp/j', 'autostart': True})
    (warning,) = [text for text in found.warnings if 'ignored' in text]
    assert 'refine_poses' in warning and 'journal' in warning and 'autostart' not in warning


def test_values_in_wrong_units_are_rejected() -> None:
    arrays = given()
    with pytest.raises(InputError, match='nanoseconds by 1e9'):
        make_maps(**{**arrays, 'range_stamps': np.array(arrays['range_stamps']) * 1e9 + 1.7e18})
    with pytest.raises(InputError, match=re.escape('did you mean radians(30)?')):
        Sonar(0.0, 0.0, 0.0, 30.0, 3.0)
    with pytest.raises(InputError, match=re.escape('did you mean radians(90)?')):
        Sonar(0.0, 0.0, 90.0, 0.5, 3.0)
    with pytest.raises(InputError, match='from the middle of the robot; both are in metres'):
        Sonar(15.0, 12.0, 0.0, 0.5, 3.0)
    with pytest.raises(InputError, match='not a number'):
        Sonar('a', 0.0, 0.0, 0.5, 3.0)
    with pytest.raises(InputError, match='not a number'):
        Sonar(10**400, 0.0, 0.0, 0.5, 3.0)
    with pytest.raises(InputError, match='leave no valid range'):
        Sonar(0.0, 0.0, 0.0, 0.5, 3.0, 4.0)
    with pytest.raises(InputError, match='must be finite'):
        Sonar(0.0, math.nan, 0.0, 0.5, 3.0)
    with pytest.raises(InputError, match='must be finite'):
        Sonar(0.0, 0.0, math.inf, 0.5, 3.0)
    poses = np.array(arrays['poses'])
    poses[3, 2] = math.nan
    with pytest.raises(InputError, match='1 poses are not finite'):
        make_maps(**{**arrays, 'poses': poses})
    with pytest.raises(ParameterError, match='p_hti'):
        make_maps(**arrays, parameters={'p_hti': 0.5})


def test_stamps_that_do_not_overlap_are_reported() -> None:
    arrays = given()
    late = np.array(arrays['range_stamps']) + 1e6
    with pytest.raises(InputError, match=r'none of .* after_odometry .*poses span'):
        make_maps(**{**arrays, 'range_stamps': late})


def test_stamps_in_milliseconds_are_reported() -> None:
    arrays = given()
    kinds, begin = ('pose_stamps', 'range_stamps'), arrays['pose_stamps'][0]
    stamps = {kind: np.round(1e3 * (np.array(arrays[kind]) - begin)).astype(int) for kind in kinds}
    with pytest.raises(InputError, match=r'poses are \d+ s apart: are the stamps in milliseconds\?'):
        make_maps(**{**arrays, **stamps, 'range_stamps': stamps['range_stamps'] + 1})


def test_clock_may_begin_at_zero() -> None:
    """In a message the stamp 0 means that there is none."""
    poses, stamps = np.array([[0.1 * k, 0.0, 0.0] for k in range(30)]), 0.1 * np.arange(30)
    sonar = {'a': Sonar(0.0, 0.0, 0.0, 0.3, 3.0)}
    late = make_maps(stamps, poses, stamps[:20], np.full(20, 2.0), sonar, 'a', {'range_time_offset': 0.05})
    assert late.maps.readings.x == pytest.approx(0.05 + 0.1 * np.arange(20), abs=1e-6)
    before = make_maps(stamps[5:], poses[5:], stamps, np.full(30, 2.0), sonar, 'a')
    assert before.rejected == {'before_odometry': 5}


def test_yaw_of_a_sensor_may_be_a_full_turn_of_float32() -> None:
    assert Sonar(0.0, 0.0, float(np.float32(2 * math.pi)), 0.3, 3.0).yaw > 2 * math.pi
    assert parse_sensor('a=0,0,6.2831855')[1].yaw > 2 * math.pi


def test_tum_trajectory_is_read(tmp_path: Path) -> None:
    path = tmp_path / 'poses.txt'
    half = math.sqrt(0.5)
    path.write_text(f'# stamp x y z qx qy qz qw\n\n1.5 2 3 0.1 0 0 0 1\n2.5 4 5 0.1 0 0 {half} {half}\n')
    stamps, poses = poses_from_tum(path)
    assert stamps.tolist() == [1.5, 2.5]
    np.testing.assert_allclose(poses, [[2, 3, 0], [4, 5, math.pi / 2]], atol=1e-12)


@pytest.mark.parametrize('line', ['1 2 3', '1 2 3 4 5 6 7 x', '1 2 3 0 0 0 0 0', 'nan 2 3 0 0 0 0 1'])
def test_bad_line_of_a_trajectory_is_reported(tmp_path: Path, line: str) -> None:
    path = tmp_path / 'poses.txt'
    path.write_text(f'1.5 2 3 0.1 0 0 0 1\n{line}\n')
    with pytest.raises(InputError, match=r'poses\.txt, line 2: '):
        poses_from_tum(path)
    with pytest.raises(InputError, match='cannot be read'):
        poses_from_tum(tmp_path / 'absent.txt')


def test_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r'```python\n(.*?)```', PAGE.read_text(encoding='utf-8'), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(example, str(PAGE), 'exec'), names)
    found: SonarMaps = names['found']
    grid, ml = found.maps.grid, found.maps.ml
    assert found.rejected == {}
    rows, columns = grid.cells_of(np.array([2.0, 2.0, 2.0]), np.array([-1.0, 0.0, 1.0]))
    assert ml[rows[1], columns[1]] == 0, 'the corridor is free'
    for row in (rows[0], rows[2]):
        assert (ml[row - 1 : row + 2, columns[0]] == 1).any(), 'its walls stand'
    assert (tmp_path / 'corridor_maps' / 'ml_map.yaml').is_file()


def test_import_of_the_package_does_not_import_numba() -> None:
    code = 'import sys, forward_grid_mapper; sys.exit("numba" in sys.modules)'
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
    with pytest.raises(AttributeError, match='make_map'):
        forward_grid_mapper.make_map  # noqa: B018


def test_inclined_sensor_gives_the_maps_of_a_level_one() -> None:
    """Ranges along the inclined axis, and a cone whose projection is that of the level sensor."""
    arrays, pitch = given(), 0.5
    level = make_maps(**arrays)
    along = 1.0 / math.cos(pitch)
    inclined = {
        name: Sonar(
            *(s.x, s.y, s.yaw),
            2.0 * math.asin(math.sin(s.field_of_view / 2) * math.cos(pitch)),
            *(s.max_range * along, s.min_range * along, pitch),
        )
        for name, s in arrays['sensors'].items()
    }
    found = make_maps(**{**arrays, 'ranges': [r * along for r in arrays['ranges']], 'sensors': inclined})
    assert found.maps.readings.z == pytest.approx(level.maps.readings.z)
    assert found.maps.readings.half_angle == pytest.approx(level.maps.readings.half_angle)
    assert np.array_equal(found.maps.ml, level.maps.ml)


def test_one_dead_sensor_of_many_is_named() -> None:
    arrays = given()
    name = arrays['sensor_of'][0]
    ranges = [0.0 if sensor == name else z for sensor, z in zip(arrays['sensor_of'], arrays['ranges'], strict=True)]
    found = make_maps(**{**arrays, 'ranges': ranges})
    assert len(found.maps.readings) > 0.8 * found.received
    assert [
        text for text in found.warnings if f'nearly all readings of {name} were rejected as below_min_range' in text
    ]


def test_steep_sensors_are_rejected_with_reason() -> None:
    arrays = given()
    name, sensor = next(iter(arrays['sensors'].items()))
    steep = Sonar(sensor.x, sensor.y, sensor.yaw, sensor.field_of_view, sensor.max_range, sensor.min_range, -1.5)
    found = make_maps(**{**arrays, 'sensors': {**arrays['sensors'], name: steep}})
    assert found.rejected['steep_sensor'] == arrays['sensor_of'].count(name)
    with pytest.raises(InputError, match=r'steep_sensor \(the sensor points up or down'):
        make_maps(**{**arrays, 'sensors': dict.fromkeys(arrays['sensors'], steep)})
    with pytest.raises(InputError, match=r'did you mean radians\(30\)'):
        Sonar(0.0, 0.0, 0.0, 0.3, 4.0, pitch=30.0)


@pytest.mark.parametrize(
    ('degrees', 'speed', 'width'), [(30, 0.25, 0.9), (15, 0.25, 0.7), (15, 0.25, 0.9), (30, 0.1, 0.9), (30, 0.25, 1.2)]
)
@pytest.mark.parametrize('seed', range(3))
def test_door_seen_only_by_readings_without_echo_is_open(degrees: float, speed: float, width: float, seed: int) -> None:
    """A sonar of 3 m range has no echo through an open door to a hall; about twenty such readings must suffice."""
    t = np.arange(0.0, 5.0 / speed, 0.1)
    x = speed * t
    ahead = np.where(6.0 - x - 0.1 < 3.0, 6.0 - x - 0.1, math.inf)
    # a cone sees the jambs until it fits into the opening
    fits = abs(x - 2.85) < width / 2 - 0.9 * math.tan(math.radians(degrees / 2))
    left, right = np.where(fits, math.inf, 0.9), np.full_like(x, 0.9)
    cone = {'field_of_view': math.radians(degrees), 'max_range': 3.0}
    sensors = {
        'ahead': Sonar(x=0.1, y=0.0, yaw=0.0, **cone),
        'left': Sonar(x=0.0, y=0.1, yaw=math.pi / 2, **cone),
        'right': Sonar(x=0.0, y=-0.1, yaw=-math.pi / 2, **cone),
    }
    ranges = np.concatenate([ahead, left, right])
    ranges += np.random.default_rng(seed).normal(0.0, 0.02, len(ranges))
    poses = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    found = make_maps(t, poses, np.tile(t, 3), ranges, sensors, np.repeat(list(sensors), len(t)).tolist())
    maps = found.maps
    rows, columns = maps.grid.cells_of(np.full(3, 2.85), np.array([0.9, 1.0, 1.1]))
    assert (maps.ml[rows, columns] != 1).all()
    assert maps.uncertainty[rows, columns].max() < 0.2
    rows, columns = maps.grid.cells_of(np.array([1.5, 4.5]), np.full(2, 1.0))
    assert (maps.ml[rows, columns] == 1).all()
