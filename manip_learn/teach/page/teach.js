// An arm that is taken by the hand: poses come from the program, the newest one is drawn; what the person does is posted.

const LIVE_SECONDS = 20; // of manipulability that stay in the chart
const MARK_SHARE = 0.7; // of the size of the scene, which encloses all that the arm can reach, for which marks are drawn
const MOST_LABELLED = 3; // ghosts that are named at a time
const WORDS_GAP = 200; // [ms] between two readings of the time in the headline

// All of a pose that can be seen, to a hundredth of a millimetre or a thousandth of a degree.
function inPicture({ seq, time, mu, ...seen }) {
  return JSON.stringify(seen, (_, x) => (typeof x === "number" ? Math.round(1e5 * x) : x));
}

class Teach {
  constructor(show, data) {
    Object.assign(this, { show, stage: show.stage, rollout: show.rollouts[0], instance: show.rollouts[0].instance, state: null, scene: null, pose: null, drawnSeq: 0, notes: data.notes });
    this.rollout.solid = true;
    Object.assign(this.rollout, { curveTimes: [], curve: [] });
    this.arrange();
    this.link = new TeachLink(data.events.slice(0, -"events".length), {
      ended: () => { this.ended = true; this.link.close(); }, pose: (pose) => this.receive(pose), scene: (scene) => this.setScene(scene), state: (state) => this.setState(state), ghosts: (ghosts) => this.ghosts && this.ghosts.set(ghosts),
    }, () => this.allow(), (words) => this.tell(words, true));
    this.panel = new Panel(this);
    if (this.stage) this.addDrawing();
    this.wire();
    this.allow();
    sayHead("waiting for the arm", false);
    show.setTime(0);
    requestAnimationFrame((now) => this.frame(now));
  }

  arrange() {
    get("step-do").append(get("panel")); // of what is of interest while the arm does it
    get("scene").after(get("hand-bar"), get("drop-here"));
    get("keys").querySelector("dl").replaceChildren(get("teach-keys").content.cloneNode(true));
    get("scene").setAttribute("aria-label", "The arm in three dimensions: drag it, or press H and move its hand by the arrow keys; otherwise arrow keys turn the view, plus and minus zoom");
    this.chart = new Chart(get("chart"), this.show.rollouts, LIVE_SECONDS, null);
  }

  addDrawing() {
    const { stage, instance } = this, size = MARK_SHARE * stage.size;
    this.pointing = new Pointing(stage, instance);
    this.furniture = new TeachFurniture(stage, instance);
    this.marks = new LiveMarks(instance, size);
    this.spring = new Spring(this.marks);
    this.trail = new TipTrail(this.rollout, size);
    this.lines = new Lines(stage);
    stage.world.add(this.marks.group, this.spring.group, this.trail.mesh, this.lines.group);
    this.rings = [0, 1].map(() => make("div", { className: "ring", "aria-hidden": "true" }));
    stage.element.append(...this.rings);
    this.key = new SceneKey(stage, this.rows());
    stage.onRendered = () => this.placeRings();
    this.ghosts = new Ghosts(this);
    this.hand = new Hand(this);
  }

  // What the marks in the picture are, and what the arm feels.
  rows() {
    const now = (say) => () => this.pose && say(this.pose), { marks, lines } = this;
    return [
      { ink: "--weak", say: now(({ weak }) => weak && "the hand can hardly move this way") },
      { ink: "--weak", say: now(({ limit }) => limit.map((name) => `${name} is at its limit`).join(", ")) },
      { ink: "--weak", form: "ball", say: now(({ touches }) => touches.length && "the arm touches the furniture") },
      { ink: "--free", say: now((pose) => pose.marks && (marks.drawn.free.length ? "free to move" : marks.drawn.freeTurns.length && "free to turn")) },
      { ink: "--held-mark", say: now((pose) => pose.marks && (marks.drawn.held.length ? "held" : marks.drawn.heldTurns.length && "may not turn")) },
      { ink: "--scene-ink", form: "line", say: () => lines.shown.learnt && (MECHANISM_WORDS[this.state.answer.mechanism.type] || "learnt") },
      { ink: "--truth", form: "line", say: () => lines.shown.truth && "the truth" },
      { ink: "--scene-ink", form: "ball", say: now((pose) => this.furniture.words(pose)) },
    ];
  }

