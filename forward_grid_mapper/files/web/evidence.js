// What every reading says of a cell: the formulas of core/sensor/cone.py, forward_model.py and core/maps/cell_evidence.py
// on the numbers that web_page.py took from there. test/files/test_web_page.py compares the two. Nothing here draws.
'use strict';

const STATES = {1: 'occupied', 0: 'free', 255: 'not observed'};
const KEPT = 20000; // cones whose obstacles are remembered

/** Clip [low, high] to the u with a * u + b >= 0. */
function clip(a, b, low, high) {
  if (a > 0) return [Math.max(low, -b / a), high];
  if (a < 0) return [low, Math.min(high, -b / a)];
  return b < 0 ? [1, 0] : [low, high];
}

class Evidence {
  /** Take over the numbers of the page: lengths in cells, as in cone_table.py. */
  constructor(page) {
    Object.assign(this, page.arrays);
    this.model = page.model;
    ({width: this.width, height: this.height, resolution: this.resolution} = page.grid);
    this.count = this.x ? this.x.length : 0;
    this.known = new Map();
  }

  /** Return the first and last row of a cone, on the grid. */
  rows(t) {
    const [ax, ay, s, c] = [this.axis_x[t], this.axis_y[t], this.sine[t], this.cosine[t]];
    const right = ay * c - ax * s, left = ay * c + ax * s;
    const top = ay >= c ? 1 : Math.max(0, right, left), bottom = -ay >= c ? -1 : Math.min(0, right, left);
    const reach = this.reach[t], y = this.y[t];
    return [Math.max(Math.floor(y + reach * bottom), 0), Math.min(Math.floor(y + reach * top), this.height - 1)];
  }

  /** Return the runs of columns of a cone in a row: those whose centres it holds, and those that its axis crosses. */
  runs(t, row) {
    const [x, y, ax, ay, s, c] = [this.x[t], this.y[t], this.axis_x[t], this.axis_y[t], this.sine[t], this.cosine[t]];
    const reach = this.reach[t], v = row + 0.5 - y, chord = reach * reach - v * v, none = [0, -1];
    if (chord < 0) return [none, none];
    const half = Math.sqrt(chord);
    const first = Math.max(Math.ceil(x - half - 0.5), 0), last = Math.min(Math.floor(x + half - 0.5), this.width - 1);
    const rx = ax * c + ay * s, ry = ay * c - ax * s, lx = ax * c - ay * s, ly = ay * c + ax * s;
    let [low, high] = clip(-ry, rx * v, -half, half);
    [low, high] = clip(ly, -lx * v, low, high);
    const wedge = low > high ? none : [Math.ceil(low + x - 0.5), Math.floor(high + x - 0.5)];
    let begin = 0, end = reach;
    if (Math.abs(ay) > 1e-12) {
      const a = (row - y) / ay, b = (row + 1 - y) / ay;
      begin = Math.max(begin, Math.min(a, b));
      end = Math.min(end, Math.max(a, b));
    } else if (!(row <= y && y < row + 1)) {
      end = -1;
    }
    const a = x + begin * ax, b = x + end * ax;
    const axis = begin > end ? none : [Math.floor(Math.min(a, b)), Math.floor(Math.max(a, b))];
    return [wedge, axis].map(([p, q]) => [Math.max(p, first), Math.min(q, last)]);
  }

  /** Return whether a cone holds a cell. */
  holds(t, row, column) {
    const du = column + 0.5 - this.x[t], dv = row + 0.5 - this.y[t], far = this.reach[t] + 2;
    if (du * du + dv * dv > far * far) return false;
    const [bottom, top] = this.rows(t);
    if (row < bottom || row > top) return false;
    return this.runs(t, row).some(([first, last]) => first <= column && column <= last);
  }

  /** Return whether a reading meets a cell beyond the incidence angle, and goes on. */
  passes(t, cell) {
    if (!this.model.cos2_limit) return false;
    const nx = this.normal_x[cell], ny = this.normal_y[cell];
    if (!nx && !ny) return false;
    const u = cell % this.width + 0.5 - this.x[t], v = Math.floor(cell / this.width) + 0.5 - this.y[t];
    const square = u * u + v * v, through = this.z[t] - this.model.through * this.sigma[t];
    if (through <= 0 || square >= through * through) return false;
    const along = u * nx + v * ny;
    return along * along < this.model.cos2_limit * square;
  }

