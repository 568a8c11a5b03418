// Motions that are played beside the live arm, again and again, with a legend and their manipulability.

const GHOST_PAUSE = 1.2; // [s] at the end, before they begin again

function ghostRollout(raw, index) {
  const keyTimes = decode(raw.keyTimes, Float64Array), curveOf = (x) => (!x ? [] : typeof x === "string" ? decode(x, Float64Array) : Float64Array.from(x));
  return {
    name: raw.name, colourName: raw.colourName, duration: raw.duration, ended: raw.ended || "", index, visible: true, solid: false, keyTimes,
    tracks: decode(raw.tracks, Float64Array), curve: curveOf(raw.curve), curveTimes: curveOf(raw.curveTimes), status: [], bands: [], kinds: [],
    hasPhases: false, hasOwnPhases: false, furniture: [], pieces: [], things: [], around: [], byKind: new Map(), get colour() { return onScreen(raw.colour); },
  };
}

class Ghosts {
  constructor(teach) {
    Object.assign(this, { teach, rollouts: [], time: 0, duration: 0, number: undefined });
    this.repeats = !matchMedia("(prefers-reduced-motion: reduce)").matches; // where motion is unwelcome, once is enough
    this.box = Object.assign(document.createElement("div"), { id: "ghost-legend" });
    get("legend").append(this.box);
    DARK.addEventListener("change", () => { for (const { instance } of this.rollouts) { instance.setSolid(false); teach.quality.plain(instance); } });
  }

  set(data) {
    const number = data ? data.number : null;
    if (number === this.number) return;
    this.number = number;
    for (const { instance } of this.rollouts) this.teach.stage.world.remove(instance.root);
    const raws = data ? data.rollouts : [], { instance } = this.teach, geometries = instance.meshes.map(({ skin }) => skin.geometry);
    this.rollouts = raws.map((raw, i) => ghostRollout(raw, i + 1));
    for (const rollout of this.rollouts) {
      rollout.instance = new RobotInstance(instance.robot, rollout, geometries, false);
      rollout.instance.setSolid(false);
      this.teach.quality.plain(rollout.instance);
      this.teach.stage.world.add(rollout.instance.root);
    }
    this.duration = Math.max(0, ...this.rollouts.map((r) => r.duration));
    this.time = 0;
    this.last = undefined;
    this.build();
    this.setTime(0);
  }

  build() {
    this.box.replaceChildren();
    this.box.hidden = !this.rollouts.length;
    this.legend = this.rollouts.length ? new Legend(this.box, this.rollouts, { onShow: (rollout, visible) => this.show(rollout, visible), onSolid: (rollout) => this.show(rollout, !rollout.visible) }) : null;
    for (const { pick, rollout } of this.legend ? this.legend.rows : []) pick.title = `Show or hide ${rollout.name}`;
    const curves = this.rollouts.some((r) => r.curve.length);
    get("ghost-chart").hidden = !curves;
    get("charts").classList.toggle("both", curves);
    get("ghost-chart").setAttribute("aria-label", curves ? `Manipulability of the ghosts: ${inWords(this.rollouts)}` : "");
    this.chart = curves ? (this.chart || new Chart(get("ghost-chart"), [], 1, null)) : this.chart;
    if (curves) Object.assign(this.chart, { rollouts: this.rollouts, duration: this.duration, logarithmic: this.teach.chart.logarithmic });
    if (curves) this.chart.draw();
    this.sayEnds();
    if (this.teach.stage) this.teach.stage.dirty();
  }

  sayEnds() {
    get("no-ghosts").hidden = !this.rollouts.length;
    get("ghost-ends").replaceChildren(...this.rollouts.filter((r) => r.ended).map((r) => {
      const item = document.createElement("li"), name = Object.assign(document.createElement("b"), { textContent: `${r.name}: ` });
      item.style.setProperty("--colour", r.colour);
      item.append(name, r.ended);
      return item;
    }));
  }

  show(rollout, visible) {
    rollout.visible = visible;
    rollout.instance.root.visible = visible;
    if (this.chart && !get("ghost-chart").hidden) this.chart.draw();
    this.setTime(this.time);
  }

  setTime(t) {
    if (!this.rollouts.length) return;
    this.time = Math.min(t, this.duration);
    for (const rollout of this.rollouts) rollout.instance.setValues(this.teach.show.valuesAt(rollout, this.time));
    this.teach.stage.sortGhosts(this.rollouts.filter((r) => r.visible).map((r) => r.instance));
    this.teach.stage.dirty();
  }

  frame(now) {
    if (!this.rollouts.length) return;
    const elapsed = this.last === undefined ? 0 : Math.min((now - this.last) / 1000, 0.25);
    this.last = now;
    this.clock = (this.clock ?? 0) + elapsed;
    if (this.time === 0 && elapsed === 0) this.clock = 0;
    if (this.clock > this.duration + GHOST_PAUSE && this.repeats) this.clock = 0;
    if (Math.min(this.clock, this.duration) !== this.time) this.setTime(this.clock);
    if (now < (this.drawn ?? 0) + 100) return;
    this.drawn = now;
    this.legend.setTime(this.time);
    if (!get("ghost-chart").hidden) this.chart.setTime(this.time);
  }
}