  wire() {
    wireCamera(this.show);
    const once = (action) => (event) => { if (!event.repeat) action(); };
    wireKeys({
      ...cameraKeys(this.show), r: once(() => this.panel.press("record")), l: once(() => this.panel.press("learn")), g: once(() => this.panel.grip()),
      h: once(() => this.hand && this.hand.turnByKeys()), n: once(() => this.hand && this.hand.toNearest()), " ": once(() => this.panel.run()),
    });
    get("by-keys").addEventListener("click", () => this.hand && this.hand.turnByKeys());
    window.addEventListener("beforeunload", (event) => { if (this.allowed && this.state.unlearnt) event.preventDefault(); });
  }

  // ---- who may ----

  get leads() { return !this.state || !this.state.leader || this.state.leader === PAGE_ID; }

  // Whether what is done here counts: the line is there, and no other tab has the arm.
  get allowed() { return Boolean(this.link && this.link.open && this.state && this.leads); }

  get isHeld() { return Boolean(this.pose && this.pose.held.some(Boolean)); }

  allow() {
    if (!this.panel) return;
    const lost = !this.link.open, { allowed } = this;
    get("controls").disabled = get("grip").disabled = get("by-keys").disabled = !allowed;
    get("lead").hidden = lost;
    get("banner").hidden = lost ? !this.wasOpen : this.leads;
    const words = this.ended ? "The program has ended. Start it again, and open its new page." : lost ? "The connection to the program is lost. Is it still running? This page comes back by itself." : "Another tab has the arm.";
    if (get("banner").querySelector("p").textContent !== words) get("banner").querySelector("p").textContent = words;
    this.wasOpen ||= !lost;
    if (lost && this.wasOpen) sayHead(this.ended ? "the program has ended" : "no connection to the program", true);
    if (!allowed && this.hand) this.hand.letGo();
  }

  say(said) { if (this.allowed) this.link.say(said); }

  // What the page itself has to say; refusals are seen as well as heard.
  tell(words, wrong = false) {
    get("alerts").textContent = wrong ? "" : words;
    if (!wrong) return;
    get("said").textContent = words;
    get("said").classList.add("lost");
  }

  // ---- what the program says ----

  receive(pose) {
    this.link.heard(pose.seq);
    this.pose = pose;
    this.isNew = true;
    this.changed ||= pose.mu !== null;
    if (pose.mu !== null) addNewest(this.rollout, pose.time, pose.mu, LIVE_SECONDS);
    if (isNew(this, inPicture(pose)) && this.stage) this.stage.dirty(); // an arm that rests need not be drawn again
  }

  setScene(scene) {
    const isNew = !this.scene || this.scene.number !== scene.number;
    this.scene = scene;
    this.panel.setScene(scene);
    fillNotes([...this.notes, ...scene.notes]);
    if (!this.stage) return;
    this.furniture.setScene(scene);
    if (isNew) this.trail.clear();
    this.stage.dirty();
  }

  setState(state) {
    this.state = state;
    this.panel.setState(state);
    this.allow();
    if (!this.stage) return;
    this.lines.setState(state);
    this.stage.dirty();
  }

  // ---- what is drawn ----

  frame(now) {
    if (this.pose && this.isNew) this.draw(this.pose);
    if (this.stage) {
      this.drawSpring();
      this.ghosts.frame(now);
      this.trail.draw(now);
      this.stage.render();
    }
    if (this.isNew) {
      Object.assign(this, { isNew: false, drawnSeq: this.pose.seq });
      this.link.drawn(this.drawnSeq);
    }
    this.drawWords(now);
    requestAnimationFrame((next) => this.frame(next));
  }

  draw(pose) {
    this.instance.setValues(pose.values);
    this.show.time = pose.time;
    this.panel.setPose(pose);
    if (!this.stage) return;
    this.hand.setPose(pose);
    this.furniture.setPose(pose);
    this.marks.setPose(pose);
    if (pose.trail && !this.wasTrail) this.trail.clear();
    if (pose.trail) this.trail.add(pose.time);
    this.wasTrail = pose.trail;
  }

