// The robot in three dimensions: joints as nested groups, one instance a rollout.
const THREE = MeshCat.THREE;
const AXES = { x: new THREE.Vector3(1, 0, 0), y: new THREE.Vector3(0, 1, 0), z: new THREE.Vector3(0, 0, 1) };

// Colours of the page, light or dark, under the names that style.css gives them.
const DARK = matchMedia("(prefers-color-scheme: dark)");

function pageColour(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

// Colours of rollouts and phases stay dark on white; on a dark page they are mixed with white.
function onScreen(hex) { return DARK.matches ? mixed(hex, "#ffffff", 0.35) : hex; }

// Now, and whenever the page turns dark or light.
function onTheme(apply) {
  apply();
  DARK.addEventListener("change", apply);
}

function matrixFromRows(rows) { return new THREE.Matrix4().set(...rows); }

function linear(hex) { return new THREE.Color(hex).convertSRGBToLinear(); }

function decode(text, Type) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Type(bytes.buffer);
}

// ---- geometry -------------------------------------------------------------------------------------------------------

const ROUND = 28; // corners of what is round

function disc(radius, length) {
  const edge = Math.min(radius, length) * 0.14, half = length / 2;
  const outline = [[0, -half], [radius - edge, -half], [radius, -half + edge], [radius, half - edge], [radius - edge, half], [0, half]];
  const bands = outline.slice(1).map((to, i) => new THREE.LatheGeometry([outline[i], to].map((p) => new THREE.Vector2(...p)), ROUND));
  return merged(bands.map((geometry) => ({ geometry }))); // of bands that share no corner: edges stay sharp
}

function meshGeometry(mesh) {
  const packed = decode(mesh.positions, Uint16Array), positions = new Float32Array(packed.length);
  for (let i = 0; i < packed.length; i++) positions[i] = mesh.origin[i % 3] + packed[i] * mesh.step[i % 3];
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(decode(mesh.triangles, mesh.wide ? Uint32Array : Uint16Array), 1));
  if (mesh.normals) geometry.setAttribute("normal", new THREE.BufferAttribute(Float32Array.from(decode(mesh.normals, Int8Array), (x) => x / 127), 3));
  else geometry.computeVertexNormals();
  return geometry;
}

function shapeGeometry(shape, meshes) {
  const s = shape.size;
  if (shape.kind === "box") return new THREE.BoxGeometry(s[0], s[1], s[2]);
  if (shape.kind === "sphere") return new THREE.SphereGeometry(s[0], ROUND, ROUND / 2);
  if (shape.kind === "mesh") return meshes[shape.mesh];
  const geometry = shape.kind === "disc" ? disc(s[0], s[1]) : new THREE.CylinderGeometry(s[0], s[0], s[1], ROUND);
  return geometry.rotateX(Math.PI / 2); // three.js cylinders stand along y, URDF's along z
}

// Geometries as one, which takes one draw call.
function merged(parts) {
  const geometry = new THREE.BufferGeometry(), joined = (lists) => Float32Array.from(lists.flatMap((list) => [...list]));
  for (const name of ["position", "normal"]) geometry.setAttribute(name, new THREE.BufferAttribute(joined(parts.map((part) => part.geometry.attributes[name].array)), 3));
  let first = 0;
  geometry.setIndex(parts.flatMap((part) => {
    const from = first;
    first += part.geometry.attributes.position.count;
    return Array.from(part.geometry.index.array, (i) => from + i);
  }));
  return geometry;
}

// A colour for each part of a merged geometry.
function coloursOf(parts) {
  return new THREE.Float32BufferAttribute(parts.flatMap(({ geometry, colour: { r, g, b } }) => Array(geometry.attributes.position.count).fill([r, g, b]).flat()), 3);
}

