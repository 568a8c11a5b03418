"""The examples run as they are shipped, are short enough to read, and the README shows code that exists."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
by_example = pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
MAX_LINES = 100


def files() -> set[Path]:
    """All files beside the examples but what Python compiles, which other tests that import them leave."""
    return {path for path in (ROOT / "examples").rglob("*") if "__pycache__" not in path.parts}


@by_example
@pytest.mark.timeout(300)
def test_example_runs(path, tmp_path):
    """Each example runs to its end from any folder, without a window, a warning or a file outside that folder."""
    before = files()
    result = subprocess.run(
        [sys.executable, "-W", "error", str(path), "--headless"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    assert result.stdout.strip(), "an example says what came out"
    assert files() == before


@by_example
def test_example_reads_well(path):
    """An example is at most 100 lines, begins with a PEP 723 header and a docstring, and its work is in main()."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    assert text.count("\n") <= MAX_LINES
    assert "# /// script" in text
    assert "manip-learn" in text.partition("# ///\n")[0], "the header names the library as a dependency"
    assert ast.get_docstring(tree)
    assert "main" in [n.name for n in tree.body if isinstance(n, ast.FunctionDef)]
    assert 'if __name__ == "__main__":' in text


def test_examples_are_numbered_without_gaps():
    """The examples read as a course: 01, 02, 03, ..."""
    assert [int(p.name[:2]) for p in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


def code_lines(text: str) -> list[str]:
    """Lines without indentation, blank lines and comments."""
    return [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]


def is_part_of(lines: list[str], of: list[str]) -> bool:
    """True if all the lines occur, in this order."""
    rest = iter(of)
    return all(line in rest for line in lines)


def snippets() -> list[str]:
    """Python blocks of the README."""
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8") if readme.exists() else ""
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("snippet", snippets(), ids=lambda s: code_lines(s)[0][:40])
def test_readme_shows_an_example(snippet):
    """Every Python block of the README is, line for line and in order, part of one example that the tests run."""
    lines = code_lines(snippet)
    if not EXAMPLES:
        pytest.skip("there are no examples yet")
    found = [p.name for p in EXAMPLES if is_part_of(lines, code_lines(p.read_text(encoding="utf-8")))]
    assert found, "no example has these lines in this order"
