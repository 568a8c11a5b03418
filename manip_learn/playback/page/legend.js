// Names, colours and values now of everything that is played.

class Legend {
  constructor(element, rollouts, { onShow, onSolid, mechanisms = [] }) {
    const several = mechanisms.length > 1;
    const words = mechanisms.flatMap(({ constraint, sentence, shown }) => {
      const said = [sentence, shown].filter(Boolean);
      return said.map((text, k) => make("span", {}, `${k ? "" : several ? `${constraint + 1}: ` : sentence ? "Mechanism: " : ""}${text}`));
    });
    if (words.length) element.append(make("p", { id: "mechanism" }, ...words));
    for (const { name, clear } of rollouts.filter((r) => r.clear)) element.append(paragraph(`${rollouts.length > 1 ? `${name} keeps` : "Keeps"} clear of ${clear}`, "around"));
    this.rows = rollouts.map((rollout) => {
      const odd = rollout.odd ? [make("span", { className: "odd", title: rollout.odd }, " odd")] : [];
      const state = make("span", { className: "state" }), mu = make("div", { className: "mu" });
      const eye = make("button", { type: "button", className: "eye", title: "Show or hide", "aria-label": `Show ${rollout.name}` }, make("i"));
      const pick = make("button", { type: "button", className: "pick", title: `${rollout.name}: draw this one solid` }, make("span", { className: "name" }, rollout.name, ...odd), state);
      const row = make("div", {}, eye, pick, mu);
      element.append(row);
      eye.addEventListener("click", () => onShow(rollout, !rollout.visible));
      pick.addEventListener("click", () => onSolid(rollout));
      return { rollout, row, eye, pick, state, mu };
    });
    element.classList.toggle("parted", rollouts.some((r) => r.hasOwnPhases));
    this.setTime(0);
  }

  setTime(t) {
    for (const { rollout, row, eye, pick, state, mu } of this.rows) {
      row.className = `rollout${rollout.solid ? " solid" : ""}${rollout.visible ? "" : " off"}`;
      eye.setAttribute("aria-pressed", String(rollout.visible));
      pick.setAttribute("aria-pressed", String(rollout.solid));
      const phase = phaseAt(rollout, t), ended = t > rollout.duration + 1e-9 && `ended at ${rollout.duration.toFixed(2)} s`;
      row.style.setProperty("--colour", hasPhaseColours(rollout) ? (phase || NO_PHASE).colour : rollout.colour);
      state.textContent = momentInWords(rollout, phase, t, [ended]).join(" · ");
      if (rollout.curve.length) mu.replaceChildren(readable(curveValue(rollout, t)), make("small", {}, "μ"));
    }
  }
}

// Phase, how far the fixtures have moved, the status, and more, of what there is.
function momentInWords(rollout, phase, t, more) {
  return [phase && phase.label, openInWords(rollout, t), statusAt(rollout, t), ...more].filter(Boolean);
}
