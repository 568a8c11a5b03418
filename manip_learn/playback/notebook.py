"""A page in the cell of a notebook: the first cell has meshcat's viewer, later ones take it from there."""

from __future__ import annotations

import sys
from html import escape
from typing import Any

from manip_learn.playback.page_writer import script_hash, viewer_script

_MISSING = "The viewer is in this notebook's first replay. If this stays empty, restart the kernel and run all cells."
# asks the notebook for the viewer until it answers, since a notebook may draw its cells in any order
_ASK = """addEventListener("message", ({ data }) => {
  if (!data.manipLearnViewer || window.MeshCat) return;
  clearInterval(asking);
  document.getElementById("missing").remove();
  for (const text of [data.manipLearnViewer, document.getElementById("program").textContent])
    document.body.append(Object.assign(document.createElement("script"), { textContent: text }));
});
const asking = setInterval(() => parent.postMessage("manip-learn: viewer", "*"), 300);"""
_ANSWER = """<script>(() => {
  const kept = () => (window.manipLearnViewer ??= document.querySelector("script[data-manip-learn]")?.textContent);
  kept();
  const isDark = Number(getComputedStyle(document.body).color.match(/[0-9.]+/)[0]) > 127; // letters are light
  const scheme = isDark ? "dark" : "light";
  for (const frame of document.querySelectorAll("iframe[title=replay]")) frame.style.colorScheme = scheme;
  addEventListener("message", ({ data, source }) => {
    if (data === "manip-learn: viewer" && kept()) source.postMessage({ manipLearnViewer: kept() }, "*");
  });
})()</script>"""
_cell: Any = False  # that has the viewer; False: none has


def in_cell(page: str) -> str:
    """Return a page as the output of a notebook's cell.

    Args:
        page: As `page_writer.page` writes it.
    """
    global _cell
    cell, viewer = _running_cell(), viewer_script()
    before, after = page.split(f"<script>{viewer}</script>\n<script>")
    inner = before.replace("script-src ", f"script-src {script_hash(_ASK)} ", 1)
    inner += f'<p id="missing">{_MISSING}</p><script type="text/plain" id="program">{after}<script>{_ASK}</script>'
    html = (
        f'<iframe title="replay" srcdoc="{escape(inner)}" style="width:100%;height:640px;border:0" '
        f'sandbox="allow-scripts"></iframe>{_ANSWER}'
    )
    # run again, the first cell has it again; in Colab each cell is a page of its own
    if _cell is False or (cell is not None and cell == _cell) or "google.colab" in sys.modules:
        _cell = cell
        html = f'<script type="text/plain" data-manip-learn>{viewer}</script>{html}'
    return html


def _running_cell() -> str | None:
    """Return the name of the cell that runs, where the notebook tells it."""
    ipython = sys.modules.get("IPython")
    shell: Any = ipython.get_ipython() if ipython is not None else None
    try:
        return shell.get_parent()["metadata"]["cellId"]
    except (AttributeError, KeyError, TypeError):  # no kernel, or a front end that does not name its cells
        return None
