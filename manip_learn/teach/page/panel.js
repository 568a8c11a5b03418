// The panel: the steps from a scene to what is taken home, as the program's state fills them.

const WAY_STEPS = { m: { factor: 100, unit: "cm", digits: 1 }, rad: { factor: 180 / Math.PI, unit: "°", digits: 0 } };
const DOING = { idle: "ready", recording: "recording", replaying: "replaying", learning: "learning", planning: "planning", running: "running", moving: "moving" };
const FREE_HANDS = ["idle", "recording"]; // the program does nothing by itself

const NO_WAY = "There is no way to go yet: in no recording does the gripper take hold of something and move it by 2 cm, or by 3°. Record one that does, and learn again.";

class Panel {
  constructor(teach) {
    Object.assign(this, { teach, say: (said) => teach.say(said), state: null });
    this.recordings = new RecordingList(get("recordings"), this.say);
    this.answer = new Answer(get("answer"), this.say);
    this.take = new Take(teach);
    this.wire();
  }

  wire() {
    const on = (id, action) => get(id).addEventListener("click", action), { say } = this;
    get("scene-kind").addEventListener("change", (event) => { say({ do: "scene", kind: event.target.value }); releaseFocus(event.target); });
    on("another", () => say({ do: "scene", kind: get("scene-kind").value }));
    on("home", () => say({ do: "home" }));
    on("record", () => this.record());
    on("learn", () => this.learn());
    on("truth", () => say({ do: "truth", show: !this.state.truth }));
    on("run", () => this.run());
    on("grip", () => this.grip());
    for (const button of document.querySelectorAll("[data-disturb]")) button.addEventListener("click", () => say({ do: "disturb", what: button.dataset.disturb }));
    on("policies", () => say({ do: "policies" }));
    on("compare", () => say({ do: "compare" }));
    on("no-ghosts", () => say({ do: "ghosts", show: false }));
    on("lead", () => this.teach.link.say({ do: "lead" }));
    get("way").addEventListener("input", () => { this.sayWay(); this.teach.sayOften({ do: "way", value: Number(get("way").value) }); });
    get("policy").addEventListener("change", (event) => releaseFocus(event.target));
    // what is typed, and the keys of sliders and boxes, are not those of the page
    get("teach").addEventListener("keydown", (event) => { if (isText(event.target) || (event.key === " " && event.target.matches("input"))) event.stopPropagation(); });
  }

  // ---- what keys and buttons do ----

  can(id) { return this.teach.allowed && !get(id).disabled && get(id).checkVisibility(); }

  record() { if (this.can("record")) this.say({ do: "record" }); }

  learn() { if (this.can("learn")) this.say({ do: "learn" }); }

  grip() { if (this.can("grip")) this.say({ do: "grip", closed: !this.teach.isHeld }); }

  run() {
    if (this.busy) { if (this.teach.allowed) this.say({ do: "stop" }); return; }
    if (!this.can("run")) return;
    const { way } = this.state, value = Number(get("way").value);
    this.say({ do: "run", policy: get("policy").value, ...(way ? { [way.unit === "rad" ? "turn" : "along"]: value } : {}), plan: get("plan").checked });
  }

  // ---- what the program says ----

  // The program moves the arm by itself, or thinks.
  get busy() { return Boolean(this.state) && !FREE_HANDS.includes(this.state.doing); }

  setScene({ kind, title, task }) {
    this.kind = kind;
    get("task").textContent = task || title || "";
    this.setKinds();
  }

  setKinds() {
    const select = get("scene-kind"), scenes = (this.state && this.state.scenes) || [], said = JSON.stringify(scenes);
    if (said !== this.scenesSaid) select.replaceChildren(...scenes.map(({ kind, title }) => Object.assign(document.createElement("option"), { value: kind, textContent: title })));
    if (said !== this.scenesSaid || this.kind !== this.shownKind) select.value = this.kind ?? select.value;
    Object.assign(this, { scenesSaid: said, shownKind: this.kind });
  }

  setState(state) {
    this.state = state;
    get("said").textContent = state.said || "";
    get("said").classList.toggle("lost", Boolean(state.wrong));
    this.setKinds();
    this.showRecording(state);
    this.showLearning(state);
    this.showRun(state);
    this.take.set(state.files || [], state.keep, Boolean(state.progress));
    this.showSteps(state);
  }

