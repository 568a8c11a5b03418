// How well each stretch of a recording fits the constraint: colours of paths and bands.

// Share of the motion that breaks the constraint -> colour: blue fits, yellow is doubtful, vermilion does not fit.
const FIT_SCALE = [[0, "#0b4f8a"], [0.03, "#3f9fd8"], [0.1, "#f0e442"], [0.3, "#e07000"], [1, "#8c1c00"]];
const AT_REST = "#98a3ae", FIT_BINS = 240;
const colouring = { mode: "phase" };

function mixed(a, b, share) {
  const parts = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)), from = parts(a), to = parts(b);
  return `#${from.map((x, k) => Math.round(x + share * (to[k] - x)).toString(16).padStart(2, "0")).join("")}`;
}

function fitColour(share) {
  if (Number.isNaN(share)) return AT_REST;
  let i = 0;
  while (i + 2 < FIT_SCALE.length && share >= FIT_SCALE[i + 1][0]) i++;
  const [low, from] = FIT_SCALE[i], [high, to] = FIT_SCALE[i + 1];
  return mixed(from, to, Math.min(Math.max((share - low) / (high - low), 0), 1));
}

// The curve of the fit, if the recording has one.
function fitOf(rollout) { return rollout.byKind?.get("fit")?.curves[0] ?? null; }

function colourOfPath(rollout, t) {
  if (colouring.mode === "fit" && rollout.fit) return onScreen(fitColour(valueAt(rollout.fit, t)));
  return hasPhaseColours(rollout) ? onScreen((phaseAt(rollout, t) || NO_PHASE).colour) : rollout.colour;
}

// Spans of a recording and the largest share in each, so that no misfit is lost; NaN where it rests.
function fitBins({ times, values }, duration, bins = FIT_BINS) {
  const worst = new Array(bins).fill(NaN), filled = new Array(bins).fill(false);
  for (let i = 0; i < times.length; i++) {
    const k = Math.min(Math.floor((times[i] / Math.max(duration, 1e-9)) * bins), bins - 1);
    filled[k] = true;
    if (!(worst[k] >= values[i]) && !Number.isNaN(values[i])) worst[k] = values[i];
  }
  return worst.map((share, k) => (filled[k] ? share : valueAt({ times, values }, ((k + 0.5) / bins) * duration)));
}

function fitBands({ fit, duration }, whole) {
  const bins = Math.max(8, Math.min(FIT_BINS, Math.round((duration / Math.max(whole, 1e-9)) * FIT_BINS), fit.times.length)), step = duration / bins;
  const label = (share) => (Number.isNaN(share) ? "at rest, or not measured" : `${(100 * share).toFixed(1)} % of the motion breaks the constraint`);
  return fitBins(fit, duration, bins).map((share, k) => ({ start: k * step, end: (k + 1) * step, kind: { label: label(share), colour: fitColour(share) } }));
}

// The colours of the scale, as entries of the key.
function fitKey() {
  const steps = FIT_SCALE.map(([share, colour]) => ({ colour, label: `${100 * share} %`, mark: "", ink: "" }));
  return [...steps, { colour: AT_REST, label: "at rest, or not measured", mark: "", ink: "" }];
}

// A choice between the colours of phases (or of the recordings) and those of the fit.
function colourChoice(show, hasPhases) {
  const modes = { phase: hasPhases ? "phases" : "one colour each", fit: "share of the motion that breaks the constraint" };
  const choose = (mode) => () => { colouring.mode = mode; show.recolour(); };
  const choices = Object.entries(modes).map(([mode, text]) => checkbox(text, colouring.mode === mode, choose(mode), { type: "radio", name: "colours", value: mode }));
  return make("fieldset", {}, make("legend", {}, "Colours of recordings"), choices);
}
