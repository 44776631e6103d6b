// The page: what the numbers beside it show, and what happens when they are pointed at.
'use strict';

const CAUSES = [
  ['obstacle', 'echo of an obstacle on the map', '#009e73', false],
  ['random', 'random measurement: not explained by the map', '#d55e00', true],
  ['lost', 'lost echo', '#cc79a7', false],
  ['nothing', 'nothing hit', '#56b4e9', false],
];
const LISTED = 12, RECENT = 1, UNKNOWN = 65535;
const TYPES = {f8: Float64Array, f4: Float32Array, u2: Uint16Array, u1: Uint8Array};
const $ = id => document.getElementById(id);

/** Return an element with text and children; text is never taken as HTML. */
function make(tag, options = {}, ...children) {
  const made = Object.assign(document.createElement(tag), options);
  made.append(...children);
  return made;
}

const signed = (nats, digits = 1) => {
  const text = nats.toFixed(digits), nothing = Number(text) === 0;
  return (nothing || nats > 0 ? '+' : '−') + text.replace('-', '');
};
const ONE = {'end here': 'ends here', 'reach farther': 'reaches farther', 'end before it': 'ends before it'};
const counted = count => `${count} reading${count === 1 ? '' : 's'}`;
const share = value => value === UNKNOWN ? 'unknown' : `${(value / 100).toFixed(0)} %`;

