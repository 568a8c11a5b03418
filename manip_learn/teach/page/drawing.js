// What is drawn beside the arm: the pull, what is held and free, what is weak, the tip's path, mechanisms.

const SPRING = { thin: 0.0016, thick: 0.0055, full: 80, ball: 0.009 }; // radii relative to the scene; the force [N] of the thickest
const WEAK_SHARE = 0.2; // from which on the program tells of a weak direction
const LEARNT = "#0072b2"; // patches of a mechanism without a phase of its own
const ZEROS = { one: "AAAAAAAAAAA=", six: "A".repeat(32) };
const UNMARKED = { tip: { joint: 0, placement: new THREE.Matrix4().toArray() }, axes: null, target: null, driven: null, times: ZEROS.one, held: ZEROS.six, free: ZEROS.six, heldTurns: ZEROS.six, freeTurns: ZEROS.six, ellipsoid: ZEROS.six };

// A unit cylinder along y between two places.
function stretch(mesh, from, to, radius) {
  const along = to.clone().sub(from), length = along.length();
  mesh.position.copy(from).addScaledVector(along, 0.5);
  if (length > 1e-9) mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.divideScalar(length));
  mesh.scale.set(radius, Math.max(length, 1e-6), radius);
}

// What is held and free at the tip, and the direction in which the tip can hardly move, from vectors of the program.
class LiveMarks extends ConstraintMarks {
  constructor(instance, size) {
    super(UNMARKED, instance, size, 1);
    this.parts.ellipsoid.visible = this.parts.target.visible = this.parts.constraint.visible = false;
    this.inks.weak = this.ink("--weak");
    this.weak = new THREE.Group();
    this.weak.add(...this.toBothSides(AXES.z, 1.15 * ARROW, this.inks.weak, (at, way) => this.head(at, way, this.inks.weak, 1.5), 1.5));
    this.weak.visible = false;
    this.group.add(this.weak);
    this.drawn = { held: [], free: [], heldTurns: [], freeTurns: [] };
  }

  setPose({ marks, weak }) {
    const tip = this.instance.tipPosition();
    this.parts.constraint.visible = Boolean(marks);
    this.parts.constraint.position.copy(tip);
    if (marks) this.setMarks(marks);
    this.weak.visible = Boolean(weak);
    if (!weak) return;
    const strength = Math.min(Math.max(1 - weak.share / WEAK_SHARE, 0), 1);
    this.weak.position.copy(tip);
    this.weak.quaternion.setFromUnitVectors(AXES.z, new THREE.Vector3(...weak.direction).normalize());
    this.weak.scale.setScalar(0.7 + 0.5 * strength);
    this.inks.weak.opacity = 0.3 + 0.7 * strength;
  }

  setMarks({ free, held, turns, fixed }) {
    if (!isNew(this, [free, held, turns, fixed].map((set) => set.map((d) => d.map((x) => x.toFixed(2)))))) return;
    const of = (set) => set.map((d) => new THREE.Vector3(...d).normalize());
    this.drawThese({ free: of(free), held: of(held), freeTurns: of(turns), heldTurns: of(fixed) });
  }
}

// The line from where the arm is held to where it is pulled.
class Spring {
  constructor(marks) {
    this.size = marks.size;
    this.marks = marks;
    this.inks = { pull: marks.ink("--pull"), limited: marks.ink("--weak"), x: marks.ink("--series-1", 0.8), y: marks.ink("--series-2", 0.8), z: marks.ink("--series-0", 0.8) };
    this.line = marks.mesh(new THREE.CylinderGeometry(1, 1, 1, 12), this.inks.pull);
    this.rail = marks.mesh(new THREE.CylinderGeometry(1, 1, 1, 8), this.inks.x);
    this.balls = [0.75, 1].map((r) => marks.mesh(new THREE.SphereGeometry(r * SPRING.ball * this.size, 20, 14), this.inks.pull));
    this.group = new THREE.Group();
    this.group.add(this.line, this.rail, ...this.balls);
  }

  // at and to: where the page's own hand is, or that of another page; null where there is none.
  set(at, to, { force = 0, limited = false } = {}, axis = null) {
    this.group.visible = Boolean(at);
    if (!at) return;
    const ink = limited ? this.inks.limited : this.inks.pull, strength = Math.min(force / SPRING.full, 1);
    stretch(this.line, at, to, (SPRING.thin + (SPRING.thick - SPRING.thin) * strength) * this.size);
    this.balls[0].position.copy(at);
    this.balls[1].position.copy(to);
    for (const mesh of [this.line, ...this.balls]) mesh.material = ink;
    this.rail.visible = Boolean(axis);
    if (!axis) return;
    this.rail.material = this.inks[axis];
    const reach = AXES[axis].clone().multiplyScalar(0.5 * this.size);
    stretch(this.rail, to.clone().sub(reach), to.clone().add(reach), 0.0009 * this.size);
  }
}

// The mechanism that was learnt, and the true one, wider and pale around it.
class Lines {
  constructor(stage) {
    Object.assign(this, { stage, group: new THREE.Group(), shown: {} });
    this.parts = { learnt: new THREE.Group(), truth: new THREE.Group() };
    this.group.add(...Object.values(this.parts));
    this.truthInk = new THREE.MeshBasicMaterial({ toneMapped: false, transparent: true, opacity: 0.45, depthWrite: false });
    onTheme(() => this.truthInk.color.copy(linear(pageColour("--truth"))));
  }

  set(name, what, make) {
    const part = this.parts[name];
    if (!isNew(part, what && [what.lines, what.patches])) return;
    part.traverse((mesh) => { if (mesh.geometry) mesh.geometry.dispose(); });
    part.clear();
    for (const mesh of what ? make(what) : []) part.add(mesh);
    this.shown[name] = Boolean(what && what.lines.length + (what.patches || []).length);
    this.stage.dirty();
  }

  setState({ answer, truth }) {
    const { size } = this.stage, mechanism = answer && answer.mechanism, colour = (answer && answer.phaseKinds && answer.phaseKinds[0] && answer.phaseKinds[0].colour) || LEARNT;
    this.set("learnt", mechanism && { patches: [], ...mechanism }, (one) => [mechanismGroup(one, colour, 0.0014 * size)]);
    this.set("truth", truth, ({ lines }) => lines.map((line) => new THREE.Mesh(tubeGeometry([...decode(line, Float32Array)], 0.005 * size), this.truthInk)));
  }
}
