"""The parameter table in ROS: declared parameters, accepted values, and messages about others."""

from __future__ import annotations

import array
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='parameters are those of rclpy')

import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter as RosParameter

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.parameters import TABLE, Parameters
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.files.parameter_file import load_parameters
from forward_grid_mapper.node.mapper_node import MapperNode
from forward_grid_mapper.node.ros_parameters import declare, descriptor, validator, with_points

ROWS = {row.name: row for row in TABLE}


class Declaring:
    """Stand-in for a node made with parameter overrides, with what `declare` needs."""

    def __init__(self, **given: Any) -> None:
        self.given = {name.replace('__', '.'): SimpleNamespace(value=value) for name, value in given.items()}
        self.declared: dict[str, Any] = {}

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        assert prefix == ''
        return dict(self.given)

    def undeclare_parameter(self, name: str) -> None:
        del self.given[name]

    def declare_parameter(self, name: str, value: Any, described: Any, ignore_override: bool) -> None:
        assert ignore_override and described.name == name and name not in self.given
        self.declared[name] = value


def test_each_parameter_is_declared_with_its_value() -> None:
    node = Declaring(p_hit=0.7, max_iterations=7, range_topics=['a', 'b'])
    parameters, poses, warnings = declare(node)
    assert set(node.declared) == set(ROWS)
    assert (node.declared['p_hit'], node.declared['max_iterations'], node.declared['sigma']) == (
        0.7,
        7,
        ROWS['sigma'].default,
    )
    assert node.declared['range_topics'] == ['a', 'b'] and parameters.node.range_topics == ('a', 'b')
    assert parameters == Parameters.from_flat({'p_hit': 0.7, 'max_iterations': 7, 'range_topics': ('a', 'b')})
    assert (poses, warnings) == ({}, [])


def test_descriptors_have_descriptions_and_ranges() -> None:
    hit = descriptor(ROWS['p_hit'])
    assert (hit.floating_point_range[0].from_value, hit.floating_point_range[0].to_value) == (
        ROWS['p_hit'].low,
        ROWS['p_hit'].high,
    )
    assert not hit.integer_range and hit.additional_constraints == '' and not hit.read_only
    resolution = descriptor(ROWS['resolution'])
    assert resolution.description == f'{ROWS["resolution"].help} [m]'
    assert not resolution.read_only and resolution.additional_constraints == 'read when the node is configured'
    reliability = descriptor(ROWS['odom_reliability']).additional_constraints
    assert 'best_effort' in reliability and reliability.endswith('; read when the node is configured')
    assert descriptor(ROWS['autostart']).read_only
    rounds = descriptor(ROWS['max_iterations'])
    assert (rounds.integer_range[0].from_value, rounds.integer_range[0].step) == (1, 1)
    assert rounds.integer_range[0].to_value == ROWS['max_iterations'].high and not rounds.floating_point_range
    choice = descriptor(ROWS['over_range'])
    assert 'no_echo' in choice.additional_constraints and not choice.floating_point_range
    without_unit = next(row for row in TABLE if not row.unit)
    assert descriptor(without_unit).description == without_unit.help
    boundless = SimpleNamespace(**{**vars(ROWS['p_hit']), 'high': math.inf, 'range': ''})
    assert not descriptor(boundless).floating_point_range
    boundless = SimpleNamespace(**{**vars(ROWS['p_hit']), 'low': -math.inf, 'range': ''})
    assert not descriptor(boundless).floating_point_range


def test_former_name_is_accepted_and_the_new_one_has_priority() -> None:
    parameters, _, warnings = declare(Declaring(max_sweeps=5))
    assert parameters.search.max_iterations == 5
    assert len(warnings) == 1 and 'max_sweeps is called max_iterations now' in warnings[0]
    node = Declaring(max_sweeps=5, max_iterations=6)
    parameters, _, warnings = declare(node)
    assert parameters.search.max_iterations == node.declared['max_iterations'] == 6
    assert len(warnings) == 1


