"""All parameters: the table of them, and their values.

The YAML file, the command line, the ROS parameters and `docs/parameters.md` are made from `TABLE`, which is collected
from the fields of the groups (`parameter_groups`).
"""

from __future__ import annotations

import dataclasses
import difflib
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_origin, get_type_hints

from .errors import ParameterError
from .former_parameters import DEPRECATED, RENAMED, deprecation
from .parameter import Constant, Parameter
from .parameter_groups import (
    AssociationParameters,
    GridParameters,
    LiveMapParameters,
    ModelParameters,
    NodeParameters,
    SearchParameters,
)

LOG = logging.getLogger('forward_grid_mapper')


@dataclass(frozen=True)
class Parameters:
    """All parameters, in groups."""

    association: AssociationParameters = dataclasses.field(default=AssociationParameters())
    grid: GridParameters = dataclasses.field(default=GridParameters())
    model: ModelParameters = dataclasses.field(default=ModelParameters())
    search: SearchParameters = dataclasses.field(default=SearchParameters())
    live: LiveMapParameters = dataclasses.field(default=LiveMapParameters())
    node: NodeParameters = dataclasses.field(default=NodeParameters())

    @classmethod
    def from_flat(cls, values: Mapping[str, Any], base: Parameters | None = None) -> Parameters:
        """Return `base` (the defaults, unless given) with the named values changed.

        Names in `DEPRECATED` are ignored, and those in `RENAMED` are replaced by the new ones, with a warning in the
        log.

        Raises
        ------
        ParameterError
            For an unknown name, a wrong type or a value out of range.
        """
        given = {}
        for name, value in values.items():
            if name in DEPRECATED or name in RENAMED:
                LOG.warning('%s', deprecation(name))
            if name not in DEPRECATED:
                row = find(name)
                given[row.name] = row.check(value)
        return (base or cls()).varied(given)

    @classmethod
    def restored(cls, values: Mapping[str, Any]) -> Parameters:
        """Return the parameters from a result of `complete`, of this version or of one whose constants were parameters.

        Raises
        ------
        ParameterError
            As in `from_flat`.
        """
        constants = {name: value for name, value in values.items() if name in _CONSTANTS}
        for name, value in constants.items():
            kind = type(_CONSTANTS[name].default)
            if type(value) is not kind or not math.isfinite(value):
                raise ParameterError(f'{name}: {value!r} is not a finite {kind.__name__}')
        # removed parameters are ignored: users of this version did not set them
        others = {name: value for name, value in values.items() if name not in constants and name not in DEPRECATED}
        return cls.from_flat(others).varied(constants)

    def varied(self, values: Mapping[str, Any]) -> Parameters:
        """Return the parameters with the named values changed, which may be constants.

        Only combinations of values are checked. Another `plain_model` changes all constants that are not named.

        Raises
        ------
        ParameterError
            If values do not fit together, or no parameter and no constant has this name.
        """
        plain, changes = values.get('plain_model', self.model.plain_model), dict[str, dict[str, Any]]()
        if plain != self.model.plain_model:
            values = {row.name: row.plain if plain else row.default for row in CONSTANTS} | dict(values)
        for name, value in values.items():
            group = _CONSTANTS[name].group if name in _CONSTANTS else find(name).group
            changes.setdefault(group, {})[name] = value
        return dataclasses.replace(
            self, **{group: dataclasses.replace(getattr(self, group), **change) for group, change in changes.items()}
        )

    def flat(self) -> dict[str, Any]:
        """Return the values of all parameters by name, in the order of the table."""
        return {row.name: getattr(getattr(self, row.group), row.name) for row in TABLE}

    def complete(self) -> dict[str, Any]:
        """Return the values of all parameters and constants by name."""
        return self.flat() | {row.name: getattr(getattr(self, row.group), row.name) for row in CONSTANTS}


def _read_table() -> tuple[tuple[Parameter, ...], tuple[Constant, ...]]:
    rows, constants = [], []
    for group in dataclasses.fields(Parameters):
        kind: Any = type(group.default)
        hints = get_type_hints(kind)
        for field in dataclasses.fields(kind):
            about = {'name': field.name, 'group': group.name, 'default': field.default, **field.metadata}
            if 'plain' in about:
                constants.append(Constant(**about))
            else:
                rows.append(Parameter(type=get_origin(hints[field.name]) or hints[field.name], **about))
    return tuple(rows), tuple(constants)


TABLE, CONSTANTS = _read_table()
_BY_NAME = {row.name: row for row in TABLE}
_CONSTANTS = {row.name: row for row in CONSTANTS}


def find(name: str) -> Parameter:
    """Return the row of a parameter by its name, or by that of the previous version (`RENAMED`).

    Raises
    ------
    ParameterError
        If there is none; the message names similar ones.
    """
    name = RENAMED.get(name, name)
    if name in _BY_NAME:
        return _BY_NAME[name]
    near = difflib.get_close_matches(name, _BY_NAME, n=3, cutoff=0.5)
    hint = f'did you mean {" or ".join(near)}?' if near else f'there are: {", ".join(_BY_NAME)}'
    raise ParameterError(f'no parameter is called {name!r}; {hint}')
