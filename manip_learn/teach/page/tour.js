// Five steps that are pointed at, one after the other.

const TOUR_KEY = "manip-learn-tour", TOUR_GAP = 14; // [px] between what is pointed at and the words
const COMES = "Draw the hand over the handle: it comes to it, and the gripper closes by itself.";
const TASK_TITLES = { drawer: "Open the drawer", door: "Open the door", "loose-door": "Open the door", table: "Wipe the table", screw: "Turn the crank", two: "Open both", free: "Move about" };
const TASK_TEXTS = {
  drawer: `${COMES} Then pull it open and push it shut; G lets go.`,
  door: `${COMES} Then swing it open and shut it; G lets go.`,
  "loose-door": `${COMES} Then swing it open and shut it; G lets go.`,
  table: "Draw the hand over the sponge: it comes to it, and the gripper closes by itself. Then wipe to and fro, in both directions; G lets go.",
  screw: "Draw the hand over the crank: it comes to it, and the gripper closes by itself. Then turn it a quarter turn or more, and back; G lets go.",
  two: `${COMES} Open and shut the drawer, let go with G, and do the same with the door.`,
  free: "Nothing holds the hand here. Move it about as you like, to see that nothing is learnt from it.",
};
const TOUR = [
  { title: "Take the hand", text: "Press on the tip of the arm, or on any link, and drag. A line shows how hard you pull; the arm follows as a real one would.", at: (teach) => teach.ringBox(), done: (teach) => teach.pulled },
  { title: (kind) => TASK_TITLES[kind] || "Do the task", text: (kind) => TASK_TEXTS[kind] || "Bring the hand to the handle: the gripper closes by itself. Then move it; G lets go.", at: (teach) => teach.handleBox() || boxOf("grip"), done: (teach) => teach.moved },
  { title: "Record five", text: "Press Record before a motion and again after it. Show five, each a little different.", at: () => boxOf("record"), done: (teach) => teach.state && teach.state.recordings.length >= 5 },
  { title: "Learn", text: "The program says in one sentence what holds the hand, and how sure it is. If it is not, it says what to show next.", at: () => boxOf("step-learn"), done: (teach) => teach.state && teach.state.answer && !teach.state.answer.refused },
  { title: "Run", text: "Say how far, press Run, and the arm does it. Push its elbow meanwhile: it gives way and stops; Run goes on from there.", at: () => boxOf("step-do"), done: (teach) => teach.state && teach.state.doing === "running" },
];

function boxOf(id) {
  const element = get(id);
  return element.checkVisibility() ? { element, ...element.getBoundingClientRect().toJSON() } : null;
}

class Tour {
  constructor(teach) {
    this.teach = teach;
    this.box = Object.assign(document.createElement("section"), { id: "tour", hidden: true });
    this.ring = Object.assign(document.createElement("div"), { id: "tour-ring", hidden: true });
    this.ring.setAttribute("aria-hidden", "true");
    this.box.setAttribute("role", "dialog");
    this.box.setAttribute("aria-labelledby", "tour-title");
    this.box.setAttribute("aria-describedby", "tour-text");
    const make = (tag, more) => Object.assign(document.createElement(tag), more), row = make("div", { className: "row" });
    this.title = make("h2", { id: "tour-title" });
    this.text = make("p", { id: "tour-text" });
    this.count = make("span", { className: "count" });
    this.next = make("button", { type: "button", id: "tour-next", className: "primary" });
    this.skip = make("button", { type: "button", id: "tour-skip", textContent: "Skip" });
    row.append(this.count, this.skip, this.next);
    this.box.append(this.title, this.text, row);
    document.body.append(this.ring, this.box);
    this.next.addEventListener("click", () => this.go(this.step + 1));
    this.skip.addEventListener("click", () => this.end());
    this.box.addEventListener("keydown", (event) => this.key(event));
    get("tour-again").addEventListener("click", () => this.start());
  }

  get seen() { try { return sessionStorage.getItem(TOUR_KEY) === "seen"; } catch { return Boolean(this.ended); } }

  // Once in a tab, when there is something to point at.
  offer() { if (!this.offered && !this.seen) this.start(); this.offered = true; }

  start() {
    this.before = document.activeElement;
    this.offered = true;
    this.step = -1;
    this.go(0);
    this.next.focus({ preventScroll: true });
  }

  go(step) {
    if (step >= TOUR.length) { this.end(); return; }
    if (step < 0) return;
    this.step = step;
    this.box.hidden = false;
    this.sayStep();
    this.count.textContent = `${step + 1} of ${TOUR.length}`;
    this.next.textContent = step + 1 < TOUR.length ? "Next" : "Done";
    this.skip.hidden = step + 1 === TOUR.length;
    this.wasDone = Boolean(TOUR[step].done(this.teach));
    const target = TOUR[step].at(this.teach);
    if (target && target.element) target.element.scrollIntoView({ block: "nearest" });
    this.place();
  }

  // The words of this scene.
  sayStep() {
    const kind = this.teach.scene && this.teach.scene.kind, words = (x) => (typeof x === "function" ? x(kind) : x), { title, text } = TOUR[this.step];
    this.title.textContent = words(title);
    this.text.textContent = words(text);
  }

  end() {
    this.ended = true;
    try { sessionStorage.setItem(TOUR_KEY, "seen"); } catch { /* no storage: once for each time it is loaded */ }
    const inside = this.box.contains(document.activeElement);
    this.box.hidden = this.ring.hidden = true;
    if (inside) (this.before && this.before !== document.body && this.before.isConnected ? this.before : get("scene")).focus({ preventScroll: true });
  }

  key(event) {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (by) { if (this.step + by < TOUR.length) this.go(this.step + by); stop(event); }
    if (event.key === "Escape") { this.end(); stop(event); }
    event.stopPropagation();
  }

  // Whoever does a step need not press Next.
  frame() {
    if (this.box.hidden) return;
    if (!this.wasDone && TOUR[this.step].done(this.teach)) this.go(this.step + 1);
    if (!this.box.hidden) this.place();
  }

  place() {
    const target = TOUR[this.step].at(this.teach), w = innerWidth, h = innerHeight;
    this.ring.hidden = !target;
    if (target) {
      Object.assign(this.ring.style, { left: `${target.x - 5}px`, top: `${target.y - 5}px`, width: `${target.width + 10}px`, height: `${target.height + 10}px` });
      this.ring.classList.toggle("round", Boolean(target.round));
    }
    if (PHONE.matches) { this.box.style.left = this.box.style.top = ""; return; } // at the foot of the window
    const { offsetWidth: wide, offsetHeight: high } = this.box, at = target || { x: w / 2, y: h / 2, width: 0, height: 0 };
    if (at.round) { // below it: what is beside a handle is what it opens
      const below = at.y + at.height + TOUR_GAP, y = below + high < h - 8 ? below : at.y - TOUR_GAP - high;
      Object.assign(this.box.style, { left: `${Math.min(Math.max(at.x + at.width / 2 - wide / 2, 8), w - wide - 8)}px`, top: `${Math.max(y, 8)}px` });
      return;
    }
    const left = at.x - TOUR_GAP - wide, right = at.x + at.width + TOUR_GAP, x = left > 8 && (at.x > w / 2 || right + wide > w - 8) ? left : Math.min(right, w - wide - 8);
    Object.assign(this.box.style, { left: `${Math.max(x, 8)}px`, top: `${Math.min(Math.max(at.y + Math.min(at.height, 60) / 2 - high / 2, 8), h - high - 8)}px` });
  }
}
