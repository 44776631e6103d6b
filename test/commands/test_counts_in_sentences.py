"""Counts in messages: singular for one, plural otherwise."""

from __future__ import annotations

import argparse

import pytest

from forward_grid_mapper.bags.reader import skipped
from forward_grid_mapper.commands import experiment_maps
from forward_grid_mapper.commands.console import Ticker
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.common.words import counted
from forward_grid_mapper.core.messages.message_types import Pose2
from forward_grid_mapper.files.picture import figures_text
from forward_grid_mapper.files.report_text import report_text
from forward_grid_mapper.recordings.contradictions import Described, contradictions


def test_count_with_singular_or_plural() -> None:
    assert counted(1, 'reading') == '1 reading'
    assert counted(0, 'reading') == '0 readings'
    assert counted(1234, 'reading', ',') == '1,234 readings'


def test_message_about_skipped_messages() -> None:
    assert skipped(1, '/a') == '1 message on /a does not fit its type and was skipped'
    assert skipped(2, '/a') == '2 messages on /a do not fit their type and were skipped'


def test_counts_in_report_and_picture() -> None:
    one = report_text({'result': {'readings': 40, 'unexplained': 1}})
    assert '1 reading (2.5 %) is most likely a random measurement\n' in one
    several = report_text({'result': {'readings': 40, 'unexplained': 2}})
    assert '2 readings (5.0 %) are most likely random measurements\n' in several
    assert figures_text(1, 0.1, -2.0).startswith('1 reading   ·')


@pytest.mark.parametrize(('sensors', 'words'), [(2, '1 more sensor)'), (3, '2 more sensors)')])
def test_number_of_sensors_that_were_moved_between_drives(sensors: int, words: str) -> None:
    frames = [f'sonar_{k}' for k in range(sensors)]
    drives = [
        Described(name, 'map', 'base_link', dict.fromkeys(frames, Pose2(x, 0.0, 0.0)), {})
        for name, x in (('monday', 0.0), ('tuesday', 1.0))
    ]
    (warning,) = contradictions(drives)
    assert f'(and so on for {words}' in warning


@pytest.mark.parametrize('seeds', [1, 2])
def test_number_of_seeds_in_the_table_of_an_experiment(monkeypatch: pytest.MonkeyPatch, seeds: int) -> None:
    """Settings of the standard map are tried with all drives, but with two at most."""
    monkeypatch.setattr(experiment_maps, 'GAINS', experiment_maps.GAINS[:1])
    # a short drive is enough
    monkeypatch.setattr(experiment_maps, 'corridor_drive', experiment_maps.passing_drive)
    for made in (experiment_maps.passer_by, experiment_maps.corridor):
        options = argparse.Namespace(seeds=seeds)
        table, _ = made(options, Parameters(), Ticker(True))
        assert counted(seeds, 'seed') in ' '.join(table.split())
    assert f'(standard map: {seeds})' in table
