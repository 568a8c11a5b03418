// A robot that is moving now: poses arrive from the program, the newest one is drawn.

const LIVE_SPAN = 20; // seconds of manipulability that stay in the chart
const TAIL_SPAN = 6; // seconds of the tip's way that stay in the picture

class Live {
  constructor(show, data) {
    Object.assign(this, { show, playing: true });
    this.rollout = show.rollouts[0];
    this.rollout.solid = true;
    Object.assign(this.rollout, { curveTimes: [], curve: [] });
    this.chart = new Chart(get("chart"), show.rollouts, LIVE_SPAN, null);
    this.legend = new Legend(get("legend"), show.rollouts, { onShow: (r, v) => show.show(r, v), onSolid: () => {} });
    get("panel").hidden = true;
    wireCamera(show);
    wireKeys(cameraKeys(show));
    this.trail = new TipTrail(this.rollout, show.stage ? show.stage.size : 1, TAIL_SPAN);
    this.rollout.instance.root.add(this.trail.mesh);
    this.addMarks(data);
    show.setTime(0);
    this.source = new EventSource(data.events);
    this.source.onmessage = (event) => this.receive(JSON.parse(event.data));
    this.source.onopen = () => sayHead("live", false);
    this.source.onerror = () => sayHead("no connection to the program", true);
    sayHead("waiting for the first pose", false);
    requestAnimationFrame(() => this.frame());
  }

  // A mechanism is drawn where it is; otherwise the directions at the tip. The ellipsoid is of one posture alone.
  addMarks({ ellipsoidScale }) {
    const [marks] = this.rollout.marks, { stage, mechanisms } = this.show;
    if (!marks || !stage) return;
    this.marks = this.rollout.drawn = new ConstraintMarks(marks, this.rollout.instance, stage.size, ellipsoidScale);
    this.marks.parts.constraint.visible = !mechanisms.length;
    this.marks.parts.ellipsoid.visible = false;
    this.rollout.instance.root.add(this.marks.group);
  }

  receive({ time, values, mu }) {
    this.rollout.instance.setValues(values);
    this.show.time = time;
    this.trail.add(time);
    if (this.marks) this.marks.setTime(0, true);
    if (mu !== null) {
      addNewest(this.rollout, time, mu, LIVE_SPAN);
      this.changed = true;
    }
    if (this.show.stage) this.show.stage.dirty();
    sayHead(`live · ${time.toFixed(2)} s`, false);
  }

  frame() {
    const now = performance.now();
    this.trail.draw(now);
    if (this.changed && now - (this.drawn ?? 0) > 100) {
      get("panel").hidden = false;
      this.chart.start = Math.max(0, this.rollout.duration - LIVE_SPAN);
      this.chart.draw();
      this.chart.setTime(this.rollout.duration);
      this.legend.setTime(this.rollout.duration);
      this.changed = false;
      this.drawn = now;
    }
    if (this.show.stage) this.show.stage.render();
    requestAnimationFrame(() => this.frame());
  }
}
