"""One self-contained page: meshcat's viewer, our program and the data, closed off from the network."""

from __future__ import annotations

import base64
import hashlib
import html
import importlib.resources
import importlib.util
import json
import re
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from manip_learn.errors import OutputError


def packed(array: np.ndarray, dtype: str) -> str:
    """The array's numbers in base64, row by row.

    Args:
        array: Any numbers, NaN too.
        dtype: As NumPy writes it, little-endian: `"<f8"`, `"<f4"`, `"<u4"` or `"<u2"`.
    """
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def unpacked(text: str, dtype: str) -> np.ndarray:
    """The numbers that `packed` was given."""
    return np.frombuffer(base64.b64decode(text), dtype)


STYLE = ("style.css", "tracks.css")
PROGRAM = (
    *("scene.js", "stage.js", "fit.js", "phases.js", "chart.js", "sheets.js", "tracks.js"),
    *("constraint_marks.js", "furniture.js", "labels.js", "shown.js", "evidence.js", "recording_choice.js"),
    *("keys.js", "legend.js", "player.js", "live.js", "main.js"),
)
TEACH_STYLE = (*STYLE, "teach.css")
TEACH_PROGRAM = (
    *(name for name in PROGRAM if name not in ("shown.js", "recording_choice.js", "live.js", "main.js")),
    *("teach_quality.js", "teach_link.js", "teach_pointing.js", "teach_hand.js", "teach_furniture.js"),
    *(
        "teach_drawing.js",
        "teach_recordings.js",
        "teach_answer.js",
        "teach_ghosts.js",
        "teach_take.js",
        "teach_panel.js",
    ),
    *("teach_tour.js", "teach.js"),
)
Mode = Literal["replay", "live", "teach"]


def page(data: dict[str, Any], *, robot: str, subtitle: str, mode: Mode = "replay") -> str:
    """HTML of a replay, of a live view, or of a page on which an arm is taught.

    Names are escaped; and even a name that slipped through could not run: scripts run only if their hash is listed.

    Args:
        data: What the program reads; finite numbers and text.
        robot: Headline.
        subtitle: Beside it.
        mode: A live page may listen to the server that it came from, one to teach on may also speak to it, and a replay
            to none.

    Raises:
        OutputError: Meshcat's viewer is missing.
    """
    teaching = mode == "teach"
    viewer, program = viewer_script(), _program(TEACH_PROGRAM if teaching else PROGRAM)
    parts = {
        "policy": _policy((viewer, program), live=mode != "replay"),
        "title": html.escape(f"{robot}: {subtitle}" if subtitle else robot),
        "style": "".join(_resource(name) for name in (TEACH_STYLE if teaching else STYLE)),
        "mode": mode,
        "teach": _resource("teach.html") if teaching else "",
        "robot": html.escape(robot),
        "subtitle": html.escape(subtitle),
        "data": json_in_html(data),
        "licences": html.escape(third_party_notices()),
        "viewer": viewer,
        "program": program,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _resource("page.html"))


def json_in_html(data: object) -> str:
    """JSON that can stand in a script element: no `<`, so nothing in it can close the element; no NaN."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _policy(scripts: tuple[str, ...], live: bool) -> str:
    hashes = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts)
    # meshcat's viewer makes style elements, hence unsafe-inline for styles
    rules = ["default-src 'none'", f"script-src {hashes}", "style-src 'unsafe-inline'", "img-src data: blob:"]
    rules += ["connect-src 'self'" if live else "connect-src 'none'", "base-uri 'none'", "form-action 'none'"]
    return "; ".join(rules)


@cache
def _resource(name: str) -> str:
    text = importlib.resources.files("manip_learn.playback").joinpath("page", name).read_text(encoding="utf-8")
    return text.replace("\r\n", "\n")


@cache
def _program(names: tuple[str, ...]) -> str:
    body = "\n".join(_resource(name) for name in names)
    return f'"use strict";\n(() => {{\n{body}\n}})();\n'


def _meshcat_folder() -> Path:
    spec = importlib.util.find_spec("meshcat")  # found, not imported: importing it brings IPython
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        if (Path(folder) / "viewer" / "dist" / "main.min.js").is_file():
            return Path(folder) / "viewer"
    raise OutputError("meshcat's viewer script main.min.js is missing: install it with pip install 'meshcat>=0.3.2'")


@cache
def viewer_script() -> str:
    """Meshcat's bundled viewer.

    Raises:
        OutputError: It is missing, or it holds what cannot stand inside a page.
    """
    text = (_meshcat_folder() / "dist" / "main.min.js").read_text(encoding="utf-8").replace("\r\n", "\n")
    text = text.replace("\r", "\n").replace("\0", "")
    if "</script" in text.lower() or "<!--" in text:
        raise OutputError("meshcat's viewer script cannot be put into a page: install meshcat 0.3.2")
    return text


@cache
def third_party_notices() -> str:
    """Licences of the viewer and of what is bundled with it (three.js, dat.gui, ...): they go with each copy of it.

    Every page has them in its source, and the wheel in its folder of licences.
    """
    folder = _meshcat_folder()
    notices = [f"meshcat's viewer\n\n{(folder / 'LICENSE').read_text(encoding='utf-8').strip()}"]
    for part in json.loads((folder / "dist" / "main.min.js.THIRD_PARTY_LICENSES.json").read_text(encoding="utf-8")):
        text = part["licenseText"] or f"{part['license']} licence, as above; its package has no text of its own"
        lines = [line.rstrip() for line in text.strip("\n").splitlines()]
        notices.append(
            "\n".join([f"{part['name']} {part['version']} by {part['author']}, {part['repository']}", "", *lines])
        )
    rule = f"\n\n{72 * '-'}\n\n"
    return f"Parts of the replay page that others wrote, and their licences{rule}{rule.join(notices)}\n"
