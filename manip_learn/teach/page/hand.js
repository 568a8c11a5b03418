// The hand that takes the arm: by the mouse, by fingers, by keys.

const REPEAT = 200; // [ms] after which a pull that is held is said again
const TURN_PER_PIXEL = Math.PI / 360; // [rad] of the hand for a pixel to the side, with shift
const STEP = 0.01, TURN_STEP = Math.PI / 60; // [m] of the pull and [rad] of the hand for a key
const KEYED = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 1], ArrowDown: [1, -1], PageUp: [2, 1], PageDown: [2, -1] }; // axis and sign
const MAGNET = 26; // [px] around a handle within which a hand that is drawn over it also comes to its depth
const GLIDE = 0.4; // [m/s] at which a pull goes to a handle by itself: as fast as a person reaches for something near
const FELT = 0.01; // [m] of a handle's motion that show which way it goes
const TOLD = 0.25; // [rad] that the view was turned by who may have meant the hand
const TOUCH = matchMedia("(pointer: coarse)");
const AT_VIEWER = 0.85; // cosine of the angle between a way and the view from which on a drag can hardly follow it

class Hand {
  constructor(teach) {
    Object.assign(this, { teach, stage: teach.stage, link: teach.link, pointing: teach.pointing, held: null, axis: null, byKeys: false, freed: null });
    const scene = this.stage.element, options = { capture: true }; // before the camera's own controls
    scene.addEventListener("pointerdown", (event) => this.down(event), options);
    scene.addEventListener("pointermove", (event) => this.move(event), options);
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) scene.addEventListener(kind, (event) => this.up(event), options);
    scene.addEventListener("keydown", (event) => this.moveByKey(event), options);
    scene.addEventListener("contextmenu", (event) => { if (this.held) event.preventDefault(); });
    window.addEventListener("keydown", (event) => this.key(event, true), options);
    window.addEventListener("keyup", (event) => this.key(event, false), options);
    window.addEventListener("blur", () => { this.axis = null; this.letGo(); });
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.letGo(); });
    window.addEventListener("pagehide", () => { if (this.held) this.link.releaseNow(); });
    this.stage.viewer.controls.addEventListener("change", () => { if (this.held && this.held.drag) this.held.drag.anchor(this.held.event, this.axis); });
  }

  down(event) {
    if (this.held && this.held.drag) {
      this.second(event);
      stop(event);
      return;
    }
    if (!this.teach.allowed || event.button !== 0 || this.cameraTurns(event)) return;
    const on = this.on(event);
    if (!on) return this.watchView(event);
    stop(event);
    this.letGo();
    this.stage.element.focus({ preventScroll: true });
    this.stage.element.setPointerCapture(event.pointerId);
    this.take({ ...on, pointer: event.pointerId, event, drag: new Drag(this.pointing, event, on.place), started: event.clientX });
  }

  on(event) { return this.pointing.onArm(event) || this.onFurniture(event); }

  // A finger beside the arm turns the camera, and so does the next one.
  cameraTurns(event) {
    if (event.pointerType !== "touch") return false;
    if (event.isPrimary) this.fingers = new Set();
    return (this.fingers ??= new Set()).size > 0 || (!this.on(event) && Boolean(this.fingers.add(event.pointerId)));
  }

  take(held) {
    this.held = { spin: null, toHandle: null, axisOfTurn: this.pointing.toEye(), to: held.place.clone(), ...held };
    this.stage.viewer.controls.enabled = false;
    this.stage.element.classList.add("pulling");
    this.hasPulled = true;
    this.hint();
    this.timer = setInterval(() => this.say(), REPEAT);
    this.say();
  }

  // What can be moved is taken by the hand, which comes to its handle first.
  onFurniture(event) {
    const number = this.teach.furniture.under(event, this.pointing), place = this.teach.instance.tipPosition();
    if (number < 0 || (this.holds >= 0 && number !== this.holds)) return null;
    return { link: null, joint: null, at: null, place, ...(this.holds >= 0 ? {} : { toHandle: number, called: true }) };
  }

  // A drag beside the hand turns the view, which is told to those who have not pulled yet.
  watchView(event) {
    const { camera } = this.stage, before = camera.quaternion.clone();
    const over = () => { this.turnedView = camera.quaternion.angleTo(before) > TOLD; this.hint(); };
    window.addEventListener("pointerup", over, { once: true });
  }

  // A second finger turns the hand by its turn about the first.
  second(event) {
    const { held } = this;
    if (event.pointerType !== "touch" || held.other !== undefined) return;
    Object.assign(held, { other: event.pointerId, angle: angleFrom(held.event, event) });
  }

  move(event) {
    if (!this.held) return this.hover(event);
    if (!this.held.drag) return;
    stop(event);
    const { held } = this;
    if (event.pointerId === held.other) {
      const angle = angleFrom(held.event, event);
      this.turn(held.axisOfTurn, held.angle - angle); // the screen's y points down
      held.angle = angle;
    } else if (event.pointerId !== held.pointer) return;
    else if (event.shiftKey) this.turn(held.axisOfTurn, TURN_PER_PIXEL * (held.event.clientX - event.clientX));
    else {
      if (held.wasTurning) held.drag.anchor(held.event, this.axis);
      held.drag.move(event);
      if (!held.called) this.setMagnet(this.handleUnder(event), event);
      if (held.toHandle === null) held.to = held.drag.place.clone();
    }
    if (event.pointerId === held.pointer) Object.assign(held, { wasTurning: event.shiftKey, event });
    this.changed();
  }

  up(event) {
    const { held } = this;
    if (this.fingers) this.fingers.delete(event.pointerId);
    if (!held || !held.drag) return;
    if (event.pointerId === held.other) held.other = undefined;
    if (event.pointerId !== held.pointer) return;
    if (event.type === "pointerup") stop(event);
    if (held.called && held.toHandle !== null) held.drag = null; // the hand comes all the same
    else this.letGo();
  }

  letGo() {
    const { held } = this;
    if (!held) return;
    if (!this.teach.pose || this.teach.pose.near !== this.freed) this.freed = null;
    clearInterval(this.timer);
    this.held = null;
    this.stage.viewer.controls.enabled = true;
    this.stage.element.classList.remove("pulling");
    this.link.release();
    this.setByKeys(false);
    this.hint();
    this.stage.dirty();
  }

  say() {
    const { link, at, to, spin } = this.held;
    this.link.pull({ do: "pull", link, at: at && at.toArray(), to: to.toArray(), turn: spin && rotationVector(spin).toArray() });
  }

  changed() {
    this.say();
    this.stage.dirty();
  }

  turn(axis, angle) {
    const { held } = this, turn = new THREE.Quaternion().setFromAxisAngle(axis, angle);
    held.spin = turn.multiply(held.spin || new THREE.Quaternion());
  }

  // Where the hand holds the arm as it is drawn now.
  heldAt() {
    const { joint, at } = this.held;
    return at ? at.clone().applyMatrix4(this.teach.instance.jointMatrix(joint)) : this.teach.instance.tipPosition();
  }

  hover(event) {
    const now = performance.now();
    if (event.buttons || event.pointerType === "touch" || now < (this.looked ?? 0) + 60) return; // a ray through many triangles takes a while
    this.looked = now;
    const over = this.teach.allowed && this.on(event);
    this.stage.element.classList.toggle("over-arm", Boolean(over));
  }

  // x, y and z bind the pull to an axis for as long as they are down.
  key(event, down) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (down && name === "Escape" && this.held) { this.letGo(); stop(event); return; }
    if (!(name in AXES) || event.ctrlKey || event.metaKey || event.altKey || isText(event.target)) return;
    const axis = down ? name : this.axis === name ? null : this.axis;
    if (axis === this.axis) return;
    this.axis = axis;
    if (!this.held || !this.held.drag) return;
    stop(event);
    this.held.drag.anchor(this.held.event, axis);
    this.stage.dirty();
  }

  // ---- to a handle ----

  // The number of the handle that the pointer is over, if the hand may come to it by itself.
  handleUnder(event) {
    const { held, teach } = this;
    if (held.link !== null || this.axis || teach.isHeld) return null;
    const gaps = teach.handlePlaces().map((place, i) => (i === this.freed ? Infinity : this.pointing.far(event, place)));
    const nearest = gaps.indexOf(Math.min(...gaps));
    return gaps[nearest] <= MAGNET ? nearest : null;
  }

  // From a handle on, the drag goes in the plane through it.
  setMagnet(number, event) {
    const { held } = this;
    if (number === held.toHandle) return;
    if (number === null) {
      const holds = this.teach.isHeld;
      held.drag.place = holds ? held.to.clone() : this.teach.handlePlaces()[held.toHandle] || held.to.clone();
      held.drag.anchor(event, this.axis, holds);
      if (!holds) held.drag.move(event);
    }
    held.toHandle = number;
    this.glided = undefined;
    this.stage.dirty();
  }

  // With each pose: a pull that goes to a handle comes nearer, and ends there when the gripper has closed.
  setPose(pose) {
    const holds = pose.held.indexOf(true), { held } = this;
    if (this.holds >= 0 && holds < 0) this.freed = this.holds;
    if (holds >= 0) this.freed = null;
    if (this.holds !== holds) Object.assign(this, { holds, goes: null, was: null });
    this.feel(this.teach.handlePlaces()[holds]);
    if (held && held.toHandle !== null) this.glide(pose);
    this.teach.furniture.lit = held ? held.toHandle : null;
    this.hint();
  }

  get piece() { return this.teach.furniture.pieces[this.holds]; }

  glide(pose) {
    const { held } = this, place = this.teach.handlePlaces()[held.toHandle];
    if (!place || this.holds >= 0) {
      if (held.drag) this.setMagnet(null, held.event);
      else if (held.called) return this.letGo();
      Object.assign(held, { toHandle: null, called: false });
      return;
    }
    if (held.called && !held.asked && pose.near === held.toHandle) { // also where it was opened a moment ago
      held.asked = true;
      this.teach.panel.grip();
    }
    const away = place.clone().sub(held.to), most = GLIDE * Math.min(Math.max(pose.time - (this.glided ?? pose.time), 0.005), 0.1);
    this.glided = pose.time;
    held.to.add(away.clampLength(0, most));
    this.say();
  }

  // What to do next, beside the hand.
  hint() {
    const { held, teach } = this, words = !held ? (this.turnedView && !this.hasPulled ? "That turned the view. To move the hand, drag the ring; Fit shows everything." : "") : held.toHandle !== null ? "let it come: the gripper closes by itself" : this.freed !== null && teach.pose.near === this.freed ? `${TOUCH.matches ? "Grip" : "G"} closes the gripper again` : this.isFirm() && !held.spin ? `held firmly: ${TOUCH.matches ? "a second finger" : "shift"} turns the hand with it` : held.drag && !this.axis && this.isHardToSee() ? `it moves towards you or away: turn the view${TOUCH.matches ? "" : ", or hold x, y or z"}` : "";
    if (words === this.hinted) return;
    this.hinted = words;
    get("hand-hint").textContent = words;
    get("hand-hint").hidden = !words;
    if (words) teach.tell(words);
  }

  // Which way a handle that is held goes: known of what slides, else seen.
  feel(place) {
    const { piece } = this;
    if (!place || !piece || this.teach.scene.kind === "table") return;
    this.was ??= place;
    if (piece.handle.unit === "m") this.goes = piece.out;
    else if (place.distanceTo(this.was) > FELT) Object.assign(this, { goes: place.clone().sub(this.was).normalize(), was: place });
  }

  // Whether what is held turns the hand with it.
  isFirm() { return this.piece && this.piece.handle.firm && this.piece.handle.unit === "rad"; }

  // Whether what is held moves towards the viewer, or away.
  isHardToSee() { return Boolean(this.goes) && Math.abs(this.goes.dot(this.pointing.toEye())) > AT_VIEWER; }

  // ---- by keys ----

  toNearest() {
    const places = this.teach.handlePlaces(), tip = this.teach.instance.tipPosition();
    if (!this.teach.allowed || this.teach.isHeld || !places.length) return;
    if (!this.byKeys) this.startByKeys();
    const gaps = places.map((place) => place.distanceTo(tip));
    this.held.toHandle = gaps.indexOf(Math.min(...gaps));
    this.glided = undefined;
  }

  turnByKeys() { if (this.byKeys) this.letGo(); else this.startByKeys(); }

  startByKeys() {
    if (!this.teach.allowed) return;
    this.letGo();
    this.stage.element.focus({ preventScroll: true });
    this.take({ link: null, joint: null, at: null, place: this.teach.instance.tipPosition(), drag: null });
    this.setByKeys(true);
  }

  setByKeys(on) {
    if (on === this.byKeys) return;
    this.byKeys = on;
    get("by-keys").setAttribute("aria-pressed", String(on));
    get("by-keys-help").hidden = !on;
    this.teach.tell(on ? "The keys move the hand: arrows, page up and page down; with shift they turn it. N goes to the nearest handle, G grips, escape lets go." : "The arm is let go.");
  }

  // To the right, upwards and away; with shift about the picture's axes that point up, to the left and to the eye.
  moveByKey(event) {
    const [k, sign] = KEYED[event.key] || [], right = this.pointing.toRight(), eye = this.pointing.toEye();
    if (!this.byKeys || !sign || event.ctrlKey || event.metaKey || event.altKey) return;
    stop(event);
    if (event.shiftKey) this.turn([eye.clone().cross(right), right.clone().negate(), eye][k], sign * TURN_STEP);
    else {
      this.held.toHandle = null;
      this.held.to.addScaledVector([right, AXES.z, AXES.z.clone().cross(right)][k], sign * STEP);
    }
    this.changed();
  }
}

function stop(event) {
  event.preventDefault();
  event.stopImmediatePropagation();
}

function rotationVector(q) {
  const sine = Math.hypot(q.x, q.y, q.z), angle = 2 * Math.atan2(sine, q.w);
  return new THREE.Vector3(q.x, q.y, q.z).multiplyScalar(sine > 1e-12 ? wrapped(angle) / sine : 2);
}

function angleFrom(first, second) { return Math.atan2(second.clientY - first.clientY, second.clientX - first.clientX); }

function wrapped(angle) { return Math.atan2(Math.sin(angle), Math.cos(angle)); }

function isText(target) { return Boolean(target.matches && target.matches("input[type=text]")); }
