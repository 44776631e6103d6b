"""A row of the table of parameters: its type, bounds and help text, and the check of a value; and constants."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import ParameterError

LARGEST_NUMBER = 1 << 1000
"""Beyond all bounds of parameters, and still a float."""


def param(
    default: Any,
    help: str,
    unit: str = '',
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    read_only: bool = False,
) -> Any:
    """Return the field of a dataclass that is a row of the table."""
    return dataclasses.field(
        default=default,
        metadata={
            'help': help,
            'unit': unit,
            'low': low,
            'high': high,
            'choices': choices,
            'read_only': read_only,
        },
    )


def constant(default: Any, plain: Any, help: str, unit: str = '') -> Any:
    """Return the field of a dataclass that is a constant of the model: `plain` is its value with `plain_model`."""
    return dataclasses.field(default=default, metadata={'plain': plain, 'help': help, 'unit': unit})


@dataclass(frozen=True)
class Constant:
    """A constant of the model, which no user sets; `plain` is its value with `plain_model`."""

    name: str
    group: str
    default: Any
    plain: Any
    unit: str
    help: str


@dataclass(frozen=True)
class Parameter:
    """One row of the table; `low` and `high` are infinite without bounds.

    `type` is float, int, bool, str or tuple (of str); `read_only` rows cannot change while the node is configured.
    """

    name: str
    group: str
    type: type
    default: Any
    unit: str
    low: float
    high: float
    choices: tuple[str, ...]
    help: str
    read_only: bool

    @property
    def range(self) -> str:
        """The admitted values as text."""
        if self.choices:
            return ' | '.join(self.choices)
        if self.type is bool:
            return 'true | false'
        if self.type is str:
            return 'text'
        if self.type is tuple:
            return 'list of text'
        return f'{self.low:g} … {self.high:g}'

    def check(self, value: Any) -> Any:
        """Return `value` as this parameter's type.

        Raises
        ------
        ParameterError
            If it has the wrong type or is out of range.
        """
        wanted = {
            float: 'a number',
            int: 'a whole number',
            bool: 'true or false',
            str: 'text',
            tuple: 'a list of text without empty entries',
        }[self.type]
        if isinstance(value, np.generic):
            value = value.item()
        if self.type is tuple and isinstance(value, list) and all(isinstance(v, str) and v for v in value):
            value = tuple(value)
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            # the largest whole numbers are no floats
            value = float(min(max(value, -LARGEST_NUMBER), LARGEST_NUMBER))
        if type(value) is not self.type:
            raise ParameterError(f'{self.name}: {value!r} is not {wanted}; admitted: {self.range} {self.unit}'.rstrip())
        if self.choices and value not in self.choices:
            raise ParameterError(f'{self.name}: {value!r} is not one of {", ".join(self.choices)}')
        if isinstance(value, (int, float)) and not self.low <= value <= self.high:
            raise ParameterError(f'{self.name}: {value!r} is out of range; admitted: {self.range} {self.unit}'.rstrip())
        return value
