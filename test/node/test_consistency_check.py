"""Checks of the latest maps: when they are made, and which results are used."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from stand_ins import PlainNode

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.node import consistency_check
from forward_grid_mapper.node.background import Inbox
from forward_grid_mapper.node.consistency_check import ConsistencyCheck

MOUNTS = {'left': Pose2(0.1, 0.0, 0.0)}


class Checked:
    """A check whose worker and executor work when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tasks: list[Callable[[], None]] = []
        self.node, self.later = PlainNode(), list[list[str]]()
        worker: Any = SimpleNamespace(put=self.tasks.append)
        self.check = ConsistencyCheck(worker, Inbox(self.node))
        monkeypatch.setattr(
            consistency_check,
            'consistency_warnings',
            lambda readings, mounts, parameters: [f'{len(readings)} {mounts}'],
        )
        monkeypatch.setattr(consistency_check, 'contradiction_of_halves', lambda maps: None)

    def warnings(self, maps: Any, mounts: Any = MOUNTS, refined: bool = False) -> list[str]:
        return self.check.warnings(maps, dict(mounts), refined, self.later.append)

    def work(self) -> int:
        """Return the number of checks made."""
        made = len(self.tasks)
        while self.tasks:
            self.tasks.pop(0)()
        self.node.turn()
        return made


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> Checked:
    return Checked(monkeypatch)


def maps_of(count: int, **values: Any) -> Any:
    return SimpleNamespace(readings=range(count), parameters=Parameters.from_flat(values))


def test_warnings_are_used_until_the_readings_have_doubled(checked: Checked) -> None:
    assert checked.warnings(maps_of(10)) == []
    assert checked.work() == 1 and checked.later == [[f'10 {MOUNTS}']]
    assert checked.warnings(maps_of(19)) == [f'10 {MOUNTS}']
    assert checked.work() == 0 and len(checked.later) == 1
    assert checked.warnings(maps_of(20)) == []
    assert checked.work() == 1 and len(checked.later) == 2


@pytest.mark.parametrize(
    'other',
    [
        {'maps': maps_of(10, p_hit=0.5)},
        {'mounts': {'left': Pose2(0.2, 0.0, 0.0)}},
        {'refined': True},
    ],
    ids=['parameters', 'sensor poses', 'trajectory'],
)
def test_other_conditions_are_checked_anew(checked: Checked, other: dict[str, Any]) -> None:
    checked.warnings(maps_of(10))
    checked.work()
    assert checked.warnings(**({'maps': maps_of(10)} | other)) == []
    assert checked.work() == 1


def test_result_for_earlier_maps_is_not_used(checked: Checked) -> None:
    checked.warnings(maps_of(10))
    checked.warnings(maps_of(30))
    assert checked.work() == 2
    assert checked.later == [[f'30 {MOUNTS}']]
    checked.warnings(maps_of(70))
    checked.check.forget()
    checked.work()
    assert len(checked.later) == 1
    assert checked.warnings(maps_of(30)) == [], 'what was found before is forgotten'


def test_run_during_a_check_gets_its_warnings_later(checked: Checked, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise runs that follow each other faster than their checks would never be checked."""

    def with_another_run(readings: Any, mounts: Any, parameters: Any) -> list[str]:
        if len(readings) == 10:
            assert checked.warnings(maps_of(11)) == []
        return [f'{len(readings)} readings']

    monkeypatch.setattr(consistency_check, 'consistency_warnings', with_another_run)
    assert checked.warnings(maps_of(10)) == []
    checked.tasks.pop(0)()
    checked.node.turn()
    # what was found is of earlier maps
    assert checked.later == []
    assert checked.warnings(maps_of(12)) == ['10 readings']
