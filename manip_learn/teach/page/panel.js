// The panel: the next step, and the cards from a scene to what is taken home, as the program's state fills them.

const FREE_HANDS = ["idle", "recording"]; // the program does nothing by itself
const FEW = 3, ENOUGH = 5; // recordings without which nothing can be learnt, and that a person is asked for, as the program has them
const NO_WAY = "There is no way to go yet: in no recording does the gripper grasp something and move it by 2 cm, or by 3°. Record one that does, and learn again.";

class Panel {
  constructor(teach) {
    Object.assign(this, { teach, say: (said) => teach.say(said), state: null });
    this.recordings = new RecordingList(get("recordings"), this.say);
    this.take = new Take(teach);
    this.wire();
  }

  wire() {
    const on = (id, action) => get(id).addEventListener("click", action), { say } = this;
    get("scene-kind").addEventListener("change", (event) => say({ do: "scene", kind: event.target.value }));
    on("another", () => say({ do: "scene", kind: get("scene-kind").value }));
    for (const id of ["home", "compare", "record", "learn"]) on(id, () => this.press(id));
    for (const id of ["run", "grip"]) on(id, () => this[id]());
    on("truth", () => say({ do: "truth", show: !this.state.truth }));
    on("no-ghosts", () => say({ do: "ghosts", show: false }));
    on("again", () => this.teach.ghosts && this.teach.ghosts.play());
    on("lead", () => this.teach.link.say({ do: "lead" }));
    get("teach").addEventListener("keydown", (event) => { if (event.target.matches("input")) event.stopPropagation(); }); // what is typed is not for the page
    for (const kind of ["click", "change"]) document.addEventListener(kind, ({ target }) => { const one = target.closest?.("button, select, summary"); if (one) releaseFocus(one); });
  }

  // ---- what keys and buttons do ----

  can(id) { return this.teach.allowed && !get(id).disabled && get(id).checkVisibility(); }

  press(id) { if (this.can(id)) this.say({ do: id }); }

  grip() { if (this.teach.allowed) this.say({ do: "grip", closed: !this.teach.isHeld }); }

  run() {
    if (this.drives) this.say({ do: "stop" });
    else this.press("run");
  }

  // ---- what the program says ----

  // The program moves the arm by itself, or thinks.
  get busy() { return Boolean(this.state) && !FREE_HANDS.includes(this.state.doing); }

  get drives() { return this.busy && this.state.doing !== "learning"; }

  setScene({ kind, title, handles }) {
    Object.assign(this, { title, handles });
    get("scene-kind").value = kind;
    get("another").textContent = `New ${handles.length ? handles[0].name : "scene"}`;
  }

  setState(state) {
    this.state = state;
    get("said").textContent = state.said || "";
    get("said").classList.toggle("lost", Boolean(state.wrong));
    this.showActions(state);
    this.showRecordings(state);
    this.showLearning(state);
    this.showRun(state);
    this.take.set(state.files || [], state.keep);
    this.showSteps(state);
  }

  // ---- the next step ----

  nextOf({ doing, recordings, unlearnt, answer, can, run }) {
    if (this.drives) return "run";
    if (doing === "recording") return "record";
    if (doing === "learning") return "learn";
    if (can.run && !unlearnt) return run && run.ended && run.ordered ? "home" : "run";
    return unlearnt && recordings.length >= (answer ? FEW : ENOUGH) ? "learn" : "record";
  }

  showActions(state) {
    const { doing, recording, recordings: { length }, unlearnt, can, progress } = state, next = this.nextOf(state), idle = doing === "idle";
    const words = {
      record: recording ? `Stop (${recording.seconds.toFixed(1)} s)` : length < ENOUGH ? `Record ${length + 1} of ${ENOUGH}` : "Record another one",
      learn: doing === "learning" ? "Learning …" : "Learn", run: this.drives ? "Stop" : "Let the arm do it",
    };
    const seen = { record: recording || idle, learn: doing === "learning" || (idle && length >= FEW && unlearnt > 0), run: this.drives || (idle && can.run), home: idle };
    for (const [id, visible] of Object.entries(seen)) {
      const button = get(id);
      button.hidden = !visible;
      button.classList.toggle("next", id === next);
      if (words[id]) button.querySelector("span:not(.dot)").textContent = words[id];
    }
    get("record").classList.toggle("on", Boolean(recording));
    get("run").classList.toggle("on", this.drives);
    get("learn").disabled = doing === "learning";
    get("progress").hidden = !progress;
    if (!progress) return;
    get("progress-words").textContent = `${progress.step} …`;
    get("progress").querySelector("progress").value = progress.share;
  }

  // ---- the cards ----

  showRecordings({ recordings, answer, doing }) {
    this.recordings.set(recordings, answer && answer.phaseKinds, this.busy || doing === "recording");
    for (const id of ["another", "scene-kind"]) get(id).disabled = doing === "recording" || doing === "learning";
  }

  showLearning({ answer, truth }) {
    fillAnswer(get("answer"), answer, this.say);
    get("headline").textContent = get("headline").title = (answer && (answer.line || answer.sentence)) || (this.teach.scene && this.teach.scene.task) || "";
    get("truth-box").hidden = !answer;
    get("truth").setAttribute("aria-pressed", String(Boolean(truth)));
    get("truth").textContent = truth ? "Hide the truth" : "Show the truth";
    fillTruth(get("truth-words"), truth);
  }

  showRun({ can, run }) {
    for (const id of ["compare", "no-ghosts"]) get(id).disabled = this.busy;
    get("compare").hidden = !can.compare;
    const notes = (run && run.notes) || [];
    if (get("run-notes").children.length !== notes.length) get("run-notes").replaceChildren(...notes.map((text) => paragraph(text, "hint")));
  }

  // Each card in a line; the one that is at hand is open, until another one is.
  showSteps(state) {
    const { doing, recordings, answer, can, run } = state, shown = recordings.length > 0, learnt = Boolean(answer) && !answer.refused;
    const done = run && run.wanted ? `${openingInWords(run.done, run.unit)} of ${openingInWords(run.wanted, run.unit)}` : "";
    const short = {
      scene: this.title || "", show: "", learn: !answer ? "" : learnt ? answer.line : "not understood yet",
      do: can.run ? done : learnt ? "no way to go yet" : "after learning", take: shown ? "" : "after the first motion",
    };
    const next = this.nextOf(state), now = can.run && (next === "run" || next === "home") ? "do" : answer && next === "record" && doing === "idle" ? "learn" : "show";
    for (const [name, words] of Object.entries(short)) {
      const step = get(`step-${name}`);
      step.querySelector(".short").textContent = words;
      step.inert = { learn: !answer, do: !can.run, take: !shown }[name] || false;
      step.classList.toggle("now", name === now);
      if (step.inert || this.now !== now) step.open = name === now && !step.inert;
    }
    if (this.now !== now) get(`step-${now}`).scrollIntoView({ block: "nearest" });
    this.now = now;
    get("no-way").textContent = learnt && !can.run ? NO_WAY : "";
  }

  setPose({ near }) {
    const held = this.teach.isHeld, handle = held && this.handles[this.teach.pose.held.indexOf(true)];
    get("grip-words").textContent = held ? "Let go" : "Grip";
    get("grip").hidden = !held && !Number.isFinite(near);
    get("holding").hidden = !held || this.drives; // the arm that drives does the pulling
    const words = handle ? `Holding the ${handle.name}. ${handle.move}. To let go:` : "";
    if (get("holding").textContent !== words) get("holding").textContent = words;
  }
}
