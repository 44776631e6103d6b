"""Explanations, in words, of errors on the command line of the node or in what ROS was given."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from ..core.common.errors import MapperError
from ..core.common.parameters import TABLE
from ..files.parameter_file import load_parameters

OPTIONS = ('--ros-args', '--help')
ROS_OPTIONS = (
    *('--param', '--params-file', '--remap', '--log-level', '--log-config-file', '--log-file-name', '--enclave'),
    *('--enable-rosout-logs', '--disable-rosout-logs', '--enable-stdout-logs', '--disable-stdout-logs'),
    *('--enable-external-lib-logs', '--disable-external-lib-logs', '-p', '-r', '-e'),
)
TOPICS = ('sonar', 'odom')
HIGHEST_DOMAIN = 232
"""DDS has no ports for higher ones."""

# a list with both an integer and a number with a decimal point
_MIXED = re.compile(r':=\s*\[(?=(?:.*,)?\s*[-+]?\d+\s*[],])[^]]*\.[^]]*\]\s*$')
_SOURCE = re.compile(r', at /\S+:\d+')
_INIT = re.compile(r'^failed to initialize rcl: ')
_RULE = re.compile(r"Couldn't parse remap rule: '(?:-r|--remap) (?P<rule>.*?)'\.")
_PARAMETER = re.compile(r"Couldn't parse parameter override rule: '(?:-p|--param) (?P<rule>.*?)'\.")
_FILE = re.compile(r"Couldn't parse params file: '--params-file (?P<file>.*?)'\. Error: (?P<why>.*)")


def _nearest(word: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f'; did you mean {near[0]}?' if near else ''


def explain_arguments(left: Sequence[str]) -> str:
    """Return a remedy for arguments that are not ROS's."""
    parameters = [row.name for row in TABLE]
    for word in left:
        name, given, _value = word.partition(':=')
        if given and name in parameters:
            return f'{name} is a parameter: --ros-args -p {word}'
        if given and (name in TOPICS or name.startswith(('~', '/', '_'))):
            return f'set a topic, or the name of the node, with --ros-args -r {word}'
        if given:
            near = _nearest(name, (*parameters, *TOPICS))
            return f'{word} is not a known option{near}; set parameters with --ros-args -p NAME:=VALUE'
    for word in left:
        if word in ROS_OPTIONS:
            return f'{word} must be after --ros-args: --ros-args {" ".join(left)}'
    return f'{" ".join(left)} is not known{_nearest(left[0], OPTIONS)}; ROS options must be after --ros-args'


def explain_ros_arguments(text: str) -> str:
    """Return a remedy for unknown arguments after --ros-args; rclpy gives them as the text of a list."""
    unknown = re.findall(r"'([^']*)'", text) or [text]
    word = unknown[0]
    if ':=' in word:
        return f'{word} must be after -p (a parameter) or -r (another name for a topic or the node)'
    return f'{", ".join(unknown)}: no such ROS option{_nearest(word, ROS_OPTIONS)}; known are {", ".join(ROS_OPTIONS)}'


def explain_domain(environment: Mapping[str, str]) -> str:
    """Return what is wrong with ROS_DOMAIN_ID, or ''."""
    text = environment.get('ROS_DOMAIN_ID', '').strip()
    if re.fullmatch(r'\+?[0-9]+', text or '0') and int(text or '0') <= HIGHEST_DOMAIN:
        return ''
    return f'ROS_DOMAIN_ID is {text}, not a whole number from 0 to {HIGHEST_DOMAIN}'


def _explain_file(path: str, why: str) -> str:
    """Return the fault of a parameter file: from our own reader if it refuses the file as well."""
    if Path(path).is_file():
        try:
            load_parameters(path)
        except MapperError as error:
            return f'--params-file {error}'
    remedy = '; write each number of a list with a decimal point' if 'same type' in why else ''
    if 'before ros__parameters' in why:
        remedy = '; parameters of a node must be below /**: and ros__parameters:, as in config/mapper.yaml'
    return f'--params-file {path}: {why}{remedy}'


def explain_ros_error(error: BaseException) -> str:
    """Return the message of an rclpy error, without the lines of its sources, and with a remedy if one is known."""
    lines = _SOURCE.sub('', str(error)).splitlines()
    text = _INIT.sub('', ' '.join(filter(None, (line.strip() for line in lines))))
    if found := _RULE.search(text):
        return (
            f'-r {found["rule"]} is not a valid rule: use -r OLD:=NEW, such as -r sonar:=/my/sonar, -r '
            '__node:=my_mapper or -r __ns:=/robot1; names may have letters, digits, _ and /, and no part may begin '
            'with a digit'
        )
    if found := _PARAMETER.search(text):
        rule = f'-p {found["rule"]} is not a valid parameter'
        if _MIXED.search(found['rule']):
            return f'{rule}: write each number of a list with a decimal point; ROS refuses lists of mixed types'
        return f'{rule}: use -p NAME:=VALUE, such as -p resolution:=0.05'
    if found := _FILE.search(text):
        return _explain_file(found['file'], found['why'])
    if 'PARAMETER_NOT_SET' in text:
        return 'a parameter has no value, or an empty list (range_topics:=[]): set a value, or leave it out'
    return text or repr(error)


def missing_section_warnings(arguments: Sequence[str], node: str) -> list[str]:
    """Return warnings about parameter files without a section for a node; ROS ignores such a file silently.

    Parameters
    ----------
    arguments : sequence of str
        The command line.
    node : str
        The full name of the node.
    """
    found = []
    for option, file in pairwise(arguments):
        # a pipe cannot be read a second time
        if option != '--params-file' or not Path(file).is_file():
            continue
        try:
            # composed, not loaded, since launch writes tags of Python, which ROS ignores
            names = list(dict.fromkeys(_sections(yaml.compose(Path(file).read_text(encoding='utf-8')), '')))
        except (OSError, ValueError, RecursionError, yaml.YAMLError):
            # ROS has accepted it
            continue
        if names and not any(_applies(name, node) for name in names):
            more = f' and {len(names) - 3} more' if len(names) > 3 else ''
            found.append(
                f'--params-file {file} is ignored: it has parameters of {", ".join(names[:3])}{more}, but this node is '
                f'{node}; put the parameters of this node into a section /** or {node}'
            )
    return found


def _applies(section: str, node: str) -> bool:
    """Return whether rclpy gives the parameters of a section to a node."""
    pattern = re.escape(section).replace(r'/\*', r'(/\w+)').replace(r'\*', '*')
    try:
        return re.fullmatch(pattern, node) is not None
    except re.error:
        # of a name such as my**
        return False


def _sections(document: Any, prefix: str) -> Iterator[str]:
    """Yield the full names of the sections of a composed parameter file."""
    for key, value in document.value if isinstance(document, yaml.MappingNode) else ():
        if key.value == 'ros__parameters':
            yield prefix
        elif isinstance(key.value, str):
            yield from _sections(value, f'{prefix}/{key.value.strip("/")}')
