// The canvas: maps as layers, readings, path and cones; moved and zoomed with mouse, finger or keys.
'use strict';

const INK = '#14171c', PATH = '#0072b2', ODOMETRY = '#cc79a7', FOR = '#d55e00', AGAINST = '#0072b2', MARK = '#009e73';
// those of drawing.py
const DRIVES = [PATH, '#009e73', '#e69f00', '#7b3294', '#56b4e9', '#8c510a', '#666666', '#1b5e20'];
const RAMP = [[0, 255, 255, 255], [0.2, 253, 240, 210], [0.5, 238, 176, 77], [0.78, 138, 74, 28], [1, 20, 23, 28]];

/** Return the colours of probabilities, 0 to 1 in 256 steps, as 32 bit numbers of a canvas. */
function colours() {
  const out = new Uint32Array(256), bytes = new Uint8Array(out.buffer);
  for (let k = 0; k < 256; k++) {
    const p = k / 255, i = Math.max(RAMP.findIndex(stop => stop[0] >= p), 1), [a, b] = [RAMP[i - 1], RAMP[i]];
    const part = (p - a[0]) / (b[0] - a[0]);
    for (let c = 0; c < 3; c++) bytes[4 * k + c] = Math.round(a[c + 1] + part * (b[c + 1] - a[c + 1]));
    bytes[4 * k + 3] = 255;
  }
  return out;
}

/** Return a map as pictures, each half as fine as the one before: of four cells the likeliest obstacle stays. */
function pyramid(values, width, height, unknown, largest) {
  const table = colours(), levels = [];
  let level = values;
  for (;;) {
    const canvas = new OffscreenCanvas(width, height), context = canvas.getContext('2d');
    const image = context.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
    for (let row = 0; row < height; row++) {
      for (let column = 0; column < width; column++) {
        const value = level[row * width + column];
        if (value !== unknown) pixels[(height - 1 - row) * width + column] = table[Math.round(255 * value / largest)];
      }
    }
    context.putImageData(image, 0, 0);
    levels.push(canvas);
    if (Math.max(width, height) < 512) return levels;
    const w = (width + 1) >> 1, h = (height + 1) >> 1, next = new level.constructor(w * h).fill(unknown);
    for (let row = 0; row < height; row++) {
      for (let column = 0; column < width; column++) {
        const at = (row >> 1) * w + (column >> 1), value = level[row * width + column];
        if (value !== unknown && (next[at] === unknown || value > next[at])) next[at] = value;
      }
    }
    [level, width, height] = [next, w, h];
  }
}

