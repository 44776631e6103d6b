"""Writes parameters: the commented YAML that ROS 2 loads, and the reference page."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import yaml

from ..core.common.parameter import Parameter
from ..core.common.parameters import CONSTANTS, TABLE, Parameters
from ..core.sensor.bounds import reading_bounds

_WIDTH = 100
_INDENT = '    '

BOUNDS_RANGE = 5.0
"""Range for which the reference page states the bounds of a reading, metres: the largest of a usual sonar."""


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
    """Return the reference of all parameters and constants: a Markdown table for each group."""
    lines = []
    for title, rows in _groups():
        lines += [f'## {title}', '', '| parameter | default | admitted | unit | meaning |', '|---|---|---|---|---|']
        for row in rows:
            cells = (f'`{row.name}`', f'`{_yaml_value(row.default)}`', row.range, row.unit, row.help)
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
        lines.append('')
        if rows[0].group == 'model':
            lines += [*_bounds_markdown(Parameters()), '']
    return '\n'.join([*lines, *_constants_markdown()]) + '\n'


def _constants_markdown() -> list[str]:
    """Return the table of the model's constants."""
    lines = [
        '## Constants of the model',
        '',
        'These cannot be set. *Plain* is the value with `plain_model`, the value of the paper. Lengths of gaps, walls '
        'and margins are in `core/common/constants.py`.',
        '',
        '| constant | default | plain | unit | meaning |',
        '|---|---|---|---|---|',
    ]
    for row in CONSTANTS:
        values = (f'`{_yaml_value(value)}`' for value in (row.default, row.plain))
        cells = (f'`{row.name}`', *values, row.unit, row.help)
        lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return lines


def _bounds_markdown(parameters: Parameters) -> list[str]:
    """Return the bounds of the evidence of one reading in the model."""
    resolution = parameters.grid.resolution
    bounds = reading_bounds(parameters.model, resolution, BOUNDS_RANGE)
    return [
        f'Largest evidence of one reading with the defaults, for cells of {resolution:g} m and ranges up to '
        f'{BOUNDS_RANGE:g} m, in nats of the objective (positive: for an obstacle):',
        '',
        '| reading | evidence on | nats |',
        '|---|---|---|',
        f'| echo | the cell at its range | {bounds.echo_for:+.2f} |',
        f'| echo at a longer range | one cell in front of it | {bounds.echo_against_cell:+.2f} |',
        f'| echo at a longer range | all cells in front of it together | {bounds.echo_against_wall:+.2f} |',
        f'| no echo | one cell of the cone | {bounds.silence_against_cell:+.2f} |',
        f'| no echo | all cells of the cone together | {bounds.silence_against_wall:+.2f} |',
    ]


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
