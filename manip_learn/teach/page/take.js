// What can be taken home, and what is brought along.

const MOST_DROPPED = 10 * 1024 * 1024; // [bytes] of a recording

class Take {
  constructor(teach) {
    Object.assign(this, { teach, root: teach.link.root, link: teach.link, waits: false });
    for (const button of document.querySelectorAll("[data-take]")) button.addEventListener("click", () => { this.waits = true; this.link.say({ do: "take", what: button.dataset.take }); });
    get("csv").addEventListener("change", () => { this.bring(get("csv").files[0]); get("csv").value = ""; });
    this.wireDrop();
  }

  // What was written since it was asked for is downloaded.
  set(files, keep) {
    const newest = Math.max(0, ...files.map(({ number }) => number)), { newest: before, waits } = this;
    get("keep").textContent = keep ? `Everything is kept in ${keep}` : "";
    if (newest === before) return;
    this.newest = newest;
    get("files").replaceChildren(...files.map(({ name, says }) => make("li", {}, this.anchor(name), says && ` ${says}`)));
    this.waits = false;
    if (waits) for (const { name, number } of files) if (number > before) this.anchor(name).click();
  }

  anchor(name) { return make("a", { href: `${this.root}files/${encodeURIComponent(name)}`, download: name }, name); }

  wireDrop() {
    const sign = get("drop-here"), hasFile = (event) => [...(event.dataTransfer ? event.dataTransfer.types : [])].includes("Files");
    document.addEventListener("dragover", (event) => { if (hasFile(event)) { event.preventDefault(); sign.hidden = false; } });
    document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) sign.hidden = true; });
    document.addEventListener("drop", (event) => {
      if (!hasFile(event)) return;
      event.preventDefault();
      sign.hidden = true;
      for (const file of event.dataTransfer.files) this.bring(file);
    });
  }

  async bring(file) {
    if (!file || !this.teach.allowed) return;
    if (!/\.csv$/i.test(file.name)) this.teach.tell(`${file.name} is no CSV file: drop a recording that ends in .csv.`, true);
    else if (file.size > MOST_DROPPED) this.teach.tell(`${file.name} has ${(file.size / 1048576).toFixed(1)} MB: at most 10 MB can be added.`, true);
    else {
      this.teach.tell(`${file.name} is being read …`, false);
      this.link.say({ do: "drop", name: file.name, text: await file.text() });
    }
  }
}
