"""The page of a run: its numbers are those of `explain`, it works in a browser, and no name is run as code."""

from __future__ import annotations

import base64
import json
import zlib
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import found_in
from made_maps import made_maps

from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.core.maps.cell_evidence import cell_evidence
from forward_grid_mapper.core.maps.map_set import MapSet
from forward_grid_mapper.core.maps.moments import moments
from forward_grid_mapper.core.maps.reading_causes import CAUSES, RANDOM
from forward_grid_mapper.files import web_page
from forward_grid_mapper.files.panels import DRIVES
from forward_grid_mapper.files.report import report_data
from forward_grid_mapper.files.results import write_results
from forward_grid_mapper.files.web_page import write_page
from forward_grid_mapper.simulation.drive import corridor_drive

PATH = np.array([[0.0, 0.0], [1.0, 0.5]])


@cache
def drive() -> MapSet:
    """The first 25 s of a drive along a corridor, with smooth walls and lost echoes."""
    readings = corridor_drive(0).readings
    first = np.argsort(readings.stamp, kind='stable')[:2400]
    return Mapper(Parameters.from_flat({})).run(readings.select(first))


def written(folder: Path, maps: MapSet, title: str = 'run', **source: Any) -> Path:
    write_page(folder / 'report.html', maps, report_data(maps, source), title, PATH)
    return folder / 'report.html'


def numbers(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding='utf-8').partition('id="data">')[2].partition('</script>')[0]
    data: dict[str, Any] = json.loads(text)
    return data


def array(data: dict[str, Any], name: str) -> Any:
    packed = data['arrays'][name]
    return np.frombuffer(zlib.decompress(base64.b64decode(packed['data'])), np.dtype('<' + packed['type']))


def some_cells(maps: MapSet) -> list[tuple[int, int]]:
    """Cells of each state, and those with the most readings."""
    random, cells = np.random.default_rng(4), []
    for state, count in ((1, 25), (0, 15), (-1, 5)):
        rows, columns = np.nonzero(maps.ml == state)
        which = random.choice(len(rows), count, replace=False)
        cells += [(int(rows[k]), int(columns[k])) for k in which]
    return cells


def test_cells_are_explained_as_by_the_command_explain(tmp_path: Path) -> None:
    maps = drive()
    cells = some_cells(maps)
    script = """
        const p = report, e = p.evidence;
        return CELLS.map(([row, column]) => {
          const f = e.cell(row, column, true);
          return {state: f.state, data: f.data, prior: f.prior, wall: f.wall, readings: f.readings.map(r =>
            [r.t, r.nats, r.distance, r.kind])};
        });
    """.replace('CELLS', json.dumps(cells))
    expected = found_in(written(tmp_path, maps), tmp_path, script)
    assert maps.normals.known.any(), 'the incidence angle must matter'
    x, y = maps.grid.centers()
    for (row, column), cell in zip(cells, expected, strict=True):
        place = float(x[column]), float(y[row])
        found = cell_evidence(maps.readings, maps.grid, maps.ml, maps.parameters, maps.normals, place)
        assert cell['data'] == pytest.approx(found.data, abs=1e-9)
        assert cell['prior'] == pytest.approx(found.prior, abs=1e-4)
        assert cell['wall'] == pytest.approx(found.wall, abs=1e-9)
        here = {t: rest for t, *rest in cell['readings']}
        assert here.keys() == set(found.readings.tolist())
        for k, t in enumerate(found.readings.tolist()):
            nats, distance, kind = here[t]
            assert nats == pytest.approx(found.nats[k], abs=1e-9)
            assert distance == pytest.approx(found.distance[k], abs=1e-9)
            assert (kind == 'end here') == found.ends_here[k]
            assert (kind == 'heard no echo') == found.silent[k]
    kinds = [kind for cell in expected for *_, kind in cell['readings']]
    assert len(kinds) > 200
    assert set(kinds) == {'end here', 'reach farther', 'heard no echo', 'end before it'}


