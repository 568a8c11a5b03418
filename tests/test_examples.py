"""The examples run as they are shipped, are short enough to read, and the README shows code that exists."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
MAX_LINES = 100
# warnings are errors, but the one of pyzmq that meshcat's own import causes
STRICT = ["-W", "error", "-W", "ignore:zmq.eventloop.ioloop:DeprecationWarning"]


def files() -> set[Path]:
    """All files beside the examples but what Python compiles, which other tests that import them leave."""
    return {path for path in (ROOT / "examples").rglob("*") if "__pycache__" not in path.parts}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
@pytest.mark.timeout(300)
def test_example_runs(path, tmp_path):
    """Each example runs to its end from any folder, without a window, a warning or a file outside that folder."""
    before = files()
    result = subprocess.run(
        [sys.executable, *STRICT, str(path), "--headless"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    assert result.stdout.strip(), "an example says what came out"
    assert files() == before


def test_examples_read_well():
    """A course, 01, 02, 03, ...: each at most 100 lines, with a PEP 723 header and a docstring, its work in main()."""
    assert [int(p.name[:2]) for p in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        assert text.count("\n") <= MAX_LINES and ast.get_docstring(tree), path.name
        assert "# /// script" in text and "manip-learn" in text.partition("# ///\n")[0], f"{path.name}: dependencies"
        assert "main" in [n.name for n in tree.body if isinstance(n, ast.FunctionDef)], path.name
        assert 'if __name__ == "__main__":' in text, path.name


def code_lines(text: str) -> list[str]:
    """Lines without indentation, blank lines and comments."""
    return [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]


def is_part_of(lines: list[str], of: list[str]) -> bool:
    """True if all the lines occur, in this order."""
    rest = iter(of)
    return all(line in rest for line in lines)


def test_readme_shows_examples():
    """Every Python block of the README is, line for line and in order, part of one example that the tests run."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = [code_lines(text) for text in re.findall(r"^```python\n(.*?)^```", readme, re.MULTILINE | re.DOTALL)]
    shipped = [code_lines(p.read_text(encoding="utf-8")) for p in EXAMPLES]
    assert found
    for lines in found:
        assert any(is_part_of(lines, example) for example in shipped), f"no example has these lines: {lines}"


def test_rows_that_are_no_jacobian_are_learnt():
    """Of a puck in a groove the true row is found: to rounding without noise, within 0.2 degrees with 1 % of it."""
    spec = importlib.util.spec_from_file_location("not_kinematic", ROOT / "examples" / "10_not_kinematic.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(example := importlib.util.module_from_spec(spec))
    features = ml.CustomFeatures(example.gradients, example.MONOMIALS, nv=2)
    for seed, noise, within in ((1, 0.0, 1e-5), (2, 0.01, 0.2), (3, 0.01, 0.2)):
        demos = example.recorded_pushes(noise, np.random.default_rng(seed))
        learner = ml.ConstraintLearner(features).fit(demos)
        assert learner.constraint_.n_constraints == 1
        assert example.angle_to_the_groove(learner.constraint_) < within