// Shapes of one joint that are equally opaque as one body.
function bodiesOf({ shapes, meshes }) {
  const made = meshes.map(meshGeometry), bodies = new Map();
  for (const shape of shapes) {
    const { joint, colour, kind } = shape, key = `${joint} ${colour[3]}`, part = { shape, geometry: shapeGeometry(shape, made).clone().applyMatrix4(matrixFromRows(shape.pose)) };
    if (!bodies.has(key)) bodies.set(key, { joint, opacity: colour[3], side: THREE.FrontSide, parts: [] });
    bodies.get(key).parts.push(part);
    if (kind === "mesh") bodies.get(key).side = THREE.DoubleSide; // as many files have triangles that look inwards
  }
  for (const body of bodies.values()) body.geometry = merged(body.parts);
  return [...bodies.values()];
}

// Straight from point to point; where points coincide, on as before.
class Polyline extends THREE.Curve {
  constructor(points) {
    super();
    this.places = Array.from({ length: points.length / 3 }, (_, i) => new THREE.Vector3().fromArray(points, 3 * i));
    this.last = this.places.length - 1;
    let along = AXES.x;
    this.ways = this.places.map((_, i) => {
      const step = this.places[Math.min(i + 1, this.last)].clone().sub(this.places[Math.max(i - 1, 0)]);
      if (step.lengthSq() > 1e-24) along = step.normalize();
      return along;
    });
  }

  getPointAt(share) { return this.places[Math.round(share * this.last)]; }

  getTangentAt(share) { return this.ways[Math.round(share * this.last)].clone(); }
}

// A ring for each point, of one corner more than sides: the first one again.
function tubeGeometry(points, radius, sides = 8) {
  return new THREE.TubeGeometry(new Polyline(points), Math.max(points.length / 3 - 1, 1), radius, sides);
}

// Rollouts beyond these are drawn by their tip's way alone, until they are made solid.
const MAX_GHOSTS = 12;

// ---- one robot ------------------------------------------------------------------------------------------------------

// Dark and light parts stay dark and light, all in the rollout's colour: structure and identity at once.
function shaded(colour, own) {
  const light = Math.max(0.3 * own[0] + 0.59 * own[1] + 0.11 * own[2], DARK.matches ? 0.3 : 0); // dark parts are seen on a dark page
  const shade = new THREE.Color(colour);
  return light < 0.5
    ? shade.lerp(new THREE.Color(0x101820), 0.5 * (1 - 2 * light))
    : shade.lerp(new THREE.Color(0xffffff), 0.75 * (2 * light - 1));
}

// Where robots coincide, as at a common start, the solid one is seen and nothing flickers.
function behind(index) {
  return { polygonOffset: true, polygonOffsetFactor: 1 + index, polygonOffsetUnits: 4 * (1 + index) };
}

class RobotInstance {
  constructor(robot, rollout, bodies, tinted) {
    Object.assign(this, { robot, rollout, bodies, tinted, meshes: [], motion: new THREE.Matrix4() });
    this.root = new THREE.Group();
    this.arm = new THREE.Group();
    this.root.add(this.arm);
    this.placements = robot.joints.map((j) => matrixFromRows(j.placement));
    this.axes = robot.joints.map((j) => new THREE.Vector3(...j.axis));
    this.groups = robot.joints.map(() => Object.assign(new THREE.Group(), { matrixAutoUpdate: false }));
    robot.joints.forEach((joint, i) => (i === 0 ? this.arm : this.groups[joint.parent]).add(this.groups[i]));
    this.links = new Map(robot.links.map(({ name, joint, placement }) => [name, { joint, placement: matrixFromRows(placement) }]));
    // a ghost first fills the depth buffer, so that only its front skin is blended and it stays easy to read
    this.veil = new THREE.MeshBasicMaterial({ colorWrite: false, side: THREE.DoubleSide, ...behind(rollout.index) });
    if (rollout.hasPhases ? rollout.solid : rollout.index < MAX_GHOSTS) this.addBodies();
  }

  addBodies() {
    for (const body of this.bodies) {
      const { position, normal } = body.geometry.attributes, geometry = new THREE.BufferGeometry(); // its colours are its own
      geometry.setAttribute("position", position).setAttribute("normal", normal).setIndex(body.geometry.index);
      const skin = new THREE.Mesh(geometry), veil = new THREE.Mesh(body.geometry, this.veil);
      skin.userData.shape = body;
      this.groups[body.joint].add(skin, veil);
      this.meshes.push({ skin, veil });
    }
  }

