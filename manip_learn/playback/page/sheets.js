// Elements of the page; and cards that open below its head: one button each, one open at a time.

// Properties with a dash, and the role, are attributes; what is null or false of the content is left out.
function make(tag, properties = {}, ...content) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) if (name === "role" || name.includes("-")) element.setAttribute(name, value); else element[name] = value;
  element.append(...content.flat().filter(Boolean));
  return element;
}

function addSheet(id, label, title) {
  let bar = get("sheets");
  if (!bar) {
    bar = make("div", { id: "sheets", role: "group", "aria-label": "Cards" });
    get("views").before(bar);
    document.addEventListener("keydown", (event) => { if (event.key === "Escape") bar.querySelectorAll("details[open]").forEach(closeList); });
  }
  const card = make("section", { className: "sheet", "aria-label": title, tabIndex: 0 }, make("h3", {}, title)); // scrolled by keys, too
  const details = make("details", { id }, make("summary", {}, label), card);
  details.addEventListener("toggle", () => { if (details.open) for (const other of bar.querySelectorAll("details")) other.open = other === details; });
  bar.append(details);
  return card;
}

function checkbox(label, checked, onChange, more = {}) {
  const box = make("input", { type: "checkbox", ...more, checked });
  box.addEventListener("change", () => onChange(box.checked));
  return make("label", { className: "check" }, box, make("span", {}, label));
}

function paragraph(text, className = "") { return make("p", { className }, text); }

function tableOf(caption, heads, rows) {
  const table = make("table", {}, make("caption", {}, caption)), head = table.createTHead().insertRow(), body = table.createTBody();
  head.append(...heads.map((text) => make("th", { scope: "col" }, text)));
  for (const cells of rows) body.insertRow().append(...cells.map((text) => make("td", {}, text)));
  return table;
}

function fillNotes(notes) {
  const box = get("notes");
  box.hidden = notes.length === 0;
  box.querySelector("summary").textContent = notes.length === 1 ? "1 note" : `${notes.length} notes`;
  box.querySelector("ul").replaceChildren(...notes.map((note) => make("li", {}, note)));
}

// The line at the head of a page whose program goes on.
function sayHead(text, lost) {
  get("subtitle").textContent = text;
  get("subtitle").classList.toggle("lost", lost);
}
