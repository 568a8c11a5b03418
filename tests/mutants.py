"""Puts small faults into a copy of the library, one at a time: do the tests notice them?

    python tests/mutants.py                        lines changed since the last release, or the last commit
    python tests/mutants.py --since main           lines changed since a revision
    python tests/mutants.py manip_learn/linalg.py  whole files
    python tests/mutants.py --hours 8 $(git ls-files 'manip_learn/*.py')  the library, a random fault after the other

Each fault is tried with the test files that are nearest to its file. Those that nobody notices are listed with what the
function around them promises, and the run fails if fewer than LEAST are noticed.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("manip_learn", "tests", "robots", "examples", "benchmarks", "docs", "pyproject.toml", "README.md")
# of the faults: about one in eight changes nothing that a caller could see (another bound of a loop that ends before
# it, a constant of a tie, < for <= where equality cannot be)
LEAST = 0.8
NEAREST = 4  # test files that are tried: those that remain repeat what these check
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
    """One fault: the line of the original, the code before and after, and the whole file with the fault in it."""

    line: int
    words: str
    promise: str
    text: str


def faults_of(text: str) -> Iterator[Fault]:
    """All faults of a file; sentences, signatures, annotations and errors are left alone."""
    for i, original in enumerate(_code(ast.parse(text))):
        for k, faulty in enumerate(_faulty(original)):
            tree = ast.parse(text)
            node = list(_code(tree))[i]
            promise = _promise(tree, node.lineno)
            words = f"{ast.unparse(original)}  ->  {ast.unparse(faulty)}".replace("\n", " ")[:200]
            new = ast.copy_location(list(_faulty(node))[k], node)
            exchanged = ast.fix_missing_locations(_Exchange(node, new).visit(tree))
            yield Fault(node.lineno, words, promise, ast.unparse(exchanged))


class _Exchange(ast.NodeTransformer):
    def __init__(self, node: ast.AST, new: ast.AST):
        self.node, self.new = node, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.node else self.generic_visit(node)


def _promise(tree: ast.Module, line: int) -> str:
    """First line of the docstring of the innermost function or class around a line."""
    around = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(n)]
    around = [n for n in around if n.lineno <= line <= (n.end_lineno or 0)]
    return (ast.get_docstring(max(around, key=lambda n: n.lineno, default=tree)) or "").split("\n")[0]


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


def nearest_tests(file: str) -> list[str]:
    """Test files that use a file of the library: those that bear its name, then those that import it and least else."""
    module, stem = file.removesuffix(".py").replace("/", "."), Path(file).stem
    names = re.findall(r"^(?:def|class) ([A-Za-z]\w*)", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)
    public = re.compile(rf"{re.escape(module)}\b|\bml\.(?:{'|'.join(names) or 'nothing'})\b")
    found = []
    for path in sorted((ROOT / "tests").glob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if stem in path.stem or public.search(text):
            found.append((stem not in path.stem, len(re.findall(r"^from manip_learn", text, re.MULTILINE)), path.name))
    return [f"tests/{name}" for _, _, name in sorted(found)[:NEAREST]]


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
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


def passes(project: Path, tests: list[str], timeout: float) -> bool:
    """Whether some test files pass on a copy of the project; what hangs does not."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--benchmark-disable"]
    environment = os.environ | {"PYTHONPATH": str(project), "CHECK_SHAPES": "0", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run([*command, *tests], cwd=project, env=environment, capture_output=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode in (0, 5)


def main() -> int:
    """Exit code 0 if the tests are strong enough."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="of the library; default: the lines that changed")
    parser.add_argument("--since", default="", help="a revision; default: the last tag, or the commit before this one")
    parser.add_argument("--hours", type=float, default=np.inf, help="no new fault after that")
    parser.add_argument("--count", type=int, default=10, help="faults of each file")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    options = parser.parse_args()
    lines = dict.fromkeys(options.files) if options.files else changed_lines(options.since)
    rng, end = np.random.default_rng(options.seed), time.monotonic() + 3600.0 * options.hours
    chosen = []
    for file, wanted in sorted(lines.items()):
        faults = [f for f in faults_of((ROOT / file).read_text(encoding="utf-8")) if not wanted or f.line in wanted]
        chosen += [(file, faults[i]) for i in rng.permutation(len(faults))[: options.count]]
    noticed = tried = 0
    seconds: dict[str, float] = {}  # of the tests of a file without any fault; infinite if these fail
    with tempfile.TemporaryDirectory() as folder:
        project = Path(folder)
        for name in COPIED:
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, project / name)
        for file, fault in (chosen[i] for i in rng.permutation(len(chosen))):
            tests, path = nearest_tests(file), project / file
            if time.monotonic() > end or not tests:
                continue
            if file not in seconds:
                before = time.monotonic()
                seconds[file] = time.monotonic() - before if passes(project, tests, 3600.0) else np.inf
                if not np.isfinite(seconds[file]):
                    print(f"{file} is left out: {' '.join(tests)} fail without any fault", file=sys.stderr)
            if not np.isfinite(seconds[file]):
                continue
            tried += 1
            original = path.read_text(encoding="utf-8")
            path.write_text(fault.text, encoding="utf-8")
            shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)
            if passes(project, tests, 60.0 + 3.0 * seconds[file]):
                print(f"{file}:{fault.line}: {fault.words}\n    promise: {fault.promise}", flush=True)
            else:
                noticed += 1
            path.write_text(original, encoding="utf-8")
    print(
        f"{noticed} of {tried} faults noticed; tests that fail without any: {[f for f in seconds if seconds[f] > 1e9]}"
    )
    return 0 if noticed >= LEAST * tried else 1


if __name__ == "__main__":
    sys.exit(main())
