// Motions that are played beside the live arm; at their end they stay, with how far they came.

// What a rollout has that a ghost has not.
const NONE = { status: [], phases: [], pieces: [], things: [], measures: { clocks: [], tracks: [] }, path: "", pathTimes: "" };

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
    this.rollouts = (data ? data.rollouts : []).map((raw, i) => prepare({ ...NONE, ...raw }, i + 1, []));
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
    const turn = () => {
      rollout.visible = rollout.instance.root.visible = !rollout.visible;
      button.setAttribute("aria-pressed", String(rollout.visible));
      this.setTime(this.time);
    };
    const button = make("button", { type: "button", title: "Show or hide it", "aria-pressed": "true", onclick: turn }, rollout.name);
    const room = make("meter", { max: 1, low: 0.2, "aria-label": `Room left to ${rollout.name}`, hidden: !rollout.curve.length });
    const item = make("li", { style: `--colour: ${rollout.colour}` }, button, room, make("span", {}, rollout.ended));
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
