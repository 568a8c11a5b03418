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
