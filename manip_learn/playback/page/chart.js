// The manipulability curves, the status strips below them, and a cursor that can be dragged.

// how what was asked is done, mildest first
const STATUS = { ok: "var(--status-ok)", slowed: "var(--status-slowed)", stopped: "var(--status-stopped)" };
const MAX_STRIPS = 8;
const TAP = 10; // a finger that moves less taps [px]
const MOST_READ = 6; // values at the cursor
const DASHES = ["", "7 4", "2 4", "10 3 2 3", "1 3 6 3"];

function svg(tag, attributes, parent) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (parent) parent.appendChild(node);
  return node;
}

function niceTicks(low, high, count) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const raw = span / Math.max(count, 1), power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * span; k++) ticks.push(k * step);
  return ticks;
}

function short(x) {
  if (x === 0) return "0";
  const size = Math.abs(x);
  return size >= 1e-3 && size < 1e5 ? String(Number(x.toPrecision(4))) : x.toExponential(1).replace("e+", "e");
}

function moveAcross(line, x) {
  for (const end of ["x1", "x2"]) line.setAttribute(end, x);
  return x;
}

// A finger that scrolls the page does not move in time: it seeks by dragging sideways, or by a tap, however long.
function wireSeek(element, seek) {
  let from = null;
  const across = (event) => Math.abs(event.clientX - from.clientX), down = (event) => Math.abs(event.clientY - from.clientY);
  element.addEventListener("pointerdown", (event) => { from = event; if (event.pointerType !== "touch") seek(event); });
  element.addEventListener("pointermove", (event) => { if (event.buttons & 1 && from && (event.pointerType !== "touch" || across(event) > down(event))) seek(event); });
  element.addEventListener("pointerup", (event) => { if (from && across(event) + down(event) < TAP) seek(event); from = null; });
}

// The lowest and the highest of values, which may be too many for Math.min.
function extent(values) { return values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]); }

// Values between `top` and `bottom` [px], over the range from the lowest to the highest.
class ValueAxis {
  // Lines from the left to the right, and the values beside them.
  drawGrid(root, values, { left, right }, say = short, limits = []) {
    for (const v of values) {
      const y = this.y(v);
      svg("line", { x1: left, x2: right, y1: y, y2: y, class: limits.includes(v) ? "limit" : "grid" }, root);
      svg("text", { x: left - 8, y: y + 4, "text-anchor": "end" }, root).textContent = say(v);
    }
  }

  y(value) {
    const [low, high] = this.range;
    return this.bottom - ((value - low) / (high - low)) * (this.bottom - this.top);
  }

  // A curve with gaps where it is not a number; x: across, of a time.
  drawLine(root, times, values, x, style) {
    const isKnown = (i) => i >= 0 && !Number.isNaN(values[i]);
    const parts = Array.from(times, (t, i) => (isKnown(i) ? `${isKnown(i - 1) ? "L" : "M"}${x(t).toFixed(1)} ${this.y(values[i]).toFixed(2)}` : ""));
    svg("path", { d: parts.join(""), class: "curve", fill: "none", "stroke-linejoin": "round", ...style }, root);
  }
}

class Chart extends ValueAxis {
  // zero: the moment that is called 0 s.
  constructor(element, rollouts, duration, onSeek, zero = 0) {
    super();
    Object.assign(this, { element, rollouts, duration, onSeek, zero, start: 0 });
    this.styles = new Map();
    new ResizeObserver(() => this.draw()).observe(element);
    if (!onSeek) return;
    element.addEventListener("pointermove", (event) => { this.hover = event.pointerType === "mouse" ? this.timeAt(event) : undefined; this.readOut(); });
    element.addEventListener("pointerleave", () => { this.hover = undefined; this.readOut(); });
    element.addEventListener("pointerdown", (event) => element.setPointerCapture(event.pointerId));
    wireSeek(element, (event) => onSeek(this.timeAt(event)));
  }

  timeAt(event) {
    const share = (event.clientX - this.element.getBoundingClientRect().left - this.left) / Math.max(this.right - this.left, 1);
    return this.start + Math.min(Math.max(share, 0), 1) * this.duration;
  }

  x(t) { return this.left + ((t - this.start) / Math.max(this.duration, 1e-9)) * (this.right - this.left); }

  findRange(curves) {
    const [least, high] = extent([0, ...curves.flatMap(({ curve }) => Array.from(curve))]);
    return high > 0 ? [least, 1.06 * high] : [least, 1];
  }

