// Where pictures take long, as without a graphics card, simpler ones that follow the hand.

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // names of what draws without a graphics card
const SLOW = { frame: 45, frames: 8 }; // a picture that takes longer is late [ms]; so many late ones in a row are too slow
const COARSE_CELLS = 20; // cells along the longest side of a mesh, in each of which one corner is left
const SMALL_MESH = 300, FEW_PIXELS = 0.6; // triangles of a mesh that is left as it is; share of the pixels along a side

// Corners within one cell of a grid become one; triangles that lose their area go.
function coarser(geometry) {
  const index = geometry.index, from = geometry.attributes.position, count = index ? index.count : from.count;
  if (count < 3 * SMALL_MESH) return geometry;
  geometry.computeBoundingBox();
  const { min, max } = geometry.boundingBox, cell = Math.max(max.x - min.x, max.y - min.y, max.z - min.z) / COARSE_CELLS, cells = new Map(), sums = [], triangles = [];
  const places = Array.from({ length: from.count }, (_, i) => {
    const at = [from.getX(i), from.getY(i), from.getZ(i)], [a, b, c] = at.map((x, k) => Math.floor((x - min.getComponent(k)) / cell)), key = (a * 64 + b) * 64 + c;
    if (!cells.has(key)) { cells.set(key, sums.length); sums.push([0, 0, 0, 0]); }
    const sum = sums[cells.get(key)];
    at.forEach((x, k) => (sum[k] += x));
    sum[3] += 1;
    return cells.get(key);
  });
  const seen = new Set();
  for (let i = 0; i < count; i += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => places[index ? index.getX(i + k) : i + k]), key = [a, b, c].sort((x, y) => x - y).join();
    if (a === b || b === c || a === c || seen.has(key)) continue;
    seen.add(key);
    triangles.push(a, b, c);
  }
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.Float32BufferAttribute(sums.flatMap(([x, y, z, n]) => [x / n, y / n, z / n]), 3));
  made.setIndex(triangles);
  made.computeVertexNormals();
  return made;
}

// Whether the browser draws without a graphics card.
function drawsBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl"), known = gl && gl.getExtension("WEBGL_debug_renderer_info");
  if (!gl) return false;
  const name = String(gl.getParameter(known ? known.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(name);
}

// The viewer asks for smooth edges, which take half of the time where there is no graphics card.
function withoutSmoothing(make) {
  const { getContext } = HTMLCanvasElement.prototype;
  HTMLCanvasElement.prototype.getContext = function (kind, options) { return getContext.call(this, kind, options && { ...options, antialias: false }); };
  try { return make(); } finally { HTMLCanvasElement.prototype.getContext = getContext; }
}

class Quality {
  constructor(stage, instance, software) {
    Object.assign(this, { stage, instance, level: 0, late: 0 });
    while (software && this.level < this.steps.length) this.lower();
  }

  get steps() { return [this.withoutShadows, this.coarse, this.fewPixels]; }

  lower() {
    this.late = 0;
    this.steps[this.level++].call(this);
    this.stage.dirty();
  }

  // Only between two pictures that follow each other it is known how long one takes.
  frame(now, drew) {
    const took = now - (this.last ?? now);
    this.last = drew && !document.hidden ? now : undefined;
    this.late = drew && took > SLOW.frame ? this.late + 1 : 0;
    if (this.late >= SLOW.frames && this.level < this.steps.length) this.lower();
  }

  withoutShadows() {
    this.stage.world.traverse((part) => { if (part.isDirectionalLight) part.castShadow = false; });
    this.stage.viewer.renderer.setPixelRatio(Math.min(1, this.stage.viewer.renderer.getPixelRatio()));
    this.stage.resize();
  }

  coarse() {
    const made = new Map();
    for (const { skin, veil } of this.instance.meshes) {
      if (!made.has(skin.geometry)) made.set(skin.geometry, coarser(skin.geometry));
      skin.geometry = veil.geometry = made.get(skin.geometry);
    }
    this.plain(this.instance);
  }

  fewPixels() {
    this.stage.viewer.renderer.setPixelRatio(FEW_PIXELS);
    this.stage.resize();
  }

  // Lit at the corners alone; after an arm has got other colours, again.
  plain({ meshes }) {
    if (this.level < 1 + this.steps.indexOf(this.coarse)) return;
    const made = new Map();
    for (const { skin } of meshes) {
      const { color, transparent, opacity, depthWrite, side, polygonOffset, polygonOffsetFactor, polygonOffsetUnits } = skin.material;
      if (!made.has(skin.material)) made.set(skin.material, new THREE.MeshLambertMaterial({ color, transparent, opacity, depthWrite, side, polygonOffset, polygonOffsetFactor, polygonOffsetUnits }));
      skin.material = made.get(skin.material);
    }
  }
}
