// Words beside what is drawn in the scene; they stand in a column, with lines to what they mean.

const LABEL = { aside: 44, apart: 21, edge: 6 }; // [px]
const MECHANISM_WORDS = { line: "line that was learnt", hinge: "axis that was learnt", screw: "axis that was learnt", plane: "plane that was learnt", ball: "ball that was learnt" };

class Labels {
  constructor(stage) {
    this.stage = stage;
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

  // In one column, on the side of the hand where the robot does not stand.
  arrange(shown, w, h) {
    if (!shown.length) return;
    const base = this.stage.onScreen(new THREE.Vector3()), xs = shown.map(({ x }) => x), legend = get("legend"), widest = Math.max(...shown.map(({ element }) => element.offsetWidth));
    const room = Math.min(...xs) - LABEL.aside - widest - (getComputedStyle(legend).position === "absolute" ? legend.offsetLeft + legend.offsetWidth : 0);
    const right = room < 0 || !base || base.x <= (Math.min(...xs) + Math.max(...xs)) / 2;
    const edge = right ? Math.max(...xs) + LABEL.aside : Math.min(...xs) - LABEL.aside, rows = [];
    for (const { y } of shown) rows.push(Math.max(y, (rows[rows.length - 1] ?? -Infinity) + LABEL.apart));
    const lift = rows.reduce((sum, y, i) => sum + y - shown[i].y, 0) / rows.length, low = h - LABEL.apart;
    const up = Math.max(Math.min(lift, rows[0] - LABEL.apart), rows[rows.length - 1] - low);
    shown.forEach(({ element, line, x, y }, i) => {
      const wide = element.offsetWidth, left = Math.min(Math.max(right ? edge : edge - wide, LABEL.edge), w - wide - LABEL.edge), at = rows[i] - up;
      element.style.transform = `translate(${left.toFixed(1)}px, ${(at - LABEL.apart / 2).toFixed(1)}px)`;
      for (const [name, value] of Object.entries({ x1: x, y1: y, x2: right ? left : left + wide, y2: at })) line.setAttribute(name, value.toFixed(1));
    });
  }
}

// What the solid rollout's marks are, how far its drawer is open, and which line was learnt.
function labelScene(show, on) {
  const labels = new Labels(show.stage), drawn = () => (show.solid.visible && show.solid.drawn) || null;
  const mark = (name, ink, say) => labels.add(ink, () => (on[name] && drawn() && drawn().holds ? say(drawn()) : ""), () => drawn().anchors()[ink]);
  mark("constraint", "--free", (d) => (d.drawn.free.length ? "free to move" : "free to turn"));
  mark("constraint", "--held", (d) => (d.drawn.held.length ? "held" : "may not turn"));
  mark("ellipsoid", "--ellipsoid", () => "speed within reach (μ)");
  mark("target", "--goal", () => "target");
  labels.add("--goal", () => (on.target && drawn() && drawn().reachedAt ? "any place on this line counts as reached" : ""), () => drawn().reachedAt);
  for (let k = 0; k < Math.max(...show.rollouts.map((r) => r.pieces.length)); k++) {
    const piece = () => show.solid.visible && show.solid.pieces[k];
    labels.add("--scene-ink", () => (on.furniture && piece() ? `${piece().kind} ${pieceInWords(show.solid, piece(), show.time)}` : ""), () => piece().at(piece().top));
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
