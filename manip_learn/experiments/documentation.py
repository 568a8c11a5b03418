"""The pages about the reproduction and what goes beyond it, filled in from results.

    python -m manip_learn.experiments.documentation OUT docs/reproduction.md docs/beyond.md

The prose is written by hand; what stands between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced, and the
pictures beside the page are renewed.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import ManipLearnError, OutputError
from manip_learn.experiments.claims import claims
from manip_learn.experiments.efficiency_tables import calibration, efficiency, identifiability

PARTS = (
    "table",
    "variants",
    "bounds",
    "rmse",
    "singular-start",
    "near-singular-start",
    "sawyer",
    "recorded",
    "beyond",
)
# page -> the blocks that it must have
PAGES: dict[str, tuple[str, ...]] = {
    "reproduction.md": ("settings", "claims", *PARTS[:7]),
    "beyond.md": ("settings", "identifiability", "efficiency", "calibration", "recorded", "beyond"),
}
PICTURES = "reproduction"


def write_page(results: Path, page: Path) -> list[Path]:
    """Fill in a page's tables and renew its pictures.

    Args:
        results: Output folder of `reproduce("all", ...)`.
        page: Markdown file with markers, named as one of `PAGES`.

    Returns:
        The files that were written.

    Raises:
        OutputError: A part of the results or a marker is missing, or a file cannot be written.
    """
    if page.name not in PAGES:
        raise OutputError(f"{page} is none of the pages that are filled in: {', '.join(PAGES)}")
    content = {part: _content(results, part) for part in PARTS}
    found = {part: c["result"] for part, c in content.items()}
    blocks = {part: _text(results / f"{part}.md") for part in PARTS}
    blocks["settings"] = _settings(content["table"]["settings"])
    blocks["claims"] = claims(found)
    blocks["identifiability"] = identifiability(found["bounds"])
    blocks["efficiency"] = efficiency(found["bounds"])
    blocks["calibration"] = calibration(found["bounds"], found["sawyer"])
    wanted = {name: blocks[name] for name in PAGES[page.name]}
    written = [write_atomically(page, filled(_text(page), wanted))]
    for part in PARTS:
        picture = results / f"{part}.png"
        if part in wanted and picture.is_file():
            written.append(write_atomically(page.parent / PICTURES / picture.name, picture.read_bytes()))
    return written


def filled(text: str, blocks: dict[str, str]) -> str:
    """A text with something new between its markers.

    Raises:
        OutputError: A marker is missing.
    """
    for name, block in blocks.items():
        pattern = re.compile(rf"(<!-- begin {re.escape(name)} -->\n).*?(<!-- end {re.escape(name)} -->)", re.DOTALL)
        if not pattern.search(text):
            raise OutputError(f"the page has no markers '<!-- begin {name} -->' and '<!-- end {name} -->': add them")
        text = pattern.sub(lambda found, new=block: f"{found[1]}\n{new.strip()}\n\n{found[2]}", text)
    return text


def _settings(settings: dict[str, Any]) -> str:
    return f"The numbers on this page: `--trials {settings['trials']} --seed {settings['seed']}`."


def _content(results: Path, part: str) -> dict[str, Any]:
    path = results / f"{part}.json"
    try:
        content = json.loads(_text(path))
    except ValueError as error:
        raise OutputError(f"{path} is no JSON: {error}; run `manip-learn reproduce all` again") from error
    if not isinstance(content, dict) or content.get("experiment") != part:
        raise OutputError(f"{path} does not hold the results of {part!r}: run `manip-learn reproduce all` again")
    return content


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}; run `manip-learn reproduce all` first") from error


def main(arguments: list[str] | None = None) -> None:
    """Fill in pages from the command line."""
    parser = argparse.ArgumentParser(description="Fill in the pages about the reproduction from results.")
    parser.add_argument("results", type=Path, help="output folder of `manip-learn reproduce all`")
    parser.add_argument("pages", type=Path, nargs="+", help="docs/reproduction.md docs/beyond.md")
    options = parser.parse_args(arguments)
    try:
        written = [path for page in options.pages for path in write_page(options.results, page)]
    except ManipLearnError as error:
        parser.exit(2, f"error: {error}\n")
    print(*written, sep="\n")


if __name__ == "__main__":
    main()
