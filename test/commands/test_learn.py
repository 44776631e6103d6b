"""The command `learn`: its output, the file it writes, and process_bag with this file."""

from __future__ import annotations

import io
import json
import math
import os
import re
import shlex
from pathlib import Path

import pytest
import yaml
from drive_samples import backwards_sensors, code_of, everything_in, mapped, tape, write_tape

from forward_grid_mapper.commands import learn, process_bag
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files import drawing
from forward_grid_mapper.files.learned_text import write_new_file
from forward_grid_mapper.files.parameter_file import load_parameters

LEARNED = ('p_hit', 'p_rand', 'p_lost', 'sigma')


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct bag of the drive."""
    return write_tape(tmp_path_factory.mktemp('plain') / 'bag', tape())


def output_of(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    capsys.readouterr()
    assert code_of(learn.main, *arguments) == code
    out, err = capsys.readouterr()
    assert 'Traceback' not in err
    return out if code == 0 else err


def test_output_has_values_errors_and_rounds(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = output_of(capsys, bag, '--rounds', 2, '--keep-going')
    start = Parameters().model
    for name in LEARNED:
        (row,) = re.findall(rf'^  {name} +([\d.]+) +([\d.]+) .*readings$', text, re.MULTILINE)
        assert float(row[0]) == getattr(start, name)
    assert re.search(r'^  p_hit .* \d\.\d{4} +\d\.\d{4} … \d\.\d{4}', text, re.MULTILINE)
    assert 'conditional on the map' in text and '95 %' in text
    assert re.search(r'^  0 .* 0\.0 m$', text, re.MULTILINE) and re.search(r'^  2 .* kept$', text, re.MULTILINE)
    assert all(len(line) <= 110 for line in text.splitlines())


def test_json_prints_only_the_values(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / 'learned.yaml'
    found = json.loads(output_of(capsys, bag, '--rounds', 2, '--json', '--keep-going', '-o', file))
    assert found['file'] == str(file)
    values = load_parameters(file).values
    for name in LEARNED:
        assert found['values'][name]['start'] == getattr(Parameters().model, name)
        assert found['values'][name]['learned'] == found['parameters'][name] == pytest.approx(values[name], rel=1e-6)
    assert len(found['rounds']) > found['accepted_round'] >= 0


def test_learned_file_is_accepted_by_process_bag(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, 'draw', lambda path, picture: path.write_bytes(b''))
    given = tmp_path / 'given.yaml'
    frame, pose = tape().extrinsics[0]
    given.write_text(
        yaml.safe_dump(
            {
                '/**': {
                    'ros__parameters': {
                        'prior': 0.3,
                        'use_sim_time': True,
                        'range_topics': ['a', 'b'],
                        f'sensors.{frame}.pose': list(map(float, pose)),
                    }
                }
            }
        )
    )
    output = tmp_path / 'learned.yaml'
    options = ('--rounds', 1, '--keep-going', '--params', given, '--set', 'p_rand=0.3', '--sensor', 'other=1,2,90deg')
    text = output_of(capsys, bag, '-o', output, *options)
    assert str(output) in text
    values, extrinsics, node = load_parameters(output)
    assert node == {'use_sim_time': True}
    assert set(extrinsics) == {frame, 'other'} and extrinsics[frame] == pytest.approx(pose)
    parameters = Parameters().varied(values)
    assert parameters.search.prior == 0.3 and parameters.node.range_topics == ('a', 'b')
    assert parameters.model.p_rand != 0.3
    assert output.read_text().startswith('# Learned from')
    report = mapped(bag, tmp_path / 'maps', '--params', output)
    assert {name: report['parameters'][name] for name in LEARNED} == {name: values[name] for name in LEARNED}


def test_values_rejected_by_held_out_readings_are_not_written(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / 'learned.yaml'
    found = json.loads(output_of(capsys, bag, '--rounds', 2, '--json', '-o', file))
    seen = found['cross_validation']
    better = all(
        seen[f'learned_at_{values}'] - seen[f'first_at_{values}'] > seen[f'error_at_{values}']
        for values in ('first', 'learned')
    )
    assert not better and found['accepted_round'] == 0
    start, written = Parameters().flat(), load_parameters(file).values
    for name in LEARNED:
        assert found['parameters'][name] == start[name] == written[name]
    assert any('the map of the learned values does not predict' in text for text in found['warnings'])
    assert 'Nothing was learned from' in file.read_text().splitlines()[0]


def test_output_mentions_that_values_were_not_tested(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = 'no readings were held out to test the learned values'
    assert text in ' '.join(output_of(capsys, bag, '--rounds', 1, '--keep-going').split())
    assert text not in ' '.join(output_of(capsys, bag, '--rounds', 1).split())


def test_sensors_with_long_names_are_read_back(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame, file = 'f' * 200, tmp_path / 'learned.yaml'
    output_of(capsys, bag, '--rounds', 1, '--sensor', f'{frame}=1,2,90deg', '-o', file)
    assert load_parameters(file).extrinsics[frame] == pytest.approx((1.0, 2.0, math.pi / 2))
    assert list(yaml.safe_load(file.read_text())) == ['/**']


def test_interrupted_writing_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted(io.StringIO):
        def write(self, text: str) -> int:
            raise KeyboardInterrupt

    def opened(path: Path, *unused: object, **options: object) -> io.StringIO:
        path.touch()
        return Interrupted()

    monkeypatch.setattr(Path, 'open', opened)
    with pytest.raises(KeyboardInterrupt):
        write_new_file(tmp_path / 'learned.yaml', 'p_hit: 0.5')
    assert not list(tmp_path.iterdir())


def test_existing_file_is_not_overwritten(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = tmp_path / 'mine.yaml'
    taken.write_text('mine')
    before = everything_in(tmp_path)
    # nor is a file made elsewhere, on a disk that is not mounted
    link = tmp_path / 'link.yaml'
    link.symlink_to(tmp_path / 'disk' / 'x.yaml')
    for path, expected in (
        (taken, 'exists'),
        (tmp_path, 'exists'),
        (link, 'exists'),
        (tmp_path / 'none' / 'x.yaml', 'not a folder'),
    ):
        message = output_of(capsys, bag, '-o', path, code=1)
        assert message.startswith('learn: error: ') and expected in message and '--output' in message
    link.unlink()
    assert everything_in(tmp_path) == before and taken.read_text() == 'mine'


def test_output_without_permission_is_reported_before_the_work(
    tmp_path: Path, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, 'access', lambda path, mode: mode == os.F_OK)
    monkeypatch.setattr(learn, 'read_drives', lambda *arguments: pytest.fail('it began to work'))
    message = output_of(capsys, bag, '-o', tmp_path / 'x.yaml', code=1)
    assert message.endswith(f'{tmp_path} is not writable; choose another folder with --output\n')


def test_output_that_the_file_system_refuses_is_reported_before_the_work(
    tmp_path: Path, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learn, 'read_drives', lambda *arguments: pytest.fail('it began to work'))
    # the folder can be written, but has no file of this name, like a folder of /proc
    assert 'cannot be written' in output_of(capsys, bag, '-o', tmp_path / ('x' * 300), code=1)
    assert not everything_in(tmp_path)


def test_bad_arguments_are_rejected(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert '--rounds' in output_of(capsys, bag, '--rounds', 0, code=1)
    assert 'p_hit' in output_of(capsys, bag, '--set', 'p_hit=2', code=1)
    assert 'absent' in output_of(capsys, tmp_path / 'absent', code=1)


def test_quiet_prints_only_warnings(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert code_of(learn.main, bag, '-q', '--rounds', 1) == 0
    out, err = capsys.readouterr()
    assert out == '' and all(line.startswith('learn: warning: ') for line in err.splitlines()) and err


def test_sensor_that_differs_from_others_gives_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A sensor that sees its own mount always has the same short range."""
    broken = tape().extrinsics[3][0]
    ranges = [m._replace(range=0.25) if m.frame_id == broken else m for m in tape().ranges]
    bag = write_tape(tmp_path / 'bag', tape()._replace(ranges=ranges))
    output = tmp_path / 'learned.yaml'
    text = ' '.join(output_of(capsys, bag, '--rounds', 1, '-o', output).split())
    assert f'a sensor stands out from the others: {broken} (always short: 0.25 m)' in text
    assert f'# WARNING: a sensor stands out from the others: {broken}' in output.read_text()
    assert code_of(learn.main, bag, '--rounds', 1, '-q') == 0
    assert f'learn: warning: a sensor stands out from the others: {broken}' in capsys.readouterr().err


def test_warnings_about_wrong_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = backwards_sensors()[1]
    bag = write_tape(tmp_path / 'bag', wrong._replace(ranges=[m for m in wrong.ranges for _ in range(2)]))
    text = ' '.join(output_of(capsys, bag, '--rounds', 1).split())
    assert 'are copies of others' in text and 'recorded twice' in text
    assert 'the sensors seem to be rotated by 180 degrees; check the poses of the sensors' in text


def test_printed_command_maps_the_same_readings() -> None:
    part = ['--start', '3', '--duration', '20', '--poses', 'true.csv']
    topics = ['--odom-topic', '/odom', '--range-topics', '/a', '/b']
    options = learn.parser().parse_args(['one bag', *part, *topics])
    line = shlex.split(learn._mapping(options, Path('learned.yaml')))
    given = process_bag.parser().parse_args(line[line.index('process_bag') + 1 :])
    assert (given.bags, given.params) == (['one bag'], 'learned.yaml')
    for name in ('start', 'duration', 'poses', 'odom_topic', 'range_topics'):
        assert getattr(given, name) == getattr(options, name)
