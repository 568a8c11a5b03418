"""Tests run on a copy of the project with one fault in it, each time in a child of a process that has the libraries."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal, final

from catalogue import ROOT, Mutant

FOLDERS = ("manip_learn", "tests", "robots", "examples", "benchmarks")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md")
Outcome = Literal["killed", "survived", "too slow", "broken"]


@final
class Workshop:
    """A copy of the project in which faults are tried.

    Args:
        folder: Where to copy to.
        timeout: Time after which a mutant counts as noticed, because it hangs [s].
    """

    def __init__(self, folder: Path, timeout: float):
        self.folder, self.timeout = folder, timeout
        for name in FOLDERS:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns(".*"))
        for name in FILES:
            shutil.copy(ROOT / name, folder / name)
        os.environ.update(PYTHONPATH=str(folder), CHECK_SHAPES="0", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        sys.path[:0] = [str(folder), str(folder / "tests")]

    def try_mutant(self, mutant: Mutant, tests: Sequence[str]) -> tuple[Outcome, str]:
        """Whether the tests notice the fault, and the first that does."""
        path = self.folder / mutant.file
        original = path.read_text(encoding="utf-8")
        _write(path, mutant.applied(self.folder))
        try:
            return self.run(tests)
        finally:
            _write(path, original)

    def run(self, tests: Sequence[str]) -> tuple[Outcome, str]:
        """Run tests, the first failure ends it."""
        answer = self.folder / "answer.json"
        answer.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            _pytest_in_child(self.folder, tests, answer)
        end = time.monotonic() + self.timeout
        while os.waitpid(child, os.WNOHANG) == (0, 0):
            if time.monotonic() > end:
                with suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return "too slow", ""
            time.sleep(0.02)
        if not answer.exists():
            return "broken", "the interpreter died"
        code, first, libraries = json.loads(answer.read_text(encoding="utf-8"))
        for name in libraries:  # what is not mutated need not be imported by every child again
            if name not in sys.modules:
                with suppress(ImportError, AttributeError):
                    importlib.import_module(name)
        return {0: "survived", 1: "killed", 5: "survived"}.get(code, "broken"), first

    def output(self) -> str:
        """What pytest printed in the last run."""
        return (self.folder / "output.txt").read_text(encoding="utf-8", errors="replace")


def _write(path: Path, text: str) -> None:
    """Change a file, and forget its bytecode: Python does not tell two texts of one second and one size apart."""
    path.write_text(text, encoding="utf-8")
    for old in path.parent.glob(f"__pycache__/{path.stem}.*"):
        old.unlink()


def _libraries(folder: Path) -> list[str]:
    """Names of the imported modules that are neither the project's nor its tests'."""
    files = {name: getattr(module, "__file__", None) or "" for name, module in list(sys.modules.items())}
    return [name for name, file in files.items() if file and not file.startswith(str(folder)) and name != "__main__"]


def _pytest_in_child(folder: Path, tests: Sequence[str], answer: Path) -> None:
    os.setsid()
    os.chdir(folder)
    output = os.open(folder / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    code, first = 4, "the tests cannot be started"
    try:
        import pytest

        notes = _FirstFailure()
        options = ["-x", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "--benchmark-disable", "--tb=line", "-W"]
        options += ["ignore::pytest.PytestAssertRewriteWarning"]  # libraries are there before pytest is
        code = int(pytest.main([*options, *tests], plugins=[notes]))
        first = notes.name
    except BaseException:  # whatever it is, the parent must hear of it, and must not go on in two processes
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        answer.write_text(json.dumps([code, first, _libraries(folder)]), encoding="utf-8")
        os._exit(0)


@final
class _FirstFailure:
    """A plugin of pytest that remembers the first test that failed."""

    def __init__(self) -> None:
        self.name = ""

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed and not self.name:
            self.name = report.nodeid

    def pytest_collectreport(self, report) -> None:
        if report.failed and not self.name:
            self.name = report.nodeid
