// Time: play, pause, scrub; and what all of it is shown in.

const get = (id) => document.getElementById(id);

// Two digits, and no fewer before the point.
function readable(x) {
  const size = Math.abs(x);
  if (size === 0) return "0";
  return size < 1e-3 || size >= 1e4 ? x.toExponential(1) : size < 10 ? x.toPrecision(2) : x.toFixed(0);
}

function prepare(rollout, index, phaseKinds) {
  const own = rollout.phaseKinds && ownKinds(rollout.phaseKinds, rollout.colour), kinds = own || phaseKinds, byKind = tracksByKind(rollout.measures);
  return {
    ...rollout, kinds, hasPhases: phaseKinds.length > 0, hasOwnPhases: Boolean(own), bands: bandsOf(rollout, kinds), index, visible: true, solid: index === 0,
    keyTimes: decode(rollout.keyTimes, Float64Array), tracks: decode(rollout.tracks, Float64Array),
    path: decode(rollout.path, Float32Array), pathTimes: decode(rollout.pathTimes, Float32Array),
    curve: decode(rollout.curve, Float64Array), curveTimes: decode(rollout.curveTimes, Float64Array),
    byKind, fit: fitOf({ byKind }), get colour() { return onScreen(rollout.colour); },
  };
}

// The tip's place at time t; after the end, the last one.
function pathAt({ path, pathTimes }, t) { return new THREE.Vector3(...rowAt(pathTimes, path, 3, t)); }

class Show {
  constructor(data) {
    this.rollouts = data.rollouts.map((r, i) => prepare(r, i, data.phaseKinds));
    for (const rollout of this.rollouts) rollout.odd = (data.odd ?? {})[rollout.name];
    this.duration = Math.max(...this.rollouts.map((r) => r.duration));
    this.time = 0;
    this.panes = Boolean(data.panes && data.panes.length);
    if (this.panes) for (const rollout of this.rollouts) rollout.solid = true;
    this.zero = data.zero ?? 0;
    this.makeScene(data);
    if (this.panes) this.arrangePanes(data.panes);
    DARK.addEventListener("change", () => this.recolour());
  }

  makeScene(data) {
    try {
      this.stage = new Stage(get("scene"), data);
    } catch (error) {
      console.warn("no 3D graphics:", error);
      get("no-webgl").hidden = false;
    }
    const bodies = bodiesOf(data.robot);
    const world = this.stage ? this.stage.world : new THREE.Group(), size = this.stage ? this.stage.size : 1;
    for (const rollout of this.rollouts) {
      rollout.instance = new RobotInstance(data.robot, rollout, bodies, !this.panes && this.rollouts.length > 1 && !rollout.hasPhases);
      rollout.instance.setSolid(rollout.solid);
      world.add(rollout.instance.root);
      if (rollout.path.length >= 6) rollout.trail = new TipPath(rollout, 0.0028 * size, rollout.instance.root);
      rollout.pieces = rollout.handles.map((spans) => new Handle(rollout, spans, 0.008 * size));
    }
    addAround(this);
    this.mechanisms = data.mechanisms;
    if (!this.stage) return;
    this.mechanismGroup = new THREE.Group();
    for (const one of this.mechanisms) this.mechanismGroup.add(mechanismGroup(one, (data.phaseKinds[one.constraint] || NO_PHASE).colour, 0.0012 * this.stage.size));
    world.add(this.mechanismGroup);
  }

  // One pane for each rollout, in its own colours, with its name and what became of it below.
  arrangePanes(panes) {
    document.body.dataset.panes = panes.length;
    const captions = panes.map(({ name, said, why }, k) => make("p", { style: `--colour: ${this.rollouts[k].colour}` }, make("strong", {}, name), said, make("span", {}, why)));
    get("scene").after(make("div", { className: "panes" }, ...captions));
    if (this.stage) this.stage.showPanes(this.rollouts.map((r) => r.instance.root));
  }

  // Time from the common zero, as it is said.
  sayTime(t) { return `${(t - this.zero).toFixed(2)} s`; }

  recolour() {
    for (const { trail, instance, solid } of this.rollouts) {
      instance.setSolid(solid);
      if (trail) trail.recolour();
    }
    if (this.onRecolour) this.onRecolour();
    this.setTime(this.time);
  }

  // Numbers of all joints at time t; after the end, the last ones.
  valuesAt(rollout, t) {
    return rowAt(rollout.keyTimes, rollout.tracks, rollout.tracks.length / rollout.keyTimes.length, t);
  }

