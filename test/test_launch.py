"""The launch file, with stand-ins for `launch` and `launch_ros` if they are not installed."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from forward_grid_mapper.core.common.parameters import TABLE, find
from forward_grid_mapper.files.parameter_file import load_parameters

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / 'launch' / 'mapper.launch.py'
MODULES = {
    'launch': ['LaunchDescription'],
    'launch.actions': ['DeclareLaunchArgument', 'LogInfo', 'OpaqueFunction'],
    'launch.conditions': ['IfCondition'],
    'launch.substitutions': ['LaunchConfiguration', 'PathJoinSubstitution'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
    'launch_ros.substitutions': ['FindPackageShare'],
}


class Call:
    """The arguments of a call of a class of launch."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments = arguments
        self.options = options

    @property
    def kind(self) -> str:
        return type(self).__name__

    def perform(self, context: dict[str, str]) -> str:
        """The text of a substitution; the context here is the values of the launch arguments."""
        return str(self.resolve(context))

    def resolve(self, values: dict[str, str]) -> Any:
        """The value of a substitution for these values of the launch arguments."""
        if self.kind == 'LaunchConfiguration':
            return values[self.arguments[0]]
        if self.kind == 'PathJoinSubstitution':
            return '/'.join(str(resolved(part, values)) for part in self.arguments[0])
        if self.kind == 'FindPackageShare':
            assert self.arguments == ('forward_grid_mapper',)
            return str(ROOT)
        if self.kind == 'ParameterValue':
            text = resolved(self.arguments[0], values)
            assert self.options['value_type'] is str
            return text
        if self.kind == 'IfCondition':
            return resolved(self.arguments[0], values).lower() == 'true'
        raise AssertionError(f'{self.kind} is no substitution')