  showRecording({ recording, recordings, answer, doing }) {
    get("record").classList.toggle("on", Boolean(recording));
    get("record-words").textContent = recording ? `Stop (${recording.seconds.toFixed(1)} s)` : recordings.length ? "Record another one" : "Record";
    get("record").disabled = this.busy;
    get("show-hint").hidden = recordings.length >= 5;
    get("show-hint").textContent = recordings.length ? `${recordings.length} of 5: show it again, a little differently.` : "Press record, take the hand and do the task. Five motions are a good number, each a little different.";
    this.recordings.set(recordings, answer && answer.phaseKinds, this.busy || doing === "recording");
    for (const id of ["another", "home", "scene-kind"]) get(id).disabled = doing === "recording" || doing === "learning";
  }

  showLearning({ doing, recordings, progress, answer, truth }) {
    get("learn").disabled = doing !== "idle" || !recordings.length;
    get("learn").firstChild.textContent = recordings.length ? `Learn from ${counted(recordings.length, "motion")}` : "Learn";
    get("progress").hidden = !progress;
    if (progress) {
      get("progress-words").textContent = `${progress.step} …`;
      get("progress").querySelector("progress").value = progress.share;
    }
    this.answer.set(answer);
    get("truth-box").hidden = !answer;
    get("truth").setAttribute("aria-pressed", String(Boolean(truth)));
    get("truth").textContent = truth ? "Hide the truth" : "Show the truth";
    fillTruth(get("truth-words"), truth);
  }

  showRun({ doing, way, run, answer }) {
    const { busy } = this, acts = answer && !answer.refused;
    get("run").classList.toggle("on", busy && doing !== "learning");
    get("run-words").textContent = busy && doing !== "learning" ? `Stop ${doing === "moving" ? "" : DOING[doing] || doing}`.trim() : "Run";
    get("run").disabled = doing === "recording" || doing === "learning" || (!acts && !busy);
    for (const id of ["policies", "compare", "no-ghosts"]) get(id).disabled = busy;
    for (const button of document.querySelectorAll("[data-disturb]")) button.disabled = doing !== "running";
    get("way-field").hidden = !way;
    if (way) this.setWay(way);
    get("run-state").textContent = run ? run.ended || this.running(run, way) : "";
  }

  running({ policy, done, wanted }, way) {
    const unit = way ? way.unit : "m", words = (x) => (Number.isFinite(x) ? openingInWords(x, unit) : "");
    return `${policy}: ${[words(done), words(wanted)].filter(Boolean).join(" of ")}`;
  }

  setWay({ unit, low, high, value }) {
    const slider = get("way"), said = [unit, low, high].join();
    if (said !== this.waySaid) Object.assign(slider, { min: low, max: high });
    const dragged = document.activeElement === slider && this.teach.saidLately("way");
    if (said !== this.waySaid || (!dragged && value !== this.wayValue)) slider.value = value;
    Object.assign(this, { waySaid: said, wayValue: value, wayUnit: unit });
    this.sayWay();
  }

  sayWay() {
    const { factor, unit, digits } = WAY_STEPS[this.wayUnit], text = `${(factor * Number(get("way").value)).toFixed(digits)}${unit === "°" ? "°" : ` ${unit}`}`;
    get("way-value").textContent = text;
    get("way").setAttribute("aria-valuetext", text);
  }

  // Steps that cannot be taken yet say why; the next one stands out.
  showSteps({ recordings, answer, files, run, way }) {
    const shown = recordings.length > 0, learnt = Boolean(answer) && !answer.refused;
    const open = { scene: true, show: true, learn: shown || Boolean(answer), do: learnt && Boolean(way), take: shown || learnt || (files || []).length > 0 };
    const now = !shown ? "show" : !answer || answer.refused ? (recordings.length < 2 ? "show" : "learn") : !way ? "show" : run && run.ended && run.ordered !== false ? "take" : "do";
    get("do-hint").textContent = learnt ? NO_WAY : "Learn something first.";
    for (const [name, usable] of Object.entries(open)) {
      get(`step-${name}`).classList.toggle("later", !usable);
      get(`step-${name}`).classList.toggle("now", name === now);
    }
  }

  setPose({ near }) {
    const held = this.teach.isHeld;
    get("grip-words").textContent = held ? "Let go of the handle" : "Grip";
    get("grip").classList.toggle("ready", !held && near !== null && near !== undefined);
  }
}
