// The handles of the fixtures that a rollout moves: in the hand while it has hold of them, else where it left them.

class Handle {
  constructor(rollout, spans, size) {
    this.spans = spans;
    const ink = new THREE.MeshStandardMaterial({ roughness: 0.5 });
    onTheme(() => ink.color.copy(linear(pageColour("--handle"))));
    this.mesh = new THREE.Mesh(new THREE.SphereGeometry(size, 24, 16), ink);
    rollout.instance.root.add(this.mesh);
  }

  // When the hand last had hold of it, at time t.
  timeOf(t) {
    const past = this.spans.filter(([start]) => start <= t), [, end] = past[past.length - 1] || [0, this.spans[0][0]];
    return past.length ? Math.min(t, end) : end;
  }

  setTime(t, placeAt) { this.mesh.position.copy(placeAt(this.timeOf(t))); }
}

// "0.214 m", or degrees: how far the fixtures of a rollout have moved.
function openInWords(rollout, t) {
  const words = [];
  for (const [kind, say] of [["opening", (x) => `${x.toFixed(3)} m`], ["turning", (x) => `${((x * 180) / Math.PI).toFixed(1)}°`]]) {
    const track = rollout.byKind.get(kind);
    for (const curve of track ? track.curves : []) words.push(`moved ${say(valueAt(curve, Math.min(t, curve.times[curve.times.length - 1])))}`);
  }
  return words.join(", ");
}