def test_unknown_names_give_warnings_except_those_of_ros() -> None:
    given = {'p_hitt': 1, 'use_sim_time': True, 'qos_overrides./a.reliability': 'x', 'cut': 3.0, 'sensors.a.poze': 1}
    node = Declaring()
    node.given = {name: SimpleNamespace(value=value) for name, value in given.items()}
    _, poses, warnings = declare(node)
    assert poses == {}
    assert sorted(warning.split()[1] for warning in warnings) == ['cut', 'p_hitt', 'sensors.a.poze']
    assert any('did you mean p_hit?' in warning for warning in warnings)
    assert any('a.poze' in text and 'as sensors.<frame_id>.pose: [x, y, yaw]' in text for text in warnings)
    assert any('cut is ignored: it is no longer a parameter' in warning for warning in warnings)


@pytest.mark.parametrize('value', [[1, -2, 0.5], (1.0, -2.0, 0.5), array.array('d', [1.0, -2.0, 0.5])])
def test_sensor_poses_are_read(value: Any) -> None:
    node = Declaring()
    node.given = {'sensors.front.left.pose': SimpleNamespace(value=value)}
    assert declare(node)[1] == {'front.left': Pose2(1.0, -2.0, 0.5)}


@pytest.mark.parametrize(
    'value',
    [
        *('abc', [1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, math.nan], [1.0, math.inf, 0.0], ['a', 'b', 'c'], 3, []),
        array.array('d', [1.0, 2.0]),
    ],
)
def test_bad_sensor_pose_is_rejected(value: Any) -> None:
    # rclpy has arrays
    shown = repr(value.tolist() if isinstance(value, array.array) else value)
    node = Declaring()
    node.given = {'sensors.front.pose': SimpleNamespace(value=value)}
    with pytest.raises(ParameterError, match=rf'sensors\.front\.pose: {re.escape(shown)} is not \[x, y, yaw\]'):
        declare(node)


def test_value_out_of_range_at_start_is_rejected() -> None:
    with pytest.raises(ParameterError, match=r'p_hit: 2\.0 is out of range'):
        declare(Declaring(p_hit=2.0))


@pytest.mark.parametrize('name', ['use_sim_time', 'start_type_description_service'])
@pytest.mark.parametrize('value', [5, 'yes', 1.0, [True]])
def test_switch_of_ros_that_is_not_true_or_false_is_rejected(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f'{name}: .* is not true or false'):
        declare(Declaring(**{name: value}))
    declare(Declaring(**{name: False}))


def test_values_set_at_run_time_are_checked_together() -> None:
    now = Parameters()
    accepted: list[Parameters] = []
    check = validator(lambda: now, accepted.append)
    result = check([RosParameter('p_hit', value=0.7), RosParameter('use_sim_time', value=True)])
    assert result.successful and accepted == [Parameters.from_flat({'p_hit': 0.7})]
    for changes, why in (
        ([('p_hit', 0.5), ('p_rand', 7.0)], 'p_rand'),
        (
            [('sigma', 0.1), ('sensors.front.pose', [0.0, 0.0, 0.0])],
            'sensors.front.pose is read-only while the node is configured',
        ),
    ):
        result = check([RosParameter(name, value=value) for name, value in changes])
        assert not result.successful and why in result.reason
    assert len(accepted) == 1
    for name, value in (('resolution', 0.05), ('range_topics', ['a', 'b'])):
        result = check([RosParameter(name, value=value)])
        assert not result.successful and f'{name} is read-only while the node is configured' in result.reason

    def refuse(parameters: Parameters) -> None:
        raise ParameterError('not now')

    result = validator(lambda: now, refuse)([RosParameter('p_hit', value=0.7)])
    assert (result.successful, result.reason) == (False, 'not now')


@pytest.mark.parametrize('mapping', [False, True])
def test_values_set_at_run_time_take_effect_at_once_or_after_the_journal_is_read(mapping: bool) -> None:
    """Before that, the readings from which the online map begins again are not complete."""
    done: list[str] = []
    node: Any = SimpleNamespace(
        parameters=Parameters(),
        mapping=mapping,
        _started=True,
        _when_ready=[],
        associator=SimpleNamespace(change=lambda parameters: done.append('readings')),
        live=SimpleNamespace(change=lambda parameters: done.append('live')),
        online=SimpleNamespace(change=lambda parameters: done.append('online')),
        feed=SimpleNamespace(restart_online=lambda: done.append('begins again')),
        _map_frame=SimpleNamespace(timeout=0.0),
        _live_timer=SimpleNamespace(timer_period_ns=0, reset=lambda: done.append('timer')),
    )

    def accepted(**values: Any) -> list[str]:
        done.clear()
        MapperNode._accept(node, node.parameters.varied(values))
        return [*done]

    assert accepted(pose_timeout=0.75) == ['readings', 'live', 'online'] and node._map_frame.timeout == 0.75
    # otherwise the old period ends first
    assert accepted(publish_rate=4.0)[3:] == ['timer'] and node._live_timer.timer_period_ns == 250_000_000
    assert accepted(p_hit=0.6)[3:] == ['begins again'] * mapping
    for work in node._when_ready:
        work()
    assert done[3:] == ['begins again']


