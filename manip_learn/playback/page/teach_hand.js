// The hand that takes the arm: by the mouse, by fingers, by keys.

const REPEAT = 200; // [ms] after which a pull that is held is said again
const TURN_PER_PIXEL = Math.PI / 360; // [rad] of the hand for a pixel to the side, with shift
const STEP = 0.01, SMALL_STEP = 0.005; // [m] of the pull for a key

class Hand {
  constructor(teach) {
    Object.assign(this, { teach, stage: teach.stage, link: teach.link, pointing: teach.pointing, held: null, axis: null, byKeys: false });
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
    const goal = this.teach.goal.at(event), on = goal || this.pointing.onArm(event);
    if (!on) return;
    stop(event);
    this.stage.element.focus({ preventScroll: true });
    this.stage.element.setPointerCapture(event.pointerId);
    this.setByKeys(false);
    this.take({ ...on, goal: Boolean(goal), pointer: event.pointerId, event, drag: new Drag(this.pointing, event, on.place), started: event.clientX });
  }

  // A finger beside the arm turns the camera, and so does the next one.
  cameraTurns(event) {
    if (event.pointerType !== "touch") return false;
    if (event.isPrimary) this.fingers = new Set();
    return (this.fingers ??= new Set()).size > 0 || (!this.teach.goal.at(event) && !this.pointing.onArm(event) && Boolean(this.fingers.add(event.pointerId)));
  }

  take(held) {
    this.held = { turn: 0, axisOfTurn: this.pointing.toEye(), to: held.place.clone(), ...held };
    this.stage.viewer.controls.enabled = false;
    this.stage.element.classList.add("pulling");
    if (held.goal) return;
    this.timer = setInterval(() => this.say(), REPEAT);
    this.say();
  }

  // A second finger turns the hand by its turn about the first.
  second(event) {
    const { held } = this;
    if (event.pointerType !== "touch" || held.other !== undefined || held.goal) return;
    Object.assign(held, { other: event.pointerId, angle: angleFrom(held.event, event) });
  }

  move(event) {
    if (!this.held) return this.hover(event);
    if (!this.held.drag) return;
    stop(event);
    const { held } = this;
    if (event.pointerId === held.other) {
      const angle = angleFrom(held.event, event);
      held.turn -= wrapped(angle - held.angle); // the screen's y points down
      held.angle = angle;
    } else if (event.pointerId !== held.pointer) return;
    else if (event.shiftKey && !held.goal) held.turn -= TURN_PER_PIXEL * (event.clientX - held.event.clientX);
    else {
      if (held.wasTurning) held.drag.anchor(held.event, this.axis);
      held.drag.move(event);
      held.to = held.drag.place.clone();
    }
    if (event.pointerId === held.pointer) Object.assign(held, { wasTurning: event.shiftKey, event });
    if (held.goal) this.teach.goal.moveTo(held.to);
    else this.say();
    this.stage.dirty();
  }

  up(event) {
    const { held } = this;
    if (this.fingers) this.fingers.delete(event.pointerId);
    if (!held || !held.drag) return;
    if (event.pointerId === held.other) held.other = undefined;
    if (event.pointerId !== held.pointer) return;
    if (event.type === "pointerup") stop(event);
    this.letGo();
  }

  letGo() {
    const { held } = this;
    if (!held) return;
    clearInterval(this.timer);
    this.held = null;
    this.stage.viewer.controls.enabled = true;
    this.stage.element.classList.remove("pulling");
    if (held.goal) this.teach.goal.drop();
    else this.link.release();
    this.setByKeys(false);
    this.stage.dirty();
  }

  say() {
    const { link, at, to, turn, axisOfTurn } = this.held;
    const vector = Math.abs(turn) > 1e-9 ? axisOfTurn.clone().multiplyScalar(turn).toArray() : null;
    this.link.pull({ do: "pull", link, at: at && at.toArray(), to: to.toArray(), turn: vector });
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
    const over = this.teach.allowed && (this.teach.goal.at(event) || this.pointing.onArm(event));
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

  // ---- by keys ----

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
    this.teach.tell(on ? "The keys move the hand: arrows, page up and page down. G grips, escape lets go." : "The arm is let go.");
  }

  moveByKey(event) {
    const { key } = event;
    if (!this.byKeys || event.ctrlKey || event.metaKey || event.altKey) return;
    const right = this.pointing.toRight(), away = new THREE.Vector3(0, 0, 1).cross(right);
    const by = { ArrowLeft: right.clone().negate(), ArrowRight: right, ArrowUp: AXES.z.clone(), ArrowDown: AXES.z.clone().negate(), PageUp: away, PageDown: away.clone().negate() }[key];
    if (!by) return;
    stop(event);
    this.held.to.addScaledVector(by, event.shiftKey ? SMALL_STEP : STEP);
    this.say();
    this.stage.dirty();
  }
}

function stop(event) {
  event.preventDefault();
  event.stopImmediatePropagation();
}

function angleFrom(first, second) { return Math.atan2(second.clientY - first.clientY, second.clientX - first.clientX); }

function wrapped(angle) { return Math.atan2(Math.sin(angle), Math.cos(angle)); }

function isText(target) { return Boolean(target.matches && target.matches("input[type=text]")); }
