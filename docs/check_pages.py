"""Check the built documentation: nothing is loaded from the network, and every link has a target.

`make docs` runs this after the build. Links within the pages are followed to the file and the anchor, those of the
Markdown files beside the pages (README, CONTRIBUTING) to the file or the heading. Links to other sites are checked by
`make links`, which needs the network.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[1]
# attributes by which a page loads something, whatever the reader does
LOADING = {
    ("script", "src"), ("link", "href"), ("img", "src"), ("img", "srcset"), ("iframe", "src"), ("source", "src"),
    ("video", "src"), ("video", "poster"), ("audio", "src"), ("object", "data"), ("embed", "src"),
}  # fmt: skip
# a link element that names a place and loads nothing
NAMING = {"canonical", "prev", "next", "author", "help", "license", "search", "index"}
REMOTE = re.compile(r"(?:https?:)?//", re.IGNORECASE)
CSS_LOADS = re.compile(r"""(?:url\(\s*|@import\s+)["']?((?:https?:)?//[^"')\s]+)""", re.IGNORECASE)
MARKDOWN_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+\s+(.*)$", re.MULTILINE)


class Page(HTMLParser):
    """What a page loads, what it links to, and its anchors."""

    def __init__(self, text: str):
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)
        self.loads += CSS_LOADS.findall(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Sort the addresses of one element."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        names_only = tag == "link" and set(values.get("rel", "").split()) & NAMING
        for name in ("href", "src", "srcset", "poster", "data"):
            if name not in values:
                continue
            (self.loads if (tag, name) in LOADING and not names_only else self.links).append(values[name])


def main() -> None:
    """Print what is wrong; exit code 1 if anything is."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/check_pages.py FOLDER_OF_BUILT_PAGES")
    built = Path(sys.argv[1])
    faults = [*faults_of_pages(built), *faults_of_markdown(ROOT)]
    for fault in faults:
        print(fault)
    if faults:
        raise SystemExit(f"{len(faults)} fault(s) in the documentation")
    print(f"{len(list(built.rglob('*.html')))} pages: links have their targets, and nothing is loaded from the network")


def faults_of_pages(built: Path) -> Iterator[str]:
    """Loads from the network, and links without a target, of all built pages."""
    pages = {path.resolve(): Page(path.read_text(encoding="utf-8")) for path in sorted(built.rglob("*.html"))}
    if not pages:
        yield f"{built} holds no page: build the documentation first"
    for path, page in pages.items():
        here = path.relative_to(built.resolve())
        yield from (f"{here}: loads {address}" for address in page.loads if REMOTE.match(address))
        for address in {*page.links, *page.loads}:
            fault = _missing(address, path, pages)
            if fault:
                yield f"{here}: {address}: {fault}"
    for sheet in built.rglob("*.css"):
        found = CSS_LOADS.findall(sheet.read_text(encoding="utf-8"))
        yield from (f"{sheet.relative_to(built)}: loads {address}" for address in found)


def _missing(address: str, page: Path, pages: dict[Path, Page]) -> str:
    """What a link lacks: the file or the anchor; empty if nothing."""
    parts = urlsplit(address)
    if parts.scheme or parts.netloc:
        return ""
    target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    if not target.exists():
        return "no such file"
    anchor = unquote(parts.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return "no such anchor"
    return ""


def faults_of_markdown(root: Path) -> Iterator[str]:
    """Links without a target in the Markdown files that are read where they lie, not as built pages."""
    for path in sorted({*root.glob("*.md"), *root.glob("examples/**/*.md"), *root.glob("robots/*.md")}):
        for address in MARKDOWN_LINK.findall(path.read_text(encoding="utf-8")):
            file, _, anchor = address.partition("#")
            if urlsplit(address).scheme:
                continue
            target = path.parent / unquote(file) if file else path
            if not target.exists():
                yield f"{path.relative_to(root)}: {address}: no such file"
            elif anchor and target.suffix == ".md" and anchor not in anchors_of_markdown(target):
                yield f"{path.relative_to(root)}: {address}: no such heading"


def anchors_of_markdown(path: Path) -> set[str]:
    """Anchors of the headings, as GitHub and MyST make them."""
    headings = HEADING.findall(path.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", h.strip().lower()).replace(" ", "-") for h in headings}


if __name__ == "__main__":
    main()
