// The list of what was shown: names, phases, odd ones, replay, delete.

const CERTAIN = 3000; // [ms] in which a second press deletes

class RecordingList {
  constructor(element, say) { Object.assign(this, { element, say, rows: [] }); }

  set(recordings, kinds, busy) {
    while (this.rows.length > recordings.length) this.remove(this.rows.pop());
    while (this.rows.length < recordings.length) this.rows.push(this.row());
    recordings.forEach((recording, i) => this.fill(this.rows[i], recording, kinds, busy));
  }

  remove({ item }) {
    if (item.contains(document.activeElement)) get("record").focus();
    item.remove();
  }

  row() {
    const row = {}, button = (text, action) => make("button", { type: "button", onclick: () => action(row) }, text), span = (className) => make("span", { className });
    row.name = make("input", { type: "text", maxLength: 80, spellcheck: false, onchange: () => this.rename(row), onkeydown: (event) => this.endTyping(row, event.key) });
    Object.assign(row, { length: span("length"), odd: span("odd"), bands: span("bands") });
    Object.assign(row, { replay: button("Replay", ({ recording: { name } }) => this.say({ do: "replay", name })), discard: button("Delete", () => this.discard(row)) });
    row.item = make("li", {}, row.name, row.length, row.replay, row.discard, row.bands, row.odd);
    this.element.append(row.item);
    return row;
  }

  endTyping({ name, recording }, key) {
    if (key === "Escape") name.value = recording.name;
    if (key === "Enter" || key === "Escape") name.blur();
  }

  rename(row) {
    const to = row.name.value.trim();
    if (!to || to === row.recording.name) row.name.value = row.recording.name;
    else this.say({ do: "rename", name: row.recording.name, to });
  }

  // The second press deletes.
  discard(row) {
    if (row.sure === row.recording.name) { this.unsure(row); this.say({ do: "delete", name: row.recording.name }); return; }
    row.sure = row.recording.name;
    row.discard.textContent = "Sure?";
    row.timer = setTimeout(() => this.unsure(row), CERTAIN);
  }

  unsure(row) {
    clearTimeout(row.timer);
    row.sure = null;
    row.discard.textContent = "Delete";
  }

  fill(row, recording, kinds, busy) {
    if (row.sure && row.sure !== recording.name) this.unsure(row);
    row.recording = recording;
    if (document.activeElement !== row.name) row.name.value = recording.name;
    for (const [part, what] of Object.entries({ name: "Name of", replay: "Replay", discard: "Delete" })) row[part].setAttribute("aria-label", `${what} ${recording.name}`);
    row.length.textContent = `${recording.seconds.toFixed(1)} s`;
    row.odd.textContent = recording.odd ? `odd: ${recording.odd}` : "";
    row.odd.hidden = !recording.odd;
    row.replay.disabled = row.discard.disabled = busy;
    this.drawBands(row, recording, kinds);
  }

  drawBands({ bands }, { phases, seconds }, kinds = []) {
    if (!isNew(bands, [phases, kinds])) return;
    const parts = phases.map(([start, end, k]) => ({ start, end, kind: k < 0 ? { label: "free", colour: "var(--unclassified)" } : kinds[k] || { label: k + 1, colour: `var(--series-${k % SERIES})` } }));
    const words = parts.map(({ end, kind }) => `${kind.label} until ${end.toFixed(1)} s`).join(", ");
    bands.replaceChildren(...(phases.length ? [stripOf(parts, seconds, { role: "img", "aria-label": `Phases: ${words}` })] : []));
  }
}
