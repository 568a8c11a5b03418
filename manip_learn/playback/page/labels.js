// Words beside what is drawn in the scene; they stand in a column, with lines to what they mean.

// [px]; a pixel of line is as bad as so many that are hidden; the place where they stand costs that share of what it would
const LABEL = { aside: 44, apart: 21, edge: 6, line: 4, stays: 0.7 };
const MECHANISM_WORDS = { line: "line that was learnt", hinge: "axis that was learnt", screw: "axis that was learnt", plane: "plane that was learnt", ball: "ball that was learnt" };

class Labels {
  // most: the share of a label that may hide something; one that has no better place is left out.
  constructor(stage, most = Infinity) {
    Object.assign(this, { stage, most });
    this.items = [];
    this.box = Object.assign(document.createElement("div"), { id: "labels" });
    this.box.setAttribute("aria-hidden", "true"); // the legend, the slider and the card Show say the same
    this.lines = svg("svg", {}, this.box);
    stage.element.append(this.box);
    stage.onRendered = () => this.place();
  }

  // at: where it points to in the robot's base; null while there is nothing.
  add(ink, say, at) {
    const element = document.createElement("span");
    element.style.setProperty("--ink-of", `var(${ink})`);
    this.box.append(element);
    this.items.push({ element, say, at, line: svg("line", { style: `stroke: var(${ink})` }, this.lines) });
  }

  place() {
    const { clientWidth: w, clientHeight: h } = this.stage.element, shown = [];
    for (const item of this.items) {
      const text = this.hidden ? null : item.say(), place = text && item.at(), at = place && this.stage.onScreen(place);
      const seen = Boolean(at) && at.x > 0 && at.x < w && at.y > 0 && at.y < h;
      item.element.hidden = !seen;
      item.line.style.display = seen ? "" : "none";
      if (!seen) continue;
      if (item.element.textContent !== text) item.element.textContent = text;
      shown.push({ ...item, ...at });
    }
    this.arrange(shown.sort((a, b) => a.y - b.y), w, h);
  }

  // What is seen of the robot and of furniture [px]: all that casts a shadow.
  things(w, h) {
    const found = [];
    this.stage.world.traverseVisible((mesh) => {
      if (!mesh.isMesh || !mesh.castShadow) return;
      if (!mesh.geometry.boundingBox) mesh.geometry.computeBoundingBox();
      const { min, max } = mesh.geometry.boundingBox, xs = [], ys = [];
      for (let k = 0; k < 8; k++) {
        const corner = new THREE.Vector3(k & 1 ? min.x : max.x, k & 2 ? min.y : max.y, k & 4 ? min.z : max.z).applyMatrix4(mesh.matrixWorld).project(this.stage.camera);
        xs.push((0.5 + 0.5 * corner.x) * w);
        ys.push((0.5 - 0.5 * corner.y) * h);
      }
      found.push({ left: Math.min(...xs), right: Math.max(...xs), top: Math.min(...ys), bottom: Math.max(...ys) });
    });
    return found;
  }

