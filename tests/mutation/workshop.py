"""Tests run on a copy of the project, each time in a child of a process that has imported the libraries."""

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

import coverage

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("manip_learn", "tests", "robots", "examples", "benchmarks", "docs")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md")
Outcome = Literal["noticed", "survived", "too slow", "broken"]


@final
class Workshop:
    """A copy of the project in which faults are tried.

    Args:
        folder: Where to copy to.
        timeout: Time after which a fault counts as noticed, because it hangs [s].
        followed: Processor time of a test file whose lines are followed, which is slower: the rest repeats what the
            first do [s].
    """

    def __init__(self, folder: Path, timeout: float, followed: float):
        self.folder, self.timeout, self.followed = folder, timeout, followed
        self._reached: dict[str, dict[str, dict[int, list[str]]]] = {}
        self.seconds: dict[str, float] = {}
        for name in FOLDERS:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns(".*", "_build"))
        for name in FILES:
            shutil.copy(ROOT / name, folder / name)
        os.environ.update(PYTHONPATH=str(folder), CHECK_SHAPES="0")
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        sys.path[:0] = [str(folder), str(folder / "tests")]

    def tests_of(self, file: str, test_files: Sequence[str]) -> dict[int, list[str]]:
        """Line of a file -> tests in some test files that run it, the quickest first.

        Tests that fail without any fault prove nothing and are left out.
        """
        lines: dict[int, list[str]] = {}
        for test_file in test_files:
            if test_file not in self._reached:
                self._reached[test_file] = self._follow(test_file)
            for line, names in self._reached[test_file].get(file, {}).items():
                lines.setdefault(line, []).extend(names)
        return {line: sorted(names, key=lambda name: self.seconds[name]) for line, names in lines.items()}

    def _follow(self, test_file: str) -> dict[str, dict[int, list[str]]]:
        """File of the library -> line -> tests of a test file that run it."""
        (self.folder / "seconds.json").unlink(missing_ok=True)
        outcome = self._run([test_file], time_limit=3.0 * self.timeout, followed=True)
        if not (self.folder / "seconds.json").exists():
            print(f"{test_file} is left out: {outcome} without any fault", file=sys.stderr)
            return {}
        seconds = json.loads((self.folder / "seconds.json").read_text(encoding="utf-8"))
        self.seconds |= seconds
        measured = coverage.CoverageData(str(self.folder / "lines"))
        measured.read()
        reached: dict[str, dict[int, list[str]]] = {}
        for path in measured.measured_files():
            by_line = measured.contexts_by_lineno(path)
            # what runs at import is reached by every test
            reached[str(Path(path).relative_to(self.folder))] = {
                line: [name for name in names if name in seconds] or ([] if any(names) else list(seconds))
                for line, names in by_line.items()
            }
        return reached

    def try_fault(self, file: str, text: str, tests: Sequence[str]) -> Outcome:
        """Whether the tests notice that a file has another text."""
        path = self.folder / file
        original = path.read_text(encoding="utf-8")
        _write(path, text)
        try:
            return self._run(tests, self.timeout)
        finally:
            _write(path, original)

    def _run(self, tests: Sequence[str], time_limit: float, followed: bool = False) -> Outcome:
        """Run tests; the first failure ends it, unless their lines are followed."""
        answer = self.folder / "answer.json"
        answer.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            _pytest_in_child(self.folder, tests, answer, self.followed if followed else 0.0)
        end = time.monotonic() + time_limit
        while os.waitpid(child, os.WNOHANG) == (0, 0):
            if time.monotonic() > end:
                with suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return "too slow"
            time.sleep(0.02)
        if not answer.exists():
            return "noticed"  # the interpreter died
        code, libraries = json.loads(answer.read_text(encoding="utf-8"))
        for name in libraries:  # what has no fault need not be imported by every child again
            if name not in sys.modules:
                with suppress(ImportError, AttributeError):
                    importlib.import_module(name)
        # 2 and 4: the file cannot be imported, or conftest.py cannot; 3: what pytest itself asks of the library fails
        return {0: "survived", 5: "survived", 1: "noticed", 2: "noticed", 3: "broken", 4: "noticed"}[code]


def _write(path: Path, text: str) -> None:
    """Change a file, and forget its bytecode: Python does not tell two texts of one second and one size apart."""
    path.write_text(text, encoding="utf-8")
    for old in path.parent.glob(f"__pycache__/{path.stem}.*"):
        old.unlink()


def _libraries(folder: Path) -> list[str]:
    """Names of the imported modules that are neither the project's nor its tests'."""
    files = {name: getattr(module, "__file__", None) or "" for name, module in list(sys.modules.items())}
    return [name for name, file in files.items() if file and not file.startswith(str(folder)) and name != "__main__"]


def _pytest_in_child(folder: Path, tests: Sequence[str], answer: Path, followed: float) -> None:
    os.setsid()
    os.chdir(folder)
    output = os.open(folder / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    code = 4
    try:
        import pytest

        notes = _Notes(followed)
        options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "--benchmark-disable", "--tb=line", "-W"]
        options += ["ignore::pytest.PytestAssertRewriteWarning"]  # libraries are there before pytest is
        if followed:
            library = [str(folder / "manip_learn" / "*")]
            notes.lines = coverage.Coverage(data_file=str(folder / "lines"), include=library, config_file=False)
            notes.lines.start()
        code = int(pytest.main([*options, *([] if followed else ["-x"]), *tests], plugins=[notes]))
        if notes.lines is not None:
            notes.lines.stop()
            notes.lines.save()
            (folder / "seconds.json").write_text(json.dumps(notes.seconds), encoding="utf-8")
    except BaseException:  # whatever it is, the parent must hear of it, and must not go on in two processes
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        answer.write_text(json.dumps([code, _libraries(folder)]), encoding="utf-8")
        os._exit(0)


@final
class _Notes:
    """A plugin of pytest: how long each test took, and its name for the lines that it reaches."""

    def __init__(self, followed: float) -> None:
        self.lines: coverage.Coverage | None = None
        self.seconds, self.end = dict[str, float](), time.process_time() + followed

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self.lines is not None:
            self.lines.switch_context(nodeid)

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed:
            self.seconds.pop(report.nodeid, None)
        elif report.passed and (report.when == "setup" or report.nodeid in self.seconds):
            self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_runtest_protocol(self, item) -> None:
        if self.lines is not None and time.process_time() > self.end:
            item.session.shouldstop = "long enough"
