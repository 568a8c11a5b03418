// Which recordings to learn from, and the command line that reads just these.

// 0, 1, 2, 5 -> "0:3,5", as --episodes counts.
function asRanges(numbers) {
  const sorted = [...numbers].sort((a, b) => a - b), parts = [];
  for (let i = 0; i < sorted.length; ) {
    let j = i;
    while (j + 1 < sorted.length && sorted[j + 1] === sorted[j] + 1) j++;
    parts.push(j > i ? `${sorted[i]}:${sorted[j] + 1}` : String(sorted[i]));
    i = j + 1;
  }
  return parts.join(",");
}

class RecordingChoice {
  constructor(choice, show, onShow) {
    Object.assign(this, { choice, show, onShow, kept: new Set(show.rollouts) });
    const card = addSheet("choice", "Recordings", "Which recordings to learn from");
    const tools = Object.assign(document.createElement("div"), { className: "tools" }), rows = Object.assign(document.createElement("div"), { className: "recordings" });
    tools.append(this.button("All", () => true), this.button("None", () => false));
    if (Object.keys(choice.odd).length) tools.append(this.button("Without the odd ones", (r) => !(r.name in choice.odd)));
    this.boxes = new Map();
    for (const rollout of show.rollouts) rows.append(this.row(rollout));
    this.command = document.createElement("code");
    this.copy = Object.assign(document.createElement("button"), { type: "button", textContent: "Copy" });
    this.copy.addEventListener("click", () => this.copyCommand());
    this.say = Object.assign(document.createElement("output"), { className: "said" });
    const line = Object.assign(document.createElement("div"), { className: "command" });
    line.append(this.command, this.copy);
    card.append(tools, rows, paragraph(choice.command ? "The command line that learns from these:" : "In Python, the demonstrations to learn from:", "note"), line, this.say);
    this.update();
  }

  row(rollout) {
    const odd = this.choice.odd[rollout.name], text = document.createDocumentFragment();
    text.append(Object.assign(document.createElement("b"), { textContent: rollout.name }));
    if (rollout.fitShare !== null) text.append(Object.assign(document.createElement("span"), { className: "share", textContent: `${(100 * rollout.fitShare).toPrecision(2)} % breaks the constraint` }));
    if (odd !== undefined) text.append(Object.assign(document.createElement("span"), { className: "odd", textContent: `odd: ${odd}` }));
    const row = checkbox(text, true, (on) => this.keep(rollout, on), { recording: rollout.name });
    this.boxes.set(rollout, row.querySelector("input"));
    return row;
  }

  button(label, chooses) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: label });
    button.addEventListener("click", () => { for (const rollout of this.show.rollouts) this.keep(rollout, chooses(rollout)); });
    return button;
  }

  keep(rollout, on) {
    this.boxes.get(rollout).checked = on;
    if (on === this.kept.has(rollout)) return;
    if (on) this.kept.add(rollout); else this.kept.delete(rollout);
    this.onShow(rollout, on);
    this.update();
  }

  words() {
    const { command, flag, episodes } = this.choice, all = this.show.rollouts, kept = all.filter((r) => this.kept.has(r));
    if (!kept.length) return "";
    if (!command) {
      const out = all.filter((r) => !this.kept.has(r)).map((r) => JSON.stringify(r.name));
      return out.length ? `ml.Demonstrations([d for d in demos if d.name not in {${out.join(", ")}}])` : "demos";
    }
    return `${command} ${flag} ${asRanges(kept.map((r) => episodes[all.indexOf(r)]))}`;
  }

  update() {
    const word = (textContent) => Object.assign(document.createElement("span"), { className: "word", textContent });
    const words = (this.words() || "keep at least one recording").split(" "); // lines break between them, not at hyphens
    this.command.replaceChildren(...words.flatMap((text, i) => (i ? [" ", word(text)] : [word(text)])));
    this.copy.disabled = !this.words();
    this.say.textContent = `${this.kept.size} of ${this.show.rollouts.length} recordings kept`;
  }

  async copyCommand() {
    try {
      await navigator.clipboard.writeText(this.words());
      this.say.textContent = "copied";
    } catch {
      getSelection().selectAllChildren(this.command);
      this.say.textContent = document.execCommand("copy") ? "copied" : "selected: copy it with Ctrl+C";
    }
  }
}
