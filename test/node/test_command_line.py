"""Errors on the node's command line are reported without a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from inside import Inside
from robot import environment

from forward_grid_mapper.core.common.errors import MapperError
from forward_grid_mapper.node import error_explanations


def rejected(domain: int, *arguments: str, **changes: str) -> tuple[int, str]:
    command = [sys.executable, '-m', 'forward_grid_mapper', 'mapper', *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env={**environment(domain), **changes}
    )
    assert done.stdout == '' and 'Traceback' not in done.stderr, done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith('mapper: error: '))
    assert '/src/' not in line
    return done.returncode, line.removeprefix('mapper: error: ')


@pytest.mark.parametrize(
    ('arguments', 'code', 'expected'),
    [
        (['resolutoin:=0.1'], 2, 'did you mean resolution?'),
        (['--ros-args', '--parms-file', 'x.yaml'], 2, 'did you mean --params-file?'),
        (['--ros-args', '-r', '__node:=1st'], 1, '-r __node:=1st is not a valid rule'),
        (['--ros-args', '-p', 'range_topics:=[]'], 1, 'a parameter has no value, or an empty list'),
        (['--ros-args', '-p', 'range_topics:=5'], 1, 'range_topics: 5 is not a list of text'),
        (['--ros-args', '-p', 'use_sim_time:=5'], 1, 'use_sim_time: 5 is not true or false'),
        (['--ros-args', '-p', 'odom_topic:="a b"'], 1, "odom_topic: 'a b' is not a valid topic name"),
        (['--ros-args', '-r', '~/ml_map:=/map', '-r', '~/live_map:=/map'], 1, '/map can have only one map'),
        (['--ros-args', '-p', 'journal:=~nobody_of_this_name/x'], 1, 'there is no user nobody_of_this_name'),
    ],
)
def test_bad_arguments_are_rejected_with_reason(domain: int, arguments: list[str], code: int, expected: str) -> None:
    found, message = rejected(domain, *arguments)
    assert expected in message
    assert found == code


@pytest.mark.parametrize('number', ['5000', '-5', 'home', '1.5'])
def test_invalid_domain_is_rejected(domain: int, number: str) -> None:
    assert rejected(domain, ROS_DOMAIN_ID=number) == (
        1,
        f'ROS_DOMAIN_ID is {number}, not a whole number from 0 to 232',
    )


@pytest.mark.parametrize('number', ['', ' ', '0', '232', '+7'])
def test_valid_domains_are_accepted(number: str) -> None:
    assert error_explanations.explain_domain({'ROS_DOMAIN_ID': number}) == '' == error_explanations.explain_domain({})


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        (['--hlep'], '--hlep is not known; did you mean --help?'),
        (['bag.mcap'], 'bag.mcap is not known; ROS options must be after --ros-args'),
        (['resolution:=0.1'], 'resolution is a parameter: --ros-args -p resolution:=0.1'),
        (['-p', 'resolution:=0.1'], 'resolution is a parameter: --ros-args -p resolution:=0.1'),
        (['odom:=/wheels'], '--ros-args -r odom:=/wheels'),
        (['~/ml_map:=/map'], '--ros-args -r ~/ml_map:=/map'),
        (['__ns:=/robot1'], '--ros-args -r __ns:=/robot1'),
        (['--params-file', 'x.yaml'], '--params-file must be after --ros-args: --ros-args --params-file x.yaml'),
    ],
)
def test_argument_that_ros_rejects_has_a_message(arguments: list[str], expected: str) -> None:
    assert expected in error_explanations.explain_arguments(arguments)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ("['--remp', 'a:=b']", '--remp, a:=b: no such ROS option; did you mean --remap?'),
        ("['resolution:=1']", 'resolution:=1 must be after -p (a parameter) or -r'),
        ('odd', 'odd: no such ROS option; known are --param,'),
    ],
)
def test_unknown_ros_option_has_a_message(text: str, expected: str) -> None:
    assert expected in error_explanations.explain_ros_arguments(text)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        (
            "failed to initialize rcl: Couldn't parse remap rule: '-r foo'. Error: x, at /a/b.c:1, at /c/d.c:22",
            '-r foo is not a valid rule: use -r OLD:=NEW',
        ),
        (
            "failed to initialize rcl: Couldn't parse parameter override rule: '-p foo'. Error: x, at /a/b.c:1",
            '-p foo is not a valid parameter: use -p NAME:=VALUE',
        ),
        (
            "Couldn't parse parameter override rule: '-p sensors.a.pose:=[0,0.2,1]'. Error: x, at /a/b.c:1",
            '-p sensors.a.pose:=[0,0.2,1] is not a valid parameter: write each number of a list with a decimal point',
        ),
        (
            "Couldn't parse parameter override rule: '-p sensors.a.pose:=[0.1,0.2'. Error: x, at /a/b.c:1",
            '-p sensors.a.pose:=[0.1,0.2 is not a valid parameter: use -p NAME:=VALUE',
        ),
        (
            "failed to initialize rcl: Couldn't parse params file: '--params-file x'. Error: cannot open, at /a/b.c:1",
            '--params-file x: cannot open',
        ),
        ('failed to create node: name\n is taken, at /a/b.c:12', 'failed to create node: name is taken'),
        ('', "RuntimeError('')"),
    ],
)
def test_error_of_rclpy_is_reported_without_source_lines(text: str, expected: str) -> None:
    assert error_explanations.explain_ros_error(RuntimeError(text)).startswith(expected)


@pytest.mark.parametrize(
    ('text', 'why', 'expected'),
    [
        ('mapper:\n  ros_parameters:\n    a: 1', 'Cannot have a value before', ': ros_parameters: did you mean ros__'),
        (
            'p_hit: 0.6',
            'Cannot have a value before ros__parameters at line 1',
            'must be below /**: and ros__parameters:',
        ),
        (
            '/**:\n  ros__parameters:\n    sensors.a.pose: [0.1, 0, 0]',
            "Sequence should be of same type. Value type 'integer' do not belong at line_num 3",
            'write each number of a list with a decimal point',
        ),
    ],
)
def test_error_in_a_parameter_file_has_a_remedy(tmp_path: Path, text: str, why: str, expected: str) -> None:
    file = tmp_path / 'my.yaml'
    file.write_text(text)
    message = error_explanations.explain_ros_error(
        RuntimeError(f"Couldn't parse params file: '--params-file {file}'. Error: {why}, at /a.c:1")
    )
    assert message.startswith(f'--params-file {file}: ') and expected in message


@pytest.mark.parametrize(
    ('text', 'names'),
    [
        # as `ros2 param dump` writes it for a node without a namespace
        ('/forward_grid_mapper:\n  ros__parameters:\n    sensors:\n      a:\n        pose: [0.1, 0.0]', '/forward_'),
        ('forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}', '/forward_grid_mapper, but this node is /robot1/'),
        ('robot2: {forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}}', '/robot2/forward_grid_mapper'),
        ('\n'.join(f'{name}: {{ros__parameters: {{}}}}' for name in 'abcd'), 'of /a, /b, /c and 1 more'),
        ('/*: {ros__parameters: {p_hit: 0.5}}', '/*'),
        ('my**: {ros__parameters: {p_hit: 0.5}}', '/my**'),
        ('/robot1/forward_grid_mapper: {ros__parameters: !!python/tuple {p_hit: 0.5}}', ''),
        ('robot1: {forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}}\namcl: {ros__parameters: {x: 1}}', ''),
        ('/**: {ros__parameters: {p_hit: 0.5}}', ''),
        ('/**/forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}', ''),
        ('/*/forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}', ''),
        ('/*/*: {ros__parameters: {p_hit: 0.5}}', ''),
        ('? [1, 2]\n: 3', ''),
        ('', ''),
        ('a: b: c', ''),
        ('a: &a {b: *a}', ''),
    ],
)
def test_parameter_file_of_another_node_gives_a_warning(tmp_path: Path, text: str, names: str) -> None:
    file = tmp_path / 'my.yaml'
    file.write_text(text)
    found = error_explanations.missing_section_warnings(
        ['--ros-args', '--params-file', str(file)], '/robot1/forward_grid_mapper'
    )
    assert len(found) == bool(names)
    assert all(names in line and 'into a section /** or /robot1/forward_grid_mapper' in line for line in found)
    assert error_explanations.missing_section_warnings(['--params-file', '/nowhere.yaml', '--params-file'], '/a') == []


def test_ros_reads_the_sections_that_give_no_warning(start: Any, tmp_path: Path) -> None:
    files = []
    for k, name in enumerate(('/**', '/**/forward_grid_mapper', '/*/forward_grid_mapper', '/forward_grid_mapper')):
        files.append(tmp_path / f'{k}.yaml')
        # each has a parameter that the node does not know
        files[-1].write_text(f'{name}: {{ros__parameters: {{strange_{k}: 0.5}}}}')
    options = [part for file in files for part in ('--params-file', str(file))]
    node = start('-r', '__ns:=/robot1', *options)
    assert [f'strange_{k} is not known' in node.output for k in range(4)] == [True, True, True, False]
    assert [f'--params-file {file} is ignored' in node.output for file in files] == [False, False, False, True]


def test_save_directory_of_an_unknown_user_fails_on_save(domain: int, tmp_path: Path) -> None:
    robot = Inside(domain, tmp_path, save_directory='~nobody_of_this_name/maps').start()
    try:
        robot.drive(0, 10)
        success, message = robot.call(robot.node.saver.save_maps)
        assert not success
        assert message == ('~nobody_of_this_name/maps: there is no user nobody_of_this_name')
        robot.set(save_directory=str(tmp_path / 'maps'))
        assert robot.call(robot.node.saver.save_maps)[0]
    finally:
        robot.close()


def test_empty_list_of_range_topics_is_rejected(domain: int, tmp_path: Path) -> None:
    """ROS accepts no empty list on a command line, but a launch file in Python may contain one."""
    robot = Inside(domain, tmp_path)
    try:
        node: Any = robot.node.parameters.node
        object.__setattr__(node, 'range_topics', ())
        with pytest.raises(MapperError, match='range_topics is empty'):
            robot.node.start()
    finally:
        robot.close()
