"""`experiment` and `demo`: they run, print a table and write a picture."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
from drive_samples import code_of, everything_in

from forward_grid_mapper.commands import demo, experiment, experiment_density, experiment_maps
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files.parameter_file import load_parameters

PAPER_FILE = Path(__file__).parents[2] / 'config' / 'paper.yaml'


@pytest.fixture(autouse=True)
def few_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try only three settings of the standard map instead of hundreds."""
    gains = experiment_maps.GAINS
    monkeypatch.setattr(experiment_maps, 'GAINS', gains[:: len(gains) // 3][:3])


def test_door_writes_a_table_and_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code_of(experiment.main, 'door', '--seeds', 1) == 0
    out = capsys.readouterr().out
    rows = re.findall(r'^(noise-free|noisy) +n = (\d+) +(.*)$', out, re.MULTILINE)
    assert [row[:2] for row in rows] == [(noise, n) for noise in ('noise-free', 'noisy') for n in ('1', '3', '16')]
    for row in rows:
        scores = re.findall(r'(\d\.\d{3})  (\d\.\d)-(\d\.\d)', row[2])
        assert len(scores) == 4
        assert all(0.0 <= float(f1) <= 1.0 and float(low) <= float(high) for f1, low, high in scores)
        assert float(scores[0][0]) > 0.5, 'the forward map has lost the walls'
        if row[0] == 'noise-free':
            assert row[2].split()[5] == '0', 'in print, no reading is attributed to chance'
    assert 'best gains of 3' in out
    folder = tmp_path / 'experiment_door'
    assert str(folder) in out
    assert {path.name for path in folder.iterdir()} == {'figure.png', 'table.txt'}
    assert (folder / 'figure.png').read_bytes().startswith(b'\x89PNG')
    assert out.startswith((folder / 'table.txt').read_text('utf-8'))
    assert everything_in(tmp_path) == sorted(map(str, (folder, *folder.iterdir())))


def test_corridor_writes_a_table_and_a_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'corridor'
    assert code_of(experiment.main, 'corridor', '--seeds', 1, '-o', output) == 0
    out = capsys.readouterr().out
    rows = re.findall(r'^(forward|standard).* (\d\.\d{3}) +(\d)/6 +(\d\.\d\d) +\d+ +\d\.\d\d +\d+$', out, re.MULTILINE)
    assert [row[0] for row in rows] == ['forward'] * 2 + ['standard'] * 3
    assert re.search(r'Of 3 gains of the standard map, \d show .* half of the smooth wall', out)
    assert {path.name for path in output.iterdir()} == {'figure.png', 'table.txt'}


def test_passer_by_writes_a_table_and_a_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'passer'
    assert code_of(experiment.main, 'passer-by', '--seeds', 1, '-o', output) == 0
    out = capsys.readouterr().out
    rows = re.findall(r'^(forward|standard).* (\d\.\d{3}) +(\d)/4  ((?:\d\.\d ){4}) +\d+ +(\d+|-)$', out, re.MULTILINE)
    assert [row[0] for row in rows] == ['forward'] * 2 + ['standard'] * 2
    assert rows[0][2] == '4', 'our map must show all doors'
    assert int(rows[0][4]) > 0, 'echoes of the person are on no map'
    assert (output / 'figure.png').read_bytes().startswith(b'\x89PNG')


def test_density_has_the_peaks_and_weights_of_the_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'density'
    assert code_of(experiment.main, 'density', '--params', PAPER_FILE, '-o', output) == 0
    out = capsys.readouterr().out
    peaks = re.findall(r'^(first|second|nothing).* (\d\.\d\d) +(\d+\.\d{3}) +(0\.\d{3})$', out, re.MULTILINE)
    near, far = (math.hypot(*(0.1 * math.floor(v / 0.1) + 0.05 for v in xy)) for xy in ((1.5, 0.05), (2.6, -0.1)))
    assert [float(at) for _, at, _, _ in peaks] == pytest.approx([near, far, 4.0], abs=0.011)
    shares = [0.95 * 0.9, 0.95 * 0.09, 0.95 * 0.01]
    assert [float(share) for *_, share in peaks] == pytest.approx(shares, abs=6e-4)
    # a normal density of 5 cm, and the floor
    tops = [0.05 / 4 + share / (0.05 * math.sqrt(2 * math.pi)) for share in shares]
    assert [float(top) for _, _, top, _ in peaks] == pytest.approx(tops, rel=0.02)
    assert re.search(r'^chance, everywhere +0\.01[23] +0\.050$', out, re.MULTILINE)
    assert (output / 'figure.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize('p_lost', [0.0, 0.5])
def test_weights_of_the_causes_sum_up_to_one(p_lost: float) -> None:
    parameters = Parameters.from_flat({'p_lost': p_lost})
    curve, _ = experiment_density.density_of_ranges(parameters)
    table = experiment_density.density_table(curve, parameters)
    weights = re.findall(r' (0\.\d{3})$', table, re.MULTILINE)
    assert sum(map(float, weights)) == pytest.approx(1.0, abs=0.003)
    assert ('echo lost' in table) == (p_lost > 0)


def test_obstacle_outside_the_cone_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    parameters = Parameters.from_flat(experiment_maps.PAPER)
    with_it, _ = experiment_density.density_of_ranges(parameters)
    monkeypatch.setattr(experiment_density, 'BESIDE', experiment_density.NEAR)
    without, _ = experiment_density.density_of_ranges(parameters)
    assert (with_it.y == without.y).all()
    monkeypatch.setattr(experiment_density, 'NEAR', experiment_density.FAR)
    monkeypatch.setattr(experiment_density, 'BESIDE', experiment_density.FAR)
    moved, _ = experiment_density.density_of_ranges(parameters)
    assert (moved.y != without.y).any()


@pytest.mark.slow
def test_parameters_change_only_the_row_of_our_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = []
    for name, options in (('a', ()), ('b', ('--set', 'p_hit=0.3', '--set', 'sigma=0.3'))):
        assert code_of(experiment.main, 'door', '--seeds', 1, '-o', tmp_path / name, *options) == 0
        lines = (tmp_path / name / 'table.txt').read_text('utf-8').splitlines()[-6:]
        tables.append([re.findall(r'\d\.\d{3}', line) for line in lines])
    forward, paper = ([[row[k] for row in table] for table in tables] for k in (0, 1))
    assert forward[0] != forward[1]
    assert paper[0] == paper[1]


def test_constants_of_the_paper_equal_its_parameter_file() -> None:
    values = load_parameters(PAPER_FILE).values
    given = {name: value for name, value in values.items() if name != 'alpha'}
    assert {name: pytest.approx(value, abs=1e-4) for name, value in experiment_maps.PAPER.items()} == given


@pytest.mark.parametrize(
    ('options', 'code', 'expected'),
    [
        (('door', '--seeds', 0), 1, '--seeds'),
        (('door', '--set', 'phit=1'), 1, 'did you mean p_hit'),
        (('window',), 2, 'door'),
    ],
)
def test_wrong_experiment_option_is_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...], code: int, expected: str
) -> None:
    assert code_of(experiment.main, *options, '-o', tmp_path / 'out') == code
    out, err = capsys.readouterr()
    assert out == '' and 'experiment: error: ' in err and expected in err
    assert everything_in(tmp_path) == []


def test_offline_demo_writes_maps_and_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code_of(demo.main, '--seen', 1, '--offline') == 0
    folder = tmp_path / 'demo_output'
    assert {path.name for path in folder.iterdir()} == {
        'bag',
        'demo.png',
        'maps',
        'reference.pgm',
        'reference.yaml',
        'scores.txt',
        'trajectory.csv',
    }
    out = capsys.readouterr().out
    assert (folder / 'scores.txt').read_text().strip() in out
    assert re.search(r'^maximum likelihood map +0\.\d{3}', out, re.MULTILINE)
    assert code_of(demo.main, '--seen', 1, '--offline') == 0
    assert (tmp_path / 'demo_output_2' / 'maps' / 'maps.png').is_file()


@pytest.mark.slow
def test_demo_with_the_node_writes_maps_and_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip('rclpy', reason='the demo replays to the node over DDS')
    assert code_of(demo.main, '--seen', 1, '--rate', 20, '-o', tmp_path / 'out') == 0
    out = capsys.readouterr().out
    assert 'EM in the node' in out
    assert re.search(r'^maximum likelihood map +0\.\d{3}', out, re.MULTILINE)
    assert (tmp_path / 'out' / 'demo.png').is_file()
    assert (tmp_path / 'out' / 'maps' / 'report.txt').is_file()


def test_experiments_do_not_need_rosbags(tmp_path: Path) -> None:
    code = (
        'import sys; sys.modules["rosbags"] = None; from forward_grid_mapper.commands.experiment import main; '
        'sys.exit(main(sys.argv[1:]))'
    )
    subprocess.run([sys.executable, '-c', code, 'density', '-o', str(tmp_path / 'out')], check=True)


def test_wrong_demo_option_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options in (
        ('--seen', 0),
        ('--seed', -1),
        ('--world', 'corridor', '--seen', 2),
        ('--params', tmp_path / 'absent.yaml'),
    ):
        assert code_of(demo.main, '-o', tmp_path / 'out', *options) == 1
        assert 'demo: error: ' in capsys.readouterr().err
    assert everything_in(tmp_path) == []