/** Return the numbers of the page, unpacked. */
async function unpack() {
  const page = JSON.parse($('data').textContent);
  await Promise.all(Object.entries(page.arrays).map(async ([name, {type, data}]) => {
    const bytes = Uint8Array.from(atob(data), c => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
    page.arrays[name] = new TYPES[type](await new Response(stream).arrayBuffer());
  }));
  return page;
}

function layersOf(page) {
  const {grid, arrays} = page, rows = [];
  const add = (id, title, values, own, unknown, largest, shown) => {
    const extent = [own.x, own.x + own.width * own.resolution, own.y, own.y + own.height * own.resolution];
    const levels = pyramid(values, own.width, own.height, unknown, largest);
    rows.push({id, title, levels, cells: own.width, extent, shown, opacity: 1, input: null});
  };
  if (page.reference) add('reference', 'Reference', arrays.reference, page.reference, 255, 1, false);
  add('live_map', 'Standard map', arrays.live_map, grid, UNKNOWN, 10000, false);
  add('uncertainty_map', 'Uncertainty map', arrays.uncertainty_map, grid, UNKNOWN, 10000, false);
  add('ml_map', 'Maximum likelihood map', arrays.ml_map, grid, 255, 1, true);
  return rows;
}

/** Return the standard maps during the drive; a page has what each adds to the one before, modulo 256. */
function momentsOf(page) {
  const {moments: changes} = page.arrays, {width, height} = page.grid, size = width * height;
  return page.moments.map((until, k) => {
    const values = changes.subarray(k * size, (k + 1) * size);
    if (k) for (let i = 0; i < size; i++) values[i] += changes[(k - 1) * size + i];
    let levels;
    return {until, values, levels: () => levels ||= pyramid(values, width, height, 255, 250)};
  });
}

/** Return the path of each drive; pairs of NaN part them. */
function pathsOf(xy) {
  const parts = [];
  let begin = 0;
  for (let k = 0; k <= xy.length; k += 2) {
    if (k < xy.length && Number.isFinite(xy[k] + xy[k + 1])) continue;
    parts.push(xy.subarray(begin, k));
    begin = k + 2;
  }
  return parts;
}

class Page {
  constructor(page) {
    this.page = page;
    this.evidence = new Evidence(page);
    this.layers = layersOf(page);
    this.standard = this.layers.find(layer => layer.id === 'live_map');
    this.standard.whole = this.standard.levels;
    this.moments = momentsOf(page);
    this.paths = pathsOf(page.arrays.path);
    this.starts = new Map();
    for (let t = 0; t < this.evidence.count; t++) {
      const {drive, stamp} = page.arrays;
      if (!this.starts.has(drive[t])) this.starts.set(drive[t], stamp[t]);
    }
    this.now = Infinity;
    this.hidden = new Set();
    this.causes = new Set(CAUSES.map((cause, k) => cause[3] ? k : -1));
    this.counts = CAUSES.map((_, k) => (page.arrays.cause || []).reduce((n, c) => n + (c === k), 0));
    this.showPath = true;
    this.found = this.marked = null;
    this.grid = page.grid;
    this.chart = new Chart($('map'), this.layers, page.view, {
      paint: context => this.paint(context), hover: xy => this.hover(xy), click: xy => this.click(xy),
    });
    this.addControls();
    const place = /x=(-?[\d.e-]+)&y=(-?[\d.e-]+)/.exec(location.hash);
    if (place) this.click([Number(place[1]), Number(place[2])]);
  }

  /** Return row and column of a place, or null off the map. */
  cellAt([x, y]) {
    const column = Math.floor((x - this.grid.x) / this.grid.resolution);
    const row = Math.floor((y - this.grid.y) / this.grid.resolution);
    return row >= 0 && row < this.grid.height && column >= 0 && column < this.grid.width ? [row, column] : null;
  }

  /** Return the middle of a cell. */
  place({row, column}) {
    return [this.grid.x + (column + 0.5) * this.grid.resolution, this.grid.y + (row + 0.5) * this.grid.resolution];
  }

  summary(found) {
    const {uncertainty_map: uncertainty, live_map: live} = this.page.arrays, [x, y] = this.place(found);
    const says = this.evidence.count ? `${signed(found.data)} nats from ${counted(found.readings.length)}, ` : '';
    return {
      title: `x = ${x.toFixed(2)} m, y = ${y.toFixed(2)} m (row ${found.row}, column ${found.column}): ${found.state}`,
      odds: `obstacle: ${share(uncertainty[found.cell])} (uncertainty map), ${share(live[found.cell])} (standard map)`,
      evidence: `${says}${signed(found.prior)} from the prior of walls`,
    };
  }

  hover(xy) {
    const cell = xy && this.cellAt(xy), tip = $('tip');
    tip.hidden = !cell;
    if (!cell) return;
    const key = String(cell);
    if (key === this.pointed) return;
    this.pointed = key;
    const said = this.summary(this.evidence.cell(...cell));
    tip.replaceChildren(...Object.values(said).map(text => make('div', {textContent: text})));
  }

  click(xy) {
    const cell = this.cellAt(xy);
    this.found = cell && this.evidence.cell(...cell, true);
    this.marked = null;
    if (cell) {
      const [x, y] = this.place(this.found);
      try { history.replaceState(null, '', `#x=${x.toFixed(3)}&y=${y.toFixed(3)}`); } catch { /* not from there */ }
    }
    this.listReadings(LISTED);
    this.chart.draw();
  }

  listReadings(most) {
    const box = $('cell'), {found} = this;
    box.replaceChildren();
    if (!found) return;
    const said = this.summary(found), {readings} = found;
    box.append(make('h2', {textContent: said.title}), make('p', {textContent: said.odds}),
      make('p', {textContent: said.evidence}));
    const groups = make('ul', {className: 'groups'});
    for (const kind of ['end here', 'reach farther', 'heard no echo', 'end before it']) {
      const mine = readings.filter(r => r.kind === kind), nats = mine.reduce((sum, r) => sum + r.nats, 0);
      const verb = mine.length === 1 ? ONE[kind] || kind : kind;
      if (mine.length) groups.append(make('li', {textContent: `${signed(nats)} nats: ${counted(mine.length)} ${verb}`}));
    }
    if (found.state === 'occupied' && this.evidence.count) {
      groups.append(make('li', {
        textContent: `${signed(found.wall)} nats for the cell together with its occupied neighbours, which share their readings`}));
    }
    if (this.page.arrays.traversed[found.cell]) {
      groups.append(make('li', {textContent: 'a sensor traversed it, so it is free, independent of the readings'}));
    }
    box.append(groups);
    if (!readings.length) return;
    // a bar of full length is at least a tenth of a nat
    const body = make('tbody'), largest = Math.max(Math.abs(readings[0].nats), 0.1);
    for (const r of readings.slice(0, most)) {
      const bar = make('span', {className: r.nats > 0 ? 'bar for' : 'bar against'});
      bar.style.width = `${Math.max(40 * Math.abs(r.nats) / largest, 1)}px`;
      const {sensor} = this.page.arrays;
      const row = make('tr', {tabIndex: 0}, make('td', {}, bar, signed(r.nats, 2)),
        make('td', {textContent: r.silent ? 'no echo' : `${r.range.toFixed(2)} m`}),
        make('td', {textContent: `${r.distance.toFixed(2)} m`}),
        make('td', {textContent: this.when(r.t)}),
        make('td', {textContent: this.page.sensors[sensor[r.t]].name || 'a sensor without a name'}));
      for (const kind of ['pointerenter', 'focus']) row.addEventListener(kind, () => this.mark(r));
      for (const kind of ['pointerleave', 'blur']) row.addEventListener(kind, () => this.mark(null));
      body.append(row);
    }
    const heads = ['nats', 'range', 'cell at', 'time', 'sensor'].map(textContent => make('th', {textContent}));
    box.append(make('div', {className: 'wide'}, make('table', {id: 'readings'}, make('thead', {}, make('tr', {}, ...heads)), body)));
    if (most < readings.length) {
      const more = make('button', {textContent: `all ${readings.length} readings`});
      more.addEventListener('click', () => this.listReadings(Infinity));
      box.append(more);
    }
    box.append(make('p', {className: 'hint', textContent: 'Orange cones are evidence for an obstacle here, blue ones against it.'}));
  }

  /** Return when a reading was taken: seconds from the beginning of its drive, and which one if there are several. */
  when(t) {
    const {drive, stamp} = this.page.arrays, seconds = `${(stamp[t] - this.starts.get(drive[t])).toFixed(1)} s`;
    return this.starts.size > 1 ? `drive ${drive[t] + 1}, ${seconds}` : seconds;
  }

  /** Go to a share of the readings: below 1, the standard map is as it was then, and maps of the whole drive are hidden. */
  go(share) {
    const {stamp} = this.page.arrays, count = this.evidence.count, last = Math.min(Math.floor(share * count), count - 1);
    const whole = share >= 1 || !count, {moments, standard} = this;
    this.now = whole ? Infinity : stamp[last];
    $('clock').textContent = whole ? 'whole drive' : this.when(last);
    if (moments.length) {
      const passed = moments.filter(moment => moment.until <= this.now);
      if (whole) standard.levels = standard.whole;
      else standard.levels = passed.length ? passed[passed.length - 1].levels() : [new OffscreenCanvas(1, 1)];
      const part = Math.round(100 * passed.length / (moments.length + 1));
      standard.label.textContent = whole ? standard.title : `${standard.title} after ${part} % of the readings`;
      if (!whole && !this.before) {
        this.before = this.layers.map(layer => [layer, layer.shown]);
        for (const layer of this.layers) layer.shown = layer === standard;
      } else if (whole && this.before) {
        for (const [layer, shown] of this.before) layer.shown = shown;
        this.before = null;
      }
      for (const layer of this.layers) layer.input.checked = layer.shown;
    }
    this.chart.draw();
  }

  /** Show a map on top of the others, or hide it. */
  show(layer, on) {
    layer.shown = on;
    this.layers.splice(this.layers.indexOf(layer), 1);
    this.layers.push(layer);
  }

  mark(reading) {
    this.marked = reading;
    this.chart.draw();
  }

  /** Return the cone of a reading in metres, up to its range. */
  cone(t) {
    const e = this.evidence, r = this.grid.resolution, offset = this.page.model.surface_offset;
    return {x: this.grid.x + e.x[t] * r, y: this.grid.y + e.y[t] * r, yaw: Math.atan2(e.axis_y[t], e.axis_x[t]),
      half: Math.atan2(e.sine[t], e.cosine[t]), reach: (e.z[t] - offset) * r};
  }

  paint(g) {
    const {chart, page, evidence: e} = this, {odometry, sensor, cause, stamp} = page.arrays;
    if (this.showPath) {
      if (odometry) chart.line(g, odometry, ODOMETRY, 1.5, [6, 4]);
      for (const path of this.paths) chart.line(g, path, 'white', 4);
      this.paths.forEach((path, k) => chart.line(g, path, DRIVES[k % DRIVES.length], 2));
    }
    const latest = new Map(), size = chart.dot(cause ? this.counts.filter((_, k) => this.causes.has(k)).reduce((a, b) => a + b, 0) : 0);
    for (let t = 0; t < e.count && stamp[t] <= this.now; t++) {
      if (this.hidden.has(sensor[t])) continue;
      if (this.now < Infinity && stamp[t] > this.now - RECENT) latest.set(sensor[t], t);
      if (!this.causes.has(cause[t])) continue;
      const {x, y, yaw, reach} = this.cone(t), [px, py] = chart.pixels(x + reach * Math.cos(yaw), y + reach * Math.sin(yaw));
      g.fillStyle = CAUSES[cause[t]][2];
      g.fillRect(px - size / 2, py - size / 2, size, size);
    }
    for (const t of latest.values()) chart.sector(g, this.cone(t), MARK, 0.15);
    for (const t of latest.values()) {
      const {x, y} = this.cone(t);
      g.fillStyle = MARK;
      g.beginPath();
      g.arc(...chart.pixels(x, y), 4, 0, 7);
      g.fill();
    }
    if (!this.found) return;
    const shown = this.marked ? [this.marked] : this.found.readings.slice(0, LISTED);
    for (const r of shown) {
      chart.sector(g, this.cone(r.t), r.nats > 0 ? FOR : AGAINST, this.marked ? 0.3 : 0.08);
    }
    const [x, y] = this.place(this.found), edge = Math.max(this.grid.resolution * chart.scale, 8);
    const [px, py] = chart.pixels(x, y);
    g.strokeStyle = 'white'; g.lineWidth = 5;
    g.strokeRect(px - edge / 2, py - edge / 2, edge, edge);
    g.strokeStyle = FOR; g.lineWidth = 2.5;
    g.strokeRect(px - edge / 2, py - edge / 2, edge, edge);
  }

  addControls() {
    const {page, chart} = this, {sensor} = page.arrays;
    const box = (id, text, checked, change, input = make('input', {type: 'checkbox', id, checked})) => {
      input.addEventListener('change', () => { change(input.checked); chart.draw(); });
      return make('label', {}, input, ...[text].flat());
    };
    for (const layer of [...this.layers].reverse()) {
      const slider = make('input', {type: 'range', min: 0, max: 100, value: 100, ariaLabel: `opacity of ${layer.title}`});
      slider.addEventListener('input', () => { layer.opacity = slider.value / 100; chart.draw(); });
      layer.input = make('input', {type: 'checkbox', id: layer.id, checked: layer.shown});
      layer.label = make('span', {textContent: layer.title});
      $('layers').append(make('div', {className: 'row'},
        box(layer.id, layer.label, layer.shown, on => this.show(layer, on), layer.input), slider));
    }
    const swatch = colour => { const s = make('span', {className: 'swatch'}); s.style.background = colour; return s; };
    const several = this.paths.length > 1, title = several ? `paths of ${this.paths.length} drives` : 'path of the robot';
    $('layers').append(make('div', {className: 'row'},
      box('path', several ? title : [swatch(PATH), title], true, on => { this.showPath = on; })));
    if (several && page.drives.length) {
      const more = this.paths.length - page.drives.length, rows = page.drives.map((name, k) =>
        make('li', {}, swatch(DRIVES[k % DRIVES.length]), make('span', {textContent: `${k + 1}: ${name}`})));
      if (more > 0) rows.push(make('li', {textContent: `and ${more} more`}));
      $('layers').append(make('ul', {id: 'drives'}, ...rows));
    }
    const toggle = (set, k) => on => { if (on) set.add(k); else set.delete(k); };
    CAUSES.forEach(([id, text, colour, on], k) => {
      $('causes').append(make('div', {className: 'row'}, box(id, [swatch(colour), text], on, toggle(this.causes, k)),
        make('span', {textContent: this.counts[k].toLocaleString('en')})));
    });
    page.sensors.forEach((row, k) => {
      const shown = box(`sensor_${k}`, row.name || '(no name)', true, on => toggle(this.hidden, k)(!on));
      $('sensors').append(make('tr', {className: row.verdict === 'ok' ? '' : 'odd'}, make('td', {}, shown),
        ...row.cells.map(textContent => make('td', {textContent})), make('td', {textContent: row.verdict})));
    });
    for (const [id, step] of [['closer', 1.5], ['farther', 1 / 1.5]]) $(id).addEventListener('click', () => chart.zoom(step));
    $('whole').addEventListener('click', () => chart.fit());
    $('drive').hidden = !sensor;
    if (!sensor) return;
    const time = $('time');
    time.addEventListener('input', () => this.go(Number(time.value)));
    this.go(1);
  }
}

unpack().then(page => { window.report = new Page(page); document.body.dataset.ready = 'yes'; }, error => {
  $('cell').textContent = `This browser cannot show the page: ${error}. It needs a browser of 2023 or later.`;
});
