"""EM in the background: however a run ends, whoever waits gets an answer, and the next one can begin."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.readings import Readings
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.node import em
from forward_grid_mapper.node.em import EmWorker, Outcome

READING = Readings.from_columns(names=('sonar',), x=0.0, y=0.0, yaw=0.0, z=[1.0], z_max=4.0, half_angle=0.2)


def outcome_of(worker: EmWorker, readings: Readings = READING) -> Outcome:
    ended = threading.Event()
    found: list[Outcome] = []

    def done(outcome: Outcome) -> None:
        found.append(outcome)
        ended.set()

    assert worker.start(readings, Parameters(), done) is not None
    assert ended.wait(60.0)
    return found[0]


@pytest.mark.parametrize(
    ('error', 'reported'),
    [(MemoryError(), 'does not fit the memory'), (ValueError('odd'), "EM failed: ValueError('odd')")],
)
def test_a_run_that_fails_says_why_and_the_next_begins(
    monkeypatch: pytest.MonkeyPatch, error: Exception, reported: str
) -> None:
    logged: list[str] = []
    worker = EmWorker(lambda run: None, logged.append)

    def fail(*arguments: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(Mapper, 'run', fail)
        assert reported in outcome_of(worker).message
    maps = outcome_of(worker).maps
    assert maps is not None
    assert len(maps.readings) == 1


def test_a_run_that_cannot_fit_does_not_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = EmWorker(lambda run: None, print)
    monkeypatch.setattr(em, 'shortage', lambda cells, readings, threads: 'there is no space')
    assert outcome_of(worker) == Outcome(None, 'there is no space')


def test_what_is_wrong_with_the_readings_comes_with_the_maps() -> None:
    worker = EmWorker(lambda run: None, print)
    steps = np.repeat(np.arange(50), 2)
    twice = Readings.from_columns(
        names=('sonar',), x=0.02 * steps, y=0.0, yaw=0.0, z=3.0 - 0.02 * steps, z_max=4.0, half_angle=0.2, stamp=steps
    )
    outcome = outcome_of(worker, twice)
    assert outcome.maps is not None
    (warning,) = outcome.warnings
    assert '50 of 100 readings are copies' in warning
    assert outcome_of(worker).warnings == []
