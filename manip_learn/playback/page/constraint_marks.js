// The constraint at the tip: arrows along what is free, a disc across what is held, the ellipsoid of the task, the target.

const ARROW = 0.085, THIN = 0.0022; // half length of an arrow and radius of a line, relative to the scene
const FADED = 0.25;

function symmetric([xx, xy, xz, yy, yz, zz]) { return [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]; }

// Eigenvalues, largest first, and unit eigenvectors of a symmetric 3 x 3 matrix, by Jacobi's rotations.
function eigen(matrix) {
  const a = matrix.map((row) => [...row]), v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 30; sweep++) {
    const off = Math.abs(a[0][1]) + Math.abs(a[0][2]) + Math.abs(a[1][2]);
    if (off < 1e-15 * (Math.abs(a[0][0]) + Math.abs(a[1][1]) + Math.abs(a[2][2]) + 1e-300)) break;
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (a[p][q] === 0) continue;
      const theta = (a[q][q] - a[p][p]) / (2 * a[p][q]), t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const c = 1 / Math.hypot(t, 1), s = t * c;
      for (const row of [...a, ...v]) [row[p], row[q]] = [c * row[p] - s * row[q], s * row[p] + c * row[q]];
      [a[p], a[q]] = [a[p].map((x, k) => c * x - s * a[q][k]), a[p].map((x, k) => s * x + c * a[q][k])];
    }
  }
  const found = [0, 1, 2].map((k) => ({ value: a[k][k], vector: v.map((row) => row[k]) }));
  return found.sort((x, y) => y.value - x.value);
}

// Orthonormal directions that a projector keeps; those of a plane stay with the axes, so that they do not spin.
function directionsOf(projector) {
  const kept = eigen(projector).filter((e) => e.value > 0.5).map((e) => new THREE.Vector3(...e.vector));
  if (kept.length !== 2) return kept;
  const normal = kept[0].clone().cross(kept[1]).normalize();
  const [axis] = Object.values(AXES).sort((x, y) => Math.abs(x.dot(normal)) - Math.abs(y.dot(normal)));
  const first = axis.clone().addScaledVector(normal, -axis.dot(normal)).normalize();
  return [first, normal.clone().cross(first)];
}

class ConstraintMarks {
  constructor(marks, instance, size, scale) {
    Object.assign(this, { instance, size, scale, target: marks.target, driven: marks.driven });
    this.tip = this.place(marks.tip);
    this.axes = marks.axes && this.place(marks.axes);
    this.times = decode(marks.times, Float64Array);
    for (const name of ["held", "free", "heldTurns", "freeTurns", "ellipsoid"]) this[name] = decode(marks[name], Float32Array);
    this.group = new THREE.Group();
    this.parts = { constraint: new THREE.Group(), ellipsoid: new THREE.Group(), target: new THREE.Group() };
    this.group.add(...Object.values(this.parts));
    this.inks = { free: this.ink("--free"), held: this.ink("--held"), veil: this.ink("--held", 0.25), egg: this.ink("--ellipsoid", 0.3), rim: this.ink("--ellipsoid"), goal: this.ink("--goal"), haze: this.ink("--goal", 0.35) };
    this.addEllipsoid();
    this.addTarget(marks.target);
    this.drawn = null;
  }

  place({ joint, placement }) { return { joint, placement: matrixFromRows(placement) }; }

  // Seen through the hand, which would hide them.
  ink(name, opacity = 1) {
    const material = new THREE.MeshBasicMaterial({ toneMapped: false, transparent: true, opacity, depthTest: false, depthWrite: false, side: THREE.DoubleSide });
    material.userData.opacity = opacity;
    onTheme(() => material.color.copy(linear(pageColour(name))));
    return material;
  }

  mesh(geometry, ink) { return Object.assign(new THREE.Mesh(geometry, ink), { renderOrder: 60 }); }

  line(from, to, ink, radius = THIN) { return this.mesh(tubeGeometry([...from.toArray(), ...to.toArray()], radius * this.size), ink); }

  // Its own z axis along a direction.
  along(direction, geometry, ink, at = new THREE.Vector3()) {
    const mesh = this.mesh(geometry, ink);
    mesh.quaternion.setFromUnitVectors(AXES.z, direction);
    mesh.position.copy(at);
    return mesh;
  }

  head(at, direction, ink, size = 1) {
    const r = 3.2 * THIN * this.size * size;
    return this.along(direction, new THREE.ConeGeometry(r, 3.2 * r, 20).rotateX(Math.PI / 2), ink, at);
  }

  // A line to both sides of the tip, relative to the scene, with an end on either side.
  toBothSides(d, length, ink, endAt, bold = 1) {
    const end = d.clone().multiplyScalar(length * this.size), back = end.clone().negate();
    return [this.line(back, end, ink, bold * THIN), endAt(end, d), endAt(back, d.clone().negate())];
  }

  poseOf({ joint, placement }) { return this.instance.jointMatrix(joint).multiply(placement); }

  // Faint where the constraint does not hold.
  fade(share) {
    for (const ink of Object.values(this.inks)) ink.opacity = share * ink.userData.opacity;
  }