USED = """
    const at = ([x, y]) => {
      const box = report.chart.canvas.getBoundingClientRect(), [px, py] = report.chart.pixels(x, y);
      return {clientX: box.left + px, clientY: box.top + py, pointerId: 1, bubbles: true};
    };
    const send = (kind, xy) => report.chart.canvas.dispatchEvent(new PointerEvent(kind, at(xy)));
    const $$ = id => document.getElementById(id);
    const picture = () => { report.chart.drawNow(); return report.chart.canvas.toDataURL(); };
    const out = {tipBefore: $$('tip').hidden};
    const whole = picture();
    for (const id of ['live_map', 'uncertainty_map', 'path', 'obstacle']) {
      $$(id).click();
      out[id] = picture() !== whole;
      $$(id).click();
    }
    $$('ml_map').click();
    out.ml_map = picture() !== whole;
    $$('ml_map').click();
    const slider = $$('ml_map').closest('.row').querySelector('input[type=range]');
    slider.value = 30;
    slider.dispatchEvent(new Event('input'));
    out.opacity = picture() !== whole;
    $$('time').value = 0.5 * $$('time').max;
    $$('time').dispatchEvent(new Event('input'));
    const half = picture(), shown = () => report.layers.filter(layer => layer.shown).map(layer => layer.id);
    out.time = half !== whole && $$('clock').textContent;
    out.half = [shown(), $$('ml_map').checked, $$('live_map').checked, report.standard.label.textContent];
    $$('time').value = 0.9 * $$('time').max;
    $$('time').dispatchEvent(new Event('input'));
    out.grows = picture() !== half;
    $$('time').value = 0;
    $$('time').dispatchEvent(new Event('input'));
    out.begins = report.standard.levels[0].width;
    $$('time').value = $$('time').max;
    $$('time').dispatchEvent(new Event('input'));
    out.whole = [shown(), $$('ml_map').checked, $$('live_map').checked, report.standard.label.textContent];
    send('pointermove', PLACE);
    out.tip = $$('tip').textContent;
    send('pointerdown', PLACE);
    send('pointerup', PLACE);
    out.clicked = picture() !== whole;
    out.cell = $$('cell').textContent;
    out.rows = document.querySelectorAll('#readings tbody tr').length;
    const before = report.chart.scale;
    $$('closer').click();
    out.zoom = report.chart.scale / before;
    const centre = report.chart.cx;
    send('pointerdown', PLACE);
    report.chart.canvas.dispatchEvent(new PointerEvent('pointermove', {...at(PLACE), clientX: at(PLACE).clientX + 50}));
    out.pan = centre - report.chart.cx;
    out.scale = report.chart.scale;
    out.hash = location.hash;
    out.sideways = document.documentElement.scrollWidth - document.documentElement.clientWidth;
    out.canvas = [report.chart.canvas.clientWidth, report.chart.canvas.clientHeight];
    return out;
"""


@pytest.mark.parametrize(('width', 'height'), [(1280, 800), (390, 800)])
def test_page_reacts_to_all_controls(tmp_path: Path, width: int, height: int) -> None:
    maps = drive()
    row, column = some_cells(maps)[0]
    x, y = maps.grid.centers()
    place = [float(x[column]), float(y[row])]
    page = written(tmp_path, maps)
    out = found_in(page, tmp_path, USED.replace('PLACE', json.dumps(place)), width, height)
    found = cell_evidence(maps.readings, maps.grid, maps.ml, maps.parameters, maps.normals, (place[0], place[1]))
    assert out['tipBefore'] is True
    for switch in ('live_map', 'uncertainty_map', 'ml_map', 'path', 'obstacle', 'opacity', 'clicked'):
        assert out[switch] is True, switch
    assert out['time'].endswith(' s')
    assert out['half'] == [['live_map'], False, True, 'Standard map after 50 % of the readings']
    assert out['grows'] is True
    assert out['begins'] == 1, 'of the first part of the drive nothing is known'
    assert out['whole'] == [['ml_map'], True, False, 'Standard map']
    assert f'x = {place[0]:.2f} m, y = {place[1]:.2f} m' in out['tip']
    assert f'nats from {len(found.readings)} readings' in out['tip']
    assert out['rows'] == min(12, len(found.readings)) > 0
    assert ': occupied' in out['cell']
    assert 'for the cell together with its occupied neighbours' in out['cell']
    assert out['zoom'] == pytest.approx(1.5)
    assert out['pan'] == pytest.approx(50 / out['scale'])
    assert out['hash'].startswith('#x=')
    assert out['sideways'] == 0, 'it must not have to be scrolled sideways'
    assert min(out['canvas']) > 300


def test_page_contains_the_maps(tmp_path: Path) -> None:
    maps = drive()
    data = numbers(written(tmp_path, maps))
    assert (array(data, 'ml_map').view(np.int8).reshape(maps.grid.shape) == maps.ml).all()
    for name, values in (('live_map', maps.live), ('uncertainty_map', maps.uncertainty)):
        steps = array(data, name).reshape(maps.grid.shape)
        assert ((steps == web_page.UNKNOWN_SHARE) == np.isnan(values)).all()
        assert np.nanmax(np.abs(np.where(np.isnan(values), np.nan, steps / web_page.STEPS) - values)) < 1e-4
    causes = array(data, 'cause')
    assert np.count_nonzero(causes == RANDOM) == np.count_nonzero(maps.unexplained)
    # p_lost is part of the model, so a reading without echo is one or the other
    silent = np.isin(causes, [CAUSES.index('lost'), CAUSES.index('no_echo')])
    assert not (silent & maps.readings.echo & (maps.readings.z < maps.readings.z_max - 1.0)).any()
    assert array(data, 'path').tolist() == PATH.ravel().tolist()


