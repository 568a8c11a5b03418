// What is drawn beside the robots: the marks of the constraint, switched on and off; and what colours the paths.

const SHOWN = {
  constraint: { say: "Constraint at the tip", has: (r) => r.drawn },
  handles: { say: "Handles", has: (r) => r.pieces.length },
  mechanism: { say: "Mechanism", has: (_, { mechanisms }) => mechanisms.length },
  around: { say: "Scene as stated", has: (r) => r.things.length },
  target: { say: "Target", has: (r) => r.drawn && r.drawn.target },
  ellipsoid: { say: "Ellipsoid of the task", has: (r) => r.drawn && r.drawn.ellipsoid.some((x) => x !== 0) },
  paths: { say: "Paths of the tip", has: () => true },
};

class Shown {
  constructor(data, show) {
    Object.assign(this, { show, scale: data.ellipsoidScale, on: Object.fromEntries(Object.keys(SHOWN).map((name) => [name, true])) });
    this.on.ellipsoid = show.rollouts.some((r) => r.curve.length); // it belongs to the curve
    const size = show.stage ? show.stage.size : 1;
    for (const rollout of show.rollouts) {
      rollout.allDrawn = rollout.marks.map((marks) => marks && new ConstraintMarks(marks, rollout.instance, size, data.ellipsoidScale));
      rollout.drawn = rollout.allDrawn[0];
      for (const drawn of rollout.allDrawn) if (drawn) rollout.instance.root.add(drawn.group);
    }
    if (show.stage) this.key = new SceneKey(show.stage, this.rows());
    this.offer(data);
    this.apply();
  }

  offer(data) {
    const names = Object.keys(SHOWN).filter((name) => this.show.rollouts.some((r) => SHOWN[name].has(r, this.show))), fits = this.show.rollouts.some((r) => r.fit);
    if (names.length < 2 && !fits) return;
    const card = addSheet("shown", "Show", "What is drawn in the scene");
    for (const name of names) card.append(checkbox(SHOWN[name].say, this.on[name], (on) => { this.on[name] = on; this.apply(); }, { "data-shown": name }));
    if (fits) card.append(colourChoice(this.show, data.phaseKinds.length > 0));
  }

  // Of the legend in the scene: the marks of the solid rollout, what was learnt and what was stated.
  rows() {
    const { show, on, scale } = this, mechanisms = show.mechanisms, words = (some) => [...new Set(some)].filter(Boolean).join(", ");
    const marks = (name, say) => () => { const { solid } = show; return on[name] && solid && solid.visible && solid.drawn && solid.drawn.holds ? say(solid.drawn.drawn, solid.drawn) : ""; };
    const own = (name, say) => () => (on[name] && show.solid && show.solid.visible ? say(show.solid) : "");
    const stated = ({ things }) => words(things.map(({ name }) => name));
    const learnt = words(mechanisms.filter(({ lines, patches }) => lines.length + patches.length).map(({ type }) => MECHANISM_WORDS[type] || "mechanism that was learnt"));
    const shown = mechanisms.filter(({ way }) => way), holds = shown.some(({ hold }) => hold);
    return [
      { ink: "--scene-ink", form: "line", say: () => (on.mechanism ? learnt : "") },
      { ink: "--shown", form: "line", say: () => (on.mechanism && shown.length ? "as it was shown" : "") },
      { ink: "--shown", form: "ball", say: () => (on.mechanism && holds ? "demonstrated grasps" : "") },
      { ink: "--handle", form: "ball", say: own("handles", (r) => (r.pieces.length ? `handle ${show.panes ? "" : openInWords(r, show.time)}` : "")) },
      { ink: "--free", say: marks("constraint", ({ held, free, heldTurns, freeTurns }) => (held.length && free.length % 3 ? "free to move" : heldTurns.length && freeTurns.length ? "free to turn" : "")) },
      { ink: "--held", say: marks("constraint", ({ held, heldTurns }) => (held.length ? "held" : heldTurns.length ? "may not turn" : "")) },
      { ink: "--goal", form: "ball", say: marks("target", (_, { target }) => (target ? "target" : "")) },
      { ink: "--goal", form: "line", say: marks("target", (_, { reachedAt }) => (reachedAt ? "any place on this line counts as reached" : "")) },
      { ink: "--ellipsoid", say: marks("ellipsoid", () => `speed within reach (μ), ${short(scale)} m for 1 m/s`) },
      { ink: "--around", say: own("around", (r) => (r.things.length ? `as stated: ${stated(r)}` : "")) },
    ];
  }

  // Those of the solid rollout only: two sets of arrows cannot be told apart.
  apply() {
    for (const r of this.show.rollouts) {
      if (r.trail) r.trail.group.visible = this.on.paths;
      for (const piece of r.pieces) piece.mesh.visible = this.on.handles;
      for (const thing of r.things) thing.group.visible = r.solid && this.on.around;
      for (const drawn of r.allDrawn) if (drawn) for (const [name, part] of Object.entries(drawn.parts)) part.visible = r.solid && this.on[name];
    }
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
    if (this.key) this.key.update();
  }
}
