"""Reads parameters: a ROS 2 parameter file, a flat YAML, or `name=value` on a command line."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ..core.common.errors import ParameterError
from ..core.common.former_parameters import DEPRECATED
from ..core.common.parameter import Parameter
from ..core.common.parameters import LOG, find
from ..core.messages.message_types import Pose2
from ..core.messages.mounts import more_than_a_turn, mount_from
from .small_text import read_text

NODE_NAME = 'forward_grid_mapper'

LIKE = 0.85
"""Similarity (`difflib`) from which the name of a section is regarded as a misspelt `NODE_NAME`."""

# Parameters that ROS itself declares on every node.
_ROS_OWN = re.compile(r'use_sim_time|start_type_description_service|qos_overrides\..+')
_MOUNT = re.compile(r'sensors\.(?P<frame>.+)\.pose')


class ParameterFile(NamedTuple):
    """Contents of a parameter file.

    Attributes
    ----------
    values : dict
        Checked values of the table's parameters, by name; those of `DEPRECATED` too, which `Parameters` leaves out.
    extrinsics : dict
        Pose of each sensor in the robot's base frame, by `frame_id`.
    node : dict
        Values of the parameters that ROS itself declares for every node, unchecked.
    """

    values: dict[str, Any]
    extrinsics: dict[str, Pose2]
    node: dict[str, Any]


def load_parameters(path: Path | str) -> ParameterFile:
    """Read a ROS 2 parameter YAML, or a flat mapping of names to values.

    Names may be nested or dotted. In a ROS file the sections `/**` and `forward_grid_mapper` (in one namespace) are
    used, and the later one takes precedence, as in the node; a section of another name is used, with a warning in the
    log, if it is the only one, as for a renamed node, unless its name looks misspelt.

    Raises
    ------
    ParameterError
        Naming the file, if it cannot be read, or contains an unknown or repeated name, an invalid value, values outside
        of its sections, or sections of `forward_grid_mapper` in several namespaces.
    """
    path = Path(path)
    try:
        text = read_text(path, ParameterError)
    except OSError as error:
        raise ParameterError(f'{path} cannot be read: {error.strerror}') from error
    try:
        document = yaml.load(text, _Loader)
        flat: dict[str, Any] = {}
        for section in _sections({} if document is None else document):
            _merge(flat, dict(_flatten(section)))
        return _sort_out(flat)
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    except RecursionError as error:
        raise ParameterError(f'{path} is not valid YAML: it is nested too deeply') from error
    except Exception as error:  # besides its own, yaml raises errors of int(), date() and others
        raise ParameterError(f'{path} is not valid YAML: {error}') from error


def parse_setting(text: str) -> tuple[str, Any]:
    """Return the name and the checked value of `name=value`; unchecked for the names of `DEPRECATED`.

    Angles are in radians or, with the suffix `deg`, in degrees.

    Raises
    ------
    ParameterError
        If the text has another form, the name is unknown or the value is not valid.
    """
    name, equals, value = (part.strip() for part in text.partition('='))
    if not equals or not name:
        raise ParameterError(f'{text!r} is not of the form name=value, such as p_hit=0.6')
    if name in DEPRECATED:
        return name, value
    if name.startswith('sensors.'):
        frame = name.removeprefix('sensors.').removesuffix('.pose')
        raise ParameterError(f'{text!r} is a pose of a sensor: give --sensor {frame}=x,y,yaw')
    row = find(name)
    return name, row.check(_typed(row, value))


def parse_sensor(text: str) -> tuple[str, Pose2]:
    """Return the frame and pose of `frame=x,y,yaw`: metres, and radians or, with the suffix `deg`, degrees.

    Raises
    ------
    ParameterError
        If the text has another form, a number is not finite, or a value can only have another unit.
    """
    frame, _, numbers = (part.strip() for part in text.rpartition('='))
    parts = numbers.split(',')
    degrees = parts[-1].strip().endswith('deg')
    parts[-1] = parts[-1].strip().removesuffix('deg')
    try:
        x, y, yaw = (float(part) for part in parts)
    except ValueError:
        x = y = yaw = math.nan
    if not frame or not all(map(math.isfinite, (x, y, yaw))):
        raise ParameterError(
            f'{text!r} is not of the form frame=x,y,yaw, such as sonar_left=0.1,0.15,1.57 or '
            'sonar_left=0.1,0.15,90deg: three numbers with decimal points, and no unit other than deg'
        )
    if not degrees and more_than_a_turn(yaw) and abs(yaw) <= 360.0:
        raise ParameterError(f'{text!r}: a yaw of {yaw:g} rad is more than a full turn; is it {frame}={numbers}deg?')
    return frame, mount_from(frame, [x, y, math.radians(yaw) if degrees else yaw])


class _Loader(yaml.SafeLoader):
    """A safe loader that refuses repeated keys and reads `1e-4` as a number, as ROS does.

    It refuses aliases too, as ROS does: a few lines of them can expand to more values than fit into memory.
    """

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ParameterError(f'aliases (*) are not supported (line {self.line + 1})')
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise ParameterError(f'{key.value} is given twice (line {key.start_mark.line + 1})')
            seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)[eE][-+]?\d+$'), list('-+.0123456789')
)


def _sections(document: Any) -> list[dict[str, Any]]:
    """Return the parameter mappings of a file, the more specific ones last."""
    if not isinstance(document, dict):
        raise ParameterError('it must contain names with values, such as "p_hit: 0.6"')
    found = {name: section or {} for name, section in _ros_sections(document, '')}
    if not found:
        return [document]
    if stray := list(_outside(document)):
        raise ParameterError(
            f'{", ".join(stray[:6])}: a node reads only the values below ros__parameters; put them into one of the '
            f'sections {", ".join(found)}'
        )
    wildcards = [name for name in found if name.strip('/') in ('*', '**')]
    own = [name for name in found if name.rpartition('/')[2] == NODE_NAME]
    if len(own) > 1:
        raise ParameterError(
            f'it has {NODE_NAME} in several namespaces ({", ".join(own)}); give a file with the section of only one '
            'of them'
        )
    # in the order of the file: rcl sets the values of all sections that match, one after the other
    if chosen := [section for name, section in found.items() if name in wildcards + own]:
        return chosen
    if len(found) > 1:
        raise ParameterError(f'it has no section for {NODE_NAME} or /**; there are: {", ".join(found)}')
    ((name, only),) = found.items()
    if difflib.get_close_matches(name.rpartition('/')[2], [NODE_NAME], cutoff=LIKE):
        raise ParameterError(f'the section {name} is for another node; did you mean {NODE_NAME}?')
    LOG.warning('parameters of %s are used, which a node with the name %s does not read', name, NODE_NAME)
    return [only]


def _ros_sections(document: dict[Any, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in document.items():
        if isinstance(value, dict):
            if 'ros__parameters' in value:
                yield f'{prefix}{key}', value['ros__parameters']
            else:
                if misspelt := [name for name in value if str(name).replace('_', '') == 'rosparameters']:
                    raise ParameterError(f'{misspelt[0]}: did you mean ros__parameters, with two underscores?')
                yield from _ros_sections(value, f'{prefix}{key}/')


def _outside(document: dict[Any, Any], prefix: str = '') -> Iterator[str]:
    """Yield the names of values outside of all sections of a ROS file."""
    for key, value in document.items():
        name = f'{prefix}{key}'
        if not isinstance(value, dict):
            if value is not None:
                yield name
        elif 'ros__parameters' in value:
            yield from (f'{name}.{other}' for other in value if other != 'ros__parameters')
        elif value:
            yield from _outside(value, f'{name}/')


def _flatten(section: Any, prefix: str = '') -> Iterator[tuple[str, Any]]:
    if not isinstance(section, dict):
        raise ParameterError('ros__parameters must contain names with values, such as "p_hit: 0.6"')
    seen = set()
    for key, value in section.items():
        name = f'{prefix}{key}'
        pairs = list(_flatten(value, f'{name}.')) if isinstance(value, dict) else [(name, value)]
        for full, leaf in pairs:
            if full in seen:
                raise ParameterError(f'{full} is given twice, nested and with dots')
            seen.add(full)
            yield full, leaf


def _merge(flat: dict[str, Any], section: dict[str, Any]) -> None:
    """Add a section, which takes precedence; frames with and without a leading slash are the same."""
    frames: dict[str, str] = {}
    for name in section:
        if (mount := _MOUNT.fullmatch(name)) and (twin := frames.setdefault(_frame_of(mount), name)) != name:
            raise ParameterError(f'{twin} and {name} are poses of the same sensor; give one of them')
    for name in list(flat):
        if (mount := _MOUNT.fullmatch(name)) and _frame_of(mount) in frames:
            del flat[name]
    flat |= section


def _frame_of(mount: re.Match[str]) -> str:
    return mount['frame'].lstrip('/')


def _sort_out(flat: dict[str, Any]) -> ParameterFile:
    result = ParameterFile({}, {}, {})
    for name, value in flat.items():
        if extrinsic := _MOUNT.fullmatch(name):
            result.extrinsics[extrinsic['frame']] = mount_from(name, value)
            if len({isinstance(number, int) for number in value}) > 1:
                LOG.warning(
                    '%s: write each number of %s with a decimal point; ROS refuses lists of mixed types', name, value
                )
        elif _ROS_OWN.fullmatch(name):
            result.node[name] = value
        elif name.partition('.')[0] in ('sensors', 'sensor'):
            raise ParameterError(f'{name}: sensors are given as sensors.<frame_id>.pose: [x, y, yaw]')
        else:
            result.values[name] = value if name in DEPRECATED else find(name).check(value)
    return result


def _typed(row: Parameter, text: str) -> Any:
    """Return `text` as the row's type, or unchanged if this fails, so that the row's own check refuses it."""
    if row.type is bool:
        return {'true': True, 'false': False}.get(text.lower(), text)
    if row.type is tuple:
        return [part.strip() for part in text.split(',') if part.strip()]
    try:
        if row.unit == 'rad' and text.endswith('deg'):
            return math.radians(float(text.removesuffix('deg')))
        return row.type(text)
    except ValueError:
        return text
