// What was understood, or why it was not, and what to show next; and the truth, for those who ask.

const KNOWN = new WeakMap();

// Whether something differs from what it was when this was last asked of its owner.
function isNew(owner, thing) {
  const text = JSON.stringify(thing), before = KNOWN.get(owner);
  KNOWN.set(owner, text);
  return text !== before;
}

function counted(n, word) { return `${n} ${word}${n === 1 ? "" : "s"}`; }

function fillAnswer(element, answer, say) {
  if (!isNew(element, answer)) return;
  element.className = answer && answer.refused ? "refused" : "";
  element.replaceChildren(...(answer ? answerParts(answer, say) : []).filter(Boolean));
}

function answerParts(answer, say) {
  const { sentence, mechanism, next, offer, phaseKinds } = answer, further = mechanism && mechanism.sentence !== sentence && mechanism.sentence;
  return [
    paragraph(sentence, "headline"), further && paragraph(further.charAt(0).toUpperCase() + further.slice(1)),
    mechanism && mechanism.shown && paragraph(mechanism.shown), next && paragraph(next, "next"),
    offer && make("button", { type: "button", id: "offer", onclick: () => say(offer.said) }, offer.say),
    phaseKinds.length && make("ul", { className: "kinds", "aria-label": "Phases" }, phaseKinds.map(({ label, colour }) => make("li", { style: `--colour: ${colour}` }, label))),
    reasons(answer),
  ];
}

// What is wide scrolls by itself, by keys too.
function reasons({ evidence, facts, rows, warnings, odd }) {
  const cares = [...warnings.map((text) => `Take care: ${text}`), ...odd.map(([name, reason]) => `${name} does not agree with the others: ${reason}`)];
  return make("details", { className: "more" },
    make("summary", {}, `Why to believe it${cares.length ? `, and ${counted(cares.length, "warning")}` : ""}`), cares.map((text) => paragraph(text, "warning")),
    evidence && paragraph(evidence), facts.length && factList(facts),
    rows.length && make("div", { className: "scrolled", tabIndex: 0, role: "group", "aria-label": "Rows of the test" }, rowTable(rows)));
}

function fillTruth(element, truth) {
  if (!isNew(element, truth)) return;
  const { sentence, errors, lines } = truth || {}, errorsOff = errors && errors.length && factList(errors.map((one) => [...one, ""]));
  const parts = [paragraph(sentence, "headline"), errorsOff, lines && lines.length && paragraph("In the picture the truth is the wide, pale line.", "note")];
  element.replaceChildren(...(truth ? parts.filter(Boolean) : []));
}
