"""Which test files use a file of the library: those that import it, by its name or by the library's public names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

from workshop import ROOT

SLOW = re.compile(r"^pytestmark = .*\bmark\.slow\b", re.MULTILINE)  # test files that only run at length
FROM = re.compile(r"^[ ]*from ([\w.]+) import (\([^)]*\)|[^\n(]*)", re.MULTILINE)
WHOLE = re.compile(r"^[ ]*import (manip_learn[\w.]*)", re.MULTILINE)
PUBLIC = re.compile(r"\bml\.(\w+)")


@cache
def _read(path: Path) -> tuple[str, list[tuple[str, set[str]]]]:
    """The text of a file, and (module, names) of its imports: looking for words takes a tenth of the time of ast."""
    text = path.read_text(encoding="utf-8")
    named = [(module, set(re.findall(r"\w+", names))) for module, names in FROM.findall(text)]
    return text, named + [(module, set()) for module in WHOLE.findall(text)]


def users_of_the_library() -> dict[str, list[str]]:
    """File of the library -> files of the library and of the tests that import it, in the order of their names."""
    _, fronts = _read(ROOT / "manip_learn" / "__init__.py")
    homes = {name: list(_definition(module, name)) for module, names in fronts for name in names}
    users: dict[str, list[str]] = {}
    for path in sorted([*(ROOT / "manip_learn").rglob("*.py"), *(ROOT / "tests").glob("**/*.py")]):
        text, imports = _read(path)
        modules = {name for module, names in imports for name in (module, *(f"{module}.{n}" for n in names))}
        used = {file for module in modules if (file := _file(module)) and (ROOT / file).is_file()}
        public = PUBLIC.findall(text) if path.is_relative_to(ROOT / "tests") else []  # not the library's own examples
        for file in used | {home for name in public for home in homes.get(name, ())}:
            users.setdefault(file, []).append(str(path.relative_to(ROOT)))
    return users


def _file(module: str) -> str:
    return f"{module.replace('.', '/')}.py" if module.startswith("manip_learn") else ""


def _definition(module: str, name: str) -> Iterator[str]:
    """The files on the way from a public name to its definition."""
    for file in (_file(module), f"{module.replace('.', '/')}/__init__.py"):
        if file and (ROOT / file).is_file():
            yield file
            for inner, names in _read(ROOT / file)[1]:
                if name in names:
                    yield from _definition(inner, name)


def rings_around(file: str, users: Mapping[str, Sequence[str]], nearest: int) -> Iterator[list[str]]:
    """Rings of at most so many test files: those that use a file, those that use what uses it, and so on; each once.

    In a ring the files that bear its name come first, then those that use least beside it.
    """
    tests_per_user = {name for names in users.values() for name in names if name.startswith("tests/")}
    slow = {name for name in tests_per_user if SLOW.search((ROOT / name).read_text(encoding="utf-8"))}
    breadth = {name: sum(name in names for names in users.values()) for name in tests_per_user}
    seen, front, stem = {file}, [file], Path(file).stem
    named = {str(path.relative_to(ROOT)) for path in (ROOT / "tests").glob(f"test_*{stem}*.py")}
    while front:
        ring = [name for name in dict.fromkeys(name for f in front for name in users.get(f, ())) if name not in seen]
        tests = {name for name in [*ring, *named] if Path(name).name.startswith("test_")} - seen - slow
        ordered = sorted(tests, key=lambda name: (stem not in name, breadth.get(name, 0), name))
        for first in range(0, len(ordered), nearest):
            yield ordered[first : first + nearest]
        seen |= set(ring) | tests
        front = [name for name in ring if not Path(name).name.startswith("test_")]
