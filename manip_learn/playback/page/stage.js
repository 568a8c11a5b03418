// Light, floor, camera: what surrounds the robots.

const FLOOR_SHADER = {
  vertex: "varying vec2 at; void main() { at = position.xy; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
  fragment: `
    varying vec2 at; uniform vec3 colour; uniform float cell; uniform float reach; uniform vec2 middle;
    float lines(float size) {
      vec2 p = at / size, w = fwidth(p), d = abs(fract(p - 0.5) - 0.5) / w;
      return (1.0 - min(min(d.x, d.y), 1.0)) * (1.0 - smoothstep(0.25, 0.6, max(w.x, w.y)));
    }
    void main() {
      float fade = 1.0 - smoothstep(0.35, 1.0, length(at - middle) / reach);
      float a = max(0.22 * lines(cell), 0.4 * lines(5.0 * cell)) * fade;
      gl_FragColor = vec4(colour, a);
    }`,
};

// Directions from the target to the camera, in the robot's base frame (z up).
// Light beyond this share of white is compressed, brightest channel first, so that white robots keep their shapes and
// coloured ones their hue. It takes the place of the tone mapping that three.js leaves to its users.
const SHOULDER = "0.45";
THREE.ShaderChunk.tonemapping_pars_fragment = THREE.ShaderChunk.tonemapping_pars_fragment.replace(
  "vec3 CustomToneMapping( vec3 color ) { return color; }",
  `vec3 CustomToneMapping( vec3 color ) {
    const float knee = ${SHOULDER};
    float m = max(max(color.r, color.g), color.b), room = 1.0 - knee;
    return m > knee ? color * (knee + room * (1.0 - exp((knee - m) / room))) / m : color;
  }`,
);

// A turn or a zoom by one key.
const TURN = Math.PI / 18, NEARER = 0.88;

const VIEWS = { front: [1, 0, 0.06], side: [0, -1, 0.06], top: [0, -0.0005, 1] };

class Stage {
  constructor(element, data) {
    this.element = element;
    this.panes = null; // side by side: the group that each pane shows, of which the others are hidden
    this.bounds = { low: new THREE.Vector3(...data.bounds[0]), high: new THREE.Vector3(...data.bounds[1]) };
    this.outline = data.outline.map((p) => new THREE.Vector3(...p));
    this.directions = { ...VIEWS, iso: [Math.cos(data.azimuth), Math.sin(data.azimuth), 0.4] };
    this.middle = this.bounds.low.clone().add(this.bounds.high).multiplyScalar(0.5);
    this.size = Math.max(this.bounds.high.distanceTo(this.bounds.low), 1e-3);
    this.world = new THREE.Group();
    const software = drawsBySoftware(), make = () => new MeshCat.Viewer(element, false), viewer = software ? withoutSmoothing(make) : make();
    this.viewer = viewer;
    viewer.gui.domElement.remove();
    viewer.hide_background();
    for (const path of [["Lights"], ["Grid"], ["Axes"]]) viewer.set_property(path, "visible", false);
    viewer.set_3d_pane_size = () => this.resize();
    Object.assign(viewer.renderer, { outputEncoding: THREE.sRGBEncoding, toneMapping: THREE.CustomToneMapping, sortObjects: true });
    viewer.scene.add(this.world);
    this.addLights();
    this.addFloor(data.floor);
    this.addAxes(0.09 * this.size);
    this.camera = viewer.camera;
    Object.assign(this.camera, { fov: 32, near: 0.01 * this.size, far: 40 * this.size });
    Object.assign(viewer.controls, { minDistance: 0.15 * this.size, maxDistance: 12 * this.size });
    this.moved = false;
    viewer.controls.addEventListener("start", () => (this.moved = true));
    viewer.controls.addEventListener("change", () => this.dirty());
    this.quality = new Quality(software, ({ shadows, pixels }) => {
      this.sun.castShadow = this.shade.visible = shadows;
      viewer.renderer.setPixelRatio(pixels);
    });
    this.look(data.view);
    new ResizeObserver(() => this.resize()).observe(element);
    this.resize();
    element.addEventListener("keydown", (event) => this.turnByKey(event));
    wirePrinting(this);
  }

  dirty() { this.viewer.needs_render = true; }

