"""What runs elsewhere calls what runs here: continuous integration, the hosted pages, and the benchmarks."""

from __future__ import annotations

import os
import re
import runpy
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks"
# how a script is started by hand; others are started by a benchmark, with the tree that they time
STARTED = re.compile(r"^    (?!PYTHONPATH=TREE ).*python benchmarks/", re.MULTILINE)


def read(name: str) -> dict[str, Any]:
    """A YAML file of the project."""
    return YAML(typ="safe").load((ROOT / name).read_text(encoding="utf-8"))


def test_the_workflow_runs_what_a_developer_runs():
    """One job calls `.ci/run` on the lowest Python, with the history that its check of the changelog needs and the pull
    request's base; others test the newest Python and macOS, and look up vulnerabilities.
    """
    workflow = read(".github/workflows/ci.yml")
    assert set(workflow["on"]) == {"push", "pull_request"} and workflow["permissions"] == {"contents": "read"}
    checkout, python, run = workflow["jobs"]["everything"]["steps"]
    assert checkout["with"]["fetch-depth"] == 0
    lowest = re.search(r'requires-python = ">=([\d.]+)', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert lowest is not None and python["with"]["python-version"] == lowest[1]
    assert run["run"] == ".ci/run" and os.access(ROOT / run["run"], os.X_OK)
    assert run["env"] == {"BASE": "${{ github.event.pull_request.base.sha }}"}
    assert '"${BASE:-}"' in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    others = workflow["jobs"]["tests"]["strategy"]["matrix"]["include"]
    assert {(job["os"], job["python"]) for job in others} == {("ubuntu-latest", "3.13"), ("macos-latest", "3.13")}
    assert workflow["jobs"]["vulnerabilities"]["steps"][-1] == {"run": "make vulnerabilities"}


def test_actions_are_pinned():
    """Each by its commit: a tag of others may move."""
    for name in ("ci", "release"):
        jobs = read(f".github/workflows/{name}.yml")["jobs"].values()
        used = [step["uses"] for job in jobs for step in job["steps"] if "uses" in step]
        assert used and all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action) for action in used)


def test_versions_agree():
    """The library, the compiled law, the citation and the changelog are of one release."""
    found = [
        re.search(pattern, (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)
        for file, pattern in (
            ("pyproject.toml", r'^version = "(.*)"'),
            ("fast/pyproject.toml", r'^version = "(.*)"'),
            ("CITATION.cff", r"^version: (.*)"),
            ("CHANGELOG.md", r"^## \[(\d.*)\] - "),
        )
    ]
    assert len({match[1] for match in found if match}) == 1 and all(found)


def test_every_benchmark_is_listed():
    """The table of benchmarks/README.md has every script that can be run, and no file that does not exist."""
    listed = set(
        re.findall(r"^\| `(\w+\.py)` \|", (BENCHMARKS / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    )
    scripts = {p.name for p in BENCHMARKS.glob("*.py") if p.name.startswith("bench_")}
    scripts |= {p.name for p in BENCHMARKS.glob("*.py") if STARTED.search(p.read_text("utf-8"))}
    assert listed == scripts


def test_every_benchmark_has_cases_beside_the_release(monkeypatch):
    """Each promise of speed has timed cases, by its name, for the comparison with the last release."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from timed_cases import CASES

    promises = {p.stem.removeprefix("bench_") for p in BENCHMARKS.glob("bench_*.py")} - {"release"}
    assert set(CASES) == promises and all(CASES.values())


ROOMS = runpy.run_path(str(ROOT / ".ci" / "rooms"))
SOURCES = {
    "a.py": (
        '"""What it\nholds."""\n# X\nX = """\nno docstring"""\n\n\ndef f():\n    """Is."""\n    return X  # it\n',
        4,
    ),
    "b.js": ("/* what\nit is */\nlet a = 1; // one\n\n// why\na += 1;\n", 2),
    "c.min.js": ("a;\n", 0),
    "vendor/d.js": ("a;\n", 0),
    "build/e.hpp": ("a;\n", 0),
    "f.css": ("a {\n}\n", 2),
    "g.md": ("words\n", 0),
}
# lines now, at the release, and agreed -> whether that is too many
GROWN = {
    "above its budget, as it was": (500, 500, 300, False),
    "above its budget, mended": (540, 500, 300, False),
    "above its budget, and a new ability": (541, 500, 300, True),
    "rebuilt": (300, 500, 300, False),
    "within its budget": (300, 250, 300, False),
    "just at its budget, and grown": (301, 300, 300, True),
    "within its budget, and grown back": (301, 250, 300, True),
}


@pytest.mark.parametrize("name", SOURCES)
def test_lines_of_code_are_counted_without_sentences(tmp_path: Path, name: str):
    """Docstrings, comments, blank lines, and libraries of others are free."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(SOURCES[name][0], encoding="utf-8")
    assert ROOMS["code_lines"](tmp_path, ".", (".py", ".js", ".css", ".hpp")) == SOURCES[name][1]


def test_a_room_that_has_grown_is_an_error(tmp_path: Path):
    """One that was above its budget may only be mended, one that was within it stays within it; the next release starts
    from what is there.
    """
    (table := tmp_path / ".ci" / "rooms.csv").parent.mkdir()
    for why, (now, release, budget, grown) in GROWN.items():
        (tmp_path / "a.py").write_text("a\n" * now, encoding="utf-8")
        table.write_text(f"room,endings,release,budget\n.,.py,{release},{budget}\n", encoding="utf-8")
        assert ROOMS["main"](tmp_path, []) == grown, why
    assert [ROOMS["most_lines"](500, 300, rooms) for rooms in (1, 12)] == [540, 980]  # tests mend twelve
    ROOMS["main"](tmp_path, ["--release"])
    assert table.read_text(encoding="utf-8") == "room,endings,release,budget\n.,.py,301,300\n"


def test_every_room_has_a_budget():
    """Every folder of the library has a line in `.ci/rooms.csv`, and what was agreed for all is the sum."""
    rows = [line.split(",") for line in (ROOT / ".ci" / "rooms.csv").read_text(encoding="utf-8").splitlines()]
    budgets = {room: int(budget) for room, endings, _, budget in rows if endings == ".py"}
    rooms = {f"manip_learn/{p.parent.name}" for p in (ROOT / "manip_learn").glob("*/__init__.py")} | {"manip_learn/*"}
    assert {room for room in budgets if room.startswith("manip_learn/")} == rooms
    assert budgets["manip_learn"] == sum(budgets[room] for room in rooms)
