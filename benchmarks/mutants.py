"""Puts small faults into a copy of the library, one at a time: do the tests notice them?

    python benchmarks/mutants.py --cover            run each test file alone and note which lines it covers (20 minutes)
    python benchmarks/mutants.py --draw 200         faults drawn from the rooms that compute, by their sizes
    python benchmarks/mutants.py                    lines changed since the last release, or the last commit
    python benchmarks/mutants.py --since main       lines changed since a revision
    python benchmarks/mutants.py manip_learn/linalg.py  whole files

Each fault is tried with the test files that reach its line and cover most of its module, and in these with the tests
that reach the line. Those that nobody notices are listed with what the function around them promises; fewer than LEAST
noticed is a failure.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("manip_learn", "tests", "robots", "examples", "benchmarks", "docs", "pyproject.toml", "README.md")
COMPUTE = ("learning", "control", "constraint", "recordings", "planning", "robot")  # rooms from which faults are drawn
# of the faults: about one in eight changes nothing that a caller could see (another bound of a loop that ends before
# it, a constant of a tie, < for <= where equality cannot be)
LEAST = 0.88
MOST_COVERING = 4  # test files that are tried: those that remain repeat what these check
COVERAGE = """[run]
source = manip_learn
relative_files = true
parallel = true
dynamic_context = test_function
patch = subprocess
disable_warnings = no-data-collected, module-not-imported, dynamic-conflict
"""
OTHER: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult,
}  # fmt: skip
PAIRS = ("min max", "minimum maximum", "argmin argmax", "any all", "ceil floor", "cos sin", "median mean")
CALLS = {a: b for pair in map(str.split, PAIRS) for a, b in (pair, pair[::-1])}
DROPPED = {"abs", "clip", "unwrap", "sorted", "flip", "cumsum", "where", "sqrt"}  # f(x, ...) -> x
SYMMETRIC = {*CALLS, "hypot", "isclose", "allclose", "array_equal", "isinstance", "zip", "outer"}


class Fault(NamedTuple):
    """One fault: its file, where it is, and the code before and after in words."""

    file: str
    node: int
    number: int
    line: int
    words: str


def faults_of(text: str) -> list[tuple[int, int, int, str]]:
    """All faults of a file: node, number, line and words; sentences, signatures, annotations, errors are left alone."""
    out = []
    for i, original in enumerate(_code(ast.parse(text))):
        before = ast.unparse(original)
        for k, faulty in enumerate(_faulty(original)):
            words = f"{before}  ->  {ast.unparse(faulty)}".replace("\n", " ")[:200]
            out.append((i, k, original.lineno, words))
    return out


def with_fault(text: str, i: int, k: int) -> tuple[str, str]:
    """The file with a fault in it, and what the function around it promises."""
    tree = ast.parse(text)
    node = list(_code(tree))[i]
    new = ast.copy_location(list(_faulty(node))[k], node)
    documented = [n for n in ast.walk(tree) if isinstance(n, ast.Module | ast.FunctionDef | ast.ClassDef)]
    around = [said for n in documented if node in ast.walk(n) and (said := ast.get_docstring(n))]  # innermost last

    class Exchange(ast.NodeTransformer):
        def visit(self, old: ast.AST) -> ast.AST:
            return new if old is node else self.generic_visit(old)

    return ast.unparse(ast.fix_missing_locations(Exchange().visit(tree))), around[-1].partition("\n")[0]


def _code(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Nodes that compute: no docstring, signature, annotation, f-string or error."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.expr | ast.stmt):
        yield node
    children = node.body if isinstance(node, ast.FunctionDef | ast.ClassDef) else ast.iter_child_nodes(node)
    if isinstance(node, ast.AnnAssign):
        children = [node.value] if node.value is not None else []
    for child in children:
        yield from _code(child)


def _faulty(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Faults that a node can have: another sign, bound, constant or call, exchanged arguments, a dropped call."""
    match node:
        case ast.Expr(value=ast.Call()):
            yield ast.Pass()
        case ast.Compare(left, [op], comparators):
            yield ast.Compare(left, [OTHER[type(op)]()], comparators)
        case ast.BinOp(left, op, right) if type(op) in OTHER:
            yield ast.BinOp(left, OTHER[type(op)](), right)
        case ast.BoolOp(op, values):
            yield ast.BoolOp(OTHER[type(op)](), values)
        case ast.UnaryOp(_, operand):
            yield operand
        case ast.If(test, body, orelse):
            yield ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.Return(value) if value is not None and not isinstance(value, ast.Constant):
            yield ast.Return(ast.Constant(None))
        case ast.Constant(bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(int() | float() as value):
            yield ast.Constant(2 * value if value else value + 1)
        case ast.Call(ast.Attribute() | ast.Name() as func, args, keywords):
            name = func.attr if isinstance(func, ast.Attribute) else func.id
            other = CALLS.get(name, "")
            if other:
                new = ast.Attribute(func.value, other) if isinstance(func, ast.Attribute) else ast.Name(other)
                yield ast.Call(new, args, keywords)
            if name in DROPPED and args:
                yield args[0]
            if len(args) > 1 and name not in SYMMETRIC and not any(isinstance(a, ast.Starred) for a in args[:2]):
                yield ast.Call(func, [args[1], args[0], *args[2:]], keywords)


class Covered:
    """Which tests reach which line, as `--cover` noted it in a folder."""

    def __init__(self, folder: Path):
        self.seconds: dict[str, float] = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))
        self.data = CoverageData(str(folder / "coverage"))
        self.data.read()
        self.files = defaultdict[str, list[str]](list)  # of a module all its paths: programs of tests run elsewhere
        for path in self.data.measured_files():
            if "manip_learn/" in path:
                self.files[path[path.rindex("manip_learn/") :]].append(path)

    def tests_of(self, file: str, line: int) -> list[str]:
        """The tests that reach a line, of the files that cover most of its module, quickest first; [] if none does."""
        by_line = defaultdict[int, list[str]](list)
        for path in self.files[file]:
            for number, contexts in self.data.contexts_by_lineno(path).items():
                by_line[number] += contexts
        reached = by_line.get(line) or by_line.get(max((n for n in by_line if n < line), default=0), [])
        own = defaultdict[str, set[str]](set)
        for test_file, _, test in (c.partition("|") for c in reached):
            if test_file in self.seconds:  # others fail without any fault
                own[test_file].add(test)
        for test_file, names in own.items():
            if not all(re.fullmatch(r"\w+\.test_\w+", n) for n in names):  # a fixture, whose tests are not known
                own[test_file] = {""}
        lines = Counter(f for contexts in by_line.values() for f in {c.partition("|")[0] for c in contexts})
        most = sorted(sorted(own, key=lambda f: -lines[f])[:MOST_COVERING], key=lambda f: self.seconds[f])
        return [f"{f}::{n.rpartition('.')[2]}" if n else f for f in most for n in sorted(own[f])]