  setSolid(solid) {
    this.solid = solid;
    this.arm.visible = solid || !this.rollout.hasPhases; // ghosts would hide the paths, whose colours are the point
    if (solid && !this.meshes.length) this.addBodies();
    for (const { skin, veil } of this.meshes) {
      const body = skin.userData.shape, moves = body.joint > 0;
      skin.material = this.material(body);
      skin.geometry.setAttribute("color", coloursOf(body.parts.map(({ shape, geometry }) => ({ geometry, colour: this.colourOf(shape) }))));
      skin.castShadow = skin.receiveShadow = solid;
      veil.visible = !solid && moves;
      skin.visible = solid || moves; // what never moves is drawn once
    }
  }

  colourOf(shape) {
    const own = shape.colour, hex = this.rollout.colour;
    let colour = new THREE.Color(own[0], own[1], own[2]);
    if (DARK.matches) colour.lerp(new THREE.Color(0xffffff), Math.max(0, 0.25 - 0.5 * Math.max(own[0], own[1], own[2])));
    if (shape.accent) colour = new THREE.Color(hex);
    else if (!this.solid) colour = shaded(hex, [0, 1, 2].map((i) => 0.4 + 0.2 * own[i]));
    else if (this.tinted && shape.joint > 0) colour = shaded(hex, own);
    return colour.convertSRGBToLinear();
  }

  material({ side, opacity }) {
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.62, metalness: 0.05, side });
    if (!this.solid) Object.assign(material, { transparent: true, opacity: 0.42, depthWrite: false, ...behind(this.rollout.index) });
    else if (opacity < 1) Object.assign(material, { transparent: true, opacity });
    return material;
  }

  setOrder(order) {
    for (const { skin, veil } of this.meshes) {
      veil.renderOrder = this.solid ? 0 : order;
      skin.renderOrder = this.solid ? 0 : order + 1;
    }
  }

  // values: the numbers of all joints, one after the other, as joint_tracks in Python made them
  setValues(values) {
    let k = 0;
    this.robot.joints.forEach((joint, i) => {
      if (joint.motion === "revolute") this.motion.makeRotationAxis(this.axes[i], values[k++]);
      else if (joint.motion === "prismatic") {
        const x = values[k++];
        this.motion.makeTranslation(x * joint.axis[0], x * joint.axis[1], x * joint.axis[2]);
      } else if (joint.motion === "free") {
        const turn = new THREE.Quaternion(values[k + 3], values[k + 4], values[k + 5], values[k + 6]).normalize();
        this.motion.makeRotationFromQuaternion(turn).setPosition(values[k], values[k + 1], values[k + 2]);
        k += 7;
      } else this.motion.identity();
      this.groups[i].matrix.multiplyMatrices(this.placements[i], this.motion);
      this.groups[i].matrixWorldNeedsUpdate = true;
    });
  }

  // Pose of a link in the robot's base, from the matrices that are drawn.
  linkMatrix(name) {
    const link = this.links.get(name);
    if (!link) throw new Error(`no link ${name}`);
    return this.jointMatrix(link.joint).multiply(link.placement);
  }

  // Pose of a joint in the robot's base, now.
  jointMatrix(joint) {
    const pose = new THREE.Matrix4();
    for (let i = joint; i > 0; i = this.robot.joints[i].parent) pose.premultiply(this.groups[i].matrix);
    return pose;
  }

  tipPosition() { return new THREE.Vector3().setFromMatrixPosition(this.linkMatrix(this.robot.tip)); }
}

// Points that are some way apart, the first and the last kept: at rest, noise would tangle the tube.
function spaced(path, times, distance) {
  const kept = [0], last = times.length - 1, far = (i, j) => Math.hypot(path[3 * i] - path[3 * j], path[3 * i + 1] - path[3 * j + 1], path[3 * i + 2] - path[3 * j + 2]);
  for (let i = 1; i < last; i++) if (far(i, kept[kept.length - 1]) >= distance) kept.push(i);
  kept.push(last);
  return { points: Float32Array.from(kept.flatMap((i) => [...path.subarray(3 * i, 3 * i + 3)])), times: Float32Array.from(kept, (i) => times[i]) };
}

