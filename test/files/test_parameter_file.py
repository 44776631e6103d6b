"""Parameters in files and on command lines."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.parameter import Parameter
from forward_grid_mapper.core.common.parameters import CONSTANTS, TABLE, Parameters
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.files.parameter_file import ParameterFile, load_parameters, parse_sensor, parse_setting
from forward_grid_mapper.files.parameter_text import dump_parameters, parameters_markdown


def admitted(row: Parameter) -> st.SearchStrategy[Any]:
    if row.choices:
        return st.sampled_from(row.choices)
    if row.type is bool:
        return st.booleans()
    words = st.text('abc/_~.', min_size=1)
    if row.type in (str, tuple):
        return words if row.type is str else st.lists(words, max_size=3).map(tuple)
    return st.integers(int(row.low), int(row.high)) if row.type is int else st.floats(row.low, row.high)


all_values = st.fixed_dictionaries({row.name: admitted(row) for row in TABLE}).filter(
    lambda values: values['p_rand'] + values['p_lost'] <= 0.99
)


def load(tmp_path: Path, text: str) -> ParameterFile:
    (tmp_path / 'p.yaml').write_text(text)
    return load_parameters(tmp_path / 'p.yaml')


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(values=all_values)
def test_dumped_parameters_are_read_back(tmp_path: Path, values: dict[str, Any]) -> None:
    parameters = Parameters.from_flat(values)
    read = load(tmp_path, dump_parameters(parameters))
    assert Parameters.from_flat(read.values) == parameters
    assert not read.extrinsics and not read.node


def test_dump_is_commented_and_plain_yaml() -> None:
    text = dump_parameters(Parameters())
    assert all(len(line) <= 100 for line in text.splitlines())
    for row in TABLE:
        assert row.help.split()[0] in text
        assert f'\n    {row.name}: ' in text
    # A parser of YAML 1.1 must see numbers too.
    assert yaml.safe_load(text)['/**']['ros__parameters'] == {
        name: list(value) if isinstance(value, tuple) else value for name, value in Parameters().flat().items()
    }


def test_markdown_has_a_row_for_each_parameter() -> None:
    text = parameters_markdown()
    rows = [line for line in text.splitlines() if line.startswith('| `')]
    assert len(rows) == len(TABLE) + len(CONSTANTS)
    columns = {row.split('`')[1]: row.replace('\\|', '').count('|') for row in rows}
    assert columns == {row.name: 6 for row in TABLE} | {row.name: 6 for row in CONSTANTS}
    assert text.count('\n## ') == len({row.group for row in TABLE})


@pytest.mark.parametrize(
    'text',
    [
        'p_hit: 0.3\nrange_topics: [a, b]\nsensors: {base/left.1: {pose: [0, 0.5, 1e-1]}}',
        '/**:\n  ros__parameters:\n    p_hit: 0.3\n    range_topics: [a, b]\n'
        '    sensors.base/left.1.pose: [0, 0.5, 0.1]',
        'forward_grid_mapper:\n  ros__parameters:\n    p_hit: 3e-1\n    range_topics: [a, b]\n'
        '    sensors:\n      base/left.1.pose: [0, 0.5, 0.1]',
        '/robot/forward_grid_mapper:\n  ros__parameters:\n    p_hit: 0.3\n    range_topics: [a, b]\n'
        '    sensors: {base/left.1: {pose: [0, 0.5, 0.1]}}\namcl: {ros__parameters: {alpha1: 0.2}}',
        'robot:\n  renamed:\n    ros__parameters:\n      p_hit: 0.3\n      range_topics: [a, b]\n'
        '      sensors: {base/left: {1.pose: [0, 0.5, 0.1]}}',
    ],
)
def test_all_forms_of_a_parameter_file_are_read(tmp_path: Path, text: str) -> None:
    assert load(tmp_path, text) == ParameterFile(
        {'p_hit': 0.3, 'range_topics': ('a', 'b')}, {'base/left.1': Pose2(0.0, 0.5, 0.1)}, {}
    )


@pytest.mark.parametrize(('pose', 'count'), [('[0, 0.5, 1]', 1), ('[0, 1, 1]', 0), ('[0.0, 0.5, 1e-1]', 0)])
def test_list_that_ros_rejects_gives_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, pose: str, count: int
) -> None:
    assert load(tmp_path, f'sensors.a.pose: {pose}').extrinsics['a'].x == 0.0
    warned = ['each number of [0, 0.5, 1] with a decimal point' in message for message in caplog.messages]
    assert warned == [True] * count


def test_parameters_of_another_node_give_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert load(tmp_path, 'slam_toolbox: {ros__parameters: {resolution: 0.05}}').values == {'resolution': 0.05}
    assert caplog.messages == [
        'parameters of slam_toolbox are used, which a node with the name forward_grid_mapper does not read'
    ]


@pytest.mark.parametrize('text', ['', '# nothing', '/**:\n  ros__parameters:\n', '{}'])
def test_file_without_values_is_read(tmp_path: Path, text: str) -> None:
    assert load(tmp_path, text) == ParameterFile({}, {}, {})


def test_later_one_of_the_sections_of_the_node_and_of_all_nodes_overrides(tmp_path: Path) -> None:
    """As in the node, which `test_ros_parameters.py` compares."""
    own = 'forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}\n'
    common = '/**: {ros__parameters: {p_hit: 0.3, use_sim_time: true}}\n'
    for text, p_hit in ((own + common, 0.3), (common + own, 0.5)):
        assert load(tmp_path, text) == ParameterFile({'p_hit': p_hit}, {}, {'use_sim_time': True})


def test_later_section_wins_for_a_frame_with_a_slash(tmp_path: Path) -> None:
    own = 'forward_grid_mapper: {ros__parameters: {sensors./a.pose: [0.5, 0.0, 0.0]}}\n'
    common = '/**: {ros__parameters: {sensors.a.pose: [0.1, 0.0, 0.0], sensors.b.pose: [0.2, 0.0, 0.0]}}\n'
    assert load(tmp_path, common + own).extrinsics == {'/a': (0.5, 0.0, 0.0), 'b': (0.2, 0.0, 0.0)}


def test_section_of_all_nodes_applies_in_a_namespace(tmp_path: Path) -> None:
    common = '/**: {ros__parameters: {p_hit: 0.3, p_rand: 0.2}}\nother:\n'
    own = '/r1: {forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}}'
    assert load(tmp_path, common + own).values == {'p_hit': 0.5, 'p_rand': 0.2}


def test_parameters_of_ros_are_accepted(tmp_path: Path) -> None:
    assert load(tmp_path, 'qos_overrides: {/odom: {subscription: {depth: 5}}}').node == {
        'qos_overrides./odom.subscription.depth': 5
    }


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('p_hitt: 0.3', 'did you mean p_hit'),
        ('range_topic: [a]', 'did you mean range_topics'),
        ('p_hit: often', "p_hit: 'often' is not a number"),
        ('p_hit: 1.5', 'p_hit: 1.5 is out of range'),
        ('p_hit:', 'p_hit: None is not a number'),
        ('max_iterations: 1.5', 'max_iterations: 1.5 is not a whole number'),
        ('online: 1', 'online: 1 is not true or false'),
        ('over_range: keep', 'not one of no_echo, discard'),
        ('p_hit: 0.3\np_hit: 0.4', 'p_hit is given twice'),
        ('sensors.a.pose: [0, 0, 0]\nsensors: {a: {pose: [0, 0, 1]}}', 'sensors.a.pose is given twice'),
        ('sensors.a.pose: [0, 0, 0]\nsensors./a.pose: [0, 0, 1]', r'sensors\.a\.pose and sensors\./a\.pose are'),
        ('sensors.a.pose: [0, 0]', 'sensors.a.pose: .* three finite numbers'),
        ('sensors.a.pose: [0, 0, 0, 0]', 'three finite numbers'),
        ('sensors.a.pose: [0, 0, .nan]', 'three finite numbers'),
        ('sensors.a.pose: [0, true, 1]', 'three finite numbers'),
        ('sensors.a.pose: "0, 0, 0"', 'three finite numbers'),
        ('sensors.a.position: [0, 0, 0]', r'sensors\.<frame_id>\.pose'),
        ('sensor.a.pose: [0, 0, 0]', r'sensors\.<frame_id>\.pose'),
        ('sensors.a.pose: [0, 0, 90]', 'more than a full turn'),
        ('forward_grid_maper: {ros__parameters: {p_hit: 0.5}}', 'did you mean forward_grid_mapper'),
        ('/robot/forward_gridmapper: {ros__parameters: {p_hit: 0.5}}', 'did you mean forward_grid_mapper'),
        ('/**: {ros_parameters: {p_hit: 0.5}}', 'ros_parameters: did you mean ros__parameters'),
        ('sensors: [a]', r'sensors\.<frame_id>\.pose'),
        ('- p_hit', 'names with values'),
        ('/**: {ros__parameters: [1]}', 'names with values'),
        ('amcl: {ros__parameters: {a: 1}}\nother: {ros__parameters: {a: 1}}', 'there are: amcl, other'),
        (
            'r1: {forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}}\n'
            '/r2/forward_grid_mapper: {ros__parameters: {p_hit: 0.6}}',
            r'several namespaces \(r1/forward_grid_mapper, /r2/forward_grid_mapper\)',
        ),
        (
            'p_rand: 0.1\nforward_grid_mapper: {ros__parameters: {p_hit: 0.5}}',
            'p_rand: a node reads only the values below',
        ),
        ('forward_grid_mapper: {p_rand: 0.1, ros__parameters: {p_hit: 0.5}}', r'forward_grid_mapper\.p_rand: a node'),
        ('r1: {p_rand: 0.1, amcl: {ros__parameters: {p_hit: 0.5}}}', 'r1/p_rand: a node'),
        ('p_hit: [', 'not valid YAML'),
        ('? [a, b]\n: 1', 'not valid YAML|no parameter is called'),
        ('p_hit: !!python/object/apply:os.getcwd []', 'not valid YAML'),
    ],
)
def test_bad_parameter_file_is_rejected_with_reason(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message) as caught:
        load(tmp_path, text)
    assert str(tmp_path / 'p.yaml') in str(caught.value)


def test_unreadable_parameter_file_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match='cannot be read'):
        load_parameters(tmp_path / 'absent.yaml')
    for content in (b'\xff\xfe\x00\x81', 'p_hit: 0.5  # Größe'.encode('latin-1')):
        (tmp_path / 'binary').write_bytes(content)
        with pytest.raises(ParameterError, match=r'binary is not text in UTF-8, from byte \d+ on; save it in this'):
            load_parameters(tmp_path / 'binary')


@settings(deadline=None)
@given(values=all_values)
def test_settings_round_trip(values: dict[str, Any]) -> None:
    for name, value in values.items():
        text = ', '.join(value) if isinstance(value, tuple) else value
        assert parse_setting(f' {name} = {text} ') == (name, value)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('p_hit', 'form name=value'),
        ('=1', 'form name=value'),
        ('p_hitt=1', 'did you mean p_hit'),
        ('p_hit=', "'' is not a number"),
        ('p_hit=nan', 'out of range'),
        ('max_iterations=1.5', "'1.5' is not a whole number"),
        ('sigma=5deg', "'5deg' is not a number"),
        ('field_of_view=xdeg', "'xdeg' is not a number"),
        ('field_of_view=200deg', 'out of range'),
        ('online=maybe', 'not true or false'),
    ],
)
def test_bad_setting_is_rejected_with_reason(text: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        parse_setting(text)


def test_setting_of_an_angle_in_degrees() -> None:
    assert parse_setting('field_of_view=30deg') == ('field_of_view', pytest.approx(math.pi / 6))
    assert parse_setting('field_of_view = 30 deg') == ('field_of_view', pytest.approx(math.pi / 6))


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('left=0.1,-2,1.5', ('left', Pose2(0.1, -2.0, 1.5))),
        (' base/left = 0.1, 1e-2, 90 deg', ('base/left', Pose2(0.1, 0.01, math.pi / 2))),
        ('a=b=0,0,-90deg', ('a=b', Pose2(0.0, 0.0, -math.pi / 2))),
    ],
)
def test_sensor_pose_is_parsed(text: str, expected: tuple[str, Pose2]) -> None:
    assert parse_sensor(text) == expected


@pytest.mark.parametrize(
    'text',
    ['left', '=1,2,3', 'left=1,2', 'left=1,2,3,4', 'left=1,2,inf', 'left=a,b,c', 'left=', 'left=1,2,90degrees'],
)
def test_bad_sensor_pose_is_rejected(text: str) -> None:
    with pytest.raises(ParameterError, match='form frame=x,y,yaw'):
        parse_sensor(text)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('left=0.1,0.2,90', 'is it left=0.1,0.2,90deg'),
        ('left=0.1,0.2,-90', 'is it left=0.1,0.2,-90deg'),
        ('left=0.1,0.2,1e4', 'more than a full turn'),
        ('left=15,12,90deg', 'x and y are in metres'),
    ],
)
def test_sensor_pose_in_other_units_is_rejected(text: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        parse_sensor(text)


def test_removed_parameters_are_ignored_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / 'old.yaml'
    file.write_text('bridges: 10\nend_cost: 2.0\nshift_moves: true\ncell_distance: center\n')
    values = {**load_parameters(file).values, **dict([parse_setting('driven_cost=20')])}
    assert Parameters.from_flat(values) == Parameters.from_flat({'end_cost': 2.0})
    assert len(caplog.messages) == 4
    assert all('ignored' in message for message in caplog.messages)
