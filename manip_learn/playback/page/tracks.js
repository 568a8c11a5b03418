// Further curves below the manipulability, one track below the other, under the same cursor.

const TRACKS = {
  opening: { title: "How far it has moved", of: "all", low: 0 },
  turning: { title: "How far it has turned", of: "all", low: 0 },
  singular: { title: "Singular values of A", of: "one" },
  velocity: { title: "Joint velocities over their limits", of: "one", low: -1, high: 1, percent: true, limits: [-1, 1] },
  position: { title: "Joint positions between their limits", of: "one", low: 0, high: 1, percent: true, limits: [0, 1] },
  "task-error": { title: "Distance to the target, constrained rows", of: "all", low: 0 },
  "following-error": { title: "Following error", of: "all", low: 0 },
  effort: { title: "Joint efforts over their largest", of: "one", low: -1, high: 1, percent: true },
  fit: { title: "Motion that breaks the constraint", of: "all", low: 0, percent: true, least: 0.1 },
};
const TRACK_HEIGHT = 104, MOST_TOGETHER = 8, SERIES = 8;

// The tracks of a rollout, by their kinds.
function tracksByKind(measures) {
  const clocks = measures.clocks.map((clock) => decode(clock, Float64Array)), found = new Map();
  for (const { kind, unit, without, curves } of measures.tracks) {
    const times = (c) => (c.times === undefined ? clocks[c.clock] : decode(c.times, Float32Array));
    found.set(kind, { unit, without, curves: curves.map((c) => ({ name: c.name, times: times(c), values: decode(c.values, Float32Array) })) });
  }
  return found;
}

// Value of a curve at time t: on the line that is drawn; NaN before its first and after its last sample, and in gaps.
function valueAt({ times, values }, t) {
  const isOutside = !times.length || t < times[0] - 1e-6 || t > times[times.length - 1] + 1e-6;
  return isOutside ? NaN : rowAt(times, values, 1, t)[0];
}

function trackText(kind, unit, value) {
  if (Number.isNaN(value)) return "–";
  if (TRACKS[kind].percent) return `${(100 * value).toFixed(Math.abs(value) < 0.0995 ? 1 : 0)} %`;
  return `${readable(value)}${unit ? ` ${unit}` : ""}`;
}

class Tracks {
  constructor(show, chart, onSeek) {
    Object.assign(this, { show, chart, rows: [], time: 0 });
    this.kinds = Object.keys(TRACKS).filter((kind) => show.rollouts.some((r) => r.byKind.has(kind)));
    this.chosen = new Set(this.kinds.filter((kind) => kind === "fit" && !show.rollouts.some((r) => r.curve.length || r.bands.length)));
    this.element = make("div", { id: "tracks", tabIndex: 0, role: "group", "aria-label": "Tracks" }); // it scrolls, by keys too
    get("chart").after(this.element);
    let width = 0;
    new ResizeObserver(() => { if (this.element.clientWidth !== width) { width = this.element.clientWidth; this.draw(); } }).observe(this.element);
    wireSeek(this.element, (event) => {
      const { left, right, start, duration } = this.chart.edges(this.element.clientWidth), at = event.clientX - this.element.getBoundingClientRect().left;
      onSeek(start + Math.min(Math.max((at - left) / Math.max(right - left, 1), 0), 1) * duration);
    });
    if (this.kinds.length) this.offerChoice();
  }

  offerChoice() {
    const box = addSheet("track-choice", "Tracks", "What is drawn over time"), { rollouts } = this.show;
    const first = [rollouts.some((r) => r.curve.length) && "Manipulability", rollouts.some((r) => r.status.length) && "status", rollouts.some((r) => r.bands.length) && "phases"].filter(Boolean).join(", ");
    if (first) box.append(checkbox(first[0].toUpperCase() + first.slice(1), true, (on) => this.showFirst(on), { "data-track": "first" }));
    for (const kind of this.kinds)
      box.append(checkbox(TRACKS[kind].title, this.chosen.has(kind), (on) => {
        if (on) this.chosen.add(kind); else this.chosen.delete(kind);
        this.arrange();
      }, { "data-track": kind }));
  }

  showFirst(on) {
    this.withoutFirst = !on;
    get("chart").hidden = !on;
    this.arrange();
  }

  arrange() {
    get("panel").hidden = get("chart").hidden && !this.chosen.size;
    this.draw();
  }

  // Of one motion where each has several curves, else of all visible ones as long as they can be told apart.
  rolloutsOf(kind) {
    const having = this.show.rollouts.filter((r) => r.visible && r.byKind.has(kind)), solid = having.filter((r) => r.solid);
    const single = TRACKS[kind].of === "one" || having.length > MOST_TOGETHER;
    return single ? (solid.length ? solid : having.slice(0, 1)) : having;
  }

