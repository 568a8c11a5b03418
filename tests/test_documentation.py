"""The documentation: the reference has every public name, examples run, and the map of the equations is right."""

from __future__ import annotations

import ast
import doctest
import re
from pathlib import Path

import pytest
from library_source import library

import manip_learn as ml

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
# names in capitals stand for any
NAMED_FILE = re.compile(r"(?<![\w./])(?!\S*[A-Z]{4})((?:\w+/)+\w+\.py)\b")
# names that every user meets: each shows itself in an example that runs as printed
MAIN = (
    "load_robot Robot FrameJacobian load_demonstrations Demonstrations Trajectory ConstraintLearner Constraint "
    "manipulability ManipulabilityAscent PointAttractor FreeDirection ResolvedRateController simulate Rollout "
    "ServoLoop replay"
).split()
EXAMPLES = [name for name in ml.__all__ if ">>>" in (getattr(ml, name).__doc__ or "")]


def test_main_names_have_an_example():
    """The names that every user meets have a runnable example in their docstring."""
    assert set(MAIN) <= set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_in_docstrings_run(name, tmp_path, monkeypatch):
    """A copy of the example prints what the docstring shows, in an empty folder and with no name but its own."""
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(ml, name), name, globs={})
    said: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(example, out=said.append).failed == 0, "".join(said)


def test_the_reference_has_every_public_name():
    """Each name of `__all__` has one entry in docs/reference, and no entry names anything else."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    entries = re.findall(r"^\.\. auto(?:class|function):: manip_learn\.([\w.]+)$", text, re.MULTILINE)
    # an error is documented with the other errors
    beside = {"learning.LearningReport"}  # what a public name holds
    assert sorted([*(e for e in entries if e not in beside), "ManipLearnError", "NoPlanError"]) == sorted(ml.__all__)


def test_the_map_names_what_exists():
    """Each file and function in the table of docs/architecture.md; each name that answers "where is ...?" is defined in
    the room that is said of it.
    """
    text, _, section = (DOCS / "architecture.md").read_text(encoding="utf-8").partition("## Where is …?")
    equations = re.findall(r"^\|[^|]+\| `(\S+)\.py` \|\s*`?([\w.]+)`?\s*\|$", text + section, re.MULTILINE)
    rooms = re.findall(r"^\|[^|]+\| `(\w+)/` \|(.*)\|$", section, re.MULTILINE)
    answers = [(room, name) for room, said in rooms for name in re.findall(r"`([\w.]+)`", said)]
    assert len(equations) > 12 and len({room for room, _ in answers}) >= 4 and len(answers) >= 10
    for place, name in [*equations, *answers]:
        files = [s.tree for s in library() if place in (s.name.replace(".", "/"), s.top)]
        assert name in set().union(*map(defined, files)), (place, name)


def test_files_that_pages_name_exist():
    """Files of the project that stand in a page for contributors, from the root or from a folder of the library."""
    pages = [ROOT / "CONTRIBUTING.md", ROOT / "README.md", *DOCS.rglob("*.md"), ROOT / "benchmarks" / "README.md"]
    folders = [ROOT, ROOT / "manip_learn", *(p for p in (ROOT / "manip_learn").rglob("*") if p.is_dir())]
    faults = [
        f"{page.relative_to(ROOT)}: {name}"
        for page in pages
        for name in NAMED_FILE.findall(page.read_text(encoding="utf-8"))
        if not any((folder / name).is_file() for folder in (page.parent, *folders))
    ]
    assert not faults, faults


def defined(tree: ast.Module) -> set[str]:
    """Functions and methods of a file, methods with the name of their class."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    methods = {f"{c.name}.{f.name}" for c in classes for f in c.body if isinstance(f, ast.FunctionDef)}
    return methods | {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