  setTime(t) {
    this.time = Math.min(Math.max(t, 0), this.duration);
    for (const rollout of this.rollouts) {
      rollout.instance.setValues(this.valuesAt(rollout, this.time));
      for (const piece of rollout.pieces) piece.setTime(this.time, (t) => pathAt(rollout, t));
      if (rollout.trail) rollout.trail.setTime(this.time, rollout.instance.tipPosition());
    }
    if (this.shown) this.shown.setTime(this.time);
    if (this.stage) {
      this.stage.sortGhosts(this.rollouts.filter((r) => !r.solid && r.visible).map((r) => r.instance));
      this.stage.dirty();
    }
  }

  show(rollout, visible) {
    rollout.visible = visible;
    rollout.instance.root.visible = visible;
    if (this.stage) this.stage.dirty();
  }

  makeSolid(chosen) {
    for (const rollout of this.rollouts) {
      if (rollout.solid === (rollout === chosen)) continue;
      rollout.solid = rollout === chosen;
      rollout.instance.setSolid(rollout.solid);
      if (rollout.solid) rollout.instance.setOrder(0);
    }
    this.show(chosen, true);
    if (this.shown) this.shown.apply();
    this.setTime(this.time);
  }

  get solid() { return this.rollouts.find((r) => r.solid); }
}

