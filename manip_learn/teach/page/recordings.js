// The list of what was shown: names, phases, odd ones, replay, delete.

const CERTAIN = 3000; // [ms] in which a second press deletes
const BAND_COLOURS = ["#0072b2", "#d55e00", "#009e73", "#b2589a", "#c98600", "#3a9bd4", "#8c5f38"];

function phaseColour(kinds, k) { return k < 0 ? "var(--unclassified)" : (kinds && kinds[k] && kinds[k].colour) || BAND_COLOURS[k % BAND_COLOURS.length]; }

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
    const row = { item: document.createElement("li"), name: Object.assign(document.createElement("input"), { type: "text", maxLength: 80, spellcheck: false }) };
    for (const tag of ["length", "odd"]) row[tag] = Object.assign(document.createElement("span"), { className: tag });
    row.bands = svg("svg", { class: "bands", viewBox: "0 0 1000 6", preserveAspectRatio: "none", role: "img" });
    for (const [key, textContent] of [["replay", "Replay"], ["discard", "Delete"]]) row[key] = Object.assign(document.createElement("button"), { type: "button", textContent });
    row.name.addEventListener("change", () => this.rename(row));
    row.name.addEventListener("keydown", (event) => { if (event.key === "Enter") row.name.blur(); else if (event.key === "Escape") { row.name.value = row.recording.name; row.name.blur(); } });
    row.replay.addEventListener("click", () => this.say({ do: "replay", name: row.recording.name }));
    row.discard.addEventListener("click", () => this.discard(row));
    row.item.append(row.name, row.length, row.replay, row.discard, row.bands, row.odd);
    this.element.append(row.item);
    return row;
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
    row.name.setAttribute("aria-label", `Name of ${recording.name}`);
    row.replay.setAttribute("aria-label", `Replay ${recording.name}`);
    row.discard.setAttribute("aria-label", `Delete ${recording.name}`);
    row.length.textContent = `${recording.seconds.toFixed(1)} s`;
    row.odd.textContent = recording.odd ? `odd: ${recording.odd}` : "";
    row.odd.hidden = !recording.odd;
    row.replay.disabled = row.discard.disabled = busy;
    this.drawBands(row, recording, kinds);
  }

  drawBands(row, { phases, seconds }, kinds) {
    const said = JSON.stringify([phases, kinds]);
    row.bands.style.display = phases.length ? "" : "none";
    if (said === row.bandsSaid) return;
    row.bandsSaid = said;
    row.bands.replaceChildren();
    row.bands.setAttribute("aria-label", `Phases: ${phases.map(([, end, k]) => `${k < 0 ? "free" : (kinds && kinds[k] && kinds[k].label) || k + 1} until ${end.toFixed(1)} s`).join(", ")}`);
    for (const [start, end, k] of phases)
      svg("rect", { x: (1000 * start) / Math.max(seconds, 1e-9), y: 0, width: Math.max((1000 * (end - start)) / Math.max(seconds, 1e-9), 2), height: 6, style: `fill: ${phaseColour(kinds, k)}` }, row.bands);
  }
}
