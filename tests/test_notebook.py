"""The notebook runs in a real kernel, and every object of the library shows itself in it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NOTEBOOK = EXAMPLES / "drawer.ipynb"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """The notebook's code cells after a run in a folder of their own, as a user would have copied it."""
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "data").mkdir()
    shutil.copytree(EXAMPLES / "data" / "sawyer_drawer", folder / "data" / "sawyer_drawer")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    assert (folder / "replay.html").is_file()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.timeout(300)
def test_every_cell_shows_something(run: list[Any]):
    """One card per cell as HTML, and a short text for consoles; nothing is printed to the error stream."""
    titles = ["Robot sawyer", "Demonstrations", "What was learnt", "Constraint: 2 of 3 rows", "Rollout", "<iframe"]
    for cell, title in zip(run, titles, strict=True):
        errors = [out for out in cell.outputs if out.output_type in ("error", "stream")]
        assert errors == []
        shown = [out.data for out in cell.outputs if out.output_type == "execute_result"]
        assert len(shown) == 1
        assert title in shown[0]["text/html"]
        assert shown[0]["text/plain"].count("\n") < 10


def test_notebook_is_shipped_without_outputs():
    """Outputs are made by the reader's own run: those of ours would be out of date."""
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None


def test_the_viewer_is_in_the_first_replay_only(tmp_path, chromium):
    """Three replays in a dark notebook, the last drawn first: all play and are dark, the first alone has the viewer."""
    script = """
import manip_learn as ml, numpy as np, sys
robot = ml.load_robot("planar3")
still = ml.Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)))
for k in range(3):
    page = ml.replay(robot, still, html=f"replay{k}.html", open_browser=False)
    open(f"cell{k}.html", "w").write(page._repr_html_())
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, timeout=100)
    cells = [(tmp_path / f"cell{k}.html").read_text() for k in range(3)]
    assert len(cells[0]) - len(cells[1]) > 500_000 and len(cells[1]) == pytest.approx(len(cells[2]), abs=10)
    notebook = tmp_path / "notebook.html"
    dark = "<!DOCTYPE html><body style='background: #111; color: #eee'>"
    notebook.write_text(dark + cells[2] + cells[0] + cells[1])
    page = chromium.new_page(color_scheme="null")
    page.goto(notebook.as_uri())
    for frame in page.frames[1:]:
        frame.wait_for_selector("#scene canvas", timeout=240_000)
        assert frame.evaluate("window.manipLearn.drawing") and frame.query_selector("#missing") is None
        assert frame.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
    lost = tmp_path / "lost.html"
    lost.write_text("<!DOCTYPE html>" + cells[1])
    page.goto(lost.as_uri())
    assert "restart the kernel" in page.frames[1].inner_text("#missing")
    page.close()
