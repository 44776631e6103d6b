"""Options that several commands share: topics before and after the bag, and parameters that only the node has."""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from drive_samples import code_of, mapped, tape, write_tape

from forward_grid_mapper import __version__
from forward_grid_mapper.__main__ import COMMANDS
from forward_grid_mapper.commands import demo, experiment, learn, process_bag, replay_bag, simulate
from forward_grid_mapper.commands.options import chosen_parameters, chosen_part, chosen_sensors, output_name
from forward_grid_mapper.core.common.errors import ParameterError
from forward_grid_mapper.core.common.parameters import TABLE
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.parameter_file import load_parameters
from forward_grid_mapper.files.parameter_text import dump_parameters

PARSERS = [process_bag.parser, learn.parser, replay_bag.parser]


@pytest.fixture
def bag(tmp_path: Path) -> str:
    """A path that exists."""
    (tmp_path / 'bag').mkdir()
    return str(tmp_path / 'bag')


def bags_of(options: argparse.Namespace) -> list[str]:
    """The bags found by the parser, for commands with one or several bags."""
    return options.bags if hasattr(options, 'bags') else [options.bag]


@pytest.mark.parametrize('command', [process_bag, learn])
def test_two_poses_of_one_sensor_are_rejected(
    command: ModuleType, bag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(command.main, bag, '--sensor', 'a=0,0,1', '--sensor', '/a=0,0,2') == 1
    assert '--sensor gives two poses of /a; give one of them' in capsys.readouterr().err
    options = command.parser().parse_args([bag, '--sensor', 'a=0,0,1', '--sensor', '/a=0,0,1', '--sensor', 'b=0,0,2'])
    assert chosen_sensors(options) == {'a': (0.0, 0.0, 1.0), 'b': (0.0, 0.0, 2.0)}


def test_output_name_keeps_the_dot_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / 'bag_1.5').mkdir()
    (tmp_path / 'one.mcap').touch()
    named = {name: process_bag._stem([str(tmp_path / name)]) for name in ('bag_1.5', 'one.mcap', 'day_*')}
    assert named == {'bag_1.5': 'bag_1.5', 'one.mcap': 'one', 'day_*': 'day_'}
    assert process_bag._stem([str(tmp_path / 'bag_1.5' / 'metadata.yaml')]) == 'bag_1.5'


@pytest.mark.parametrize('parser', PARSERS)
@pytest.mark.parametrize(
    'form',
    [
        'BAG --range-topics A B',
        'BAG --range-topics A,B',
        'BAG --range-topics A, B',
        'BAG --range-topics A --range-topics B',
        'BAG --range-topics=A,B',
        '--range-topics=A,B BAG',
        '--range-topics A B -q BAG',
        '--range-topics A B -- BAG',
        '--range-topics A B BAG',
        '--range-topics A,B BAG',
        '--range-topics A --range-topics B BAG',
        '-q --range-topics A B BAG --odom-topic O',
    ],
)
def test_bag_is_found_before_and_after_the_topics(
    parser: Callable[[], argparse.ArgumentParser], form: str, bag: str
) -> None:
    options = parser().parse_args([bag if word == 'BAG' else word for word in form.split()])
    assert (bags_of(options), options.range_topics) == ([bag], ['A', 'B'])


@pytest.mark.parametrize('parser', [process_bag.parser, learn.parser])
@pytest.mark.parametrize(
    'form',
    [
        'BAG BAG other --range-topics A B',
        'BAG -q BAG other --range-topics A,B',
        'BAG --range-topics=A,B BAG -q other',
        '-q --range-topics A B BAG BAG other',
        '--range-topics A B -- BAG BAG other',
    ],
)
def test_several_bags_are_found_before_and_after_the_topics(
    parser: Callable[[], argparse.ArgumentParser],
    form: str,
    bag: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'other').mkdir()
    options = parser().parse_args([bag if word == 'BAG' else word for word in form.split()])
    assert (options.bags, options.range_topics) == ([bag, bag, 'other'], ['A', 'B'])


