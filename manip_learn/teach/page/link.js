// The line to the program: what it says comes as events, what the person does is posted.

// [ms]: least time between two pulls, one a frame of the screen; until a line that was lost is tried again
const PULL_GAP = 1000 / 60, RETRY = 2000;
const PAGE_ID = [...crypto.getRandomValues(new Uint8Array(12))].map((byte) => byte.toString(16).padStart(2, "0")).join("");

class TeachLink {
  // slots: name -> what is done with its newest value; onOpen(true or false) when the line is there or lost.
  constructor(root, slots, onOpen, onRefused) {
    Object.assign(this, { root, slots, onOpen, onRefused, open: false, seq: 0, hand: [], sent: new Map(), latencies: [], spoken: Promise.resolve() });
    this.listen();
    if (navigator.serviceWorker) navigator.serviceWorker.register(`${root}afterwards.js`).catch(() => {}); // it says that the program has ended to who comes later
  }

  listen() {
    this.source = new EventSource(`${this.root}events?page=${PAGE_ID}`);
    for (const [slot, receive] of Object.entries(this.slots))
      this.source.addEventListener(slot, (event) => { this.setOpen(true); receive(JSON.parse(event.data)); });
    this.source.onopen = () => this.setOpen(true);
    this.source.onerror = () => {
      this.setOpen(false);
      if (this.source.readyState === EventSource.CLOSED) setTimeout(() => this.listen(), RETRY);
    };
  }

  close() {
    this.source.close();
    this.setOpen(false);
  }

  setOpen(open) {
    if (open === this.open) return;
    this.open = open;
    this.onOpen(open);
  }

  post(said, more = {}) {
    return fetch(`${this.root}said?page=${PAGE_ID}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(said), ...more });
  }

  // In the order in which it was said.
  say(said) {
    this.spoken = this.spoken.then(() => this.post(said)).then(
      (answer) => { if (!answer.ok) this.onRefused(answer.status === 413 ? "That is too much at once: at most 16 MB." : `The program did not accept that (${answer.status}).`); },
      () => this.onRefused("The program did not hear that: is it still running?"),
    );
    return this.spoken;
  }

  // The newest pull; one that still waits gives way to it, a release that waits does not.
  pull(said) {
    this.hand = this.hand.filter((one) => one.do !== "pull");
    this.hand.push(said);
    this.pump();
  }

  release() {
    this.hand = [{ do: "release" }];
    this.pump();
  }

  // When the page goes away.
  releaseNow() {
    this.hand = [];
    this.post({ do: "release" }, { keepalive: true }).catch(() => {});
  }

  // One at a time, so that a slow answer leaves no queue behind it.
  async pump() {
    if (this.busy || !this.hand.length) return;
    this.busy = true;
    const early = (this.pulled ?? -Infinity) + PULL_GAP - performance.now();
    if (early > 0) await new Promise((resolve) => setTimeout(resolve, early));
    const said = this.hand.shift();
    try {
      if (said) await this.post(said.do === "pull" ? this.numbered(said) : said);
    } catch {
      this.setOpen(false); // the stream says when it is back
    }
    this.busy = false;
    this.pump();
  }

  numbered(said) {
    this.pulled = performance.now();
    this.sent.set(++this.seq, this.pulled);
    return { ...said, seq: this.seq };
  }

  // A page that was loaded again goes on counting where the one before it ended.
  heard(seq) { if (Number.isFinite(seq)) this.seq = Math.max(this.seq, seq); }

  // The picture shows what followed from all pulls up to this one: how long that took [ms].
  drawn(seq) {
    for (const [one, when] of this.sent) if (one <= seq && this.sent.delete(one)) this.latencies.push(performance.now() - when);
    this.latencies = this.latencies.slice(-500);
  }
}
