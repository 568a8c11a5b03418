// Start: read the data, build the page, say when it is ready.

function start() {
  const data = JSON.parse(get("data").textContent), show = new Show(data);
  fillNotes(data.notes);
  const player = document.body.dataset.mode === "live" ? new Live(show, data) : new Player(show);
  if (player instanceof Player) {
    show.shown = new Shown(data, show);
    fillDone(data.done);
    fillEvidence(data.evidence);
    player.arrangePanel();
  }
  window.manipLearn = {
    seek: (t) => player.seek?.(t),
    play: () => player.play?.(),
    pause: () => player.pause?.(),
    // Row-major 4 x 4 pose of a link in the robot's base, now.
    linkPose: (name, link) => {
      const rollout = show.rollouts.find((r) => r.name === name);
      if (!rollout) throw new Error(`no rollout ${name}`);
      return rollout.instance.linkMatrix(link).transpose().toArray();
    },
    // Every value under the cursor at time t: track -> rollout -> curve.
    trackValues: (t) => player.tracks.valuesAt(t),
    // Semi-axes of a rollout's ellipsoid at time t [m/s], longest first, and what it holds and leaves free now, and where.
    marks: (name, t) => {
      const { drawn } = show.rollouts.find((r) => r.name === name);
      return { ...Object.fromEntries(Object.entries(drawn.drawn).map(([k, v]) => [k, v.map((d) => d.toArray())])), ellipsoid: drawn.ellipsoidAt(t), pose: drawn.poseNow() };
    },
    // The place of a handle in the robot's base, now [m].
    handle: (name, k = 0) => show.rollouts.find((r) => r.name === name).pieces[k].mesh.position.toArray(),
    get time() { return show.time; },
    get duration() { return show.duration; },
    get playing() { return Boolean(player.playing); },
    // Whether the last frame had shadows and all pixels: without a graphics card those of a motion have not.
    get fullFrame() { return !show.stage || show.stage.quality.drawn === 0; },
    get drawing() { return Boolean(show.stage); },
  };
  window.manipLearnReady = true;
}
start();
