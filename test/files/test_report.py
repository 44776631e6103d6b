"""The report as data and as text."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_maps import made_maps

from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files import quality_warning
from forward_grid_mapper.files.report import report_data, write_report
from forward_grid_mapper.files.report_text import report_text

SOURCE: dict[str, Any] = {
    'bag': Path('/data/run_1.mcap'),
    'range_topics': ('/left', '/right'),
    'odom_topic': '/odom',
    'odom_frame': 'odom',
    'map_frame': 'odom',
    'mounts_from': "the bag's /tf_static",
    'counts': {'received': np.int64(100), 'accepted': 60, 'rejected': {'no pose': 30, 'range is NaN': np.int32(10)}},
    'stamps': (1_700_000_000_000_000_000, 1_700_000_060_000_000_000),
    'duration_s': np.float32(60.0),
    'path_m': 31.25,
    'warnings': ['sonar_back has no pose: 30 readings rejected'],
    'sensors': {'sonar_left': {'no_echo': 7}, 'sonar_back': {'accepted': 0, 'no_echo': 0, 'unexplained': 0}},
    'note': np.nan,
}
STATISTICS: dict[str, Any] = {
    'pairs': np.int64(12345),
    'flips': 321,
    'shifts': 12,
    'iterations': 5,
    'searched_objective': -151.5,
    'searched_log_likelihood': -125.0,
    'converged': np.bool_(False),
    'seconds': {'index': np.float64(0.25), 'search': 0.5},
}


def test_data_is_valid_strict_json() -> None:
    data = report_data(made_maps(statistics=STATISTICS), SOURCE)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data['input']['note'] is None
    assert data['input']['bag'] == '/data/run_1.mcap'
    assert data['statistics']['converged'] is False


def test_numbers_are_those_of_the_maps() -> None:
    data = report_data(made_maps(width=40, height=30, readings=60), SOURCE)
    assert data['map']['free_cells'] == 34 * 24
    assert data['map']['occupied_cells'] == 36 * 26 - 34 * 24
    assert data['map']['unknown_cells'] == 40 * 30 - 36 * 26
    assert data['result'] == {
        'readings': 60,
        'unexplained': 6,
        'log_likelihood': -123.5,
        'objective': -150.25,
        # said only of drives with many readings
        'contradiction': 0.0,
    }
    for name, counts in (('right', (30, 0, 0)), ('left', (30, 7, 6))):
        row = data['sensors'][f'sonar_{name}']
        assert (row['accepted'], row['no_echo'], row['unexplained']) == counts
        assert row['health']['readings'] == 30
        assert row['health']['random'] == counts[2] / 30
        assert row['health']['verdict'] == 'ok'


def test_source_is_not_changed() -> None:
    source = {'counts': {'received': 1}, 'warnings': ['a']}
    report_data(made_maps(), source)
    assert source == {'counts': {'received': 1}, 'warnings': ['a']}


def test_text_has_counts_warnings_and_results() -> None:
    text = report_text(report_data(made_maps(settings={'p_hit': 0.3}, statistics=STATISTICS), SOURCE))
    for part in (
        'WARNINGS (1)',
        'sonar_back has no pose',
        '/data/run_1.mcap',
        '/left, /right',
        '/odom, frame odom',
        '31.2 m in 60.0 s from 2023-11-14 22:13:20 UTC',
        '100 received, 60 accepted (60.0 %)',
        '30   30.0 %  no pose',
        '4.0 x 3.0 m: 40 x 30 cells of 0.1 m, corner (-2.00, -1.50)',
        '120 occupied, 816 free, 264 not observed',
        '-123.5 nats (-2.058 a reading)',
        '-150.2 nats; -151.5 nats at the end of the search, before post-processing\n',
        'NOT converged',
        'index 0.25, search 0.50; together 0.75',
        f'p_hit  0.3  (default {Parameters().model.p_hit})',
    ):
        assert part in text
    assert all(len(line) <= 100 for line in text.splitlines())


def test_broken_sensor_is_in_the_warnings_and_the_table() -> None:
    maps = made_maps(readings=200)
    maps = dataclasses.replace(maps, unexplained=maps.readings.sensor == 1)
    data = report_data(maps, {'warnings': ['first']})
    assert data['warnings'][0] == 'first'
    assert 'sonar_right (mostly random)' in data['warnings'][1]
    text = report_text(data)
    assert 'WARNINGS (2)' in text
    (row,) = (line for line in text.splitlines() if line.startswith('  sonar_right'))
    assert row.split()[1] == '100' and '100.0 %' in row and row.endswith('mostly random')


def test_many_random_readings_give_a_hint_to_refine_poses() -> None:
    maps = made_maps(readings=200)
    silent = np.arange(200) % 2 == 0
    half = dataclasses.replace(maps.readings, z=np.where(silent, maps.readings.z_max, maps.readings.z))
    for part, source, option in (
        (50, {}, 'refine_poses'),
        (50, {'bag': 'monday'}, '--refine-poses'),
        (20, {}, None),
        (50, {'trajectory': {'refined': False, 'reason': 'it is short'}}, None),
        (50, {'trajectory': {'refined': False, 'reason': ''}}, 'refine_poses'),
    ):
        some = dataclasses.replace(maps, unexplained=np.arange(200) < part)
        text = ' '.join(report_text(report_data(some, source)).split())
        hint = f'many, as with odometry that drifts ({option}), wrong poses of sensors, or people who walk by'
        assert (hint in text) == (option is not None)
        assert ('many, as' in text) == (option is not None)
    # readings without an echo are hardly ever random
    some = dataclasses.replace(maps, readings=half, unexplained=~silent & (np.arange(200) < 50))
    assert 'many, as' in report_text(report_data(some, {}))


@pytest.mark.parametrize(
    ('part', 'apart', 'source', 'shown'),
    [
        (20, 0.06, {'bag': 'monday'}, 'jumps (--refine-poses corrects this), the robot was carried'),
        (80, 0.06, {}, 'jumps (refine_poses corrects this), the robot was carried'),
        (
            20,
            0.06,
            {'trajectory': {'refined': False, 'reason': 'it is short'}},
            'jumps (no better trajectory was found)',
        ),
        (20, 0.06, {'trajectory': {'refined': False, 'reason': ''}}, 'jumps (refine_poses corrects this)'),
        (20, 0.02, {}, ''),
        (5, 0.06, {}, None),
        (20, 0.06, {'trajectory': {'refined': True}}, None),
        (20, 0.06, {'drives': [{'bag': 'a'}]}, None),
    ],
)
def test_halves_that_contradict_each_other_give_a_warning(
    monkeypatch: pytest.MonkeyPatch, part: int, apart: float, source: dict[str, Any], shown: str | None
) -> None:
    """They are compared only if many echoes do not fit, and the trajectory was not refined."""
    monkeypatch.setattr(quality_warning, 'contradiction', lambda readings, parameters: apart)
    maps = made_maps(readings=200)
    data = report_data(dataclasses.replace(maps, unexplained=np.arange(200) < part), source)
    assert data['result']['contradiction'] == (None if shown is None else apart)
    warned = [text for text in data['warnings'] if text.startswith('the two halves of the drive contradict each other')]
    assert len(warned) == bool(shown) and all(shown in text for text in warned)


def test_report_without_source() -> None:
    text = report_text(report_data(made_maps(), {}))
    assert '60 received, 60 accepted (100.0 %)' in text
    assert 'all at their defaults' in text
    assert 'None' not in text and 'WARNINGS' not in text


def test_report_without_readings_and_likelihood() -> None:
    maps = dataclasses.replace(made_maps(readings=0), log_likelihood=float('nan'), objective=float('-inf'))
    data = report_data(maps, {'counts': {'received': 0, 'rejected': {}}, 'sensors': None, 'stamps': 12})
    assert data['result']['objective'] is None
    assert '0 received, 0 accepted (–)' in report_text(data)
    assert report_text({}).startswith('Sonar maps')


def test_report_files_are_written(tmp_path: Path) -> None:
    data = report_data(made_maps(), SOURCE)
    write_report(tmp_path, data)
    assert json.loads((tmp_path / 'report.json').read_text(encoding='utf-8')) == data
    assert (tmp_path / 'report.txt').read_text(encoding='utf-8') == report_text(data)
    with pytest.raises(OutputError, match=r'report\.json'):
        write_report(tmp_path / 'absent', data)


def test_sensors_have_the_readings_used_if_max_readings_leaves_out_some() -> None:
    maps = made_maps()
    count = len(maps.readings)
    for accepted, head in ((count, 'accepted'), (count + 1, 'used')):
        data = report_data(maps, {'counts': {'received': accepted, 'accepted': accepted}})
        row = next(line for line in report_text(data).splitlines() if line.startswith('Sensors'))
        assert row.split()[:2] == ['Sensors', head]


def test_names_that_control_a_terminal_are_escaped() -> None:
    text = report_text({'input': {**SOURCE, 'range_topics': ('/\x1b[31mred', '/ä\u202e')}})
    assert '/\\x1b[31mred, /ä\\u202e' in text and text.replace('\n', '').isprintable()