  draw() {
    this.rows = this.kinds.filter((kind) => this.chosen.has(kind)).map((kind) => new TrackRow(kind, this.rolloutsOf(kind), this.chart, this.show.rollouts.length > 1));
    this.element.replaceChildren(...this.rows.map((row) => row.figure));
    for (const row of this.rows) row.draw();
    this.setTime(this.time);
  }

  setTime(t) {
    this.time = t;
    for (const row of this.rows) row.setTime(t);
  }

  // Every value under the cursor, as numbers: track -> rollout -> curve.
  valuesAt(t) {
    return Object.fromEntries(this.kinds.map((kind) => [kind, Object.fromEntries(this.show.rollouts.filter((r) => r.byKind.has(kind)).map((r) =>
      [r.name, Object.fromEntries(r.byKind.get(kind).curves.map((c) => [c.name, valueAt(c, Math.min(t, r.duration))]))]))]));
  }
}

class TrackRow extends ValueAxis {
  constructor(kind, rollouts, chart, named) {
    super();
    Object.assign(this, { kind, rollouts, chart, form: TRACKS[kind] });
    this.curves = rollouts.flatMap((r) => r.byKind.get(kind).curves.map((curve, k) => ({ curve, rollout: r, k, own: this.form.of === "all" })));
    this.unit = rollouts.length ? rollouts[0].byKind.get(kind).unit.replace("limit", "") : "";
    const caption = make("figcaption", {}, make("b", {}, this.form.title)), [first] = rollouts;
    if (named && this.form.of === "one" && first) caption.append(make("span", { className: "of", style: `--colour: ${first.colour}` }, first.name));
    this.values = this.curves.map(({ curve, rollout, k, own }) => {
      const mark = svg("svg", { width: 18, height: 4, "aria-hidden": "true" }), text = make("span");
      svg("line", { x1: 0, x2: 18, y1: 2, y2: 2, ...this.stroke(rollout, k, own) }, mark);
      caption.append(make("span", { className: "value" }, mark, `${own ? rollout.name : curve.name} `, text));
      return text;
    });
    const without = [...new Set(rollouts.flatMap((r) => r.byKind.get(kind).without))];
    if (without.length) caption.append(make("span", {}, `no limits: ${without.join(", ")}`));
    this.box = make("div", { className: "curves" });
    this.figure = make("figure", { className: "track" }, caption, this.box);
  }

  stroke(rollout, k, own) {
    const colour = own ? rollout.colour : `var(--series-${k % SERIES})`;
    const dash = own ? DASHES[rollout.index % DASHES.length] : DASHES[Math.floor(k / SERIES) % DASHES.length];
    return { style: `stroke: ${colour}`, "stroke-width": own && rollout.solid && this.rollouts.length > 1 ? 3 : 2, "stroke-dasharray": dash };
  }

  findRange() {
    const { form } = this, values = this.curves.flatMap(({ curve }) => Array.from(curve.values)).filter((v) => !Number.isNaN(v));
    if (!values.length) return [0, 1];
    const [least, high] = extent([...values, ...[form.low, form.high, form.least].filter((v) => v !== undefined)]), low = form.low === undefined ? Math.min(least, 0) : least;
    const room = 0.06 * (high - low || Math.abs(high) || 1);
    return [low < (form.low ?? 0) || form.limits ? low - room : low, high + room];
  }

  draw() {
    const w = this.box.clientWidth;
    if (w < 50) return;
    const { left, right } = this.chart.edges(w);
    Object.assign(this, { top: 6, bottom: TRACK_HEIGHT - 8, range: this.findRange() });
    const root = svg("svg", { width: w, height: TRACK_HEIGHT, "aria-hidden": "true" });
    const { limits, percent } = this.form, middle = limits && (limits[0] + limits[1]) / 2;
    this.drawGrid(root, limits ? [limits[0], middle, limits[1]] : niceTicks(...this.range, 3), { left, right }, percent ? (v) => `${Math.round(100 * v)} %` : short, limits);
    for (const { curve, rollout, k, own } of this.curves)
      this.drawLine(root, curve.times, curve.values, (t) => this.chart.x(t), this.stroke(rollout, k, own));
    this.cursor = svg("line", { y1: 0, y2: TRACK_HEIGHT, class: "cursor" }, root);
    this.box.replaceChildren(root);
  }

  setTime(t) {
    this.curves.forEach(({ curve, rollout }, i) => (this.values[i].textContent = trackText(this.kind, this.unit, valueAt(curve, Math.min(t, rollout.duration)))));
    if (this.cursor) moveAcross(this.cursor, this.chart.x(t));
  }
}