class Player {
  constructor(show) {
    this.show = show;
    this.playing = false;
    this.speed = 1;
    this.loop = false;
    this.chart = new Chart(get("chart"), show.rollouts, show.duration, (t) => this.seek(t), show.zero);
    this.legend = new Legend(get("legend"), show.rollouts, {
      onShow: (rollout, visible) => this.showRollout(rollout, visible),
      onSolid: (rollout) => { show.makeSolid(rollout); this.chart.draw(); this.drawSlider(); this.update(); },
      mechanisms: show.mechanisms,
    });
    this.tracks = new Tracks(show, this.chart, (t) => this.seek(t));
    this.chart.onDrawn = () => this.tracks.draw();
    show.onRecolour = () => { this.fillColourKey(); this.arrangePanel(); this.drawSlider(); this.update(); };
    this.wireTransport();
    wireKeys(this.keyActions());
    this.fillColourKey();
    this.arrangePanel();
    this.drawSlider();
    this.moveTo(0);
    if (!this.goTo(location.hash) && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play(); // once
    requestAnimationFrame((now) => this.frame(now));
  }

  showRollout(rollout, visible) {
    this.show.show(rollout, visible);
    this.chart.draw();
    this.update();
  }

  // Curves, bands, both or neither.
  arrangePanel() {
    const { rollouts } = this.show, fit = colouring.mode === "fit", curves = rollouts.some((r) => r.curve.length);
    const bands = rollouts.filter((r) => r.bands.length || (fit && r.fit)).length, below = fit ? "fit" : "phases", title = get("panel-title");
    get("chart").hidden = this.tracks.withoutFirst || (!curves && !bands && rollouts.every((r) => !r.status.length));
    get("panel").hidden = get("chart").hidden && !this.tracks.chosen.size;
    get("chart").setAttribute("aria-label", inWords(rollouts));
    get("phase").hidden = !rollouts.some((r) => r.bands.length);
    this.title ??= [...title.childNodes];
    if (curves) title.replaceChildren(...this.title, bands ? `, ${below}` : "");
    else title.textContent = bands ? (fit ? "Motion that breaks the constraint" : "Phases") : "Tracks";
    get("panel").setAttribute("aria-label", curves ? `Manipulability${bands ? ` and ${below}` : ""}` : title.textContent);
    if (!bands) return this.chart.draw();
    if (rollouts.filter((r) => r.hasOwnPhases).length === bands) get("chart").style.height = `calc(clamp(150px, 25vh, 260px) + ${6 + BAND.tallest}px)`; // further rows take from the curves
    else get("chart").style.height = curves ? "clamp(180px, 34vh, 360px)" : `min(38vh, ${44 + BAND.tallest * bands}px)`;
    this.chart.draw();
  }

  drawSlider() { get("scrub-bands").replaceChildren(stripOf(this.show.solid.bands, this.show.duration, { "aria-hidden": "true" })); }

  fillColourKey() {
    get("status-key").replaceChildren(...this.chart.colourKey().map(({ colour, label, mark = "", ink }) => {
      const image = svg("svg", { width: 16, height: mark ? 14 : 9 });
      svg("rect", { width: 16, height: mark ? 14 : 9, rx: 2, fill: colour }, image);
      if (mark) svg("text", { x: 8, y: 11, "text-anchor": "middle", style: `fill: ${ink}` }, image).textContent = mark;
      return make("span", {}, image, label);
    }));
  }

  wireTransport() {
    const actions = { play: () => this.toggle(), back: () => this.step(-1), forward: () => this.step(1), loop: () => this.setLoop(!this.loop) };
    for (const [name, action] of Object.entries(actions)) get(name).addEventListener("click", action);
    get("scrub").max = this.show.duration || 1;
    get("scrub").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    get("speed").addEventListener("change", (event) => { this.speed = Number(event.target.value); releaseFocus(event.target); });
    get("duration").textContent = `/ ${this.show.sayTime(this.show.duration)}`;
    wireCamera(this.show);
  }

  setLoop(loop) { this.loop = loop; get("loop").setAttribute("aria-pressed", String(loop)); }

  changeSpeed(by) {
    const box = get("speed");
    box.selectedIndex = Math.min(Math.max(box.selectedIndex + by, 0), box.options.length - 1);
    this.speed = Number(box.value);
  }

  keyActions() {
    const end = this.show.duration;
    return {
      " ": () => this.toggle(), ArrowLeft: (e) => (e.shiftKey ? this.seek(this.show.time - 1) : this.step(-1)),
      ArrowRight: (e) => (e.shiftKey ? this.seek(this.show.time + 1) : this.step(1)),
      ArrowUp: () => this.changeSpeed(1), ArrowDown: () => this.changeSpeed(-1), Home: () => this.seek(0), End: () => this.seek(end),
      ...cameraKeys(this.show), r: () => this.setLoop(!this.loop),
    };
  }

  play() {
    if (this.show.time >= this.show.duration) this.moveTo(0);
    this.setPlaying(true);
  }

  pause() { this.setPlaying(false); this.writeAddress(); }

  // "#t=3.2&view=top": a moment, from the common zero, and a view.
  goTo(hash) {
    const asked = new URLSearchParams(hash.slice(1)), t = parseFloat(asked.get("t"));
    if (this.show.stage && asked.get("view") in this.show.stage.directions) this.show.stage.look(asked.get("view"));
    if (Number.isFinite(t)) this.moveTo(t + this.show.zero);
    return Number.isFinite(t);
  }

  writeAddress() {
    const { stage, time, zero } = this.show;
    history.replaceState(null, "", `#t=${(time - zero).toFixed(3)}${stage ? `&view=${stage.view}` : ""}`);
  }
  toggle() { if (this.playing) this.pause(); else this.play(); }

  setPlaying(playing) {
    this.playing = playing && this.show.duration > 0;
    this.last = undefined;
    get("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  seek(t) { this.pause(); this.moveTo(t); }

  // To the next or the previous key frame of the solid rollout, or of the longest one after its end.
  step(direction) {
    const longest = this.show.rollouts.reduce((a, b) => (b.duration > a.duration ? b : a));
    const now = this.show.time, past = now + direction * 1e-9 > this.show.solid.duration;
    const times = (past ? longest : this.show.solid).keyTimes;
    let i = indexAt(times, now + 1e-9);
    if (direction > 0) i += 1;
    else if (times[i] >= now - 1e-9) i -= 1;
    this.seek(times[Math.min(Math.max(i, 0), times.length - 1)]);
  }

  moveTo(t) { this.show.setTime(t); this.update(); }

  update() {
    const t = this.show.time;
    this.chart.setTime(t);
    this.tracks.setTime(t);
    this.legend.setTime(t);
    const phase = phaseAt(this.show.solid, t);
    this.sayPhase(this.show.solid, phase);
    get("scrub").value = t;
    get("clock").textContent = this.show.sayTime(t);
    get("scrub").setAttribute("aria-valuetext", this.inWords(t, phase));
  }

  // Where there is little room, a rollout's own phases go without its name: the legend has it.
  sayPhase({ name, hasOwnPhases }, phase) {
    const { label = "", colour = "transparent", outline = "transparent" } = phase || {};
    get("phase").replaceChildren(make("span", {}, make("span", { className: hasOwnPhases ? "of" : "" }, phase ? `${name}: ` : ""), label));
    get("phase").style = `--colour: ${colour}; --outline: ${outline}`;
  }

  // The moment for those who hear it.
  inWords(t, phase) {
    const { solid, duration } = this.show;
    const said = momentInWords(solid, phase, t, [solid.curve.length && `manipulability ${readable(curveValue(solid, t))}`]);
    return [`${this.show.sayTime(t)} of ${this.show.sayTime(duration)}`, ...said].join(", ");
  }

  frame(now) {
    if (this.playing) {
      const elapsed = this.last === undefined ? 0 : Math.min((now - this.last) / 1000, 0.25);
      this.last = now;
      let t = this.show.time + elapsed * this.speed;
      if (t >= this.show.duration) {
        if (this.loop) t = t % this.show.duration; else { t = this.show.duration; this.setPlaying(false); }
      }
      this.moveTo(t);
    }
    if (this.show.stage) this.show.stage.render();
    requestAnimationFrame((next) => this.frame(next));
  }
}