def test_read_only_parameters_can_be_set_before_configure() -> None:
    accepted: list[Parameters] = []
    check = validator(Parameters, accepted.append, lambda: False)
    changes = {'resolution': 0.05, 'range_topics': ['a', 'b'], 'sensors.front.pose': [0.1, 0.0, 0.0]}
    assert check([RosParameter(name, value=value) for name, value in changes.items()]).successful
    assert accepted == [Parameters.from_flat({'resolution': 0.05, 'range_topics': ('a', 'b')})]
    for name, value in (('resolution', 0.0), ('sensors.front.pose', [0.1, 0.0])):
        result = check([RosParameter(name, value=value)])
        assert not result.successful and name in result.reason
    assert len(accepted) == 1


def test_new_poses_can_be_set_before_configure_and_unknown_names_never() -> None:
    accepted: list[Parameters] = []
    for configured in (False, True):
        check = validator(Parameters, accepted.append, lambda configured=configured: configured, {'p_hit'}.__contains__)
        for name, why in (
            ('p_hitt', 'parameter p_hitt is not known to this node; did you mean p_hit?'),
            ('cut', 'parameter cut is not known to this node: no longer a parameter'),
            ('max_sweeps', 'parameter max_sweeps is not known to this node; did you mean max_iterations?'),
            ('sensors.front.poze', 'set poses of sensors as sensors.<frame_id>.pose: [x, y, yaw]'),
            ('sensors.pose', 'set poses of sensors as sensors.<frame_id>.pose: [x, y, yaw]'),
            ('', 'is not known'),
        ):
            result = check([RosParameter('p_hit', value=0.7), RosParameter(name, value=[0.0, 0.0, 0.0])])
            assert not result.successful and why in result.reason
        assert check([RosParameter('qos_overrides./tf.depth', value=5)]).successful
        pose = check([RosParameter('sensors.front.pose', value=[0.0, 0.0, 0.0])])
        assert pose.successful is not configured
    assert 'set it between cleanup and configure' in pose.reason


def test_whole_number_is_converted_to_a_double_parameter() -> None:
    changes = [
        RosParameter('sigma', value=1),
        RosParameter('sigma', value=0.5),
        RosParameter('max_iterations', value=3),
        RosParameter('stranger', value=3),
        RosParameter('p_hit', value='often'),
    ]
    found = with_points(changes)
    kinds = RosParameter.Type
    assert [change.type_ for change in found] == [
        kinds.DOUBLE,
        kinds.DOUBLE,
        kinds.INTEGER,
        kinds.INTEGER,
        kinds.STRING,
    ]
    assert [change.name for change in found] == [change.name for change in changes]
    assert found[0].value == 1.0 and isinstance(found[0].value, float)


@pytest.mark.parametrize('order', [1, -1])
def test_file_has_the_same_values_for_the_node_and_the_offline_tool(tmp_path: Path, domain: int, order: int) -> None:
    sections = ['/**: {ros__parameters: {p_hit: 0.3}}\n', 'forward_grid_mapper: {ros__parameters: {p_hit: 0.5}}\n']
    file = tmp_path / 'parameters.yaml'
    file.write_text(''.join(sections[::order]))
    context = Context()
    rclpy.init(args=['test', '--ros-args', '--params-file', str(file)], context=context, domain_id=domain)
    try:
        node = rclpy.create_node(
            'forward_grid_mapper', context=context, automatically_declare_parameters_from_overrides=True
        )
        assert load_parameters(file).values['p_hit'] == node.get_parameter('p_hit').value
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
