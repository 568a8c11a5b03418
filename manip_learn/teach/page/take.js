// What can be taken home, and what is brought along.

const MOST_DROPPED = 10 * 1024 * 1024; // [bytes] of a recording
const SETTLED = 1500, GIVEN_UP = 60000; // [ms] after which a file that was there already is taken, and none is awaited any more
// what is asked for -> its name
const TAKEN = { constraint: "constraint.json", csv: "recordings_csv.zip", lerobot: "recordings_lerobot.zip", replay: "replay.html", script: "taught.py" };

class Take {
  constructor(teach) {
    Object.assign(this, { teach, root: teach.link.root, link: teach.link, files: [], asked: [] });
    for (const button of document.querySelectorAll("[data-take]")) button.addEventListener("click", () => this.ask(button.dataset.take));
    get("csv").addEventListener("change", () => { this.bring(get("csv").files[0]); get("csv").value = ""; });
    this.wireDrop();
  }

  ask(what) {
    const before = new Set(this.files.map((file) => file.name));
    this.asked.push({ what, before, when: performance.now() });
    this.link.say({ do: "take", what });
    setTimeout(() => this.match(), SETTLED + 10);
  }

  set(files, keep, writing) {
    this.writing = writing;
    const said = JSON.stringify(files);
    if (said !== this.filesSaid) {
      this.filesSaid = said;
      this.files = files;
      get("files").replaceChildren(...files.map((file) => this.row(file)));
    }
    get("keep").textContent = keep ? `Everything is kept in ${keep}` : "";
    this.match();
  }

  address(name) { return `${this.root}files/${encodeURIComponent(name)}`; }

  row({ name, says }) {
    const item = document.createElement("li"), link = Object.assign(document.createElement("a"), { href: this.address(name), download: name, textContent: name });
    item.append(link, says ? ` ${says}` : "");
    return item;
  }

  // A file that was not there before; one that was there once nothing is written any more.
  match() {
    this.asked = this.asked.filter(({ what, before, when }) => {
      const age = performance.now() - when, late = age > SETTLED;
      const name = TAKEN[what], there = this.files.some((file) => file.name === name), written = !before.has(name) || (late && !this.writing);
      if (there && written) this.download(name);
      return !(there && written) && age < GIVEN_UP;
    });
  }

  download(name) {
    const link = Object.assign(document.createElement("a"), { href: this.address(name), download: name });
    document.body.append(link);
    link.click();
    link.remove();
  }

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