  // The own hand is drawn where the pointer is now, not where the program last heard of it.
  drawSpring() {
    const { held, axis } = this.hand, told = this.pose && this.pose.hand;
    if (held) this.spring.set(this.hand.heldAt(), held.to, told || {}, held.drag && axis);
    else if (told) this.spring.set(new THREE.Vector3(...told.at), new THREE.Vector3(...told.to), told);
    else this.spring.set(null);
  }

  drawWords(now) {
    if (now < (this.worded ?? 0) + WORDS_GAP || !this.pose) return;
    this.worded = now;
    const { weak, limit, touches } = this.pose, doing = this.state && this.state.doing;
    if (this.link.open) sayHead(doing === "idle" ? "ready" : doing || "live", false);
    const words = [weak && "The hand can hardly move this way.", touches.length && "The arm touches the furniture.", ...limit.map((name) => `${name} is at its limit.`)].filter(Boolean).join(" ");
    if (words !== this.warned) this.tell(words);
    this.warned = words;
    if (this.key) this.key.update();
    if (this.changed && get("step-do").open && !(this.ghosts && this.ghosts.curves)) this.drawChart();
  }

  // The manipulability of the ghosts, or else of the arm lately.
  drawChart() {
    this.changed = false;
    const { rollout, chart } = this, curves = this.ghosts && this.ghosts.curves, last = rollout.duration;
    const shown = curves ? this.ghosts : { rollouts: this.show.rollouts, duration: LIVE_SECONDS };
    Object.assign(chart, { rollouts: shown.rollouts, duration: shown.duration, start: curves ? 0 : Math.max(0, last - LIVE_SECONDS) });
    chart.draw();
    chart.setTime(curves ? this.ghosts.time : last);
  }

  // Around the tip, and around the handle until the hand holds it.
  placeRings() {
    const rests = this.allowed && !this.hand.held && !this.isHeld, [piece] = this.furniture.pieces;
    [rests && this.instance.tipPosition(), rests && this.state.doing === "recording" && piece && piece.handleAt()].forEach((place, i) => {
      const at = place && this.stage.onScreen(place);
      this.rings[i].hidden = !at;
      if (at) this.rings[i].style.transform = `translate(${at.x.toFixed(1)}px, ${at.y.toFixed(1)}px)`;
    });
  }

  // ---- where things are on the page ----

  // Of each handle, in the robot's base.
  handlePlaces() { return this.pose ? this.pose.furniture.map(([x, y, z]) => new THREE.Vector3(x, y, z)) : []; }
}

function startTeaching() {
  const data = JSON.parse(get("data").textContent), teach = new Teach(new Show(data), data);
  window.manipLearnTeach = {
    id: PAGE_ID,
    get pose() { return teach.pose; },
    get state() { return teach.state; },
    get scene() { return teach.scene; },
    // Where a place in the robot's base is on the page [px]; null behind the camera.
    screenOf: (point) => teach.pointing.onPage(new THREE.Vector3(...point)),
    tipOnScreen: () => teach.pointing.onPage(teach.instance.tipPosition()),
    tip: () => teach.instance.tipPosition().toArray(),
    // Of the newest pose that has been drawn.
    get drawnSeq() { return teach.drawnSeq; },
    get latencies() { return [...teach.link.latencies]; },
    // Row-major 4 x 4 pose of a link in the robot's base, as drawn.
    linkPose: (link) => teach.instance.linkMatrix(link).transpose().toArray(),
    // From the scene to the eye, unit vector in the robot's base.
    toEye: () => teach.pointing.toEye().toArray(),
    // What the person pulls: link, place, and the number of a handle that it goes to; null without a pull.
    get pull() { const held = teach.hand && teach.hand.held; return held ? { link: held.link, to: held.to.toArray(), toHandle: held.toHandle } : null; },
    get allowed() { return teach.allowed; },
  };
  window.manipLearnReady = true;
}
startTeaching();
