// What a plan keeps clear of, as it stands there; and all of the arm's way past it in one picture.

const AROUND = "#5f5a66";
const BETWEEN = 0.1, MOST_STATIONS = 60; // between two pictures of the arm on its way [rad or m], and how many there are
const OPTION = "--scene";
const MOST_NAMES = 6; // in the picture; the legend has all

// "table as given; floor assumed: --scene names what is there"
function aroundInWords(rollout) {
  const said = [["as given", false], [`assumed: ${OPTION} names what is there`, true]].map(([how, assumed]) => {
    const names = [...new Set(rollout.around.filter((thing) => thing.assumed === assumed).map((thing) => thing.name))], last = names.pop();
    return last && `${names.length ? `${names.join(", ")} and ` : ""}${last} ${how}`;
  });
  return said.filter(Boolean).join("; ");
}

// What a scene states, as stated: a face is a patch, and a floor reaches to the rim of the picture.
class AroundThing {
  constructor(rollout, described) {
    Object.assign(this, described, { rollout, group: new THREE.Group(), rests: matrixFromRows(described.pose) });
    const isFace = this.kind === "face", isFloor = isFace && this.name === "floor", colour = linear(AROUND);
    // a face lies across y, out of which it looks
    const geometry = isFace ? new THREE.PlaneGeometry(...this.size).rotateX(-Math.PI / 2) : shapeGeometry({ ...described, mesh: 0 }, this.mesh ? [meshGeometry(this.mesh)] : []);
    const body = new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({ color: colour, transparent: true, opacity: isFloor ? 0.1 : 0.5, depthWrite: false, side: THREE.DoubleSide, roughness: 0.8, ...behind(0) }));
    body.renderOrder = isFloor ? 1 : 4;
    this.group.matrixAutoUpdate = false;
    this.group.add(body);
    geometry.computeBoundingBox();
    this.top = isFloor ? null : isFace ? new THREE.Vector3(this.size[0] / 2, 0, this.size[1] / 2) : new THREE.Vector3(0, 0, geometry.boundingBox.max.z);
    if (!isFloor) {
      const ink = new THREE.LineBasicMaterial({ color: colour, toneMapped: false });
      this.group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 30), ink));
    }
    this.group.matrix.copy(this.rests);
  }

  // "table, 0.03 m from right_l5": at the nearest
  get words() { return `${this.name}${this.nearest == null ? "" : `, ${this.nearest.toFixed(2)} m from ${this.link}`}`; }

  at() { return this.top.clone().applyMatrix4(this.group.matrix); }
}

// The arm at many moments of an approach or a retreat as one veil: its front skin alone is blended, once.
function sweptGroup(show, rollout, bodies) {
  const { instance, bands } = rollout, group = new THREE.Group(), moments = [];
  for (const { start, end } of bands.filter(({ kind }) => LEAVES.includes(kind.label.split(": ").pop()))) {
    let before = null;
    for (let k = 0; k <= MOST_STATIONS; k++) {
      const t = start + (k / MOST_STATIONS) * (end - start), values = Array.from(show.valuesAt(rollout, t));
      if (before && k < MOST_STATIONS && Math.max(...values.map((x, i) => Math.abs(x - before[i]))) < BETWEEN) continue;
      moments.push(values);
      before = values;
    }
  }
  const skin = new THREE.MeshStandardMaterial({ color: linear(rollout.colour), transparent: true, opacity: 0.22, depthWrite: false, roughness: 0.8, ...behind(2) });
  const veil = new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true, ...behind(2) });
  const made = bodies.map(({ joint, geometry }) => (joint > 0 ? [veil, skin].map((ink, k) => Object.assign(new THREE.InstancedMesh(geometry, ink, moments.length), { renderOrder: 60 + k, frustumCulled: false })) : []));
  moments.forEach((values, n) => {
    instance.setValues(values);
    bodies.forEach(({ joint }, i) => { for (const mesh of made[i]) mesh.setMatrixAt(n, instance.jointMatrix(joint)); });
  });
  if (moments.length) group.add(...made.flat());
  return group;
}

// Of each rollout that keeps clear of something.
function addAround(show, bodies) {
  for (const rollout of show.rollouts) {
    rollout.things = rollout.around.filter((thing) => !thing.assumed).map((described) => new AroundThing(rollout, described));
    rollout.named = rollout.things.filter((thing, k, all) => thing.top && k === all.findIndex((other) => other.name === thing.name)).slice(0, MOST_NAMES);
    if (!rollout.around.length) continue;
    rollout.swept = sweptGroup(show, rollout, bodies);
    rollout.instance.root.add(rollout.swept, ...rollout.things.map((thing) => thing.group));
  }
}
