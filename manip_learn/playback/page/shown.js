// What is drawn beside the robots: the marks of the constraint, switched on and off; and what colours the paths.

const SHOWN = {
  constraint: { say: "Constraint at the tip", on: true },
  furniture: { say: "Furniture that is moved", on: true },
  mechanism: { say: "Mechanism", on: true },
  target: { say: "Target", on: true },
  ellipsoid: { say: "Ellipsoid of the task", on: true },
  paths: { say: "Paths of the tip", on: true },
  labels: { say: "Labels", on: true },
};

class Shown {
  constructor(data, show) {
    Object.assign(this, { show, scale: data.ellipsoidScale, on: Object.fromEntries(Object.entries(SHOWN).map(([name, { on }]) => [name, on])) });
    const size = show.stage ? show.stage.size : 1;
    for (const rollout of show.rollouts) {
      if (!rollout.marks) continue;
      rollout.drawn = new ConstraintMarks(rollout.marks, rollout.instance, size, data.ellipsoidScale);
      rollout.instance.root.add(rollout.drawn.group);
    }
    if (show.stage) this.labels = labelScene(show, this.on);
    this.offer(data);
    this.apply();
  }

  has(name) {
    if (name === "mechanism") return this.show.mechanisms.length > 0;
    if (name === "paths") return true;
    if (name === "furniture") return this.show.rollouts.some((r) => r.piece);
    if (name === "labels") return ["constraint", "mechanism", "furniture"].some((other) => this.has(other));
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
    words.ellipsoid = `ellipsoid: speed of the tip along what is held, for joint velocities of norm 1 (rad/s or m/s); ${short(this.scale)} m drawn for 1 m/s`;
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
      if (r.piece) r.piece.group.visible = this.on.furniture;
      if (!r.drawn) continue;
      for (const [name, part] of Object.entries(r.drawn.parts)) part.visible = r.solid && this.on[name];
    }
    if (this.labels) this.labels.hidden = !this.on.labels;
    if (this.show.mechanismGroup) this.show.mechanismGroup.visible = this.on.mechanism;
    this.setTime(this.show.time);
    if (this.show.stage) this.show.stage.dirty();
  }

  setTime(t) {
    for (const r of this.show.rollouts)
      if (r.drawn && r.solid && r.visible) r.drawn.setTime(Math.min(t, r.duration), !r.hasPhases || phaseAt(r, Math.min(t, r.duration)) === r.kinds[0]);
  }
}
