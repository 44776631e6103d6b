"""Real drives with default parameters, scored with the map of a laser."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from drive_samples import mapped

LEAST = {
    ('office_a', 'ml_map'): (0.86, 0.65),
    ('office_b', 'ml_map'): (0.78, 0.53),
    ('office_a', 'live_map'): (0.75, 0.0),
    ('office_b', 'live_map'): (0.66, 0.0),
}
"""Least share of the navigable floor common to map and reference (nav_iou), and least F1 of the wall cells."""


@pytest.mark.slow
@pytest.mark.parametrize('run', ['office_a', 'office_b'])
def test_maps_of_offices_reach_the_least_scores(shared: Path, tmp_path: Path, run: str) -> None:
    pytest.importorskip('scipy', reason='score_map.py needs scipy')
    data = shared / 'data' / run
    report = mapped(data / 'bag', tmp_path / 'maps', '--odom-topic', '/odom_corrected')
    assert report['changed_parameters'] == {}
    assert (report['input']['odom_frame'], report['input']['mounts_from']) == ('map', '/tf_static')
    for name in ('ml_map', 'live_map'):
        command = [sys.executable, shared / 'tools' / 'score_map.py', tmp_path / 'maps' / f'{name}.yaml']
        command += [data / 'reference.yaml', '--trajectory', data / 'trajectory.csv', '--json']
        scores = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        floor, walls = LEAST[run, name]
        assert scores['nav_iou'] >= floor and scores['f1'] >= walls, (name, scores)


@pytest.mark.parametrize(('run', 'count'), [('office_a', 1591), ('office_b', 815)])
def test_office_is_mapped_with_wheel_odometry(shared: Path, tmp_path: Path, run: str, count: int) -> None:
    report = mapped(shared / 'data' / run / 'bag', tmp_path / 'maps', '--odom-topic', '/odom')
    assert (report['input']['odom_topic'], report['input']['odom_frame']) == ('/odom', 'odom')
    assert report['counts']['received'] == count
    assert report['counts']['accepted'] > 0.95 * count
    assert '/odom, frame odom' in (tmp_path / 'maps' / 'report.txt').read_text('utf-8')
    assert report['map']['occupied_cells'] > 0
