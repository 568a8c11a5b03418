"""Small faults of the kind that people make, put into the syntax tree of a Python file one at a time."""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import final

COMPARISONS: dict[type, type] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
ARITHMETIC: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}
PAIRS = [
    ("min", "max"),
    ("minimum", "maximum"),
    ("argmin", "argmax"),
    ("any", "all"),
    ("ceil", "floor"),
    ("cos", "sin"),
]
CALLS = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])} | {"median": "mean", "hypot": "maximum"}
DROPPED = {"abs", "clip", "unwrap", "sorted", "flip", "cumsum", "where", "sqrt"}  # f(x, ...) -> x
SYMMETRIC = {
    "minimum",
    "maximum",
    "min",
    "max",
    "hypot",
    "isclose",
    "allclose",
    "array_equal",
    "isinstance",
    "zip",
    "outer",
}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@final
@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        line: Line of the original file, from 1.
        words: The code before and after.
        promise: First line of the docstring of the function or class around it.
        text: The whole file with the fault in it, when called; its comments and its layout are gone.
    """

    line: int
    words: str
    promise: str
    text: Callable[[], str]


def faults_of(text: str) -> list[Fault]:
    """All faults of a file, in its order; sentences, signatures, annotations and errors are left alone."""
    tree = ast.parse(text)
    promises = _promises(tree)
    found = []
    for node, faulty in _changes(tree):
        line, words = node.lineno, f"{_short(node)}  ->  {_short(faulty)}"
        if isinstance(node, ast.FunctionDef):  # its own line runs at import
            line, words = node.body[ast.get_docstring(node) is not None].lineno, f"{node.name}  ->  returns at once"
        promise = next((words for first, last, words in promises if first <= line <= last), "")
        found.append(Fault(line, words, promise, partial(_unparsed, tree, node, faulty)))
    return sorted(found, key=lambda fault: fault.line)


def _short(node: ast.AST) -> str:
    return ast.unparse(node).split("\n")[0][:100]


def _unparsed(tree: ast.Module, node: ast.AST, faulty: ast.AST) -> str:
    return ast.unparse(_replaced(tree, node, faulty))


def _promises(tree: ast.Module) -> list[tuple[int, int, str]]:
    """(first line, last line, first line of the docstring) of functions, classes and the file, the innermost first."""
    found = [(1, 10**9, (ast.get_docstring(tree) or "").split("\n")[0])]
    for node in ast.walk(tree):
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)) and (words := ast.get_docstring(node)):
            found.append((node.lineno, node.end_lineno or node.lineno, words.split("\n")[0]))
    return sorted(found, key=lambda item: item[1] - item[0])


def _replaced(tree: ast.Module, node: ast.AST, faulty: ast.AST) -> ast.Module:
    """A copy of the tree with one node exchanged; all other nodes are shared."""

    class Exchange(ast.NodeTransformer):
        def visit(self, at: ast.AST) -> ast.AST:
            if at is node:
                return faulty
            return self.generic_visit(copy.copy(at))

    # generic_visit writes to lists in place: each node's lists must be its own
    class Fresh(Exchange):
        def generic_visit(self, at: ast.AST) -> ast.AST:
            for name, value in ast.iter_fields(at):
                if isinstance(value, list):
                    setattr(at, name, list(value))
            return super().generic_visit(at)

    return ast.fix_missing_locations(Fresh().visit(tree))


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, ast.expr | ast.stmt]]:
    """(node, faulty node) of every fault."""
    for node in _code(tree):
        for faulty in _faulty(node):
            yield node, ast.copy_location(faulty, node)


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that compute: no docstring, signature, annotation, f-string or error."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    yield node
    if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
        children: list[ast.AST] = list(node.body)
    elif isinstance(node, ast.AnnAssign):
        children = [node.value] if node.value is not None else []
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from _code(child)


def _faulty(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Faults that a node can have."""
    match node:
        case ast.FunctionDef(name=name, body=body) if name != "__init__" and _is_procedure(node):
            words = body[: ast.get_docstring(node) is not None]
            work = body[len(words) :]
            if work and not (
                len(work) == 1 and isinstance(work[0], ast.Expr | ast.Pass | ast.Raise)
            ):  # a call is dropped
                yield ast.FunctionDef(**vars(node) | {"body": [*words, ast.Return(None)]})
        case ast.Expr(value=ast.Call()):
            yield ast.Pass()
        case ast.Compare(left, ops, comparators):
            for i, op in enumerate(ops):
                yield ast.Compare(left, [*ops[:i], COMPARISONS[type(op)](), *ops[i + 1 :]], comparators)
        case ast.BinOp(left, op, right) if type(op) in ARITHMETIC and not isinstance(left, ast.JoinedStr | ast.List):
            yield ast.BinOp(left, ARITHMETIC[type(op)](), right)
            if isinstance(op, ast.Add | ast.Sub):
                yield left
        case ast.BoolOp(op, values):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert(), operand):
            yield operand
        case ast.If(test, body, orelse):
            yield ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.Call(func, args, keywords):
            yield from _faulty_calls(func, args, keywords)
        case ast.Return(value) if value is not None and not isinstance(value, ast.Constant):
            yield ast.Return(ast.Constant(None))
        case ast.Constant(bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(int() as value):
            yield from (ast.Constant(n) for n in ((2 * value, value // 2) if abs(value) > 2 else (value + 1,)))
        case ast.Constant(float() as value):
            yield from (ast.Constant(factor * value) for factor in (2.0, 0.5)) if value else [ast.Constant(1.0)]


def _is_procedure(function: ast.FunctionDef) -> bool:
    """Whether a function is called for what it does: it has neither a value nor a yield."""
    return not any(
        isinstance(node, ast.Yield | ast.YieldFrom) or (isinstance(node, ast.Return) and node.value is not None)
        for node in ast.walk(function)
    )


def _faulty_calls(func: ast.expr, args: list[ast.expr], keywords: list[ast.keyword]) -> Iterator[ast.expr]:
    match func:
        case ast.Attribute(value, attr=name):
            other: ast.expr = ast.Attribute(value, CALLS.get(name, ""), ast.Load())
        case ast.Name(id=name):
            other = ast.Name(CALLS.get(name, ""), ast.Load())
        case _:
            return
    if name in CALLS:
        yield ast.Call(other, args, keywords)
    if name in DROPPED and args:
        yield args[0]
    if len(args) > 1 and name not in SYMMETRIC and not any(isinstance(arg, ast.Starred) for arg in args[:2]):
        yield ast.Call(func, [args[1], args[0], *args[2:]], keywords)
