// Phases: bands in time and along the tip's path, and the mechanism that held the hand. Those of recordings tell which
// constraint holds, in its colour; those that a rollout itself has tell how far it is, in the rollout's colour.

const NO_PHASE = { label: "not classified", mark: "", colour: "#cfd6dd", ink: "#000000" };
const BAND = { tallest: 20, lowest: 3, named: 11, numbered: 12 }; // heights of a row [px], and the least for its texts
const MAX_NAME = 22, LEAVES = ["approach", "retreat"];
const LEADING = { radius: 0.5, dash: 9 }; // the path before the way: its radius and the length of a dash, both in radii of a path

function bandsOf(rollout, kinds) {
  return rollout.phases.map(([start, end, k]) => ({ start, end, kind: k < 0 ? kinds[kinds.length - 1] : kinds[k] }));
}

// A rollout's own kinds: as much of its colour as their strength, the rest the page's.
function ownKinds(kinds, rolloutColour) {
  return kinds.map((kind) => ({
    ...kind,
    get colour() { return kind.strength < 1 ? mixed(pageColour("--page"), onScreen(rolloutColour), kind.strength) : onScreen(rolloutColour); },
    get outline() { return onScreen(rolloutColour); },
    get ink() { return kind.strength < 1 ? pageColour("--ink") : DARK.matches ? pageColour("--page") : kind.ink; },
  }));
}

// Whether the path and the legend have the colours of phases.
function hasPhaseColours(rollout) { return rollout.hasPhases && !rollout.hasOwnPhases; }

// Whether the hand has taken hold, as far as the rollout's own phases tell.
function takesHold(rollout, t) {
  const phase = rollout.hasOwnPhases && phaseAt(rollout, t);
  return !phase || !LEAVES.includes(phase.label.split(": ").pop());
}

// What is known of the moment t; null if the page has no phases, or the recording has ended.
function phaseAt(rollout, t) {
  if (!(rollout.hasPhases || rollout.hasOwnPhases) || t > rollout.duration + 1e-9) return null;
  const band = rollout.bands.find((b) => t >= b.start && (t < b.end || (t <= b.end && b.end >= rollout.duration - 1e-9)));
  return band ? band.kind : rollout.hasOwnPhases ? null : NO_PHASE;
}

// Whether a recording has moments without a phase that are long enough to be seen.
function hasGaps(rollout) {
  const covered = rollout.bands.reduce((sum, b) => sum + b.end - b.start, 0);
  return !rollout.hasOwnPhases && rollout.bands.length > 0 && covered < 0.99 * rollout.duration;
}

function shortName(name, most = MAX_NAME) {
  const head = Math.min(9, most >> 1);
  return name.length <= most ? name : `${name.slice(0, head)}…${name.slice(-Math.max(most - head - 1, 1))}`;
}

// As many rows as there is room for; the solid recording is always among them.
function bandRows(rollouts, room) {
  const rows = rollouts.filter((r) => r.visible && (r.bands.length || (colouring.mode === "fit" && r.fit))), fit = Math.max(1, Math.floor(room / BAND.lowest));
  if (rows.length <= fit) return rows;
  return rows.filter((r, i) => r.solid || i < fit - 1).slice(0, fit);
}

// The number or the word on a band so wide; of a word that has no room its first letter.
function markOn({ mark, outline }, width) {
  if (!outline) return width >= 16 ? mark : "";
  return width >= 14 + 7 * mark.length ? mark : width >= 11 ? mark.slice(0, 1) : "";
}

function drawBands(root, chart, rollout, y, row) {
  const height = Math.max(row - (row > 8 ? 5 : 1), 2), group = svg("g", { class: "bands" }, root);
  svg("line", { x1: chart.x(chart.start), x2: chart.x(rollout.duration), y1: y + height / 2, y2: y + height / 2, stroke: "var(--unclassified)", "stroke-width": 2 }, group);
  if (row >= BAND.named) {
    const name = svg("text", { x: chart.left - 10, y: y + height / 2 + 4, "text-anchor": "end", class: rollout.solid ? "solid" : "" }, group);
    name.textContent = shortName(rollout.name, Math.min(MAX_NAME, Math.floor((chart.left - 14) / 8)));
    svg("title", {}, name).textContent = rollout.name;
  }
  drawBars(group, chart, rollout, colouring.mode === "fit" && rollout.fit ? fitBands(rollout, chart.duration) : rollout.bands, y, height);
}

