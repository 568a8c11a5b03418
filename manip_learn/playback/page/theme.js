// Colours of the page, light or dark, under the names that style.css gives them.

const DARK = matchMedia("(prefers-color-scheme: dark)");

function pageColour(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

// Now, and whenever the page turns dark or light.
function onTheme(apply) {
  apply();
  DARK.addEventListener("change", apply);
}