  addLights() {
    const s = this.size, sun = new THREE.DirectionalLight(0xffffff, 0.9);
    sun.position.set(this.middle.x + 0.7 * s, this.middle.y - 0.5 * s, this.middle.z + 1.4 * s);
    sun.target.position.copy(this.middle);
    this.sun = sun;
    sun.shadow.mapSize.set(2048, 2048);
    Object.assign(sun.shadow.camera, { left: -0.75 * s, right: 0.75 * s, top: 0.75 * s, bottom: -0.75 * s, near: 0.2 * s, far: 4 * s });
    Object.assign(sun.shadow, { bias: -0.0006, normalBias: 0.004 * s, radius: 5 });
    const fill = new THREE.DirectionalLight(0xdfe9f5, 0.16);
    fill.position.set(this.middle.x - s, this.middle.y - 0.6 * s, this.middle.z + 0.4 * s);
    fill.target.position.copy(this.middle);
    const sky = new THREE.HemisphereLight(0xffffff, 0x7d8a97, 0.46);
    sky.position.set(0, 0, 1);
    this.world.add(sun, sun.target, fill, fill.target, sky);
  }

  addFloor(height) {
    const reach = 1.5 * this.size, cell = Math.pow(10, Math.round(Math.log10(this.size / 12)));
    const grid = new THREE.Mesh(
      new THREE.PlaneGeometry(2, 2).scale(reach, reach, 1).translate(this.middle.x, this.middle.y, 0),
      new THREE.ShaderMaterial({
        vertexShader: FLOOR_SHADER.vertex, fragmentShader: FLOOR_SHADER.fragment, transparent: true, depthWrite: false,
        side: THREE.DoubleSide, extensions: { derivatives: true },
        uniforms: { colour: { value: new THREE.Color() }, cell: { value: cell }, reach: { value: reach }, middle: { value: new THREE.Vector2(this.middle.x, this.middle.y) } },
      }),
    );
    const shade = (this.shade = new THREE.Mesh(grid.geometry, new THREE.ShadowMaterial({ opacity: 0.17, depthWrite: false })));
    shade.receiveShadow = true;
    grid.position.z = shade.position.z = height;
    grid.renderOrder = shade.renderOrder = -1;
    this.world.add(grid, shade);
    onTheme(() => {
      grid.material.uniforms.colour.value.set(pageColour("--floor-line"));
      shade.material.opacity = Number(pageColour("--floor-shade"));
      this.dirty();
    });
  }