def resolved(value: Any, values: dict[str, str]) -> Any:
    """`value` with all substitutions resolved."""
    if isinstance(value, Call):
        return value.resolve(values)
    if isinstance(value, dict):
        return {key: resolved(item, values) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(resolved(item, values) for item in value)
    return value


@pytest.fixture
def description() -> Iterator[list[Call]]:
    """The launch description of the file."""
    with pytest.MonkeyPatch.context() as patch:
        for name, kinds in MODULES.items():
            module = ModuleType(name)
            for kind in kinds:
                setattr(module, kind, type(kind, (Call,), {}))
            patch.setitem(sys.modules, name, module)
        yield runpy.run_path(str(FILE))['generate_launch_description']().arguments[0]


def started(description: list[Call], **given: str) -> list[dict[str, Any]]:
    """Options of the nodes that would start, in order."""
    values: dict[str, str] = {}
    for call in description:
        if call.kind == 'DeclareLaunchArgument':
            name = call.arguments[0]
            values[name] = given.pop(name, None) or resolved(call.options['default_value'], values)
            assert values[name] in call.options.get('choices', [values[name]])
    assert not given, 'these arguments are not declared'
    (opaque,) = (call for call in description if call.kind == 'OpaqueFunction')
    nodes = [resolved(call.options, values) for call in opaque.options['function'](values) if call.kind == 'Node']
    return [node for node in nodes if node.get('condition', True)]


def launched(description: list[Call], **given: str) -> dict[str, dict[str, Any]]:
    """Options of the nodes that would start, by executable."""
    return {node['executable']: node for node in started(description, **given)}


def test_default_launch_starts_only_the_node(description: list[Call]) -> None:
    nodes = launched(description)
    assert set(nodes) == {'mapper'}
    node = nodes['mapper']
    assert (node['package'], node['name'], node['namespace']) == ('forward_grid_mapper', 'forward_grid_mapper', '')
    # no parameters that would override the file or SetParameter
    (file,) = node['parameters']
    assert load_parameters(file).values
    assert node['arguments'] == ['--ros-args', '--log-level', 'info']
    assert node['respawn'] is False


def test_all_arguments_have_a_description(description: list[Call]) -> None:
    arguments = [call for call in description if call.kind == 'DeclareLaunchArgument']
    assert {'namespace', 'params_file', 'use_sim_time', 'rviz', 'log_level'} <= {
        call.arguments[0] for call in arguments
    }
    assert all(call.options['description'] for call in arguments)


def test_arguments_are_passed_to_the_node(description: list[Call], tmp_path: Path) -> None:
    file = tmp_path / 'my.yaml'
    file.touch()
    given = {
        'params_file': str(file),
        'use_sim_time': 'true',
        'sonar': '/range',
        'odom': 'wheels',
        'log_level': 'debug',
    }
    node = launched(description, **given)['mapper']
    assert node['parameters'] == [str(file), {'use_sim_time': True}]
    assert dict(node['remappings'])['sonar'] == '/range'
    assert dict(node['remappings'])['odom'] == 'wheels'
    assert node['arguments'][-1] == 'debug'


def test_parameter_file_in_the_home_folder_is_found_and_a_missing_one_ends_launch(
    description: list[Call], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell passes `params_file:=~/my.yaml` unchanged, and launch only warns of a file that does not exist."""
    monkeypatch.setenv('HOME', str(tmp_path))
    file = tmp_path / 'my.yaml'
    with pytest.raises(RuntimeError, match=f'params_file: there is no file {file}'):
        launched(description, params_file='~/my.yaml')
    file.touch()
    assert launched(description, params_file='~/my.yaml')['mapper']['parameters'] == [str(file)]


def test_topics_of_rviz_follow_the_namespace(description: list[Call]) -> None:
    nodes = launched(description, rviz='true', namespace='robot', odom='wheels')
    node, rviz = nodes['mapper'], nodes['rviz2']
    assert node['namespace'] == rviz['namespace'] == 'robot'
    for moved in (node, rviz):
        assert {('/tf', 'tf'), ('/tf_static', 'tf_static')} <= set(moved['remappings'])
    option, config = rviz['arguments']
    assert option == '-d'
    renamed = dict(rviz['remappings'])
    displays = yaml.safe_load(Path(config).read_text())
    for display in displays['Visualization Manager']['Displays']:
        for kind in ('Topic', 'Update Topic'):
            if topic := display.get(kind, {}).get('Value'):
                assert not renamed[topic].startswith('/'), f'{topic} would not follow the namespace'
    assert renamed['/odom'] == 'wheels'


def test_parameters_as_launch_arguments_keep_their_types(description: list[Call]) -> None:
    given = {
        'range_topics': 'left, right,',
        'range_reliability': 'reliable',
        'odom_reliability': 'best_effort',
        'map_frame': 'map',
        'online': 'true',
        'autostart': 'false',
        # a string, although YAML reads it as null
        'journal': '~',
    }
    _, chosen = launched(description, **given)['mapper']['parameters']
    assert chosen == {**given, 'range_topics': ['left', 'right'], 'online': True, 'autostart': False}
    for name, value in chosen.items():
        assert find(name).check(value) == (tuple(value) if isinstance(value, list) else value)
    *_, alone = launched(description, online='false')['mapper']['parameters']
    assert alone == {'online': False}


def test_launch_arguments_have_the_choices_of_the_table(description: list[Call]) -> None:
    declared = {call.arguments[0]: call.options for call in description if call.kind == 'DeclareLaunchArgument'}
    for row in TABLE:
        if row.name in declared and row.choices:
            assert declared[row.name]['choices'] == ['', *row.choices]
            assert declared[row.name]['default_value'] == ''


def test_chosen_map_is_remapped_for_nav2(description: list[Call]) -> None:
    nodes = launched(description, map='ml_map', rviz='true')
    assert [pair for pair in nodes['mapper']['remappings'] if pair[1] == 'map'] == [('~/ml_map', 'map')]
    renamed = dict(nodes['rviz2']['remappings'])
    assert renamed['/forward_grid_mapper/ml_map'] == 'map'
    # the mapper names the updates after the topic of the map
    assert renamed['/forward_grid_mapper/ml_map_updates'] == 'map_updates'
    assert renamed['/forward_grid_mapper/live_map'] == 'forward_grid_mapper/live_map'
    assert not [pair for pair in launched(description)['mapper']['remappings'] if pair[1] == 'map']


@pytest.mark.parametrize('chosen', ['', 'ml_map', 'live_map', 'uncertainty_map'])
def test_map_of_probabilities_logs_the_settings_for_nav2(description: list[Call], chosen: str) -> None:
    values = {call.arguments[0]: '' for call in description if call.kind == 'DeclareLaunchArgument'}
    values |= {'map': chosen, 'params_file': str(ROOT / 'config' / 'mapper.yaml')}
    (opaque,) = (call for call in description if call.kind == 'OpaqueFunction')
    messages = [call.options['msg'] for call in opaque.options['function'](values) if call.kind == 'LogInfo']
    assert len(messages) == (chosen in ('live_map', 'uncertainty_map'))
    assert all('lethal_cost_threshold: 65' in text for text in messages)


@pytest.mark.parametrize('written', ['true', 'True'])
def test_switches_accept_the_spelling_of_python(description: list[Call], written: str) -> None:
    nodes = launched(description, use_sim_time=written, online=written, rviz=written, use_respawn=written)
    assert nodes['mapper']['parameters'][1:] == [{'use_sim_time': True}, {'online': True}]
    assert nodes['rviz2']['parameters'] == [{'use_sim_time': True}]
    assert nodes['mapper']['respawn'] is True


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        ({}, []),
        ({'refine_poses': 'false'}, []),
        ({'refine_poses': 'True'}, ['-f', 'map']),
        ({'map_frame': 'site'}, ['-f', 'site']),
        # the node strips the slash of ROS 1 as well
        ({'map_frame': '/site'}, ['-f', 'site']),
        ({'map_frame': 'site', 'refine_poses': 'true'}, ['-f', 'site']),
    ],
)
def test_fixed_frame_of_rviz_is_that_of_the_maps(
    description: list[Call], given: dict[str, str], expected: list[str]
) -> None:
    """RViz filters maps by the transform to its fixed frame at their stamps, unless they are in that frame."""
    assert launched(description, rviz='true', **given)['rviz2']['arguments'][2:] == expected


def test_mapper_is_respawned_on_request(description: list[Call]) -> None:
    node = launched(description, use_respawn='true')['mapper']
    assert node['respawn'] is True
    assert node['respawn_delay'] > 0


def test_rviz_starts_first_so_that_its_absence_leaves_no_mapper(description: list[Call]) -> None:
    assert [node['executable'] for node in started(description, rviz='true')] == ['rviz2', 'mapper']


def test_launch_accepts_the_file() -> None:
    pytest.importorskip('launch_ros', reason='launch_ros is not installed (a sourced ROS 2)')
    made = runpy.run_path(str(FILE))['generate_launch_description']()
    names = {argument.name for argument in made.get_launch_arguments()}
    assert {'namespace', 'params_file', 'rviz'} <= names