def test_slider_shows_the_standard_map_at_each_moment(tmp_path: Path) -> None:
    maps = drive()
    page = written(tmp_path, maps)
    changes = array(numbers(page), 'moments').reshape(-1, *maps.grid.shape)
    then = list(moments(maps, web_page.MOMENTS))[:-1]
    assert len(changes) == len(then) == web_page.MOMENTS - 1
    expected = found_in(page, tmp_path, 'return report.moments.map(m => [m.until, [...m.values]])')
    for (until, values), moment, steps in zip(expected, then, changes.cumsum(axis=0, dtype=np.uint8), strict=True):
        assert until == moment.stamp / 1e9
        np.testing.assert_array_equal(np.array(values).reshape(maps.grid.shape), steps)
        np.testing.assert_array_equal(steps == web_page.UNKNOWN_THEN, np.isnan(moment.live))
        known = steps != web_page.UNKNOWN_THEN
        assert np.abs(steps[known] / web_page.STEPS_THEN - moment.live[known]).max() <= 0.5 / web_page.STEPS_THEN + 1e-6


def test_large_maps_have_fewer_moments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = drive()
    for cells, count in ((4, 3), (1, 0)):
        monkeypatch.setattr(web_page, 'MOST_CELLS_OF_MOMENTS', cells * maps.grid.size)
        page = written(tmp_path, maps)
        assert len(numbers(page)['moments']) == count
        script = 'report.go(0.5); return [report.layers.filter(layer => layer.shown).map(layer => layer.id)]'
        assert found_in(page, tmp_path, script) == [['live_map' if count else 'ml_map']]