  // In one column where it hides least of the robot and of furniture: beside the marks, beside all that is seen, or at an
  // edge; at the height of the marks, at the top or at the bottom. It stays where it is until another place is far better.
  arrange(shown, w, h) {
    if (!shown.length) return;
    const { aside, apart, edge } = LABEL, legend = get("legend"), n = shown.length, things = this.things(w, h), xs = shown.map(({ x }) => x);
    const widths = shown.map(({ element }) => element.offsetWidth), wide = Math.max(...widths), narrow = Math.min(...widths);
    const least = edge + (getComputedStyle(legend).position === "absolute" ? legend.offsetLeft + legend.offsetWidth : 0);
    // each label begins at a column on the right of what is meant, or ends at one on the left of it, as far as it has room
    const columns = [Math.max(...xs) + aside, Math.max(...things.map(({ right }) => right)) + edge, w - edge - wide].map((x) => ({ x, right: true }));
    columns.push(...[Math.min(...xs) - aside, Math.min(...things.map(({ left }) => left)) - edge, least + wide].map((x) => ({ x, right: false })));
    const rows = [];
    for (const { y } of shown) rows.push(Math.max(y, (rows[rows.length - 1] ?? -Infinity) + apart));
    const lift = rows.reduce((sum, y, i) => sum + y - shown[i].y, 0) / n, up = Math.max(Math.min(lift, rows[0] - apart), rows[n - 1] - h + apart);
    const heights = [rows.map((y) => y - up), rows.map((_, i) => apart * (i + 0.75)), rows.map((_, i) => h - apart * (n - i - 0.25))];
    const places = columns.flatMap(({ x, right }, c) => heights.map((ys, r) => {
      const lefts = widths.map((width) => Math.max(Math.min(right ? x : x - width, w - edge - width), edge)), beside = right ? x + narrow <= w - edge : x - narrow >= least;
      const hides = widths.map((width, i) => things.reduce((sum, t) => sum + Math.max(0, Math.min(t.right, lefts[i] + width) - Math.max(t.left, lefts[i])) * Math.max(0, Math.min(t.bottom, ys[i] + apart / 2) - Math.max(t.top, ys[i] - apart / 2)), 0));
      const cost = shown.reduce((sum, at, i) => sum + hides[i] + LABEL.line * Math.hypot(at.x - (right ? lefts[i] : lefts[i] + widths[i]), at.y - ys[i]), 0);
      return { name: `${c}${r}`, lefts, ys, right, hides, cost: beside ? cost * (this.column === `${c}${r}` ? LABEL.stays : 1) : Infinity };
    }));
    const best = places.reduce((a, b) => (b.cost < a.cost ? b : a));
    this.column = best.name;
    shown.forEach(({ element, line, x, y }, i) => {
      const left = best.lefts[i], at = best.ys[i], inTheWay = best.hides[i] > this.most * widths[i] * apart;
      element.style.visibility = line.style.visibility = inTheWay ? "hidden" : "";
      element.style.transform = `translate(${left.toFixed(1)}px, ${(at - apart / 2).toFixed(1)}px)`;
      for (const [name, value] of Object.entries({ x1: x, y1: y, x2: best.right ? left : left + widths[i], y2: at })) line.setAttribute(name, value.toFixed(1));
    });
  }
}

// What the solid rollout's marks are, how far its drawer is open, and which line was learnt.
function labelScene(show, on) {
  // half: the legend and the card Show say it too
  const labels = new Labels(show.stage, 0.5), drawn = () => (show.solid.visible && show.solid.drawn) || null;
  const mark = (name, ink, say) => labels.add(ink, () => (on[name] && drawn() && drawn().holds ? say(drawn()) : ""), () => drawn().anchors()[ink]);
  mark("constraint", "--free", (d) => (d.drawn.free.length ? "free to move" : "free to turn"));
  mark("constraint", "--held", (d) => (d.drawn.held.length ? "held" : "may not turn"));
  mark("ellipsoid", "--ellipsoid", () => "speed within reach (μ)");
  mark("target", "--goal", () => "target");
  labels.add("--goal", () => (on.target && drawn() && drawn().reachedAt ? "any place on this line counts as reached" : ""), () => drawn().reachedAt);
  for (let k = 0; k < Math.max(...show.rollouts.map((r) => r.pieces.length)); k++) {
    const piece = () => show.solid.visible && show.solid.pieces[k];
    labels.add("--scene-ink", () => (on.handles && piece() ? `handle${k ? "" : ` ${openInWords(show.solid, show.time)}`}` : ""), () => piece().mesh.position);
  }
  for (let k = 0; k < Math.max(...show.rollouts.map((r) => r.named.length)); k++) {
    const thing = () => show.solid.visible && show.solid.named[k];
    labels.add("--scene-ink", () => (on.around && thing() ? thing().words : ""), () => thing().at());
  }
  for (const { constraint, lines, patches, type, way } of show.mechanisms) {
    const words = MECHANISM_WORDS[type] && `${show.mechanisms.length > 1 ? `${constraint + 1}: ` : ""}${MECHANISM_WORDS[type]}`;
    const ends = decode([...lines, ...patches][0] || "", Float32Array);
    if (ends.length) labels.add("--scene-ink", () => (on.mechanism ? words : ""), () => new THREE.Vector3(...ends.slice(-3)));
    const shown = decode(way, Float32Array);
    if (shown.length) labels.add("--scene-ink", () => (on.mechanism ? "as it was shown" : ""), () => new THREE.Vector3(...shown.slice(-3)));
  }
  return labels;
}
