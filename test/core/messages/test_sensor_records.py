"""Sensors get records until there are too many, and only if their names are proper."""

from __future__ import annotations

import pytest

from forward_grid_mapper.core.messages.rep117 import LONGEST_NAME
from forward_grid_mapper.core.messages.sensor_records import MOST_FRAMES, has_room, record_of


def test_first_sensors_keep_their_records() -> None:
    records: dict[str, list[int]] = {}
    for k in range(2 * MOST_FRAMES):
        record = record_of(records, f'sonar_{k}', list)
        assert (record is None) == (k >= MOST_FRAMES)
    assert len(records) == MOST_FRAMES
    assert record_of(records, 'sonar_0', list) is records['sonar_0']
    assert has_room(records, 'sonar_0') and not has_room(records, 'sonar_1000')


@pytest.mark.parametrize('name', ['', 'a\nb', 'x' * (LONGEST_NAME + 1)])
def test_improper_names_have_no_record(name: str) -> None:
    records: dict[str, list[int]] = {}
    assert record_of(records, name, list) is None and not has_room(records, name) and not records
