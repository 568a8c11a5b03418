// What was understood, or why it was not, and what to show next; and the truth, for those who ask.

class Answer {
  constructor(element, say) { Object.assign(this, { element, say, said: undefined }); }

  set(answer) {
    const said = JSON.stringify(answer);
    if (said === this.said) return;
    this.said = said;
    this.element.className = answer && answer.refused ? "refused" : "";
    this.element.replaceChildren(...(answer ? this.parts(answer) : []));
  }

  parts(answer) {
    const { sentence, mechanism, next, offer, phaseKinds } = answer, parts = [paragraph(sentence, "headline")];
    if (mechanism && mechanism.sentence && mechanism.sentence !== sentence) parts.push(paragraph(mechanism.sentence.charAt(0).toUpperCase() + mechanism.sentence.slice(1)));
    if (mechanism && mechanism.shown) parts.push(paragraph(mechanism.shown));
    if (next) parts.push(paragraph(next, "next"));
    if (offer) parts.push(this.offer(offer));
    if (phaseKinds.length) parts.push(this.legend(phaseKinds));
    return [...parts, this.more(answer)];
  }

  offer({ say, said }) {
    const button = Object.assign(document.createElement("button"), { type: "button", id: "offer", textContent: say });
    button.addEventListener("click", () => this.say(said));
    return button;
  }

  legend(kinds) {
    const list = Object.assign(document.createElement("ul"), { className: "kinds" });
    list.setAttribute("aria-label", "Phases");
    for (const { label, colour } of kinds) {
      const item = Object.assign(document.createElement("li"), { textContent: label });
      item.style.setProperty("--colour", colour);
      list.append(item);
    }
    return list;
  }

  more({ evidence, facts, rows, warnings, odd }) {
    const parts = warnings.map((text) => paragraph(`Take care: ${text}`, "warning"));
    for (const [name, reason] of odd) parts.push(paragraph(`${name} does not agree with the others: ${reason}`, "warning"));
    if (evidence) parts.push(paragraph(evidence));
    if (facts.length) parts.push(factList(facts));
    if (rows.length) parts.push(scrolled(rowTable(rows), "Rows of the test"));
    const box = Object.assign(document.createElement("details"), { className: "more" }), summary = document.createElement("summary");
    summary.textContent = warnings.length || odd.length ? `Why to believe it, and ${counted(warnings.length + odd.length, "warning")}` : "Why to believe it";
    box.append(summary, ...parts);
    return box;
  }
}

function counted(n, word) { return `${n} ${word}${n === 1 ? "" : "s"}`; }

// What is wide scrolls by itself, by keys too.
function scrolled(element, label) {
  const box = Object.assign(document.createElement("div"), { className: "scrolled", tabIndex: 0 });
  box.setAttribute("role", "group");
  box.setAttribute("aria-label", label);
  box.append(element);
  return box;
}

function fillTruth(element, truth) {
  const said = JSON.stringify(truth && [truth.sentence, truth.errors]);
  if (element.dataset.said === said) return;
  element.dataset.said = said;
  element.replaceChildren(...(truth ? [paragraph(truth.sentence, "headline"), ...(truth.errors.length ? [factList(truth.errors.map((one) => [...one, ""]))] : [])] : []));
  if (truth && truth.lines.length) element.append(paragraph("In the picture the truth is the wide, pale line.", "note"));
}
