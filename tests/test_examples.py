"""The examples and the notebook run as they are shipped."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import manip_learn as ml

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
NOTEBOOK = nbformat.read(ROOT / "examples" / "drawer.ipynb", as_version=4)
# warnings are errors, but the one of pyzmq that meshcat's own import causes
STRICT = ["-W", "error", "-W", "ignore:zmq.eventloop.ioloop:DeprecationWarning"]
TITLES = ["Robot sawyer", "Demonstrations", "What was learnt", "Constraint: 2 of 3 rows", "Rollout", "<iframe"]


def run(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python."""
    more = {"env": {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}, "capture_output": True, "text": True}
    return subprocess.run([sys.executable, *words], cwd=cwd, timeout=280, **more)


def files() -> set[Path]:
    """All files beside the examples but what Python compiles, which other tests that import them leave."""
    return {path for path in (ROOT / "examples").rglob("*") if "__pycache__" not in path.parts}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
@pytest.mark.timeout(300)
def test_example_runs(path, tmp_path):
    """Each example of the course runs to its end from any folder, without a window, a warning or a file outside."""
    before = files()
    done = run(*STRICT, str(path), "--headless", cwd=tmp_path)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert done.stdout.strip() and "# /// script" in path.read_text(encoding="utf-8")
    assert files() == before and int(path.name[:2]) == EXAMPLES.index(path) + 1


def test_rows_that_are_no_jacobian_are_learnt():
    """Of a puck in a groove the true row is found: to rounding without noise, within 0.2 degrees with 1 % of it."""
    example = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "10_not_kinematic.py")))
    features = ml.CustomFeatures(example.gradients, example.MONOMIALS, nv=2)
    for seed, noise, within in ((1, 0.0, 1e-5), (2, 0.01, 0.2), (3, 0.01, 0.2)):
        demos = example.recorded_pushes(noise, np.random.default_rng(seed))
        constraint = ml.ConstraintLearner(features).fit(demos).constraint_
        assert constraint.n_constraints == 1 and example.angle_to_the_groove(constraint) < within


@pytest.mark.timeout(300)
def test_every_cell_of_the_notebook_shows_something(tmp_path):
    """In a folder of its own, as a user would have copied it: one card per cell as HTML, and a short text for consoles;
    nothing is printed to the error stream. It is shipped without outputs, which are made by the reader's own run.
    """
    cells = [cell for cell in NOTEBOOK.cells if cell.cell_type == "code"]
    assert [(cell.outputs, cell.execution_count) for cell in cells] == [([], None)] * len(TITLES)
    shutil.copytree(ROOT / "examples" / "data" / "sawyer_drawer", tmp_path / "data" / "sawyer_drawer")
    NotebookClient(NOTEBOOK, timeout=240, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    assert (tmp_path / "replay.html").is_file()
    for cell, title in zip(cells, TITLES, strict=True):
        assert [out for out in cell.outputs if out.output_type in ("error", "stream")] == []
        (shown,) = [out.data for out in cell.outputs if out.output_type == "execute_result"]
        assert title in shown["text/html"] and shown["text/plain"].count("\n") < 10


REPLAYS = """
import manip_learn as ml, numpy as np
still = ml.Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)))
for k in range(2):
    page = ml.replay(ml.load_robot("planar3"), still, html=f"replay{k}.html", open_browser=False)
    open(f"cell{k}.html", "w").write(page._repr_html_())
"""


def test_replays_of_one_notebook_share_the_viewer(tmp_path, chromium):
    """Two replays, the second drawn first: both play, and only the first contains the viewer."""
    assert run("-c", REPLAYS, cwd=tmp_path).returncode == 0
    first, second = ((tmp_path / f"cell{k}.html").read_text() for k in range(2))
    assert len(first) - len(second) > 500_000
    (notebook := tmp_path / "notebook.html").write_text("<!DOCTYPE html>" + second + first)
    page = chromium.new_page()
    page.goto(notebook.as_uri())
    for frame in page.frames[1:]:
        frame.wait_for_selector("#scene canvas", timeout=240_000)
        assert frame.evaluate("window.manipLearn.drawing")
    page.close()
