// The first steps in words: the one that has not been done yet, until all are.

const TOUR_KEY = "manip-learn-tour", TOUCH = matchMedia("(pointer: coarse)");
const TOUR = [
  { title: "Take the hand", text: () => (TOUCH.matches ? "Put a finger on the ring at the tip of the arm, and draw it." : "Press on the ring at the tip of the arm, or on any link, and drag."), done: ({ pulled }) => pulled },
  { title: "Try the task", text: ({ name, move }) => `Draw the ${name} by its handle: the hand comes to it and takes hold. ${move}.`, done: ({ moved, scene }) => moved || !scene.handles.length },
  { title: "Show it five times", text: () => "Press Record, do the task, press Stop; a little differently each time.", done: ({ state }) => state.recordings.length >= ENOUGH || state.answer },
  { title: "Learn", text: () => "The program says in one sentence what holds the hand, and how sure it is.", done: ({ state }) => state.answer && !state.answer.refused },
  { title: "Let the arm do it", text: () => "Push it meanwhile: it gives way and stops, and goes on when you ask again.", done: ({ state }) => state.run },
];

class Tour {
  constructor(teach) {
    Object.assign(this, { teach, box: get("tour"), on: !this.seen });
    get("tour-skip").addEventListener("click", () => this.turn(false));
    get("tour-again").addEventListener("click", () => { Object.assign(teach, { pulled: false, moved: false }); this.turn(true); });
  }

  get seen() { try { return sessionStorage.getItem(TOUR_KEY) === "seen"; } catch { return false; } }

  turn(on) {
    this.on = on;
    try { sessionStorage.setItem(TOUR_KEY, on ? "" : "seen"); } catch { /* no storage: once for each time it is loaded */ }
  }

  frame() {
    const { teach, box } = this, { state, scene } = teach, step = this.on && state && scene ? TOUR.findIndex(({ done }) => !done(teach)) : -1;
    box.hidden = step < 0;
    if (box.hidden) return;
    box.classList.toggle("brief", Boolean((teach.hand && teach.hand.held) || state.recording));
    const { title, text } = TOUR[step], words = [`${step + 1} of ${TOUR.length}: ${title}`, text(scene.handles[0] || {})];
    if (words.join() !== this.said) [this.box.querySelector("b").textContent, this.box.querySelector("span").textContent] = words;
    this.said = words.join();
  }
}
