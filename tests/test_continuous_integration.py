"""What runs elsewhere calls what runs here: continuous integration, the hosted pages, and the benchmarks."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = {
    "pyproject.toml": r'^version = "(.*)"',
    "fast/pyproject.toml": r'^version = "(.*)"',
    "CITATION.cff": r"^version: (.*)",
    "CHANGELOG.md": r"^## \[(\d.*)\] - ",
}
# how a script is started by hand; others are started by a benchmark, with the tree that they time
STARTED = re.compile(r"^    (?!PYTHONPATH=TREE ).*python benchmarks/", re.MULTILINE)


def read(name: str) -> str:
    """A file of the project."""
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_workflow_runs_what_a_developer_runs():
    """`.ci/run` runs on the lowest Python, with rights to read, and with the history and the base of the pull request,
    which its check of the changelog needs.
    """
    workflow = YAML(typ="safe").load(read(".github/workflows/ci.yml"))
    assert workflow["permissions"] == {"contents": "read"}
    checkout, python, run = workflow["jobs"]["everything"]["steps"]
    assert checkout["with"]["fetch-depth"] == 0
    assert f'requires-python = ">={python["with"]["python-version"]}' in read("pyproject.toml")
    assert run["run"] == ".ci/run" and os.access(ROOT / run["run"], os.X_OK)
    assert run["env"] == {"BASE": "${{ github.event.pull_request.base.sha }}"} and '"${BASE:-}"' in read(".ci/run")


def test_versions_agree():
    """The library, the compiled law, the citation and the changelog are of one release."""
    found = [re.search(pattern, read(file), re.MULTILINE) for file, pattern in VERSIONS.items()]
    assert all(found) and len({match[1] for match in found if match}) == 1


def test_every_benchmark_is_listed():
    """The table of benchmarks/README.md has every script that can be run, and no file that does not exist."""
    listed = set(re.findall(r"^\| `(\w+\.py)` \|", read("benchmarks/README.md"), re.MULTILINE))
    scripts = {p.name: p.read_text("utf-8") for p in (ROOT / "benchmarks").glob("*.py")}
    assert listed == {name for name, text in scripts.items() if name.startswith("bench_") or STARTED.search(text)}
