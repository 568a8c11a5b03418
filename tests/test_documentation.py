"""The documentation: the reference has every public name, and the map of the equations points at code that exists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from library_source import library, listed

import manip_learn as ml

DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_the_reference_has_every_public_name():
    """Each name of `__all__` has its entry in docs/reference.md, and no entry names anything else."""
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    entries = re.findall(r"^\.\. auto(?:class|function):: manip_learn\.([\w.]+)$", text, re.MULTILINE)
    # an error is documented with the other errors
    # what a public name holds, and what needs an extra of its own
    beside = {"learning.LearningReport", "playback.write_rerun"}
    assert sorted([*(e for e in entries if e not in beside), "ManipLearnError"]) == sorted(ml.__all__)


def test_equations_are_where_the_map_says():
    """Each file and function in the table of docs/architecture.md exists."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    trees = {source.relative: source.tree for source in library()}
    rows = re.findall(r"^\|[^|]+\| `(\S+\.py)` \|(.*)\|$", text, re.MULTILINE)
    table = [(file, function.strip().strip("`")) for file, function in rows]
    assert len(table) > 12
    faults = [f"{file}: {name}" for file, name in table if file not in trees or name not in defined(trees[file])]
    assert not faults, listed(faults)


def defined(tree: ast.Module) -> set[str]:
    """Functions and methods of a file, methods with the name of their class."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    methods = {f"{c.name}.{f.name}" for c in classes for f in c.body if isinstance(f, ast.FunctionDef)}
    return methods | {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
