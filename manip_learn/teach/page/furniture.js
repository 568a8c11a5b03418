// The furniture of a scene, where the program says that it is.

const TONES = { front: "#eadfcb", body: "#cbb898", handle: "#39424c" };
const FURNITURE_INKS = Object.fromEntries(Object.entries(TONES).map(([what, hex]) => [what, new THREE.MeshStandardMaterial({ color: linear(hex), roughness: 0.75, emissive: linear(hex), emissiveIntensity: 0.14 })]));
const EDGES = new THREE.LineBasicMaterial({ color: linear("#5d5340"), transparent: true, opacity: 0.55 });

// A box and its edges.
function boardOf([x, y, z, across, deep, high, what], inks = FURNITURE_INKS) {
  const geometry = new THREE.BoxGeometry(across, deep, high), mesh = new THREE.Mesh(geometry, inks[what]);
  mesh.castShadow = mesh.receiveShadow = true;
  const parts = [mesh, new THREE.LineSegments(new THREE.EdgesGeometry(geometry), EDGES)];
  for (const part of parts) part.position.set(x, y, z);
  return parts;
}

const HANDLE_STATES = { rest: ["handle", 0], near: ["near", 0.55], held: ["holds", 0.55] };
const LEAST_OPENING = { m: 0.001, rad: 0.01 }; // below which nothing is said
const BEFORE_A_FRONT = Math.PI * (62 / 180); // the camera from the way that the front opens
const MARGIN = 0.04; // around all that is drawn, relative to the scene

// "12.3 cm", "41°".
function openingInWords(value, unit) {
  return unit === "rad" ? `${((value * 180) / Math.PI).toFixed(0)}°` : `${(100 * value).toFixed(1)} cm`;
}

class TeachPiece {
  constructor({ fixed, moving }, handle) {
    Object.assign(this, { handle, group: new THREE.Group(), leaf: new THREE.Group() });
    this.grip = new THREE.MeshStandardMaterial({ color: linear(TONES.handle), roughness: 0.6 });
    const inks = { ...FURNITURE_INKS, handle: this.grip }, carcass = new THREE.Group();
    carcass.matrixAutoUpdate = false;
    carcass.matrix.copy(matrixFromRows(fixed.pose));
    for (const box of fixed.boxes) carcass.add(...boardOf(box, inks));
    for (const box of moving.boxes) this.leaf.add(...boardOf(box, inks));
    this.corners = (boxes) => boxes.flatMap(([x, y, z, w, d, h]) => [-1, 1].flatMap((i) => [-1, 1].flatMap((j) => [-1, 1].map((k) => new THREE.Vector3(x + (i * w) / 2, y + (j * d) / 2, z + (k * h) / 2)))));
    this.still = this.corners(fixed.boxes).map((p) => p.applyMatrix4(carcass.matrix));
    this.out = new THREE.Vector3().setFromMatrixColumn(carcass.matrix, 1);
    this.front = this.corners(moving.boxes);
    this.leaf.visible = false; // until it is known where it is
    this.group.add(carcass, this.leaf);
    this.setState("rest");
  }

  setPose([x, y, z, qw, qx, qy, qz]) {
    this.leaf.position.set(x, y, z);
    this.leaf.quaternion.set(qx, qy, qz, qw).normalize();
    this.leaf.updateMatrix();
    this.leaf.visible = true;
  }

  setState(state) {
    if (state === this.state) return;
    this.state = state;
    this.recolour();
  }

  recolour() {
    const [name, glow] = HANDLE_STATES[this.state], colour = linear(name === "handle" ? TONES.handle : pageColour(`--${name}`));
    this.grip.color.copy(colour);
    this.grip.emissive.copy(colour);
    this.grip.emissiveIntensity = glow;
  }

  // Where its handle is in the robot's base, now.
  handleAt() { return this.leaf.visible ? this.leaf.position.clone() : new THREE.Vector3(...this.handle.at); }

