// Why the constraint should be believed: the report in words.

function fillEvidence(evidence) {
  if (!evidence || !(evidence.headline || evidence.facts.length)) return;
  const card = addSheet("evidence", "Evidence", "What was learnt, and why to believe it");
  if (evidence.headline) card.append(paragraph(evidence.headline, "headline"));
  if (evidence.kind) card.append(paragraph(evidence.kind));
  if (evidence.facts.length) card.append(factList(evidence.facts));
  if (evidence.words) card.append(paragraph(evidence.words));
  if (evidence.rows.length) card.append(rowTable(evidence.rows));
  for (const warning of evidence.warnings) card.append(paragraph(`Take care: ${warning}`, "warning"));
  const said = evidence.warnings.join();
  for (const [name, reason] of evidence.odd.filter(([name]) => !said.includes(name))) card.append(paragraph(`${name} does not agree with the others: ${reason}`, "warning"));
  for (const note of evidence.notes) card.append(paragraph(note, "note"));
}

function factList(facts) {
  const list = Object.assign(document.createElement("dl"), { className: "facts" });
  for (const [label, value, meaning] of facts) {
    const term = document.createElement("dt"), said = document.createElement("dd"), strong = document.createElement("b");
    term.textContent = label;
    strong.textContent = value;
    said.append(strong, ` ${meaning}`);
    list.append(term, said);
  }
  return list;
}

// Each row of the test: joints exchanged between recordings would use a held row so many times more.
function rowTable(rows) {
  const caption = "Recombination test: how many times more the motion would use a row if the joints of different recordings were combined; p: the chance of that by accident";
  return tableOf(caption, ["row", "verdict", "strength", "chance"], rows);
}

function tableOf(caption, heads, rows) {
  const table = document.createElement("table"), head = table.createTHead().insertRow(), body = table.createTBody();
  table.createCaption().textContent = caption;
  for (const text of heads) head.append(Object.assign(document.createElement("th"), { textContent: text, scope: "col" }));
  for (const cells of rows) {
    const line = body.insertRow();
    for (const text of cells) line.insertCell().textContent = text;
  }
  return table;
}

// What became of each way.
function fillDone(rows) {
  if (!rows.length) return;
  const known = ["", "took hold at", "way", "off", "fastest joint", "margin"].map((head, k) => ({ head, k })).filter(({ k }) => rows.some((row) => row[k]));
  const caption = "Off: the largest distance of the hand from what holds it; margin: the least share of a limit that is left";
  addSheet("done", "Done", "What was done").append(tableOf(caption, known.map(({ head }) => head), rows.map((row) => known.map(({ k }) => row[k]))));
}
