// From a place on the screen to the arm: rays, what they hit, and where a dragged point goes.

const TIP_RING = 24, FINGER_WIDTH = 10; // [px]: around the tip, and around a finger, within which the arm is hit
const ALONG_VIEW = 0.02; // squared sine of the angle to the view below which a drag along an axis is not defined

// The viewer's world is y-up.
function inBase(v) { return new THREE.Vector3(v.x, -v.z, v.y); }

class Pointing {
  constructor(stage, instance) {
    Object.assign(this, { stage, instance, caster: new THREE.Raycaster() });
  }

  cast({ clientX, clientY }) {
    const box = this.stage.element.getBoundingClientRect();
    this.stage.camera.updateMatrixWorld();
    this.caster.setFromCamera(new THREE.Vector2((2 * (clientX - box.left)) / box.width - 1, 1 - (2 * (clientY - box.top)) / box.height), this.stage.camera);
    return new THREE.Ray(inBase(this.caster.ray.origin), inBase(this.caster.ray.direction));
  }

  // From the scene to the eye, in the robot's base.
  toEye() { return inBase(this.stage.camera.getWorldDirection(new THREE.Vector3())).negate(); }

  // To the right of the picture, level.
  toRight() { return AXES.z.clone().cross(this.toEye()).normalize(); }

  // On the page [px]; null behind the camera.
  onPage(place) {
    const at = this.stage.onScreen(place), box = this.stage.element.getBoundingClientRect();
    return at && { x: box.left + at.x, y: box.top + at.y };
  }

  far(event, place) {
    const at = this.onPage(place);
    return at ? Math.hypot(at.x - event.clientX, at.y - event.clientY) : Infinity;
  }

  // What the pointer is on: the tip (link null), a point of a link in its joint's frame, or nothing.
  onArm(event) {
    const tip = this.instance.tipPosition();
    if (this.far(event, tip) <= TIP_RING) return { link: null, joint: null, at: null, place: tip };
    const sides = event.pointerType === "touch" ? [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]] : [[0, 0]];
    for (const [x, y] of sides) {
      const found = this.shapeAt({ clientX: event.clientX + FINGER_WIDTH * x, clientY: event.clientY + FINGER_WIDTH * y });
      if (found) return found;
    }
    return null;
  }

  shapeAt(where) {
    this.cast(where);
    const skins = this.instance.meshes.map(({ skin }) => skin).filter((skin) => skin.visible && skin.userData.shape.joint > 0);
    const [hit] = this.caster.intersectObjects(skins, false);
    if (!hit) return null;
    const { joint } = hit.object.userData.shape, link = this.instance.robot.links.find((one) => one.joint === joint);
    if (!link) return null;
    const place = inBase(hit.point);
    return { link: link.name, joint, at: place.clone().applyMatrix4(this.instance.jointMatrix(joint).invert()), place };
  }

  // Where the pointer is in the plane of the view through a place, or along an axis through it; null if that is undefined.
  dragged(event, through, axis) {
    const ray = this.cast(event);
    if (!axis) return ray.intersectPlane(new THREE.Plane().setFromNormalAndCoplanarPoint(this.toEye(), through), new THREE.Vector3());
    const d = AXES[axis], c = d.dot(ray.direction), sine = 1 - c * c, apart = through.clone().sub(ray.origin);
    if (sine < ALONG_VIEW) return null;
    return through.clone().addScaledVector(d, (c * apart.dot(ray.direction) - apart.dot(d)) / sine);
  }
}

// A point that follows the pointer from where it was taken, without a jump.
class Drag {
  constructor(pointing, event, place) {
    Object.assign(this, { pointing, place: place.clone() });
    this.anchor(event, null);
  }

  // From here on along this axis, or in the plane of the view; without a jump, or else to the pointer itself.
  anchor(event, axis, smooth = true) {
    Object.assign(this, { axis, through: this.place.clone(), offset: new THREE.Vector3() });
    if (smooth) this.offset.copy(this.through).sub(pointOr(this.pointing.dragged(event, this.through, axis), this.through));
  }

  move(event) {
    const at = this.pointing.dragged(event, this.through, this.axis);
    if (at) this.place = at.add(this.offset);
  }
}

function pointOr(point, other) { return point || other.clone(); }