def cover(folder: Path, jobs: int) -> None:
    """Run each test file alone and note the lines that each of its tests covers."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rules = folder / "rules"
    rules.write_text(COVERAGE + f"data_file = {folder / 'coverage'}\n", encoding="utf-8")
    seconds = dict[str, float]()

    def alone(test_file: str) -> None:
        run, before = ["-m", "coverage", "run", f"--rcfile={rules}", f"--context={test_file}"], time.monotonic()
        if passes(ROOT, [*run, "-m", *PYTEST, test_file], 3600.0):
            seconds[test_file] = time.monotonic() - before
        else:
            print(f"{test_file} is left out: it fails without any fault", file=sys.stderr)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(alone, sorted(f"tests/{p.name}" for p in (ROOT / "tests").glob("test_*.py"))))
    subprocess.run([sys.executable, "-m", "coverage", "combine", f"--rcfile={rules}"], cwd=ROOT, check=True)
    (folder / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")


def drawn(count: int, seed: int) -> list[Fault]:
    """Draw faults from the rooms that compute, of each its share; a change of a line hardly changes the draw."""
    order = dict[str, list[tuple[str, Fault]]]()
    for room in COMPUTE:
        keyed = order[room] = []
        for path in sorted((ROOT / "manip_learn" / room).rglob("*.py")):
            file, seen = path.relative_to(ROOT).as_posix(), Counter[str]()
            for node, number, line, words in faults_of(path.read_text(encoding="utf-8")):
                key = f"{seed} {file} {words} {seen[words]}"
                seen[words] += 1
                keyed.append((hashlib.sha256(key.encode()).hexdigest(), Fault(file, node, number, line, words)))
        keyed.sort()
    total = sum(map(len, order.values()))
    return [f for keyed in order.values() for _, f in keyed[: round(count * len(keyed) / total)]]


def changed_lines(since: str) -> dict[str, set[int]]:
    """File -> lines that were changed since a revision; by default the last tag, or the commit before this one."""
    since = since or _git("describe", "--tags", "--abbrev=0") or "HEAD~1"
    since = _git("merge-base", since, "HEAD")  # what others have changed there meanwhile is not ours
    changed, lines = dict[str, set[int]](), set[int]()
    for line in _git("diff", "--unified=0", "--diff-filter=AMR", since, "--", "manip_learn/*.py").splitlines():
        if line.startswith("+++ b/"):
            lines = changed[line.removeprefix("+++ b/")] = set()
        elif found := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", line):
            lines |= set(range(int(found[1]), int(found[1]) + int(found[2] or 1)))
    return changed


def _git(*words: str) -> str:
    """What Git says; empty where it fails."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


