"""The parameter table: ranges, defaults, names of earlier versions, and the constants that are no parameters."""

from __future__ import annotations

import pytest

from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.former_parameters import DEPRECATED, RENAMED, deprecation
from forward_grid_mapper.core.common.parameters import CONSTANTS, TABLE, Parameters, find


@pytest.mark.parametrize('row', TABLE, ids=lambda row: row.name)
def test_rows_have_help_and_accept_their_default_but_no_bad_values(row) -> None:
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


def test_parameters_survive_a_round_trip_through_flat_values() -> None:
    changed = Parameters.from_flat({'p_hit': 0.5, 'resolution': 1, 'online': False})
    assert changed.model.p_hit == 0.5
    assert changed.grid.resolution == 1.0
    assert Parameters.from_flat(changed.flat()) == changed
    assert Parameters.from_flat({}, base=changed) == changed


def test_unknown_parameter_name_is_rejected_with_a_similar_name() -> None:
    with pytest.raises(ParameterError, match='p_hit'):
        find('phit')
    with pytest.raises(ParameterError, match='resolution'):
        Parameters.from_flat({'zzz': 1})


def test_p_rand_and_p_lost_that_sum_up_to_more_than_one_are_rejected() -> None:
    with pytest.raises(ParameterError, match='p_rand'):
        Parameters.from_flat({'p_rand': 0.7, 'p_lost': 0.5})


@pytest.mark.parametrize('name', DEPRECATED)
def test_removed_parameter_is_ignored_with_a_warning(name: str, caplog: pytest.LogCaptureFixture) -> None:
    assert name not in {row.name for row in TABLE}
    base = Parameters.from_flat({'p_hit': 0.5})
    assert Parameters.from_flat({name: 3, 'p_rand': 0.1}, base=base) == Parameters.from_flat({'p_rand': 0.1}, base=base)
    assert caplog.messages == [deprecation(name)]
    assert name in deprecation(name)


@pytest.mark.parametrize(('old', 'new'), RENAMED.items())
def test_former_name_of_a_parameter_is_accepted_with_a_warning(
    old: str, new: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert old not in {row.name for row in TABLE}
    value = find(new).low
    assert Parameters.from_flat({old: value}) == Parameters.from_flat({new: value})
    assert caplog.messages == [deprecation(old)]
    assert new in deprecation(old)


def test_plain_model_sets_all_constants_which_are_no_parameters() -> None:
    assert not {row.name for row in CONSTANTS} & {row.name for row in TABLE}
    plain = Parameters.from_flat({'plain_model': True})
    assert plain == Parameters().varied({'plain_model': True, **{row.name: row.plain for row in CONSTANTS}})
    assert Parameters.from_flat({'plain_model': False}, base=plain) == Parameters()
    # without plain_model among the values, constants do not change
    other = Parameters().varied({'least_passed': 0.5})
    assert Parameters.from_flat({'p_hit': 0.5, 'plain_model': False}, base=other).search.least_passed == 0.5


def test_complete_values_restore_parameters_and_constants() -> None:
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
