"""What runs elsewhere calls what runs here: continuous integration, the hosted pages, and the benchmarks."""

from __future__ import annotations

import os
import re
import runpy
from pathlib import Path
from typing import Any

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
