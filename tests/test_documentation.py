"""The documentation: the reference has every public name, examples run, maps, figures and stated forces are right."""

from __future__ import annotations

import ast
import csv
import doctest
import re
import runpy
import shutil
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


def test_each_figure_is_drawn_from_its_table(tmp_path):
    """The script that draws the pictures of the pages of figures makes each picture that is there."""
    pytest.importorskip("matplotlib", reason="the extra 'experiments' is not installed")
    shutil.copytree(DOCS / "figures", here := tmp_path / "figures", ignore=shutil.ignore_patterns("*.svg"))
    runpy.run_path(str(here / "plot.py"), run_name="__main__")
    assert {p.name for p in here.glob("*.svg")} == {p.name for p in (DOCS / "figures").glob("*.svg")}


ARM_PAGES = [DOCS / f"{name}.md" for name in ("arms", "run_on_your_arm", "control")]


@pytest.mark.parametrize("page", [*ARM_PAGES, ROOT / "SECURITY.md"], ids=lambda page: page.stem)
def test_a_detected_force_is_told_from_what_is_measured(page):
    """15 N across is what a loop detects; the larger forces that are measured stand in a sentence of their own."""
    with (DOCS / "figures" / "servos_jams.csv").open(encoding="utf-8") as file:
        rows = {row["speed [m/s]"]: row for row in csv.DictReader(file) if row["driven [N]"] == "60"}
    text = " ".join(page.read_text(encoding="utf-8").split())
    detects = [sentence for sentence in re.split(r"(?<=[a-z])[.:] ", text) if "15 N across" in sentence]
    assert detects and all("detects" in sentence and "88 N" not in sentence for sentence in detects)
    for speed in ("0.06", "0.25"):
        median, worst = rows[speed]["largest, median and worst [N]"].split(", ")
        assert re.search(rf"{median} N \({worst}( at worst)?\) at {speed} m/s", text), (page, speed)


@pytest.mark.parametrize("page", ["arms", "run_on_your_arm"])
def test_a_stand_in_is_not_called_a_simulation(page):
    """What goes at once where it is sent has no dynamics: the page says so at its head, and each tab of such an arm."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    head = " ".join(text.partition("\n## ")[0].split())
    assert "without dynamics" in head and "ried only in simulation" not in head and "in simulation only" not in head
    if page == "arms":
        for arm in ("ur", "xarm", "lerobot", "ros2_control"):
            first_words = text.partition(f"\n:sync: {arm}\n")[2].partition("```")[0]
            assert "without dynamics" in first_words, arm