@pytest.mark.parametrize(
    ('words', 'expected'),
    [
        (['--start', '-1'], '--start -1: give seconds from the beginning'),
        (['--start', 'nan'], '--start nan'),
        (['--duration', '0'], '--duration 0: give seconds above 0'),
        (['--duration', 'nan'], '--duration nan'),
    ],
)
def test_impossible_part_is_rejected_with_reason(words: list[str], expected: str, bag: str) -> None:
    with pytest.raises(ParameterError, match=expected):
        chosen_part(process_bag.parser().parse_args([bag, *words]))


def test_bag_is_found_after_remappings(bag: str) -> None:
    options = replay_bag.parser().parse_args(['--remap', 'a:=b', 'c:=d', bag])
    assert (options.bag, options.remap) == (bag, ['a:=b', 'c:=d'])
    options = replay_bag.parser().parse_args(['--range-topics', 'A', '--remap', 'a:=b', bag])
    assert (options.bag, options.remap, options.range_topics) == (bag, ['a:=b'], ['A'])


@pytest.mark.parametrize('parser', PARSERS)
@pytest.mark.parametrize(
    ('form', 'expected'),
    [
        ('', 'no bag is given'),
        ('-q', 'no bag is given'),
        ('--range-topics A absent', 'BAG --range-topics A absent'),
        ('--range-topics A', 'Give the bag first'),
        ('--range-topics BAG', '--range-topics: expected one word or more before the bag'),
    ],
)
def test_missing_bag_is_rejected(
    parser: Callable[[], argparse.ArgumentParser],
    form: str,
    expected: str,
    bag: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as left:
        parser().parse_args([bag if word == 'BAG' else word for word in form.split()])
    assert left.value.code == 2
    assert expected in capsys.readouterr().err


def test_usage_shows_the_bag_as_required() -> None:
    for parser in PARSERS:
        assert ' bag' in parser().format_usage() and '[bag]' not in parser().format_usage()


# ---- parameters


NODE = [row for row in TABLE if row.group == 'node']


@pytest.mark.parametrize('name', [row.name for row in NODE])
def test_parameter_of_the_node_is_rejected_on_the_command_line(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    value = {float: '2.5', bool: 'true', int: '3'}.get(next(row.type for row in NODE if row.name == name), 'reliable')
    options = process_bag.parser().parse_args(['bag', '--set', f'{name}={value}'])
    with pytest.raises(ParameterError, match=f'--set {name}: this parameter is only for the node'):
        chosen_parameters(options)
    assert code_of(process_bag.main, tmp_path / 'absent', '--set', f'{name}={value}', '-o', tmp_path / 'maps') == 1
    error = capsys.readouterr().err
    assert f'--set {name}: this parameter is only for the node' in error
    assert ('give --refine-poses' in error) == (name == 'refine_poses')


def test_changed_node_parameters_in_a_file_give_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: None)
    file = tmp_path / 'p.yaml'
    file.write_text('/**: {ros__parameters: {map_frame: map, publish_rate: 5.0, odom_topic: odom, p_hit: 0.6}}')
    path = write_tape(tmp_path / 'recorded', tape())
    report = mapped(path, tmp_path / 'maps', '--params', file, '-q')
    (warning,) = (w for w in report['warnings'] if 'only for the node' in w)
    assert str(file) in warning and "map_frame (the maps are in odometry's frame)" in warning
    assert 'odom_topic' not in warning, 'a default changes nothing'
    assert 'publish_rate' not in warning, 'it changes no map'
    assert 'p_hit' not in warning
    assert warning in capsys.readouterr().err
    assert 'map_frame' in (tmp_path / 'maps' / 'report.txt').read_text()
    assert code_of(learn.main, path, '--params', file, '--rounds', 1, '-q') == 0
    assert f'learn: warning: {warning}' in capsys.readouterr().err


def test_each_node_parameter_in_a_file_that_changes_maps_gives_a_warning(tmp_path: Path) -> None:
    other = {float: 3.25, str: 'reliable', tuple: ['x'], int: 3}
    for row in NODE:
        file = tmp_path / f'{row.name}.yaml'
        file.write_text(f'{row.name}: {str(not row.default if row.type is bool else other[row.type]).lower()}')
        chosen = chosen_parameters(process_bag.parser().parse_args(['bag', '--params', str(file)]))
        assert len(chosen.warnings) == (row.name in ('range_topics', 'odom_topic', 'map_frame', 'refine_poses'))
        assert all(row.name in warning for warning in chosen.warnings)
        # the parameter file of the node, and the option that has the same effect
        for option, *value in (['--refine-poses'], ['--odom-topic', 'odom'], ['--range-topics', 'sonar']):
            if row.name == option[2:].replace('-', '_'):
                given = process_bag.parser().parse_args(['bag', '--params', str(file), option, *value])
                assert not chosen_parameters(given).warnings
    file = tmp_path / 'defaults.yaml'
    file.write_text(dump_parameters(chosen.parameters.__class__()))
    assert chosen_parameters(process_bag.parser().parse_args(['bag', '--params', str(file)])).warnings == []


def test_experiment_warns_of_node_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / 'p.yaml'
    file.write_text('map_frame: map')
    (tmp_path / 'taken').write_text('')
    assert code_of(experiment.main, 'door', '--params', file, '-o', tmp_path / 'taken') == 1
    assert 'experiment: warning: ' in capsys.readouterr().err


@pytest.mark.parametrize('main', [process_bag.main, learn.main, experiment.main, demo.main])
def test_dump_config_prints_a_parameter_file(
    main: Callable[..., int],
    tmp_path: Path,
    bag: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    first = [bag] if main in (process_bag.main, learn.main) else ['door'] if main is experiment.main else []
    settings = ['--set', 'p_hit=0.55', '--set', 'max_incidence_angle=35deg', '--dump-config']
    assert code_of(main, *first, *settings) == 0
    file = tmp_path / 'dumped.yaml'
    file.write_text(capsys.readouterr().out)
    values = load_parameters(file).values
    assert (values['p_hit'], values['max_incidence_angle']) == (0.55, pytest.approx(math.radians(35)))
    assert {path.name for path in tmp_path.iterdir()} == {'bag', 'dumped.yaml'}


@pytest.mark.parametrize('main', [process_bag.main, learn.main])
def test_dump_config_works_without_a_bag(main: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(main, '--set', 'p_hit=0.55', '--dump-config') == 0
    assert '\n    p_hit: 0.55\n' in capsys.readouterr().out


@pytest.mark.parametrize('name', sorted(COMMANDS))
def test_command_prints_its_version(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main = importlib.import_module(f'forward_grid_mapper.{COMMANDS[name][0]}').main
    assert code_of(main, '--version') == 0
    assert capsys.readouterr().out == f'{name} of forward_grid_mapper {__version__}\n'


@pytest.mark.parametrize('command', [process_bag, learn, demo, experiment, simulate])
def test_empty_output_name_is_rejected(command: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    words = {experiment: ['door'], simulate: ['door'], demo: []}.get(command, ['MY_BAG'])
    with pytest.raises(SystemExit):
        command.parser().parse_args([*words, '-o', ''])
    assert '-o/--output: the name is empty' in capsys.readouterr().err


def test_home_folder_in_an_output_name_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """bash does not expand `--output=~/maps`; a folder with the name ~ would be made, which is dangerous to remove."""
    monkeypatch.setenv('HOME', str(tmp_path))
    assert output_name('~/maps') == str(tmp_path / 'maps')
    for name in ('maps', './~/maps', 'maps~', 'maps/'):
        assert output_name(name) == name
    with pytest.raises(argparse.ArgumentTypeError, match='no user nobody_at_all'):
        output_name('~nobody_at_all/maps')
    for command in (process_bag, learn):
        options = command.parser().parse_args([str(tmp_path), '--output=~/maps'])
        assert options.output == str(tmp_path / 'maps')