  points() { return [...this.still, ...(this.leaf.visible ? this.front.map((p) => p.clone().applyMatrix4(this.leaf.matrix)) : [])]; }

  dispose() { this.group.traverse((part) => { if (part.geometry) part.geometry.dispose(); }); }
}

class TeachFurniture {
  constructor(stage, instance) {
    Object.assign(this, { stage, instance, group: new THREE.Group(), pieces: [], number: null, lit: null });
    stage.world.add(this.group);
    DARK.addEventListener("change", () => { for (const piece of this.pieces) piece.recolour(); });
  }

  setScene(scene) {
    if (this.number === scene.number) return;
    this.number = scene.number;
    for (const piece of this.pieces) piece.dispose();
    this.group.clear();
    this.pieces = scene.furniture.map((piece, i) => new TeachPiece(piece, scene.handles[i]));
    this.group.add(...this.pieces.map((piece) => piece.group));
    this.unframed = true;
  }

  setPose(pose) {
    this.pieces.forEach((piece, i) => {
      if (pose.furniture[i]) piece.setPose(pose.furniture[i]);
      piece.setState(pose.held[i] ? "held" : pose.near === i || this.lit === i ? "near" : "rest");
    });
    if (this.unframed) this.frame();
  }

  // The camera where the arm and its furniture fill the picture, before the front that is opened.
  frame() {
    this.unframed = false;
    const { stage, instance } = this, arm = instance.groups.map((_, i) => new THREE.Vector3().setFromMatrixPosition(instance.jointMatrix(i)));
    const points = [...arm, instance.tipPosition(), ...this.pieces.flatMap((piece) => piece.points())], box = new THREE.Box3().setFromPoints(points);
    const corners = (p, by) => [0, 1, 2, 3, 4, 5, 6, 7].map((k) => new THREE.Vector3(k & 1 ? by : -by, k & 2 ? by : -by, k & 4 ? by : 0).add(p));
    stage.outline = [...points.flatMap((p) => corners(p, MARGIN * stage.size)), ...corners(instance.tipPosition(), ARROW * stage.size)]; // the marks stand around the tip
    box.getCenter(stage.middle);
    const out = this.pieces.length ? this.pieces[0].out : null, usual = Math.atan2(stage.directions.iso[1], stage.directions.iso[0]);
    if (out && Math.hypot(out.x, out.y) > 0.5) {
      const front = Math.atan2(out.y, out.x), sides = [front - BEFORE_A_FRONT, front + BEFORE_A_FRONT];
      const azimuth = sides.sort((a, b) => Math.cos(b - usual) - Math.cos(a - usual))[0];
      stage.directions.iso = [Math.cos(azimuth), Math.sin(azimuth), 0.4];
    }
    stage.look(stage.view);
  }

  // Number of the piece whose handle, or whose part that moves, the pointer is over; -1 for none.
  under(event, pointing) {
    const gaps = this.pieces.map((piece) => pointing.far(event, piece.handleAt())), near = gaps.indexOf(Math.min(...gaps));
    if (near >= 0 && gaps[near] < MAGNET) return near;
    pointing.cast(event);
    const [hit] = pointing.caster.intersectObjects(this.pieces.map(({ group }) => group), true);
    return hit ? this.pieces.findIndex(({ leaf }) => { let part = hit.object; while (part && part !== leaf) part = part.parent; return part === leaf; }) : -1;
  }

  // How far a handle is moved, and whether it can be gripped.
  words({ opening, held, near }) {
    return this.pieces.map(({ handle: { name, unit } }, i) => {
      const open = Math.abs(opening[i] ?? 0) > LEAST_OPENING[unit] && `${openingInWords(opening[i], unit)} open`;
      const words = [held[i] ? "gripped" : near === i && "within reach: grip it", open].filter(Boolean).join(" · ");
      return words && `${name}: ${words}`;
    }).filter(Boolean).join(", ");
  }
}
