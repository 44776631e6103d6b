"""Writing parameters: the commented YAML that ROS 2 loads, and the reference page."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import yaml

from ..core.common.parameters import TABLE, Parameter, Parameters

_WIDTH = 100
_INDENT = '    '


def dump_parameters(parameters: Parameters) -> str:
    """Return a ROS 2 parameter file with every parameter, its help, unit and range in comments."""
    values = parameters.flat()
    lines = ['/**:', '  ros__parameters:']
    for title, rows in _groups():
        lines += ['', *_comment(f'---- {title}')]
        for row in rows:
            limits = f'{row.unit}, {row.range}' if row.unit else row.range
            lines += [
                '',
                *_comment(row.help),
                *_comment(f'[{limits}]'),
                f'{_INDENT}{_yaml(row.name, values[row.name])}',
            ]
    return '\n'.join(lines) + '\n'


def parameters_markdown() -> str:
    """Return the reference of all parameters: a Markdown table for each group."""
    lines = []
    for title, rows in _groups():
        lines += [f'## {title}', '', '| parameter | default | admitted | unit | meaning |', '|---|---|---|---|---|']
        for row in rows:
            cells = (f'`{row.name}`', f'`{_yaml_value(row.default)}`', row.range, row.unit, row.help)
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
        lines.append('')
    return '\n'.join(lines)


def _groups() -> Iterator[tuple[str, list[Parameter]]]:
    """Yield each group's title, the first line of its docstring, and its rows."""
    titles = {field.name: type(field.default).__doc__ or field.name for field in dataclasses.fields(Parameters)}
    for group, rows in groupby(TABLE, key=lambda row: row.group):
        yield titles[group].splitlines()[0].rstrip('.'), list(rows)


def _comment(text: str) -> list[str]:
    lead = f'{_INDENT}# '
    return textwrap.wrap(text, _WIDTH, initial_indent=lead, subsequent_indent=lead)


def _yaml(name: str, value: Any) -> str:
    if isinstance(value, tuple):
        return f'{name}: {yaml.safe_dump(list(value), default_flow_style=True, width=1000).strip()}'
    return yaml.safe_dump({name: value}, width=1000).strip()


def _yaml_value(value: Any) -> str:
    return _yaml('v', value).partition(': ')[2]
