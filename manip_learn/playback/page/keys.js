// Keys that work wherever the focus is, the list of them, the camera's buttons, and the picture on paper.

// What a control does with a key by itself is left to it.
function isOwnKey(target, key) {
  if (target.tagName === "SELECT" || target.closest?.(".sheet")) return true;
  return key === " " && (target.tagName === "SUMMARY" || (target.tagName === "BUTTON" && target.id !== "play"));
}

function wireKeys(actions) {
  const list = get("keys");
  const all = { ...actions, "?": () => { list.open = !list.open; }, Escape: () => closeList(list) };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const action = all[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || (event.key !== "?" && event.key !== "Escape" && isOwnKey(event.target, event.key))) return;
    event.preventDefault();
    action(event);
  });
  document.addEventListener("pointerdown", (event) => { if (!list.contains(event.target)) list.open = false; });
  document.addEventListener("click", () => { if (document.activeElement.tagName !== "SELECT") releaseFocus(document.activeElement); });
}

function lookFrom(show, view) {
  if (show.stage) show.stage.look(view === "fit" ? show.stage.view : view);
}

function wireCamera(show) {
  for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => lookFrom(show, button.dataset.view));
  get("save").addEventListener("click", () => {
    if (show.stage) Object.assign(document.createElement("a"), { href: show.stage.picture(), download: `${get("robot-name").textContent}.png` }).click();
  });
}

function cameraKeys(show) {
  const views = { f: "fit", 1: "iso", 2: "front", 3: "side", 4: "top" };
  return Object.fromEntries(Object.entries(views).map(([key, view]) => [key, () => lookFrom(show, view)]));
}

function closeList(list) {
  if (list.open && list.contains(document.activeElement)) list.querySelector("summary").focus();
  list.open = false;
}

// A choice made with the mouse gives the keyboard back to the player; one made with keys keeps the focus.
function releaseFocus(control) { if (!control.matches(":focus-visible")) control.blur(); }

// Browsers print an empty canvas: a picture takes its place on paper.
function wirePrinting(stage) {
  let picture = null;
  window.addEventListener("beforeprint", () => {
    picture = Object.assign(document.createElement("img"), { className: "print", alt: "The robot", src: stage.picture() });
    stage.element.append(picture);
  });
  window.addEventListener("afterprint", () => picture && picture.remove());
}
