"""Blocks of code in Markdown pages, and whether a shown output is what came out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

# <!-- not run: why --> on the line before a block
SKIPPED = re.compile(r"<!-- not run: (.+?) -->\s*$")
# a tab with a key (`:sync: ur`), as MyST writes it between colons
TAB = re.compile(r"^(:{3,})\{tab-item\}")
SYNC = re.compile(r"^:sync: (\S+)$")
NUMBER = re.compile(r"[-+−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")
LEFT_OUT = re.compile(r"(?:(?<=\s)|^)\.\.\.(?=\s|$)")
BOX = re.compile(r"^[─│┌┐└┘├┤┬┴┼━╇╪]+$")
# figures vary between machines and versions of libraries in their last digits, times altogether
TOLERANCE = 0.25
SECONDS = ("s", "s;", "s,", "s.", "ms")


@dataclass(frozen=True)
class Block:
    """One block of a page.

    Attributes:
        page: Where it is.
        line: Number of its first line.
        language: What its fence says; `"shell"` for command lines.
        text: The lines between the fences.
        skipped: Why it is not run; empty if it is.
        tab: Key of the tab that holds it; empty outside of tabs.
    """

    page: Path
    line: int
    language: str
    text: str
    skipped: str
    tab: str = ""

    @property
    def commands(self) -> list[str]:
        """Command lines of this program, continued lines joined."""
        joined = re.sub(r"\\\n\s*", " ", self.text)
        lines = [line.strip().removeprefix("$ ") for line in joined.splitlines()]
        return [line for line in lines if line.startswith("manip-learn ")]


def blocks(page: Path) -> Iterator[Block]:
    """Yield all fenced blocks of a page, and indented lines that are commands of this program."""
    tab = colons = reason = ""
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        for line in token.content.splitlines() if token.type == "inline" else ():
            if opening := TAB.match(line):
                tab, colons = "", opening[1]
            elif key := SYNC.match(line):
                tab = key[1]
            elif line == colons:
                tab = ""
        if token.map and (token.type == "fence" or token.content.startswith("manip-learn ")):
            language = token.info.partition(" ")[0]
            yield Block(page, token.map[0] + 1 + len(token.markup[:1]), language, token.content, reason, tab)
        skipped = SKIPPED.search(token.content) if token.type == "html_block" else None
        reason = skipped[1] if skipped else ""


def tabs(page: Path) -> list[str]:
    """Return the keys of a page's tabs in their order; one empty key for a page without tabs."""
    return list(dict.fromkeys(block.tab for block in blocks(page) if block.tab)) or [""]


def differences(shown: str, printed: str) -> list[str]:
    """Parts of a shown output that were not printed: three dots stand for what was left out.

    Where lines are broken does not count, nor do times, nor the last digits of a number.
    """
    words = _words(printed)
    missing, start = [], 0
    for part in LEFT_OUT.split(shown):
        wanted = _words(part)
        found = next((i for i in range(start, len(words) + 1) if _same(wanted, words[i : i + len(wanted)])), None)
        if found is None:
            missing.append(part.strip())
        else:
            start = found + len(wanted)
    return missing


def _words(text: str) -> list[tuple[str, tuple[float, ...]]]:
    """Words, each with its numbers taken out."""
    found = [word for word in text.split() if not BOX.match(word)]
    out = []
    for word, after in zip(found, (*found, "")[1:], strict=True):
        numbers = tuple(float(n.replace(",", "").replace("−", "-")) for n in NUMBER.findall(word))
        out.append((NUMBER.sub("#", word), () if after in SECONDS else numbers))
    return out


def _same(wanted: list[tuple[str, tuple[float, ...]]], seen: list[tuple[str, tuple[float, ...]]]) -> bool:
    return len(wanted) == len(seen) and all(
        w == s and (not x or not y or all(map(_close, x, y))) for (w, x), (s, y) in zip(wanted, seen, strict=True)
    )


def _close(one: float, other: float) -> bool:
    return abs(one - other) <= max(TOLERANCE * max(abs(one), abs(other)), 0.011)
