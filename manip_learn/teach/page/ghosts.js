// Motions that are played beside the live arm; at their end they stay, with how far they came.

function ghostRollout(raw, index) {
  const keyTimes = decode(raw.keyTimes, Float64Array);
  return {
    ...raw, index, visible: true, solid: false, keyTimes, tracks: decode(raw.tracks, Float64Array), curve: decode(raw.curve, Float64Array), curveTimes: decode(raw.curveTimes, Float64Array),
    status: [], bands: [], kinds: [], furniture: [], pieces: [], things: [], around: [], byKind: new Map(), get colour() { return onScreen(raw.colour); },
  };
}

class Ghosts {
  constructor(teach) {
    Object.assign(this, { teach, rollouts: [], rows: [], number: null });
    for (let i = 0; i < MOST_LABELLED; i++) teach.key.add({ ink: "--scene-ink", say: () => this.words(this.rollouts[i]) });
    DARK.addEventListener("change", () => { for (const { instance } of this.rollouts) instance.setSolid(false); });
  }

  get curves() { return this.rollouts.some(({ curve }) => curve.length); }

  // Where it ended, once it has.
  words(ghost) { return ghost && ghost.visible && ghost.ended && this.time >= ghost.duration ? `${ghost.name}: ${ghost.ended}` : ""; }

  set(data) {
    const number = data ? data.number : null;
    if (number === this.number) return;
    this.number = number;
    for (const { instance } of this.rollouts) this.teach.stage.world.remove(instance.root);
    const { robot, bodies } = this.teach.instance;
    this.rollouts = (data ? data.rollouts : []).map((raw, i) => ghostRollout(raw, i + 1));
    for (const rollout of this.rollouts) {
      rollout.instance = new RobotInstance(robot, rollout, bodies, false);
      rollout.instance.setSolid(false);
      this.teach.stage.world.add(rollout.instance.root);
    }
    this.duration = Math.max(0, ...this.rollouts.map((r) => r.duration));
    this.most = Math.max(...this.rollouts.flatMap((r) => [...r.curve]));
    this.rows = this.rollouts.map((rollout) => this.row(rollout));
    get("ghost-ends").replaceChildren(...this.rows.map(({ item }) => item));
    get("ghosts").hidden = !this.rollouts.length;
    get("ghosts").scrollIntoView({ block: "nearest" });
    this.play();
  }

  // A button that hides it, how it ended, and the room that it has left now.
  row(rollout) {
    const item = document.createElement("li"), button = Object.assign(document.createElement("button"), { type: "button", textContent: rollout.name, title: "Show or hide it" });
    const room = Object.assign(document.createElement("meter"), { max: 1, low: 0.2 });
    item.style.setProperty("--colour", rollout.colour);
    button.setAttribute("aria-pressed", "true");
    room.setAttribute("aria-label", `Room left to ${rollout.name}`);
    room.hidden = !rollout.curve.length;
    item.append(button, room, Object.assign(document.createElement("span"), { textContent: rollout.ended }));
    button.addEventListener("click", () => {
      rollout.visible = rollout.instance.root.visible = !rollout.visible;
      button.setAttribute("aria-pressed", String(rollout.visible));
      this.setTime(this.time);
    });
    return { item, room, rollout };
  }

  play() {
    this.last = undefined;
    this.setTime(0);
    this.teach.drawChart();
  }

  setTime(t) {
    this.time = t;
    for (const rollout of this.rollouts) rollout.instance.setValues(this.teach.show.valuesAt(rollout, t));
    for (const { room, rollout } of this.rows) if (rollout.curve.length) room.value = curveValue(rollout, t) / this.most;
    this.teach.stage.sortGhosts(this.rollouts.filter((r) => r.visible).map((r) => r.instance));
    this.teach.stage.dirty();
  }

  frame(now) {
    if (!this.rollouts.length || this.time >= this.duration) return;
    const elapsed = this.last === undefined ? 0 : Math.min((now - this.last) / 1000, 0.25);
    this.last = now;
    this.setTime(Math.min(this.time + elapsed, this.duration));
    if (this.curves) this.teach.chart.setTime(this.time);
  }
}