  setTime(t, isHeld) {
    Object.assign(this, { time: t, holds: isHeld });
    const tip = this.poseOf(this.tip), centre = new THREE.Vector3().setFromMatrixPosition(tip);
    const turn = this.axes ? new THREE.Quaternion().setFromRotationMatrix(new THREE.Matrix4().extractRotation(this.poseOf(this.axes))) : new THREE.Quaternion();
    for (const part of [this.parts.constraint, this.parts.ellipsoid]) {
      part.position.copy(centre);
      part.quaternion.copy(turn);
    }
    if (this.drawn === null || this.held.length > 6) this.drawDirections(t);
    this.placeEllipsoid(t);
    this.fade(isHeld ? 1 : FADED);
    if (this.target && this.target.carrier) this.poseOf(this.carrier).decompose(this.parts.target.position, this.parts.target.quaternion, new THREE.Vector3());
  }

  // Row-major pose of what is drawn at the tip.
  poseNow() {
    const { position, quaternion } = this.parts.constraint;
    return new THREE.Matrix4().compose(position, quaternion, new THREE.Vector3(1, 1, 1)).transpose().toArray();
  }

  drawDirections(t) {
    const at = (name) => directionsOf(symmetric(rowAt(this.times, this[name], 6, t)));
    this.drawThese({ held: at("held"), free: at("free"), heldTurns: at("heldTurns"), freeTurns: at("freeTurns") });
  }

  // Unit vectors in the axes of the group.
  drawThese(directions) {
    this.drawn = directions;
    for (const old of this.parts.constraint.children) old.geometry.dispose();
    this.parts.constraint.clear();
    const { held, free, heldTurns, freeTurns } = this.drawn, add = (...meshes) => this.parts.constraint.add(...meshes);
    const { free: open, held: shut, veil } = this.inks, scaled = (share) => share * ARROW * this.size;
    const ring = (d, share, ink, turn) => this.along(d, new THREE.TorusGeometry(scaled(share), THIN * this.size, 8, 64, turn), ink);
    if (held.length && free.length < 3) for (const d of free) add(...this.toBothSides(d, ARROW, open, (at, way) => this.head(at, way, open)));
    if (held.length === 1) add(...this.toBothSides(held[0], 0.5 * ARROW, shut, (at, way) => this.along(way, new THREE.CircleGeometry(scaled(0.2), 32), shut, at)));
    if (held.length === 2) {
      const normal = held[0].clone().cross(held[1]).normalize();
      add(this.along(normal, new THREE.CircleGeometry(scaled(0.5), 48), veil), ring(normal, 0.5, shut));
    }
    if (held.length === 3) add(this.mesh(new THREE.SphereGeometry(scaled(0.3), 24, 16), veil));
    for (const d of heldTurns.length ? freeTurns : []) { // three quarters of a turn, with a head
      const arc = ring(d, 0.75, open, 1.5 * Math.PI), at = (x, y) => new THREE.Vector3(x, y, 0).applyQuaternion(arc.quaternion);
      add(arc, this.head(at(0, -scaled(0.75)), at(1, 0), open));
    }
    for (const d of heldTurns) add(ring(d, 0.62, shut));
  }

  addEllipsoid() {
    this.egg = this.mesh(new THREE.SphereGeometry(1, 40, 28), this.inks.egg);
    this.egg.matrixAutoUpdate = false;
    this.semiaxes = [0, 1, 2].map(() => Object.assign(this.mesh(new THREE.CylinderGeometry(1, 1, 2, 10), this.inks.rim), { matrixAutoUpdate: false }));
    this.parts.ellipsoid.add(this.egg, ...this.semiaxes);
  }

  // Lengths of the semi-axes [m/s] and their directions, longest first, at time t.
  ellipsoidAt(t) {
    return eigen(symmetric(rowAt(this.times, this.ellipsoid, 6, t))).map(({ value, vector }) => ({ length: Math.sqrt(Math.max(value, 0)), vector }));
  }

  placeEllipsoid(t) {
    const axes = this.ellipsoidAt(t), thin = THIN * this.size, v = axes.map((a) => new THREE.Vector3(...a.vector)), long = axes.map((a) => Math.max(a.length * this.scale, 0.4 * thin));
    this.egg.matrix.makeBasis(...v.map((x, k) => x.clone().multiplyScalar(long[k])));
    this.semiaxes.forEach((mesh, k) => {
      const side = v[(k + 1) % 3].clone().multiplyScalar(0.5 * thin), up = v[(k + 2) % 3].clone().multiplyScalar(0.5 * thin);
      mesh.matrix.makeBasis(side, v[k].clone().multiplyScalar(long[k]), up);
      mesh.visible = long[k] > thin;
    });
  }

  addTarget(target) {
    if (!target) return;
    if (target.carrier) this.carrier = this.place(target.carrier);
    const at = new THREE.Vector3(...target.point), r = 0.009 * this.size;
    const ball = this.mesh(new THREE.SphereGeometry(r, 24, 16), this.inks.goal);
    ball.position.copy(at);
    this.parts.target.add(ball);
    for (const axis of Object.values(AXES)) {
      const d = axis.clone().multiplyScalar(3 * r);
      this.parts.target.add(this.line(at.clone().sub(d), at.clone().add(d), this.inks.goal, 0.7 * THIN));
    }
    // along what is free every place counts as reached
    const free = !this.driven && this.free.length === 6 && !this.axes ? directionsOf(symmetric(this.free)) : [];
    if (free.length !== 1) return;
    const d = free[0].multiplyScalar(3 * ARROW * this.size);
    this.reachedAt = at.clone().add(d);
    this.parts.target.add(this.line(at.clone().sub(d), this.reachedAt, this.inks.haze, 0.8 * THIN));
  }
}
