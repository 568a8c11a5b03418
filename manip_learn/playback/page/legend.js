// Names, colours and values now of everything that is played.

class Legend {
  constructor(element, rollouts, { onShow, onSolid, mechanisms = [] }) {
    this.rows = rollouts.map((rollout) => {
      const row = document.createElement("div"), eye = document.createElement("button"), pick = document.createElement("button");
      const mark = document.createElement("i"), name = document.createElement("span"), state = document.createElement("span"), mu = document.createElement("div");
      Object.assign(eye, { type: "button", className: "eye", title: "Show or hide" });
      eye.setAttribute("aria-label", `Show ${rollout.name}`);
      Object.assign(pick, { type: "button", className: "pick", title: `${rollout.name}: draw this one solid` });
      name.className = "name"; state.className = "state"; mu.className = "mu";
      name.textContent = rollout.name;
      if (rollout.odd) name.append(Object.assign(document.createElement("span"), { className: "odd", textContent: " odd", title: rollout.odd }));
      eye.append(mark); pick.append(name, state); row.append(eye, pick, mu); element.append(row);
      eye.addEventListener("click", () => onShow(rollout, !rollout.visible));
      pick.addEventListener("click", () => onSolid(rollout));
      return { rollout, row, eye, pick, state, mu };
    });
    element.classList.toggle("parted", rollouts.some((r) => r.hasOwnPhases));
    for (const rollout of rollouts.filter((r) => r.around.length)) {
      const words = Object.assign(document.createElement("p"), { className: "around" }), [said, after] = aroundInWords(rollout).split(OPTION);
      words.append(`${rollouts.length > 1 ? `${rollout.name} keeps` : "Keeps"} clear of ${said}`);
      if (after) words.append(Object.assign(document.createElement("span"), { textContent: OPTION }), after);
      element.prepend(words);
    }
    if (mechanisms.length) {
      const words = Object.assign(document.createElement("p"), { id: "mechanism" });
      for (const { constraint, sentence, shown } of mechanisms) {
        const whose = mechanisms.length > 1 ? `${constraint + 1}: ` : sentence ? "Mechanism: " : "";
        for (const said of [sentence && whose + sentence, shown && (sentence ? shown : whose + shown)].filter(Boolean)) words.append(Object.assign(document.createElement("span"), { textContent: said }));
      }
      element.prepend(words);
    }
    this.setTime(0);
  }

  setTime(t, sayStatus = (word) => word) {
    for (const { rollout, row, eye, pick, state, mu } of this.rows) {
      row.className = `rollout${rollout.solid ? " solid" : ""}${rollout.visible ? "" : " off"}`;
      eye.setAttribute("aria-pressed", String(rollout.visible));
      pick.setAttribute("aria-pressed", String(rollout.solid));
      const ended = t > rollout.duration + 1e-9, word = statusAt(rollout, t), phase = phaseAt(rollout, t);
      row.style.setProperty("--colour", hasPhaseColours(rollout) ? (phase || NO_PHASE).colour : rollout.colour);
      state.textContent = [phase && phase.label, openInWords(rollout, t), word && sayStatus(word), ended && `ended at ${rollout.duration.toFixed(2)} s`].filter(Boolean).join(" · ");
      if (rollout.curve.length) {
        const value = document.createElement("small");
        value.textContent = "μ";
        mu.replaceChildren(readable(curveValue(rollout, t)), value);
      }
    }
  }
}