class Chart {
  /** Show maps on a canvas; `paint` is called with the context and the chart once they are drawn. */
  constructor(canvas, layers, extent, {paint, hover, click}) {
    Object.assign(this, {canvas, layers, extent, paint, hover, click, waiting: false, touches: new Map()});
    this.fit();
    // at once, or the old picture would be stretched until the next frame
    new ResizeObserver(() => { if (this.whole) this.fit(); this.drawNow(); }).observe(canvas);
    canvas.addEventListener('pointerdown', e => this.down(e));
    canvas.addEventListener('pointermove', e => this.move(e));
    for (const kind of ['pointerup', 'pointercancel']) canvas.addEventListener(kind, e => this.up(e));
    canvas.addEventListener('pointerleave', () => this.hover(null));
    canvas.addEventListener('wheel', e => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY / 400), ...this.at(e)); },
      {passive: false});
    canvas.addEventListener('keydown', e => this.key(e));
  }

  /** Show all of the map. */
  fit() {
    const {clientWidth: w, clientHeight: h} = this.canvas, [left, right, bottom, top] = this.extent;
    this.scale = 0.94 * Math.min(w / (right - left), h / (top - bottom)) || 1;
    [this.cx, this.cy] = [(left + right) / 2, (bottom + top) / 2];
    this.whole = true;
    this.draw();
  }

  zoom(factor, px = this.canvas.clientWidth / 2, py = this.canvas.clientHeight / 2) {
    const [x, y] = this.metres(px, py);
    this.whole = false;
    this.scale = Math.min(Math.max(this.scale * factor, 0.5), 5000);
    const [nx, ny] = this.metres(px, py);
    [this.cx, this.cy] = [this.cx + x - nx, this.cy + y - ny];
    this.draw();
  }

  at(e) {
    const box = this.canvas.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  }

  metres(px, py) {
    return [this.cx + (px - this.canvas.clientWidth / 2) / this.scale,
      this.cy - (py - this.canvas.clientHeight / 2) / this.scale];
  }

  pixels(x, y) {
    return [(x - this.cx) * this.scale + this.canvas.clientWidth / 2,
      (this.cy - y) * this.scale + this.canvas.clientHeight / 2];
  }

  down(e) {
    this.touches.set(e.pointerId, this.at(e));
    this.moved = this.touches.size > 1 ? Infinity : 0;
    if (e.isTrusted) this.canvas.setPointerCapture(e.pointerId);
  }

  move(e) {
    const now = this.at(e), before = this.touches.get(e.pointerId);
    if (!before) return this.hover(this.metres(...now));
    const others = [...this.touches].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
    if (others.length) {
      const [o] = others, span = p => Math.hypot(p[0] - o[0], p[1] - o[1]);
      this.zoom(span(now) / Math.max(span(before), 1), ...o);
    } else {
      this.moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      this.whole = false;
      this.cx -= (now[0] - before[0]) / this.scale;
      this.cy += (now[1] - before[1]) / this.scale;
      this.draw();
    }
    this.touches.set(e.pointerId, now);
  }

  up(e) {
    if (this.touches.delete(e.pointerId) && e.type === 'pointerup' && this.moved < 5) {
      this.click(this.metres(...this.at(e)));
    }
  }

  key(e) {
    const step = 60 / this.scale, pan = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]};
    if (pan[e.key]) {
      this.cx += step * pan[e.key][0];
      this.cy += step * pan[e.key][1];
      this.draw();
    } else if (e.key === '+' || e.key === '=') this.zoom(1.5);
    else if (e.key === '-') this.zoom(1 / 1.5);
    else if (e.key === '0') this.fit();
    else return;
    e.preventDefault();
  }

  /** Draw once before the next frame, however often this is called. */
  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.drawNow(); });
  }

  drawNow() {
    const ratio = devicePixelRatio || 1, {clientWidth: w, clientHeight: h} = this.canvas;
    [this.canvas.width, this.canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
    const g = this.canvas.getContext('2d');
    g.scale(ratio, ratio);
    for (const layer of this.layers) {
      if (!layer.shown) continue;
      const [left, right, bottom, top] = layer.extent, [x0, y0] = this.pixels(left, top);
      const [x1, y1] = this.pixels(right, bottom), coarse = layer.cells / ((x1 - x0) * ratio);
      // a wall one cell thick must not fall between pixels
      const k = Math.min(Math.max(Math.ceil(Math.log2(coarse) - 0.01), 0), layer.levels.length - 1);
      g.globalAlpha = layer.opacity;
      g.imageSmoothingEnabled = false;
      // the coarser pictures may end beyond the map, above it and right of it
      const {width, height} = layer.levels[k], cell = (x1 - x0) / layer.cells * 2 ** k;
      g.drawImage(layer.levels[k], x0, y1 - height * cell, width * cell, height * cell);
    }
    g.globalAlpha = 1;
    this.paint(g, this);
    this.drawScale(g, w, h);
  }

  /** Return the edge of dots which together cover a hundredth of the canvas at most. */
  dot(count) {
    const area = this.canvas.clientWidth * this.canvas.clientHeight;
    return Math.min(Math.max(Math.sqrt(0.01 * area / Math.max(count, 1)), 1), 3.5);
  }

  drawScale(g, w, h) {
    const wanted = 110 / this.scale, power = 10 ** Math.floor(Math.log10(wanted));
    const length = [5, 2, 1].map(n => n * power).find(n => n <= wanted), px = length * this.scale, x = 16, y = h - 16;
    g.fillStyle = 'rgba(255,255,255,.85)';
    g.fillRect(x - 8, y - 22, px + 16, 32);
    g.fillStyle = g.strokeStyle = INK;
    g.lineWidth = 2;
    g.beginPath();
    g.moveTo(x, y - 5); g.lineTo(x, y); g.lineTo(x + px, y); g.lineTo(x + px, y - 5);
    g.stroke();
    g.font = '12px system-ui, sans-serif';
    g.fillText(length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`, x + 4, y - 8);
  }

  line(g, xy, colour, width, dash = []) {
    g.strokeStyle = colour;
    g.lineWidth = width;
    g.lineJoin = 'round';
    g.setLineDash(dash);
    g.beginPath();
    let pen = false;
    for (let k = 0; k < xy.length; k += 2) {
      const drawn = Number.isFinite(xy[k] + xy[k + 1]);
      if (drawn) g[pen ? 'lineTo' : 'moveTo'](...this.pixels(xy[k], xy[k + 1]));
      pen = drawn;
    }
    g.stroke();
    g.setLineDash([]);
  }

  sector(g, {x, y, yaw, half, reach}, colour, alpha) {
    const [px, py] = this.pixels(x, y);
    g.beginPath();
    g.moveTo(px, py);
    g.arc(px, py, reach * this.scale, -yaw - half, -yaw + half);
    g.closePath();
    g.globalAlpha = alpha;
    g.fillStyle = g.strokeStyle = colour;
    g.fill();
    g.globalAlpha = Math.min(4 * alpha, 1);
    g.lineWidth = 1;
    g.stroke();
    g.globalAlpha = 1;
  }
}
