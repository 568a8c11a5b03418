"""List the figures of the pages with commit, day and command: `python docs/list_figures.py`.

A figure is a table of numbers, in a page or in a file, or a picture. The section in which it stands says where it
comes from, in a line that is read or in a comment:

    Measured at `COMMIT`, YYYY-MM-DD, with `COMMAND`
    <!-- Made at `COMMIT`, YYYY-MM-DD, with `COMMAND` -->

The next such line below a figure counts, or the last one above it. `make docs` runs this: exit code 1 where a figure
has none, or where a table or a picture lies below docs/ and no page shows it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
HEADING = re.compile(r"^#+\s+(.*)$")
ORIGIN = re.compile(r"(?:Measured|Made) at `([0-9a-f]{8,40})`, (\d{4}-\d\d-\d\d), with `([^`]+)`")
FILE = re.compile(r"[\w./-]+\.(?:csv|svg|png|webp)")
ROW = re.compile(r"^\|(.*)\|$")
NUMBER = re.compile(r"[<>±~≤≥-]?\s*\d[\d.,]*(e[-+]?\d+)?(\s*(%|°|\S{1,3}|degrees|of \d+|(\+-|±|to|\.\.) \S+.*))?")
MEASURED = 1 / 3  # of the cells beside the first column are numbers: a table of numbers, not of words with some
KEPT = {".csv", ".svg", ".png", ".webp"}


class Figure(NamedTuple):
    """A table or a picture; `origin` is (commit, day, command), or None."""

    page: str
    section: str
    name: str
    origin: tuple[str, str, str] | None


def sections(text: str) -> Iterator[tuple[str, str]]:
    """(heading, text below it) of a page; a line of a code block is no heading."""
    heading, lines, fenced = "", [], False
    for line in text.splitlines():
        fenced ^= line.startswith("```")
        if not fenced and (found := HEADING.match(line)):
            yield heading, "\n".join(lines)
            heading, lines = found[1], []
        lines.append(line)
    yield heading, "\n".join(lines)


def number_tables(text: str) -> Iterator[int]:
    """Where a table begins that is one of numbers, by its cells beside the first column."""
    place, rows = 0, []
    for line in [*text.splitlines(), ""]:
        if found := ROW.match(line):
            rows.append([cell.strip(" *`") for cell in found[1].split("|")])
        elif rows:
            cells = [cell for row in rows[2:] for cell in row[1:] if cell]
            if cells and sum(bool(NUMBER.fullmatch(cell)) for cell in cells) > MEASURED * len(cells):
                yield place
            rows = []
        if not rows:
            place += len(line) + 1


def figures_of(page: Path, root: Path = ROOT) -> Iterator[Figure]:
    """The figures of a page, in their order."""
    for heading, text in sections(page.read_text(encoding="utf-8")):
        origins = [(m.start(), (m[1], m[2], m[3])) for m in ORIGIN.finditer(text)]
        shown = [(m.start(), m[0]) for m in FILE.finditer(text) if (page.parent / m[0]).is_file()]
        for place, name in sorted([*shown, *((start, "a table") for start in number_tables(text))]):
            below = [origin for start, origin in origins if start > place]
            origin = below[0] if below else origins[-1][1] if origins else None
            yield Figure(str(page.relative_to(root)), heading, name, origin)


def faults_of_figures(root: Path = ROOT) -> Iterator[str]:
    """Print the list; one line a figure without an origin, and a file that no page shows."""
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    seen = set()
    for page in (p for p in pages if "_build" not in p.parts):
        for figure in figures_of(page, root):
            seen.add((page.parent / figure.name).resolve())
            where = f"{figure.page}: {figure.section}: {figure.name}"
            print(f"{where}: {' '.join(figure.origin) if figure.origin else 'NOT KNOWN'}")
            if figure.origin is None:
                yield f"{where}: add a line 'Measured at `COMMIT`, YYYY-MM-DD, with `COMMAND`' to the section"
    for file in sorted((root / "docs").rglob("*")):
        if file.suffix in KEPT and "_build" not in file.parts and file.resolve() not in seen:
            yield f"{file.relative_to(root)}: no page shows it: remove it"


def main() -> None:
    """Print all figures, then what is wrong; exit code 1 if anything is."""
    if faults := list(faults_of_figures()):
        raise SystemExit("\n".join([*faults, f"{len(faults)} fault(s) in the figures"]))


if __name__ == "__main__":
    sys.exit(main())