PYTEST = ["pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--benchmark-disable"]


def passes(project: Path, command: list[str], timeout: float) -> bool:
    """Whether Python succeeds on a copy of the project; what hangs does not."""
    environment = os.environ | {"PYTHONPATH": str(project), "OMP_NUM_THREADS": "1"}
    with suppress(subprocess.TimeoutExpired):
        where: Any = {"cwd": project, "env": environment, "capture_output": True, "timeout": timeout}
        return subprocess.run([sys.executable, *command], **where).returncode in (0, 5)
    return False


def survivors(faults: Iterable[Fault], covered: Covered, jobs: int) -> Iterator[tuple[Fault, str, bool]]:
    """Try faults in copies of the project: each with what its function promises, and whether no test notices it."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        projects = SimpleQueue[Path]()
        for number in range(jobs):
            project = Path(folder, str(number))
            project.mkdir()
            for name in COPIED:
                (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, project / name)
            projects.put(project)

        def tried(fault: Fault) -> tuple[Fault, str, bool]:
            original = (ROOT / fault.file).read_text(encoding="utf-8")
            faulty, promise = with_fault(original, fault.node, fault.number)
            tests = covered.tests_of(fault.file, fault.line)
            if not tests:
                return fault, promise, True
            project = projects.get()
            path = project / fault.file
            path.write_text(faulty, encoding="utf-8")
            shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
            limit = 60.0 + 3.0 * sum(covered.seconds[t] for t in {t.partition("::")[0] for t in tests})
            survives = passes(project, ["-m", *PYTEST, *tests], limit)
            path.write_text(original, encoding="utf-8")
            projects.put(project)
            return fault, promise, survives

        yield from pool.map(tried, faults)


def main() -> int:
    """Exit code 0 if the tests are strong enough."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="of the library; default: the lines that changed")
    parser.add_argument("--cover", action="store_true", help="note which tests cover which lines, and end")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "covered", help="of these notes")
    parser.add_argument("--draw", type=int, default=0, help=f"faults of {', '.join(COMPUTE)}, by their sizes")
    parser.add_argument("--since", default="", help="a revision; default: the last tag, or the commit before this one")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="at the same time")
    options = parser.parse_args()
    if options.cover:
        cover(options.folder.resolve(), options.jobs)
        return 0
    chosen = drawn(options.draw, options.seed) if options.draw else []
    lines = {} if options.draw else dict.fromkeys(options.files) or changed_lines(options.since)
    for file, wanted in sorted(lines.items()):
        found = faults_of((ROOT / file).read_text(encoding="utf-8"))
        chosen += [Fault(file, *f) for f in found if not wanted or f[2] in wanted]
    noticed = 0
    for fault, promise, survives in survivors(chosen, Covered(options.folder.resolve()), options.jobs):
        noticed += not survives
        if survives:
            print(f"{fault.file}:{fault.line}: {fault.words}\n    promise: {promise}", flush=True)
    print(f"{noticed} of {len(chosen)} faults noticed")
    return 0 if noticed >= LEAST * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
