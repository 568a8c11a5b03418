// Cards that open below the head of the page: one button each, one open at a time.

function addSheet(id, label, title) {
  let bar = get("sheets");
  if (!bar) {
    bar = Object.assign(document.createElement("div"), { id: "sheets" });
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Cards");
    get("views").before(bar);
    document.addEventListener("keydown", (event) => {
      const open = bar.querySelector("details[open]");
      if (event.key !== "Escape" || !open) return;
      open.open = false;
      open.querySelector("summary").focus();
    });
  }
  const details = Object.assign(document.createElement("details"), { id }), summary = document.createElement("summary");
  summary.textContent = label;
  const card = Object.assign(document.createElement("section"), { className: "sheet" }), head = document.createElement("h3");
  head.textContent = title;
  card.setAttribute("aria-label", title);
  card.tabIndex = 0; // so that it can be scrolled by keys
  card.append(head);
  details.append(summary, card);
  details.addEventListener("toggle", () => { if (details.open) for (const other of bar.querySelectorAll("details")) other.open = other === details; });
  bar.append(details);
  return card;
}

function checkbox(label, on, onChange, data = {}) {
  const row = Object.assign(document.createElement("label"), { className: "check" }), box = Object.assign(document.createElement("input"), { type: "checkbox", checked: on });
  Object.assign(box.dataset, data);
  box.addEventListener("change", () => onChange(box.checked));
  const text = document.createElement("span");
  text.append(label);
  row.append(box, text);
  return row;
}

function paragraph(text, className = "") {
  return Object.assign(document.createElement("p"), { textContent: text, className });
}
