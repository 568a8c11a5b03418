// Start: read the data, build the page, say when it is ready.

function fillNotes(notes) {
  const box = get("notes");
  box.hidden = notes.length === 0;
  box.querySelector("summary").textContent = notes.length === 1 ? "1 note" : `${notes.length} notes`;
  for (const note of notes) {
    const item = document.createElement("li");
    item.textContent = note;
    box.querySelector("ul").append(item);
  }
}

function start() {
  const data = JSON.parse(get("data").textContent), show = new Show(data);
  fillNotes(data.notes);
  const player = document.body.dataset.mode === "live" ? new Live(show, data) : new Player(show);
  window.manipLearn = {
    seek: (t) => player.seek(t),
    play: () => player.play(),
    pause: () => player.pause(),
    // Row-major 4 x 4 pose of a link in the robot's base, now.
    linkPose: (name, link) => {
      const rollout = show.rollouts.find((r) => r.name === name);
      if (!rollout) throw new Error(`no rollout ${name}`);
      return rollout.instance.linkMatrix(link).transpose().toArray();
    },
    get time() { return show.time; },
    get duration() { return show.duration; },
    get playing() { return Boolean(player.playing); },
    // Where the camera stands, in the robot's base [m].
    get eye() { return show.stage.eye().toArray(); },
    get drawing() { return Boolean(show.stage); },
  };
  window.manipLearnReady = true;
}
start();
