"""Write one self-contained HTML page: meshcat's viewer, our program and the data, without network access."""

from __future__ import annotations

import base64
import hashlib
import html
import importlib.util
import json
import re
import sys
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import OutputError

_FOLDER = Path(__file__).with_name("page")


def to_base64(array: np.ndarray, dtype: str) -> str:
    """Return the numbers of an array in base64, row by row.

    Args:
        array: Array of numbers; NaN is allowed.
        dtype: Little-endian NumPy type: `"<f8"`, `"<f4"`, `"<u4"`, `"<u2"` or `"i1"`.
    """
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


@final
@dataclass(frozen=True)
class PageKind:
    """Kind of page: its source files and its network access.

    Attributes:
        mode: `"replay"` for no network access; `"live"` to receive data from its own server; another name to send to it
            too.
        style: Style sheets.
        program: Parts of the program in order.
        markup: HTML between the picture and the curves.
    """

    mode: str
    style: tuple[Path, ...]
    program: tuple[Path, ...]
    markup: tuple[Path, ...] = ()


_PARTS = "scene stage fit phases chart sheets tracks constraint_marks handles around scene_key shown evidence keys"
REPLAY = PageKind(
    "replay",
    (_FOLDER / "style.css", _FOLDER / "tracks.css"),
    tuple(_FOLDER / f"{name}.js" for name in f"quality {_PARTS} legend player live main".split()),
)
LIVE = replace(REPLAY, mode="live")


def render_page(data: dict[str, Any], *, robot: str, subtitle: str, kind: PageKind = REPLAY) -> str:
    """Return the HTML of a replay, of a live view, or of another kind of page.

    Names are escaped. A content security policy also prevents names from running as scripts.

    Args:
        data: Data for the JavaScript program: finite numbers and text.
        robot: Headline.
        subtitle: Text next to it.
        kind: Source files and network access of the page.

    Raises:
        OutputError: Meshcat's viewer is missing.
    """
    body = "\n".join(map(_content, kind.program))
    viewer, program = viewer_script(), f'"use strict";\n(() => {{\n{body}\n}})();\n'
    server = "'none'" if kind.mode == "replay" else "'self'"
    # meshcat's viewer makes style elements, hence unsafe-inline for styles
    policy = (
        f"default-src 'none'; script-src {script_hash(viewer)} {script_hash(program)}; style-src 'unsafe-inline'; "
        f"img-src data: blob:; connect-src {server}; worker-src {server}; base-uri 'none'; form-action 'none'"
    )
    texts = {"robot": robot, "subtitle": subtitle, "licences": third_party_notices()}
    texts["title"] = f"{robot}: {subtitle}" if subtitle else robot
    parts = {name: html.escape(text) for name, text in texts.items()}
    parts |= {"policy": policy, "mode": kind.mode, "data": json_in_html(data), "viewer": viewer, "program": program}
    parts |= {name: "".join(map(_content, getattr(kind, name))) for name in ("style", "markup")}
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _content(_FOLDER / "page.html"))


def json_in_html(data: object) -> str:
    """Return JSON text that can be embedded in an HTML script element.

    It contains no `<`, so that no text can close the element, and no NaN.

    Args:
        data: JSON values.
    """
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def script_hash(script: str) -> str:
    """Return the hash that allows a script in the content security policy of a page.

    Args:
        script: Text of the script.

    Returns:
        For example `'sha256-...'`, with the quotes.
    """
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


@cache
def _content(file: Path) -> str:
    """Return the text of a file."""
    return file.read_text(encoding="utf-8")  # also converts all line endings to \n


def _meshcat(name: str) -> str:
    """Return the text of a file in meshcat's viewer folder.

    Raises:
        OutputError: Meshcat is not installed.
    """
    spec = importlib.util.find_spec("meshcat")  # located without an import, which would load IPython
    if spec is None or spec.origin is None:
        raise OutputError("meshcat's viewer is missing: install it with pip install 'meshcat>=0.3.2'")
    return _content(Path(spec.origin).parent / "viewer" / name)


@cache
def viewer_script() -> str:
    """Return the JavaScript text of meshcat's bundled viewer.

    Raises:
        OutputError: The viewer is missing, or its text cannot be embedded in a page.
    """
    text = _meshcat("dist/main.min.js").replace("\0", "")
    if "</script" in text.lower() or "<!--" in text:
        raise OutputError("meshcat's viewer script cannot be embedded in a page: install meshcat 0.3.2")
    return text


@cache
def third_party_notices() -> str:
    """Return the licences of the viewer and of the packages bundled with it (three.js, dat.gui, ...).

    Every copy of the viewer includes them: pages in their source, and the wheel in its folder of licences.
    """
    notices = [f"meshcat's viewer\n\n{_meshcat('LICENSE').strip()}"]
    for part in json.loads(_meshcat("dist/main.min.js.THIRD_PARTY_LICENSES.json")):
        text = part["licenseText"] or f"{part['license']} licence, as above; its package has no text of its own"
        head = f"{part['name']} {part['version']} by {part['author']}, {part['repository']}"
        notices.append("\n".join([head, "", *(line.rstrip() for line in text.strip("\n").splitlines())]))
    rule = f"\n\n{72 * '-'}\n\n"
    return f"Parts of the replay page that others wrote, and their licences{rule}{rule.join(notices)}\n"


# ---- in notebook cells: the first one contains meshcat's viewer, later ones take it from there --------------------

_MISSING = "The viewer is in this notebook's first replay. If this stays empty, restart the kernel and run all cells."
# requests the viewer from the notebook until it answers, because cells may be drawn in any order
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
  const scheme = Number(getComputedStyle(document.body).color.match(/[0-9.]+/)[0]) > 127 ? "dark" : "light"; // letters
  for (const frame of document.querySelectorAll("iframe[title=replay]")) frame.style.colorScheme = scheme;
  addEventListener("message", ({ data, source }) => {
    if (data === "manip-learn: viewer" && kept()) source.postMessage({ manipLearnViewer: kept() }, "*");
  });
})()</script>"""
_cell: Any = False  # cell that contains the viewer; False: no cell


def notebook_output(page: str) -> str:
    """Return a page as the output of a notebook cell.

    Args:
        page: Output of `render_page`.

    Returns:
        HTML with the page in an inline frame.
    """
    global _cell
    cell, viewer = _running_cell(), viewer_script()
    before, after = page.split(f"<script>{viewer}</script>\n<script>")
    inner = before.replace("script-src ", f"script-src {script_hash(_ASK)} ", 1)
    inner += f'<p id="missing">{_MISSING}</p><script type="text/plain" id="program">{after}<script>{_ASK}</script>'
    output = (
        f'<iframe title="replay" srcdoc="{html.escape(inner)}" style="width:100%;height:640px;border:0" '
        f'sandbox="allow-scripts"></iframe>{_ANSWER}'
    )
    # the first cell gets the viewer again when it runs again; in Colab each cell is a separate page
    if _cell is False or (cell is not None and cell == _cell) or "google.colab" in sys.modules:
        _cell = cell
        output = f'<script type="text/plain" data-manip-learn>{viewer}</script>{output}'
    return output


def _running_cell() -> str | None:
    """Return the id of the running cell, if the notebook provides it."""
    try:
        return sys.modules["IPython"].get_ipython().get_parent()["metadata"]["cellId"]
    except (AttributeError, KeyError, TypeError):  # no kernel, or a front end that does not name its cells
        return None
