"""The library's own source, parsed: what the tests of its structure read."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "manip_learn"


@dataclass(frozen=True)
class Source:
    """One file: its dotted name without the package's, e.g. `robot.loading`, and its syntax tree."""

    path: Path
    name: str
    text: str
    tree: ast.Module

    @property
    def top(self) -> str:
        """First part of the name: `robot` for `robot.loading`; empty for the package itself."""
        return self.name.split(".")[0]

    @property
    def relative(self) -> str:
        """Path below the package, e.g. `robot/loading.py`."""
        return self.path.relative_to(PACKAGE).as_posix()

    def imports(self) -> Iterator[tuple[str, int]]:
        """Every module or name that is imported anywhere in the file, and its line; typing-only imports too."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from ((alias.name, node.lineno) for alias in node.names)
                if self.top == "commands":  # what is taken by the front door is imported from where it lives
                    fronts = {alias.asname for alias in node.names if alias.name == "manip_learn"}
                    yield from self.taken(fronts)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.relative}:{node.lineno}: imports are absolute in this project"
                yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)

    def taken(self, fronts: set[str | None]) -> Iterator[tuple[str, int]]:
        """Public names that are taken from the package under these names, by their modules, and the lines."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in fronts:
                yield f"{public_homes()[node.attr]}.{node.attr}", node.lineno

    def typing_lines(self) -> set[int]:
        """Lines under `if TYPE_CHECKING:`, which never run."""
        guards = [n for n in ast.walk(self.tree) if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]
        return {line for guard in guards for line in range(guard.lineno, (guard.end_lineno or guard.lineno) + 1)}


@cache
def public_homes() -> dict[str, str]:
    """Public name -> module that the package loads it from."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: f"manip_learn.{node.module}" for node in imports for alias in node.names}


@cache
def library() -> tuple[Source, ...]:
    """All files of the library, in the order of their names."""
    sources = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        sources.append(Source(path, name, text, ast.parse(text, str(path))))
    return tuple(sources)


def listed(faults: list[str]) -> str:
    """All faults that a rule has found, one per line: what its failing test shows."""
    return "\n".join((f"{len(faults)} found:", *faults))