  draw() {
    const w = this.element.clientWidth, h = this.element.clientHeight;
    if (w < 50 || h < 40) return;
    const curves = this.rollouts.filter((r) => r.visible && r.curve.length), strips = this.stripsToDraw();
    const row = strips.length > 5 ? 7 : 10, stripsHeight = strips.length ? 8 + row * strips.length : 0;
    const bands = bandRows(this.rollouts, curves.length ? h / 2 : h - 40);
    const bandRow = Math.min(BAND.tallest, Math.floor((curves.length ? h / 2 : h - 40) / Math.max(bands.length, 1)));
    const below = stripsHeight + (bands.length ? 6 + bandRow * bands.length : 0);
    const bottom = curves.length || !bands.length ? h - 24 - below : 6;
    Object.assign(this, { left: this.margin(bands, bandRow), right: w - 14, top: 8, bottom, curves });
    this.range = this.findRange(curves);
    const root = svg("svg", { width: w, height: h, "aria-hidden": "true" });
    this.drawAxes(root, h, below);
    for (const { curveTimes, curve, colour, solid, index } of curves)
      this.drawLine(root, curveTimes, curve, (t) => this.x(t), { stroke: colour, "stroke-width": solid ? 3 : 2, "stroke-dasharray": DASHES[index % DASHES.length] });
    strips.forEach((r, i) => this.drawStrip(root, r, this.bottom + 9 + row * i, row - 3));
    bands.forEach((r, i) => drawBands(root, this, r, this.bottom + stripsHeight + 8 + bandRow * i, bandRow));
    this.cursor = svg("line", { y1: this.top, y2: this.bottom + below + 2, stroke: "var(--ink)", "stroke-width": 1.5 }, root);
    this.knob = svg("path", { d: "M-6 0h12l-6 8z", fill: "var(--ink)" }, root);
    this.dots = curves.map((r) => [r, svg("circle", { r: 5, fill: r.colour, stroke: "var(--page)", "stroke-width": 2 }, root)]);
    this.pointer = svg("line", { y1: this.top, y2: this.bottom, stroke: "var(--muted)" }, root);
    this.readout = make("div", { className: "readout" });
    this.element.replaceChildren(root, this.readout);
    this.readOut();
    if (this.time !== undefined) this.setTime(this.time);
    if (this.onDrawn) this.onDrawn();
  }

  // Where time begins and ends, for what is drawn below; without curves of its own, as wide as that is.
  edges(width) {
    if (this.left === undefined || this.element.hidden) Object.assign(this, { left: 58, right: width - 14 });
    return this;
  }

  // Room for the numbers of the curve, or for the names of the bands.
  margin(bands, bandRow) {
    if (!bands.length || bandRow < BAND.named) return 58;
    return Math.max(58, Math.min(170, 0.34 * this.element.clientWidth, 22 + 7.4 * Math.max(...bands.map((r) => shortName(r.name).length))));
  }

  // All visible ones while there is room, else that of the solid rollout.
  stripsToDraw() {
    const strips = this.rollouts.filter((r) => r.visible && r.status.length);
    return strips.length <= MAX_STRIPS ? strips : strips.filter((r) => r.solid);
  }

  drawAxes(root, h, below) {
    const bare = !this.curves.length && this.bottom < 10;
    if (!bare) this.drawGrid(root, niceTicks(...this.range, Math.max(2, (this.bottom - this.top) / 30)), this);
    if (this.curves.length && this.range[0] <= 0) {
      const y = this.y(0);
      svg("line", { x1: this.left, x2: this.right, y1: y, y2: y, class: "singular" }, root);
      svg("text", { x: this.right, y: y - 4, "text-anchor": "end", class: "singular" }, root).textContent = "singular";
    }
    const ticks = niceTicks(this.start - this.zero, this.start - this.zero + this.duration, (this.right - this.left) / 90);
    ticks.forEach((t, i) => {
      const x = this.x(t + this.zero);
      svg("line", { x1: x, x2: x, y1: this.top, y2: this.bottom + (bare ? below : 0), stroke: "var(--grid)" }, root);
      const text = svg("text", { x, y: this.bottom + below + 18, "text-anchor": "middle" }, root);
      text.textContent = short(Number(t.toPrecision(8))) + (i === ticks.length - 1 ? " s" : "");
      if (x > this.right - 14) text.setAttribute("text-anchor", "end");
    });
  }

  drawStrip(root, rollout, y, height) {
    svg("rect", { x: this.left - 14, y, width: 8, height, rx: 2, fill: rollout.colour }, root);
    const ends = [...rollout.status.slice(1).map(([start]) => start), rollout.duration];
    const label = (word, state) => (word === state ? state : `${state} (${word})`);
    drawBars(root, this, rollout, rollout.status.map(([start, word, state], i) => ({ start, end: ends[i], kind: { label: label(word, state), colour: STATUS[state] } })), y, height);
  }

