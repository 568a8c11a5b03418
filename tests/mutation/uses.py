"""Which test files use a file of the library: those that import it, by its name or by the library's public names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

from workshop import ROOT

SLOW = re.compile(r"^pytestmark = .*\bmark\.slow\b", re.MULTILINE)  # test files that only run at length


@cache
def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def users_of_the_library() -> dict[str, list[str]]:
    """File of the library -> files of the library and of the tests that import it, in the order of their names."""
    homes = _public_homes()
    users: dict[str, list[str]] = {}
    for path in sorted([*(ROOT / "manip_learn").rglob("*.py"), *(ROOT / "tests").glob("**/*.py")]):
        tree = _parsed(path)
        for file in set(_imported(tree)) | {home for name in _public_names(tree) for home in homes.get(name, ())}:
            users.setdefault(file, []).append(str(path.relative_to(ROOT)))
    return users


def _public_homes() -> dict[str, list[str]]:
    """Public name -> the file that defines it, and those on the way there."""
    tree = _parsed(ROOT / "manip_learn" / "__init__.py")
    homes: dict[str, list[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                homes[alias.name] = list(_definition(node.module, alias.name))
    return homes


def _definition(module: str, name: str) -> Iterator[str]:
    for path in (ROOT / (module.replace(".", "/") + ".py"), ROOT / module.replace(".", "/") / "__init__.py"):
        if not path.is_file():
            continue
        yield str(path.relative_to(ROOT))
        for node in ast.walk(_parsed(path)):
            if isinstance(node, ast.ImportFrom) and node.module and name in [alias.name for alias in node.names]:
                yield from _definition(node.module, name)


def _public_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "ml":
            yield node.attr


def _imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            path = ROOT / (name.replace(".", "/") + ".py")
            if path.is_file():
                yield str(path.relative_to(ROOT))


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
