"""The parameter table holds itself to its own ranges."""

from __future__ import annotations

import pytest

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.former_parameters import DEPRECATED, RENAMED, deprecation
from forward_grid_mapper.core.common.parameters import CONSTANTS, TABLE, Parameters, find


@pytest.mark.parametrize('row', TABLE, ids=lambda row: row.name)
def test_rows_are_complete_and_defaults_admitted(row) -> None:
    assert row.help.endswith('.')
    assert row.check(row.default) == row.default
    if row.type in (int, float):
        assert row.low < row.high
        for bad in (row.low - 1, row.high + 1, 10**400, 'word', None, True):
            with pytest.raises(ParameterError, match=row.name):
                row.check(type(row.default)(bad) if isinstance(bad, float) and row.type is int else bad)
    if row.type is float:
        with pytest.raises(ParameterError):
            row.check(float('nan'))
    if row.choices:
        with pytest.raises(ParameterError, match=row.choices[0]):
            row.check('nonsense')


def test_flat_values_go_there_and_back() -> None:
    changed = Parameters.from_flat({'p_hit': 0.5, 'resolution': 1, 'online': False})
    assert changed.model.p_hit == 0.5
    assert changed.grid.resolution == 1.0
    assert Parameters.from_flat(changed.flat()) == changed
    assert Parameters.from_flat({}, base=changed) == changed


def test_unknown_names_get_a_hint() -> None:
    with pytest.raises(ParameterError, match='p_hit'):
        find('phit')
    with pytest.raises(ParameterError, match='resolution'):
        Parameters.from_flat({'zzz': 1})


def test_causes_must_leave_something_for_the_map() -> None:
    with pytest.raises(ParameterError, match='p_rand'):
        Parameters.from_flat({'p_rand': 0.7, 'p_lost': 0.5})


@pytest.mark.parametrize('name', DEPRECATED)
def test_names_of_the_version_before_are_left_out_with_a_warning(name: str, caplog: pytest.LogCaptureFixture) -> None:
    assert name not in {row.name for row in TABLE}
    base = Parameters.from_flat({'p_hit': 0.5})
    assert Parameters.from_flat({name: 3, 'p_rand': 0.1}, base=base) == Parameters.from_flat({'p_rand': 0.1}, base=base)
    assert caplog.messages == [deprecation(name)]
    assert name in deprecation(name)


@pytest.mark.parametrize(('old', 'new'), RENAMED.items())
def test_former_names_are_taken_with_a_warning(old: str, new: str, caplog: pytest.LogCaptureFixture) -> None:
    assert old not in {row.name for row in TABLE}
    value = find(new).low
    assert Parameters.from_flat({old: value}) == Parameters.from_flat({new: value})
    assert caplog.messages == [deprecation(old)]
    assert new in deprecation(old)


def test_constants_have_two_values_and_are_no_parameters() -> None:
    assert not {row.name for row in CONSTANTS} & {row.name for row in TABLE}
    plain = Parameters.from_flat({'plain_model': True})
    assert plain == Parameters().varied({'plain_model': True, **{row.name: row.plain for row in CONSTANTS}})
    assert Parameters.from_flat({'plain_model': False}, base=plain) == Parameters()
    # what does not name it leaves them alone
    other = Parameters().varied({'least_passed': 0.5})
    assert Parameters.from_flat({'p_hit': 0.5, 'plain_model': False}, base=other).search.least_passed == 0.5


def test_what_is_complete_is_restored() -> None:
    other = Parameters().varied({'least_passed': 0.5, 'live_directions': 2, 'p_hit': 0.5, 'plain_model': True})
    assert Parameters.restored(other.complete()) == other
    assert Parameters.from_flat(other.flat()) != other
    assert Parameters.restored({'least_passed': 0.5}) == Parameters().varied({'least_passed': 0.5})
    for bad in (float('nan'), 'word', None, True):
        with pytest.raises(ParameterError, match='least_passed'):
            Parameters.restored({'least_passed': bad})
    with pytest.raises(ParameterError, match='p_hit'):
        Parameters.restored({**other.complete(), 'p_hit': 2.0})
    with pytest.raises(ParameterError, match='zzz'):
        Parameters().varied({'zzz': 1})