  addAxes(length) {
    const radius = 0.035 * length, arrows = [];
    for (const [name, colour] of [["x", "#d55e00"], ["y", "#009e73"], ["z", "#0072b2"]]) {
      const direction = AXES[name], turn = new THREE.Quaternion().setFromUnitVectors(AXES.y, direction);
      const shaft = new THREE.CylinderGeometry(radius, radius, length, 12).translate(0, length / 2, 0), head = new THREE.ConeGeometry(2.6 * radius, 0.22 * length, 16).translate(0, 1.1 * length, 0);
      for (const geometry of [shaft, head]) arrows.push({ geometry: geometry.applyQuaternion(turn), colour: linear(colour) });
      const label = this.label(name, colour, 0.42 * length);
      label.position.copy(direction).multiplyScalar(1.45 * length);
      this.world.add(label);
    }
    const geometry = merged(arrows).setAttribute("color", coloursOf(arrows));
    this.world.add(new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ vertexColors: true, toneMapped: false })));
  }

  label(text, colour, size) {
    const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
    const pen = canvas.getContext("2d");
    Object.assign(pen, { font: "600 46px system-ui, sans-serif", fillStyle: colour, textAlign: "center", textBaseline: "middle" });
    pen.fillText(text, 32, 32);
    const map = new THREE.CanvasTexture(canvas);
    map.encoding = THREE.sRGBEncoding;
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthWrite: false, toneMapped: false }));
    sprite.scale.setScalar(size);
    return sprite;
  }

  resize() {
    if (matchMedia("print").matches) return;  // the layout of a sheet has no place for a canvas
    const w = Math.max(this.element.clientWidth, 1), h = Math.max(this.element.clientHeight, 1);
    this.viewer.renderer.setSize(w, h);
    this.camera.aspect = this.paneWidth / h;
    this.camera.updateProjectionMatrix();
    if (!this.moved) this.look(this.view);
    this.dirty();
  }

  // Put the camera where the whole motion fills the picture, beside the legend where there is room.
  look(view) {
    this.view = view;
    this.moved = false;
    const back = new THREE.Vector3(...this.directions[view]).normalize();
    const right = new THREE.Vector3(0, 0, 1).cross(back).normalize(), up = new THREE.Vector3().crossVectors(back, right);
    const w = this.paneWidth, h = Math.max(this.element.clientHeight, 1);
    const legend = w > 760 && !this.panes && getComputedStyle(get("legend")).position === "absolute" ? Math.min(300, 0.3 * w) : 0;
    const tanV = Math.tan((this.camera.fov * Math.PI) / 360) * 0.88, tanH = (tanV * (w - legend)) / h;
    // the outline in the camera's axes: centre it, then step back until all of it is inside
    const seen = this.outline.map((p) => p.clone().sub(this.middle)).map((p) => [p.dot(right), p.dot(up), p.dot(back)]);
    const centre = [0, 1].map((k) => (Math.min(...seen.map((p) => p[k])) + Math.max(...seen.map((p) => p[k]))) / 2);
    let distance = 0.3 * this.size;
    for (const [x, y, z] of seen) distance = Math.max(distance, z + Math.abs(x - centre[0]) / tanH, z + Math.abs(y - centre[1]) / tanV);
    const shift = (legend / h) * Math.tan((this.camera.fov * Math.PI) / 360) * distance;
    const target = this.middle.clone().addScaledVector(right, centre[0] - shift).addScaledVector(up, centre[1]);
    const eye = target.clone().addScaledVector(back, distance);
    // the viewer's camera lives in a y-up world
    this.viewer.controls.target.set(target.x, target.z, -target.y);
    this.camera.position.set(eye.x, eye.z, -eye.y);
    this.viewer.controls.update();
    this.dirty();
  }

  // Arrows go round the robot, plus and minus nearer and farther; the camera's world is y-up.
  turnByKey(event) {
    const by = { ArrowLeft: [-TURN, 0, 1], ArrowRight: [TURN, 0, 1], ArrowUp: [0, -TURN, 1], ArrowDown: [0, TURN, 1],
      "+": [0, 0, NEARER], "=": [0, 0, NEARER], "-": [0, 0, 1 / NEARER] }[event.key];
    if (!by || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    const controls = this.viewer.controls, at = new THREE.Spherical().setFromVector3(this.camera.position.clone().sub(controls.target));
    at.theta += by[0];
    at.phi = Math.min(Math.max(at.phi + by[1], 0.01), Math.PI - 0.01);
    at.radius = Math.min(Math.max(at.radius * by[2], controls.minDistance), controls.maxDistance);
    this.camera.position.setFromSpherical(at).add(controls.target);
    this.moved = true;
    controls.update();
    this.dirty();
  }

  // What is drawn now, as the address of an image.
  picture() {
    this.quality.set(0);
    this.draw();
    return this.viewer.renderer.domElement.toDataURL("image/png");
  }

  // The camera's place in the robot's base, whose z is up.
  eye() { return new THREE.Vector3(this.camera.position.x, -this.camera.position.z, this.camera.position.y); }

  // Ghosts are blended from far to near.
  sortGhosts(instances) {
    const eye = this.eye();
    const far = instances.map((instance) => [instance.tipPosition().distanceTo(eye), instance]).sort((a, b) => b[0] - a[0]);
    far.forEach(([, instance], i) => instance.setOrder(10 + 2 * i));
  }

  // Where a place in the robot's base is seen [px]; null behind the camera.
  onScreen(place) {
    const seen = new THREE.Vector3(place.x, place.z, -place.y).project(this.camera);
    return seen.z > 1 ? null : { x: (0.5 + 0.5 * seen.x) * this.element.clientWidth, y: (0.5 - 0.5 * seen.y) * this.element.clientHeight };
  }

  render() {
    if (!this.quality.isDue(performance.now(), this.viewer.needs_render)) return;
    this.draw();
    if (this.onRendered) this.onRendered();
  }

  get paneWidth() { return Math.max(this.element.clientWidth / (this.panes ? this.panes.length : 1), 1); }

  // The scene, or once for each pane, by the same camera.
  draw() {
    if (!this.panes) return this.viewer.render();
    const { renderer, scene } = this.viewer, w = this.paneWidth, h = Math.max(this.element.clientHeight, 1);
    renderer.setScissorTest(true);
    this.panes.forEach((shown, k) => {
      for (const group of this.panes) group.visible = group === shown;
      renderer.setViewport(k * w, 0, w, h);
      renderer.setScissor(k * w, 0, w, h);
      renderer.render(scene, this.camera);
    });
    renderer.setScissorTest(false);
    renderer.setViewport(0, 0, this.element.clientWidth, h);
    this.viewer.needs_render = false;
  }

  showPanes(groups) {
    this.panes = groups;
    this.resize();
  }
}