// Bars from moment to moment, with words for who points at one; kinds that have marks are rounded, and marked where there is room.
function drawBars(root, chart, { name }, bands, y, height) {
  for (const { start, end, kind } of bands) {
    const x = chart.x(start), isPlain = kind.mark === undefined, width = Math.max(chart.x(end) - x, 1.2), mark = isPlain ? "" : markOn(kind, width);
    const bar = svg("rect", { x, y, width, height, rx: isPlain ? 0 : Math.min(2, width / 2), fill: kind.colour, stroke: kind.outline || "none" }, root);
    svg("title", {}, bar).textContent = `${name}: ${kind.label}, ${start.toFixed(2)} s to ${end.toFixed(2)} s`;
    const isWord = kind.outline && mark.length > 1, at = isWord ? 6 : kind.outline ? width / 2 : 9;
    if (mark && height >= BAND.numbered)
      svg("text", { x: x + at, y: y + height / 2 + 4, "text-anchor": isWord ? "start" : "middle", class: "mark", style: `fill: ${kind.ink}` }, root).textContent = mark;
  }
}

// Bands in a strip that is stretched to the room that there is.
function stripOf(bands, duration, more = {}) {
  const root = svg("svg", { viewBox: "0 0 1000 6", preserveAspectRatio: "none", ...more }), at = (t) => (1000 * t) / Math.max(duration, 1e-9);
  for (const { start, end, kind: { colour, outline = "none" } } of bands)
    svg("rect", { x: at(start), y: 0, width: Math.max(at(end) - at(start), 2), height: 6, fill: colour, stroke: outline, "vector-effect": "non-scaling-stroke" }, root);
  return root;
}

// One colour a point of the path, as the corners of its tube need them.
function pathColours(rollout, times, corners) {
  return new THREE.Float32BufferAttribute(Array.from(times, (t) => Array(corners).fill(linear(colourOfPath(rollout, t)).toArray())).flat(2), 3);
}

// What was shown, from where the hands took hold, a ball where all of them did, to the farthest point, with a head.
function shownWay(points, radius, hold) {
  const ink = new THREE.MeshBasicMaterial({ toneMapped: false }), at = (k) => new THREE.Vector3(...points.slice(3 * k, 3 * k + 3));
  onTheme(() => ink.color.copy(linear(pageColour("--shown"))));
  const last = points.length / 3 - 1, along = at(last).sub(at(Math.max(last - 1, 0))).normalize();
  const head = new THREE.Mesh(new THREE.ConeGeometry(2.6 * radius, 8 * radius, 20), ink), ball = new THREE.Mesh(new THREE.SphereGeometry(2.6 * radius, 20, 14), ink);
  if (along.lengthSq() > 0) head.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along);
  head.position.copy(at(last));
  ball.position.copy(at(0));
  return [new THREE.Mesh(tubeGeometry(points, radius), ink), head, ...(hold ? [ball] : [])];
}

function mechanismGroup(mechanism, colour, radius) {
  const group = new THREE.Group(), ink = new THREE.MeshBasicMaterial({ toneMapped: false }), way = decode(mechanism.way, Float32Array);
  if (way.length) group.add(...shownWay(way, 2.2 * radius, mechanism.hold));
  onTheme(() => ink.color.copy(linear(pageColour("--scene-ink"))));
  for (const line of mechanism.lines) group.add(new THREE.Mesh(tubeGeometry(decode(line, Float32Array), radius), ink));
  for (const patch of mechanism.patches) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(decode(patch, Float32Array), 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const material = new THREE.MeshBasicMaterial({ color: linear(colour), toneMapped: false, transparent: true, opacity: 0.2, side: THREE.DoubleSide, depthWrite: false });
    group.add(Object.assign(new THREE.Mesh(geometry, material), { renderOrder: 1 }));
  }
  return group;
}
