// The drawers, the doors and the cranks that the solid rollout moves; of the others, the outlines of their fronts.

const TONES = { front: "#eadfcb", body: "#cbb898", handle: "#39424c" };
const FURNITURE_INKS = Object.fromEntries(Object.entries(TONES).map(([what, hex]) => [what, new THREE.MeshStandardMaterial({ color: linear(hex), roughness: 0.75, emissive: linear(hex), emissiveIntensity: 0.14 })]));
const EDGES = new THREE.LineBasicMaterial({ color: linear("#5d5340"), transparent: true, opacity: 0.55 });

// How far a piece of furniture is open over time.
function openingOf(rollout, { unit, curve }) {
  const track = rollout.byKind.get(unit === "m" ? "opening" : "turning");
  return track && track.curves[curve];
}

// "0.214 m open", or degrees.
function pieceInWords(rollout, piece, t) {
  const opening = openingOf(rollout, piece);
  if (!opening) return "";
  const value = valueAt(opening, Math.min(t, rollout.duration));
  if (piece.kind === "crank") return `turned ${(value * 180 / Math.PI).toFixed(0)}°`;
  if (piece.unit === "m") return piece.pushedFrom ? `pushed in ${value.toFixed(3)} m` : `${value.toFixed(3)} m open`;
  return `${(value * 180 / Math.PI).toFixed(1)}° open`;
}

function openInWords(rollout, t) { return rollout.furniture.map((piece) => pieceInWords(rollout, piece, t)).filter(Boolean).join(", "); }

// A box and its edges.
function boardOf([x, y, z, across, deep, high, what], inks = FURNITURE_INKS) {
  const geometry = new THREE.BoxGeometry(across, deep, high), mesh = new THREE.Mesh(geometry, inks[what]);
  mesh.castShadow = mesh.receiveShadow = true;
  const parts = [mesh, new THREE.LineSegments(new THREE.EdgesGeometry(geometry), EDGES)];
  for (const part of parts) part.position.set(x, y, z);
  return parts;
}

class FurniturePiece {
  constructor(rollout, described) {
    Object.assign(this, described, { rollout, opening: openingOf(rollout, described), group: new THREE.Group(), carcass: new THREE.Group(), leaf: new THREE.Group(), outline: new THREE.Group() });
    this.group.matrixAutoUpdate = false;
    this.group.matrix.copy(matrixFromRows(this.pose));
    for (const box of this.fixed) this.carcass.add(...boardOf(box));
    for (const box of this.moving) this.leaf.add(...boardOf(box));
    const [x, y, z, ...size] = this.moving.find((box) => box[6] === "front");
    this.ghostInk = new THREE.LineBasicMaterial({ toneMapped: false });
    this.outline.add(this.placed(new THREE.LineSegments(new THREE.EdgesGeometry(new THREE.BoxGeometry(...size.slice(0, 3))), this.ghostInk), x, y, z));
    this.top = new THREE.Vector3(x, y, z + size[2] / 2);
    this.group.add(this.carcass, this.leaf, this.outline);
    rollout.instance.root.add(this.group);
  }

  placed(object, x, y, z) { object.position.set(x, y, z); return object; }

  setTime(t) { if (this.opening) this.setOpening(valueAt(this.opening, Math.min(t, this.rollout.duration))); }

  setOpening(open) {
    const [x, y] = this.pivot, c = Math.cos(open), s = Math.sin(open);
    for (const part of [this.leaf, this.outline]) {
      if (this.kind === "drawer") part.position.y = Math.abs(this.pushedFrom - open);
      else {
        part.rotation.z = open;
        part.position.set(x - c * x + s * y, y - s * x - c * y, this.pitch * open);
      }
    }
    this.carcass.visible = this.leaf.visible = this.rollout.solid;
    this.outline.visible = !this.rollout.solid && !this.rollout.hasPhases;
    this.ghostInk.color.copy(linear(this.rollout.colour));
  }

  // Pose of the moving part in the robot's base, now.
  leafMatrix() {
    this.leaf.updateMatrix();
    return this.leaf.matrix.clone().premultiply(this.group.matrix);
  }

  at(place) { return place.clone().applyMatrix4(this.leafMatrix()); }
}
