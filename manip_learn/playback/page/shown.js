// What is drawn beside the robots: the marks of the constraint, switched on and off; and what colours the paths.

const SHOWN = {
  constraint: { say: "Constraint at the tip", on: true },
  handles: { say: "Handles", on: true },
  mechanism: { say: "Mechanism", on: true },
  around: { say: "What it keeps clear of", on: true },
  swept: { say: "All of the arm's way there", on: true },
  target: { say: "Target", on: true },
  ellipsoid: { say: "Ellipsoid of the task" },
  paths: { say: "Paths of the tip", on: true },
  labels: { say: "Labels", on: true },
};

class Shown {
  constructor(data, show) {
    Object.assign(this, { show, scale: data.ellipsoidScale, on: Object.fromEntries(Object.entries(SHOWN).map(([name, { on }]) => [name, on])) });
    this.on.swept = !show.panes; // the difference is the point there
    this.on.ellipsoid = show.rollouts.some((r) => r.curve.length); // it belongs to the curve
    const size = show.stage ? show.stage.size : 1;
    for (const rollout of show.rollouts) {
      rollout.allDrawn = rollout.marks.map((marks) => marks && new ConstraintMarks(marks, rollout.instance, size, data.ellipsoidScale));
      rollout.drawn = rollout.allDrawn[0];
      for (const drawn of rollout.allDrawn) if (drawn) rollout.instance.root.add(drawn.group);
    }
    if (show.stage && !show.panes) this.labels = labelScene(show, this.on);
    this.offer(data);
    this.apply();
  }

  has(name) {
    if (name === "mechanism") return this.show.mechanisms.length > 0;
    if (name === "paths") return true;
    if (name === "handles") return this.show.rollouts.some((r) => r.pieces.length);
    if (name === "around") return this.show.rollouts.some((r) => r.things.length);
    if (name === "swept") return this.show.rollouts.some((r) => r.swept && r.swept.children.length);
    if (name === "labels") return ["constraint", "mechanism", "handles", "around"].some((other) => this.has(other));
    return this.show.rollouts.some((r) => r.drawn && (name !== "target" || r.drawn.target) && (name !== "ellipsoid" || r.drawn.ellipsoid.some((x) => x !== 0)));
  }

  offer(data) {
    const names = Object.keys(SHOWN).filter((name) => this.has(name)), fits = this.show.rollouts.some((r) => r.fit);
    if (names.length < 2 && !fits) return;
    const card = addSheet("shown", "Show", "What is drawn in the scene");
    for (const name of names) card.append(checkbox(SHOWN[name].say, this.on[name], (on) => { this.on[name] = on; this.apply(); }, { shown: name }));
    if (this.has("constraint")) card.append(this.key());
    if (fits) card.append(colourChoice(this.show, data.phaseKinds.length > 0));
  }

  key() {
    const list = Object.assign(document.createElement("ul"), { className: "key" });
    const words = { free: "arrow: free to move, round arrow: free to turn", held: "disc, bar or ball: held, ring: may not turn", goal: "ball and cross: target; the line through it: places that count as reached" };
    words.ellipsoid = `ellipsoid: speed within the reach of the tip along the rows of μ, for joint velocities of norm 1 (rad/s or m/s); ${short(this.scale)} m drawn for 1 m/s`;
    const used = { free: "constraint", held: "constraint", goal: "target", ellipsoid: "ellipsoid" };
    for (const [name, text] of Object.entries(words)) {
      if (!this.has(used[name])) continue;
      const item = document.createElement("li");
      item.style.setProperty("--colour", `var(--${name})`);
      item.textContent = text;
      list.append(item);
    }
    return list;
  }

  // Those of the solid rollout only: two sets of arrows cannot be told apart.
  apply() {
    for (const r of this.show.rollouts) {
      if (r.trail) r.trail.group.visible = this.on.paths;
      for (const piece of r.pieces) piece.mesh.visible = this.on.handles;
      for (const thing of r.things) thing.group.visible = r.solid && this.on.around;
      if (r.swept) r.swept.visible = r.solid && this.on.swept;
      for (const drawn of r.allDrawn) if (drawn) for (const [name, part] of Object.entries(drawn.parts)) part.visible = r.solid && this.on[name];
    }
    if (this.labels) this.labels.hidden = !this.on.labels;
    if (this.show.mechanismGroup) this.show.mechanismGroup.visible = this.on.mechanism;
    this.setTime(this.show.time);
    if (this.show.stage) this.show.stage.dirty();
  }

  // The marks of the constraint that holds now; where none does, those of the one before stay faint.
  setTime(t) {
    for (const r of this.show.rollouts) {
      const now = Math.min(t, r.duration), phase = phaseAt(r, now), k = hasPhaseColours(r) ? r.kinds.indexOf(phase) : (phase && phase.constraint) ?? 0;
      const known = k >= 0 && k < r.allDrawn.length, holds = known && takesHold(r, now);
      if (known) r.drawn = r.allDrawn[k];
      for (const drawn of r.allDrawn) if (drawn) drawn.group.visible = drawn === r.drawn;
      if (r.drawn && r.solid && r.visible) r.drawn.setTime(now, holds);
    }
  }
}