// In the phases that lead to a rollout's way the path is thin and dashed.
function thinLeading({ attributes: { position, normal }, index }, rollout, points, times, radius, sides) {
  const dash = LEADING.dash * radius, ring = 3 * (sides + 1), places = new Polyline(points).places;
  let far = 0;
  places.forEach((place, i) => {
    if (i) far += place.distanceTo(places[i - 1]);
    if ((phaseAt(rollout, times[i]) || { strength: 1 }).strength >= 1) return;
    for (let j = ring * i; j < ring * (i + 1); j++) position.array[j] -= (1 - LEADING.radius) * radius * normal.array[j];
    if (far % (2 * dash) > dash) index.array.fill(0, 6 * sides * i, 6 * sides * (i + 1));
  });
}

// The tip's way: faint as a whole, strong up to now, and a ball where the tip is. Unlit, so that colours are those of the legend.
class TipPath {
  constructor(rollout, radius, parent) {
    const { points, times } = spaced(rollout.path, rollout.pathTimes, radius);
    Object.assign(this, { rollout, times, sides: 6, group: new THREE.Group() });
    const geometry = tubeGeometry(points, radius, this.sides), { attributes, index } = geometry;
    if (rollout.hasOwnPhases) thinLeading(geometry, rollout, points, times, radius, this.sides);
    const ink = (more) => new THREE.MeshBasicMaterial({ vertexColors: true, toneMapped: false, ...more, ...behind(rollout.index) });
    this.whole = new THREE.Mesh(geometry, ink({ transparent: true, opacity: 0.4, depthWrite: false }));
    this.past = new THREE.Mesh(Object.assign(new THREE.BufferGeometry(), { attributes, index }), ink({})); // of which a part is drawn
    this.ball = new THREE.Mesh(new THREE.SphereGeometry(2.6 * radius, 16, 12), new THREE.MeshStandardMaterial({ roughness: 0.6, emissiveIntensity: 0.25, ...behind(rollout.index) }));
    this.group.add(this.whole, this.past, this.ball);
    this.recolour();
    parent.add(this.group);
  }

  recolour() { this.whole.geometry.setAttribute("color", pathColours(this.rollout, this.times, this.sides + 1)); }

  setTime(t, tip) {
    this.past.geometry.setDrawRange(0, indexAt(this.times, t) * this.sides * 6);
    this.ball.position.copy(tip);
    for (const channel of ["color", "emissive"]) this.ball.material[channel].copy(linear(colourOfPath(this.rollout, t)));
  }
}

// Where the tip was lately, in a motion that is going on.
const TRAIL = { apart: 0.004, radius: 0.0022, most: 1500, gap: 70 }; // distance of points and radius relative to the scene, their number, time between redrawings [ms]

class TipTrail {
  constructor(rollout, size, seconds = Infinity) {
    Object.assign(this, { rollout, size, seconds, points: [], drawn: 0, changed: false });
    const ink = new THREE.MeshBasicMaterial({ toneMapped: false });
    onTheme(() => ink.color.copy(linear(rollout.colour)));
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), ink);
  }

  clear() { Object.assign(this, { points: [], changed: true }); }

  add(time) {
    const tip = this.rollout.instance.tipPosition(), last = this.points[this.points.length - 1];
    if (last && time < last.time) this.clear();
    const isFar = !this.points.length || last.distanceTo(tip) >= TRAIL.apart * this.size;
    if (isFar) this.points.push(Object.assign(tip, { time }));
    if (this.points.length > TRAIL.most) this.points = this.points.filter((_, i) => i % 2 === 0);
    const { length } = this.points;
    this.points = this.points.filter((point) => point.time >= time - this.seconds);
    this.changed ||= isFar || this.points.length < length;
  }

  draw(now) {
    if (!this.changed || now < this.drawn + TRAIL.gap) return;
    Object.assign(this, { changed: false, drawn: now });
    this.mesh.geometry.dispose();
    this.mesh.geometry = this.points.length > 1 ? tubeGeometry(this.points.flatMap((p) => p.toArray()), TRAIL.radius * this.size) : new THREE.BufferGeometry();
  }
}
