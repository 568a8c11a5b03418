// Where frames take long, as without a graphics card, simpler ones while something moves, and a full one once it rests.

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // names of what draws without a graphics card
const SLOW = { frame: 45, frames: 8 }; // a frame that takes longer is late [ms]; so many late ones in a row are too slow
const REST = 600; // [ms] without a change until the full frame

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
  // apply: sets { shadows, pixels }, these for one of CSS. Without smooth edges a full frame has twice as many along a side.
  constructor(software, apply) {
    const ratio = window.devicePixelRatio || 1, full = { shadows: true, pixels: software ? 2 : Math.min(ratio, 2) };
    this.levels = [full, { shadows: false, pixels: Math.min(ratio, 1) }, { shadows: false, pixels: 0.6 }];
    Object.assign(this, { apply, level: software ? this.levels.length - 1 : 0, late: 0, changed: 0 });
    this.set(0);
  }

  set(level) {
    if (level !== this.drawn) this.apply(this.levels[level]);
    this.drawn = level;
  }

  // Whether a frame is due; only between two that follow each other it is known how long one takes.
  isDue(now, changed) {
    const took = now - (this.last ?? now), isLate = changed && took > SLOW.frame;
    this.last = changed && !document.hidden ? now : undefined;
    this.late = isLate ? this.late + 1 : 0;
    if (this.late >= SLOW.frames && this.level < this.levels.length - 1) Object.assign(this, { level: this.level + 1, late: 0 });
    if (changed) this.changed = now;
    const rests = !changed && this.drawn > 0 && now > this.changed + REST;
    if (changed || rests) this.set(rests ? 0 : this.level);
    return changed || rests;
  }
}
