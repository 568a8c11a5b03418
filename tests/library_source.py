"""The library's own source, parsed: what the tests of its structure read."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "manip_learn"


@dataclass(frozen=True)
class Source:
    """One file: its dotted name without the package's, e.g. `robot.loading`, and its syntax tree."""

    name: str
    text: str
    tree: ast.Module

    @property
    def top(self) -> str:
        """First part of the name: `robot` for `robot.loading`; empty for the package itself."""
        return self.name.split(".")[0]


@cache
def library() -> tuple[Source, ...]:
    """All files of the library, in the order of their names."""
    sources = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        sources.append(Source(name, text, ast.parse(text, str(path))))
    return tuple(sources)
