// The legend of what is drawn in the scene: a swatch and words for each kind of mark, those that are drawn now alone.

const MECHANISM_WORDS = { line: "line that was learnt", hinge: "axis that was learnt", screw: "axis that was learnt", plane: "plane that was learnt", ball: "ball that was learnt" };

class SceneKey {
  constructor(stage, rows) {
    this.list = make("ul", { id: "scene-key", "aria-label": "What is drawn" });
    this.rows = [];
    stage.element.after(this.list);
    for (const row of rows) this.add(row);
  }

  // ink: a colour of style.css; say: its words, none while nothing of the kind is drawn; form: "line" or "ball" for its swatch.
  add({ ink, say, form = "" }) {
    const element = make("li", { className: form, hidden: true, style: `--colour: var(${ink})` });
    this.list.append(element);
    this.rows.push({ element, say });
  }

  update() {
    for (const { element, say } of this.rows) {
      const words = say() || "";
      element.hidden = !words;
      if (element.textContent !== words) element.textContent = words;
    }
  }
}