class Tags(HTMLParser):
    """Counts the elements of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.found.append(tag)


def test_names_are_never_code(tmp_path: Path) -> None:
    evil = '</script><img src=x onerror=alert(1)><script>{{data}}\x00\udc80'
    plain, maps = made_maps(), made_maps()
    object.__setattr__(maps.readings, 'sensor_names', (evil, 'b'))
    (tmp_path / 'plain').mkdir()
    (tmp_path / 'evil').mkdir()
    pages = [
        written(tmp_path / 'plain', plain, 'run', warnings=['one']),
        written(tmp_path / 'evil', maps, evil, warnings=[evil], bag=evil),
    ]
    counts = []
    for page in pages:
        tags = Tags()
        tags.feed(page.read_text(encoding='utf-8'))
        counts.append(sorted(tags.found))
    assert counts[0] == counts[1]
    assert numbers(pages[1])['sensors'][0]['name'] == evil


def test_page_needs_no_network(tmp_path: Path) -> None:
    text = written(tmp_path, made_maps()).read_text(encoding='utf-8')
    assert '://' not in text
    assert "default-src 'none'" in text


def test_page_with_12000_readings_is_below_five_megabytes(tmp_path: Path) -> None:
    readings = corridor_drive(0).readings
    assert len(readings) == 12_000
    maps = Mapper(Parameters.from_flat({})).run(readings)
    assert written(tmp_path, maps).stat().st_size < 5_000_000


def test_too_many_readings_or_cells_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = made_maps()
    monkeypatch.setattr(web_page, 'MOST_READINGS', 10)
    page = written(tmp_path, maps)
    assert 'z' not in numbers(page)['arrays']
    assert 'forward_grid_mapper explain' in page.read_text()
    monkeypatch.setattr(web_page, 'MOST_CELLS', 10)
    report = write_results(tmp_path / 'maps', maps, {}, PATH, 'large')
    assert any('report.html was not written' in text for text in report['warnings'])
    assert not (tmp_path / 'maps' / 'report.html').exists()


def test_headers_of_the_sensors_do_not_touch(tmp_path: Path) -> None:
    # as narrow as beside long verdicts
    script = """
        $('sensor_table').style.width = 'min-content';
        const ends = [...document.querySelectorAll('#sensor_table th')].map(head => {
            const range = document.createRange();
            range.selectNodeContents(head);
            return range.getBoundingClientRect();
        });
        return ends.slice(1).map((head, k) => head.left - ends[k].right);
    """
    gaps = found_in(written(tmp_path, made_maps(readings=10)), tmp_path, script)
    assert len(gaps) == 4 and min(gaps) >= 6, gaps


@pytest.mark.parametrize('readings', [0, 10])
def test_page_with_few_readings_opens(tmp_path: Path, readings: int) -> None:
    page = written(tmp_path, made_maps(readings=readings))
    assert found_in(page, tmp_path, 'return [report.evidence.count, document.querySelectorAll("#cell p").length]') == [
        readings,
        1,
    ]


@pytest.mark.parametrize(('count', 'expected'), [(1, '1 reading ends here'), (2, '2 readings end here')])
def test_number_of_readings_by_sensor_is_shown(tmp_path: Path, count: int, expected: str) -> None:
    script = """
        const found = report.evidence.cell(0, 0, true);
        const one = {t: 0, nats: 1, distance: 1, range: 1, silent: false, kind: 'end here'};
        report.found = {...found, readings: Array(COUNT).fill(one)};
        report.listReadings(12);
        return $('cell').innerText;
    """
    text = found_in(written(tmp_path, made_maps(readings=10)), tmp_path, script.replace('COUNT', str(count)))
    assert f'nats: {expected}' in text
    assert f'nats from {count} {"reading" if count == 1 else "readings"}, ' in text


def test_paths_of_several_drives_are_separate(tmp_path: Path) -> None:
    xy = np.full((30_001, 2), 0.5)
    xy[10_001] = np.nan
    xy[:10_001] = -0.5
    maps = made_maps()
    write_page(tmp_path / 'report.html', maps, report_data(maps, {}), 'two', xy)
    kept = array(numbers(tmp_path / 'report.html'), 'path').reshape(-1, 2)
    (gap,) = np.flatnonzero(np.isnan(kept[:, 0]))
    assert (kept[:gap] == -0.5).all() and (kept[gap + 1 :] == 0.5).all()
    script = """
        const lines = [], g = {stroke() {}, beginPath() {}, setLineDash() {}, moveTo: () => lines.push(0),
          lineTo: () => lines[lines.length - 1]++};
        report.chart.line(g, report.page.arrays.path, 'black', 1);
        return lines;
    """
    assert found_in(tmp_path / 'report.html', tmp_path, script) == [gap - 1, len(kept) - gap - 2]
    assert f'DRIVES = [PATH, {", ".join(map(repr, DRIVES[1:]))}]' in (web_page.WEB / 'chart.js').read_text()
    assert f"PATH = '{DRIVES[0]}'" in (web_page.WEB / 'chart.js').read_text()


@pytest.mark.parametrize('count', [2, 30])
def test_each_drive_has_a_colour_and_the_first_have_a_name(tmp_path: Path, count: int) -> None:
    paths = np.concatenate([[[k, 0.0], [k, 1.0], [np.nan, np.nan]] for k in range(count)])[:-1]
    maps, names = made_maps(), [f'day_{k}' for k in range(count)]
    write_page(
        tmp_path / 'report.html', maps, report_data(maps, {'drives': [{'bag': name} for name in names]}), '', paths
    )
    script = """
        const lines = [];
        report.chart.line = (g, xy, colour) => { if (colour !== 'white') lines.push([xy[0], colour]); };
        report.chart.drawNow();
        return [lines, [...document.querySelectorAll('#drives li')].map(li => li.textContent)];
    """
    lines, legend = found_in(tmp_path / 'report.html', tmp_path, script)
    assert lines == [[k, DRIVES[k % len(DRIVES)]] for k in range(count)]
    shown = [f'{k + 1}: {name}' for k, name in enumerate(names[: web_page.MOST_DRIVES])]
    assert legend == shown + ([f'and {count - len(shown)} more'] if count > len(shown) else [])


def test_path_far_from_the_origin_is_exact(tmp_path: Path) -> None:
    xy = np.linspace([500_000.0, 5_200_000.0], [500_009.0, 5_200_003.0], 100)
    maps = made_maps()
    write_page(tmp_path / 'report.html', maps, report_data(maps, {}), 'far', xy)
    assert np.array_equal(array(numbers(tmp_path / 'report.html'), 'path').reshape(-1, 2), xy)


def test_long_path_is_thinned(tmp_path: Path) -> None:
    xy = np.stack([np.linspace(0, 9, 50_000), np.zeros(50_000)], 1)
    maps = made_maps()
    write_page(tmp_path / 'report.html', maps, report_data(maps, {}), 'long', xy, xy + 1, (maps.grid, maps.ml))
    data = numbers(tmp_path / 'report.html')
    kept = array(data, 'path').reshape(-1, 2)
    assert len(kept) == web_page.MOST_POINTS
    assert (kept[0].tolist(), kept[-1].tolist()) == ([0, 0], [9, 0])
    assert array(data, 'odometry').reshape(-1, 2)[-1].tolist() == [10, 1]
    assert array(data, 'reference').shape == (maps.grid.size,)