  /** Return the distance of a cell from the apex of a cone. */
  distance(t, cell) {
    const u = cell % this.width + 0.5 - this.x[t], v = Math.floor(cell / this.width) + 0.5 - this.y[t];
    return Math.sqrt(u * u + v * v);
  }

  /** Return the occupied cells of a cone that return its echo: [cell, distance], the nearest first. */
  obstacles(t) {
    let found = this.known.get(t);
    if (found) return found;
    const cells = new Set(), [bottom, top] = this.rows(t);
    for (let row = bottom; row <= top; row++) {
      for (const [first, last] of this.runs(t, row)) {
        for (let cell = row * this.width + first; cell <= row * this.width + last; cell++) {
          if (this.ml_map[cell] === 1 && !this.passes(t, cell)) cells.add(cell);
        }
      }
    }
    found = [...cells].map(cell => [cell, this.distance(t, cell)]).sort((a, b) => a[1] - b[1]);
    if (this.known.size > KEPT) this.known.clear();
    this.known.set(t, found);
    return found;
  }

  /** Return log p(z | m) of a reading whose cone has obstacles at these distances, the nearest first. */
  logLikelihood(t, distances) {
    const m = this.model, sigma = this.sigma[t], metres = sigma * this.resolution;
    let weight = m.mixture_weight, hit = 0;
    for (const d of distances) {
      const error = (this.z[t] - d) / sigma;
      const density = Math.abs(error) <= m.cut ? Math.exp(-0.5 * error * error) / (Math.sqrt(2 * Math.PI) * metres) : 0;
      hit += weight * m.p_hit * density;
      weight *= 1 - m.p_hit;
    }
    return Math.log(this.random[t] + this.lost[t] + hit + weight * this.max_range[t]);
  }

  /** Return log p(z | m, a cell occupied), and with all of `cleared` free instead. */
  both(t, row, column, cleared) {
    const cell = row * this.width + column, obstacles = this.obstacles(t);
    const free = obstacles.filter(([c]) => !cleared.has(c)).map(([, d]) => d);
    const rest = obstacles.filter(([c]) => c !== cell).map(([, d]) => d);
    if (this.holds(t, row, column) && !this.passes(t, cell)) {
      rest.push(this.distance(t, cell));
      rest.sort((a, b) => a - b);
    }
    return [this.logLikelihood(t, rest), this.logLikelihood(t, free)];
  }

  /** Return what is known of a cell, as `cell_evidence` does; what readings say of the wall only if it is asked for. */
  cell(row, column, withWall = false) {
    const cell = row * this.width + column, m = this.model, alone = new Set([cell]), readings = [];
    for (let t = 0; t < this.count; t++) {
      if (!this.holds(t, row, column) || this.passes(t, cell)) continue;
      const [occupied, free] = this.both(t, row, column, alone), nats = m.exponent * (occupied - free);
      if (Math.abs(nats) <= m.nothing) continue;
      const d = this.distance(t, cell), silent = this.z[t] >= this.z_max[t];
      const ends = !silent && Math.abs(this.z[t] - d) <= m.here * this.sigma[t];
      const range = (this.z[t] - m.surface_offset) * this.resolution, at = (d - m.surface_offset) * this.resolution;
      const kind = ends ? 'end here' : silent ? 'heard no echo' : range > at ? 'reach farther' : 'end before it';
      readings.push({t, nats, distance: at, range, silent, kind});
    }
    readings.sort((a, b) => Math.abs(b.nats) - Math.abs(a.nats));
    const data = readings.reduce((sum, r) => sum + r.nats, 0);
    const found = {row, column, cell, state: STATES[this.ml_map[cell]], readings, data, prior: this.prior[cell]};
    if (withWall) found.wall = this.wall(row, column);
    return found;
  }

  /** Return what all readings say for the cell with its occupied neighbours, against none of them. */
  wall(row, column) {
    const block = new Set();
    for (let r = row - 1; r <= row + 1; r++) {
      for (let c = column - 1; c <= column + 1; c++) block.add(r * this.width + c);
    }
    let sum = 0;
    for (let t = 0; t < this.count; t++) {
      const far = this.reach[t] + 4, u = column + 0.5 - this.x[t], v = row + 0.5 - this.y[t];
      if (u * u + v * v > far * far) continue;
      const [occupied, free] = this.both(t, row, column, block);
      sum += occupied - free;
    }
    return this.model.exponent * sum;
  }
}