  setTime(t) {
    this.time = t;
    if (!this.cursor) return;
    const x = moveAcross(this.cursor, this.x(t));
    this.knob.setAttribute("transform", `translate(${x} ${this.top - 8})`);
    for (const [rollout, dot] of this.dots) {
      dot.setAttribute("cx", this.x(Math.min(t, rollout.duration)));
      dot.setAttribute("cy", this.y(curveValue(rollout, t)));
    }
    this.readOut();
  }

  // The values where the mouse is: beside it, above or below the curves.
  readOut() {
    if (!this.readout) return;
    const t = this.hover, shown = [...this.curves].sort((a, b) => b.solid - a.solid).slice(0, MOST_READ);
    this.readout.hidden = t === undefined || !shown.length;
    this.pointer.style.display = this.readout.hidden ? "none" : "";
    if (this.readout.hidden) return;
    const x = moveAcross(this.pointer, this.x(t)), values = shown.map((r) => curveValue(r, Math.min(t, r.duration))), middle = values.reduce((sum, v) => sum + this.y(v), 0) / values.length;
    const across = 2 * x < this.left + this.right ? `left: ${x + 12}px` : `right: ${this.element.clientWidth - x + 12}px`, top = 2 * middle > this.top + this.bottom;
    this.readout.style = `${across}; ${top ? "top: 2px" : `bottom: ${this.element.clientHeight - this.bottom + 2}px`}`;
    this.readout.replaceChildren(make("p", {}, `${t.toFixed(2)} s`), ...shown.map((r, i) => make("p", { style: `--colour: ${r.colour}` }, make("b", {}, `${readable(values[i])} ${shortName(r.name)}`))));
  }

  // What the colours of strips and bands mean: the statuses that occur, mildest first, then the phases.
  colourKey() {
    const states = new Set(this.rollouts.flatMap((r) => r.status.map(([, , state]) => state))), used = new Set(this.rollouts.flatMap((r) => r.bands.map((b) => b.kind)));
    let phases = [...new Set(this.rollouts.flatMap((r) => (r.hasOwnPhases ? [] : r.kinds)))].filter((kind) => used.has(kind)); // a rollout's own have their words
    if (this.rollouts.some(hasGaps)) phases.push({ ...NO_PHASE, colour: "var(--unclassified)" });
    if (colouring.mode === "fit") phases = fitKey();
    const statuses = Object.keys(STATUS).filter((state) => states.has(state)).map((label) => ({ label, colour: STATUS[label] }));
    return [...statuses, ...phases];
  }
}

// What the picture shows, for those who cannot see it.
function inWords(rollouts) {
  const least = ({ name, curve, curveTimes }) => {
    const i = curve.indexOf(Math.min(...curve));
    return `${name}: lowest manipulability ${readable(curve[i])} at ${curveTimes[i].toFixed(2)} s`;
  };
  const curves = rollouts.filter((r) => r.curve.length).map(least), bands = rollouts.filter((r) => r.bands.length);
  return [...curves, ...bands.map((r) => `${r.name}: ${r.hasOwnPhases ? r.bands.map(({ kind, end }) => `${kind.label} until ${end.toFixed(2)} s`).join(", ") : `${r.bands.length} phases`}`)].join("; ") || "Status over time";
}

// Index of the last time that is not after t.
function indexAt(times, t) {
  let low = 0, high = times.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle; else high = middle;
  }
  return low;
}

// Numbers of a table with one row a time, between rows on the line; a table of one row holds always.
function rowAt(times, table, width, t) {
  const rows = table.length / width, i = rows === 1 ? 0 : indexAt(times, t), row = (k) => table.slice(k * width, (k + 1) * width), from = row(i);
  if (i + 1 >= rows || t <= times[i]) return from;
  const share = (t - times[i]) / (times[i + 1] - times[i]), to = row(i + 1);
  return Array.from(from, (x, k) => x + share * (to[k] - x));
}

function curveValue({ curveTimes, curve }, t) { return rowAt(curveTimes, curve, 1, t)[0]; }

// "ok", "slowed" or "stopped"; none of a recording.
function statusAt({ status }, t) { return status.length ? status[indexAt(status.map(([start]) => start), t)][2] : ""; }

// A further value of a curve that is being made, of which the last seconds stay.
function addNewest(rollout, time, mu, seconds) {
  const { curveTimes: times, curve } = rollout;
  if (times.length && time < times[times.length - 1]) { times.length = 0; curve.length = 0; }
  times.push(time);
  curve.push(mu);
  while (times.length > 2 && times[1] < time - seconds) { times.shift(); curve.shift(); }
  rollout.duration = time;
}
