"""The parameter table as ROS parameters: descriptors, ranges, validation, and the poses of sensors."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from ..core.common.errors import ParameterError
from ..core.common.former_parameters import DEPRECATED, RENAMED, deprecation
from ..core.common.parameter import Parameter
from ..core.common.parameters import TABLE, Parameters
from ..core.messages.message_types import Pose2
from ..core.messages.mounts import mount_from

ROS_SWITCHES = ('use_sim_time', 'start_type_description_service')
ROS_OWN = (*ROS_SWITCHES, 'qos_overrides')
NAMES = {row.name for row in TABLE}
CONFIGURED = {row.name for row in TABLE if row.read_only}
"""Parameters that `configure` reads, like the poses of sensors."""

AT_START = ('autostart',)
"""Those of them that only the start of the process reads."""

_POSE = re.compile(r'sensors\.(?P<frame>.+)\.pose', re.DOTALL)


def descriptor(row: Parameter) -> ParameterDescriptor:
    """Return the ROS descriptor of a row of the table."""
    constraints = [
        '' if row.type in (int, float) else row.range,
        'read when the node is configured' if row.read_only else '',
    ]
    made = ParameterDescriptor(
        name=row.name,
        description=f'{row.help} [{row.unit}]' if row.unit else row.help,
        additional_constraints='; '.join(filter(None, constraints)),
        read_only=row.name in AT_START,
    )
    if row.type is float and math.isfinite(row.low) and math.isfinite(row.high):
        made.floating_point_range = [FloatingPointRange(from_value=row.low, to_value=row.high)]
    elif row.type is int:
        made.integer_range = [IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)]
    return made


def declare(node: Node) -> tuple[Parameters, dict[str, Pose2], list[str]]:
    """Declare every parameter; return their values, the poses of sensors, and warnings about unknown names.

    The node must be created with `automatically_declare_parameters_from_overrides`, since the names of the poses are
    not known beforehand.

    Raises
    ------
    ParameterError
        If a value has the wrong type or is out of range.
    """
    given = node.get_parameters_by_prefix('')
    for name in ROS_SWITCHES:
        # rclpy only logs it, and a node without the clock of a simulation would wait for other stamps
        if name in given and not isinstance(given[name].value, bool):
            raise ParameterError(f'{name}: {given[name].value!r} is not true or false; admitted: true | false')
    former = {new: old for old, new in RENAMED.items()}
    values = {}
    for row in TABLE:
        value = row.default
        # the new name takes precedence
        for name in (former.get(row.name, ''), row.name):
            if name in given:
                value = row.check(given[name].value)
                node.undeclare_parameter(name)
        values[row.name] = value
        stored = list(value) if isinstance(value, tuple) else value
        node.declare_parameter(row.name, stored, descriptor(row), ignore_override=True)
    poses = _extrinsics(given)
    for name in filter(_is_pose, given):
        # rclpy has declared it with a fixed type, so that it could not be deleted
        node.undeclare_parameter(name)
        node.declare_parameter(name, given[name].value, _pose_descriptor(name), ignore_override=True)
    return Parameters.from_flat(values), poses, _unknown_names(given)


def mounts(node: Node) -> dict[str, Pose2]:
    """Return the poses of sensors that are given as parameters.

    Raises
    ------
    ParameterError
        If a value is not a pose.
    """
    return _extrinsics(node.get_parameters_by_prefix(''))


def validator(
    current: Callable[[], Parameters],
    accept: Callable[[Parameters], None],
    configured: Callable[[], bool] = lambda: True,
    declared: Callable[[str], bool] = lambda name: True,
) -> Callable[[Any], Any]:
    """Return a callback that checks parameters before they are set.

    Parameters
    ----------
    current : callable
        Returns the current parameters.
    accept : callable
        Receives the new ones if all are valid.
    configured : callable
        Returns whether the node is configured, so that it has read the parameters in `CONFIGURED`.
    declared : callable
        Returns whether the node has a parameter. The only others that are accepted are poses of sensors, and those of
        ROS, which rclpy declares by setting them.
    """

    def check(changes: list[RosParameter]) -> SetParametersResult:
        try:
            for change in changes:
                name = change.name
                if not (declared(name) or _is_known(name)):
                    raise ParameterError(_unknown(name))
                if configured() and (name in CONFIGURED or name.startswith('sensors.')):
                    raise ParameterError(
                        f'{name} is read-only while the node is configured: restart the node with it, or set it '
                        'between cleanup and configure'
                    )
            _extrinsics({change.name: change for change in changes if not _deletes(change)})
            known = {change.name: change.value for change in changes if change.name in NAMES}
            accept(Parameters.from_flat(known, base=current()))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    return check


def with_points(changes: list[RosParameter]) -> list[RosParameter]:
    """Return parameters with integers converted to doubles where the parameter has this type.

    So `p_hit 1` is accepted without a decimal point, and the parameter keeps its type.
    """
    floats = {row.name for row in TABLE if row.type is float}
    return [
        RosParameter(change.name, RosParameter.Type.DOUBLE, float(change.value))
        if change.name in floats and change.type_ == RosParameter.Type.INTEGER
        else change
        for change in changes
    ]


def _pose_descriptor(name: str) -> ParameterDescriptor:
    """Return the descriptor of the pose of a sensor."""
    return ParameterDescriptor(
        name=name,
        description='Pose of the sensor on the robot: x, y, yaw [m, m, rad]',
        additional_constraints='read when the node is configured',
        dynamic_typing=True,
    )


def _deletes(change: RosParameter) -> bool:
    return bool(change.type_ == RosParameter.Type.NOT_SET)


def _is_pose(name: str) -> bool:
    return _POSE.fullmatch(name) is not None


def _is_known(name: str) -> bool:
    """Return whether a parameter is one of this node, or of ROS, whether or not it is declared."""
    return name in NAMES or _is_pose(name) or name.partition('.')[0] in ROS_OWN


def _extrinsics(given: dict[str, RosParameter]) -> dict[str, Pose2]:
    return {
        found['frame']: mount_from(name, parameter.value)
        for name, parameter in given.items()
        if (found := _POSE.fullmatch(name))
    }


def _unknown_names(given: dict[str, RosParameter]) -> list[str]:
    return [
        deprecation(name) if name in DEPRECATED or name in RENAMED else _unknown(name, ' and is ignored')
        for name in given
        if not _is_known(name)
    ]


def _unknown(name: str, outcome: str = '') -> str:
    """Return that the node has no such parameter, with a remedy if one is known."""
    near = [RENAMED[name]] if name in RENAMED else difflib.get_close_matches(name, NAMES, n=1)
    hint = f'; did you mean {near[0]}?' if near else ''
    if name in DEPRECATED:
        hint = f': {DEPRECATED[name]}'
    if re.match(r'sensors?\.', name):
        hint = '; set poses of sensors as sensors.<frame_id>.pose: [x, y, yaw]'
    return f'parameter {name} is not known to this node{outcome}{hint}'
