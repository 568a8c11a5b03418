// Why the constraint should be believed: the report in words; and what became of each way.

function fillEvidence(evidence) {
  if (!evidence || !(evidence.headline || evidence.facts.length)) return;
  const { headline, kind, facts, words, rows } = evidence, card = addSheet("evidence", "Evidence", "What was learnt, and why to believe it");
  card.append(paragraph(headline, "headline"), paragraph(kind), factList(facts), paragraph(words));
  if (rows.length) card.append(rowTable(rows));
}

function factList(facts) {
  return make("dl", { className: "facts" }, facts.flatMap(([label, value]) => [make("dt", {}, label), make("dd", {}, value)]));
}

// Each row of the test: joints exchanged between recordings would use a held row so many times more.
function rowTable(rows) {
  const caption = "Recombination test: how many times more the motion would use a row if the joints of different recordings were combined; p: the chance of that by accident";
  return tableOf(caption, ["row", "verdict", "strength", "chance"], rows);
}

function fillDone(rows) {
  if (!rows.length) return;
  const heads = ["", "grasp at", "way", "off", "fastest joint", "margin"], known = heads.map((_, k) => k).filter((k) => rows.some((row) => row[k]));
  const caption = "Off: the largest distance of the hand from what holds it; margin: the least share of a limit that is left";
  addSheet("done", "Done", "What was done").append(tableOf(caption, known.map((k) => heads[k]), rows.map((row) => known.map((k) => row[k]))));
}
