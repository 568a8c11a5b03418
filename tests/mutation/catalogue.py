"""The catalogue of mutants: small faults put into the library on purpose, and the tests that must notice them.

One TOML file per area in `catalogue/`. A mutant says which text of which file is replaced by what, and which tests fail
on it; or why no test can tell it from the original (`equivalent`).
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import final

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).resolve().parent / "catalogue"


class StaleCatalogueError(Exception):
    """The text that a mutant replaces is no longer in its file, or is there more than once."""


@final
@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        file: File of the library, relative to the root of the project.
        old: Text that is replaced; occurs exactly once in the file.
        new: What takes its place.
        tests: pytest's names of the tests that fail on the mutant; empty for an equivalent one.
        equivalent: Why no test can tell it from the original; empty for all others.
    """

    file: str
    old: str
    new: str
    tests: tuple[str, ...] = ()
    equivalent: str = ""

    @property
    def name(self) -> str:
        """File and the line that changes."""
        old, new = self.old.splitlines(), self.new.splitlines() or [""]
        changed = [(a, b) for a, b in zip(old, new, strict=False) if a != b]
        before, after = changed[0] if changed else (old[-1], new[-1])
        return f"{self.file}: {before.strip()}  ->  {after.strip() or '(nothing)'}"

    def applied(self, root: Path) -> str:
        """The content of the file with the fault in it.

        Raises:
            StaleCatalogueError: The old text is not there exactly once.
        """
        path = root / self.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        count = text.count(self.old)
        if count != 1 or self.old == self.new:
            raise StaleCatalogueError(
                f"{self.file} has this text {count} times, expected once: {self.old!r}. The code has changed: correct "
                "the mutant, or take it out of tests/mutation/catalogue"
            )
        return text.replace(self.old, self.new)


def areas() -> list[str]:
    """Names of the catalogue's files."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(area: str) -> list[Mutant]:
    """Mutants of one area.

    Raises:
        StaleCatalogueError: A mutant that says neither which tests notice it nor why none can, or both.
    """
    entries = tomllib.loads((FOLDER / f"{area}.toml").read_text(encoding="utf-8")).get("mutant", [])
    mutants = [Mutant(**{**entry, "tests": tuple(entry.get("tests", ()))}) for entry in entries]
    for mutant in mutants:
        if bool(mutant.tests) == bool(mutant.equivalent):
            raise StaleCatalogueError(f"{area}: say which tests notice it, or why it is equivalent: {mutant.name}")
    return mutants


def save(area: str, mutants: Iterable[Mutant]) -> None:
    """Write one area, sorted by file as they come."""
    FOLDER.mkdir(exist_ok=True)
    text = "\n".join(_entry(mutant) for mutant in mutants)
    (FOLDER / f"{area}.toml").write_text(text, encoding="utf-8")


def _entry(mutant: Mutant) -> str:
    verdict = f"equivalent = {json.dumps(mutant.equivalent)}" if mutant.equivalent else f"tests = {_list(mutant.tests)}"
    return f'[[mutant]]\nfile = "{mutant.file}"\nold = {_text(mutant.old)}\nnew = {_text(mutant.new)}\n{verdict}\n'


def _list(names: tuple[str, ...]) -> str:
    return "[" + ", ".join(json.dumps(name) for name in names) + "]"


def _text(text: str) -> str:
    """A literal string where TOML allows it, so that code reads as code."""
    if "'''" in text or text.endswith("'"):
        return json.dumps(text, ensure_ascii=False)
    return f"'''\n{text}'''" if "\n" in text or "'" in text else f"'{text}'"
