"""Small faults of the kind that people make, found in the syntax tree of a Python file."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import final

import numpy as np

COMPARISONS = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
ARITHMETIC = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*", ast.FloorDiv: "*", ast.Mod: "*"}
CALLS = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmin": "argmax",
    "argmax": "argmin",
    "sum": "mean",
    "mean": "sum",
    "median": "mean",
    "any": "all",
    "all": "any",
    "ceil": "floor",
    "floor": "ceil",
    "cos": "sin",
    "sin": "cos",
    "round": "int",
    "hypot": "maximum",
    "searchsorted": "digitize",
}
DROPPED = {"abs", "clip", "unwrap", "sorted", "flip", "cumsum", "where", "sqrt"}  # f(x, ...) -> x
# (start line, start column, end line, end column, new text), columns in bytes
Edit = tuple[int, int, int, int, str]


@final
class Faults(ast.NodeVisitor):
    """All faults of one file; sentences, signatures and what only raises an error are left alone."""

    def __init__(self, text: str):
        self.lines = text.encode().split(b"\n")
        self.edits: list[Edit] = []
        self.visit(ast.parse(text))

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """What an error says is looked at by people."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Sentences likewise."""

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            self._replace(node, "pass")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        left = node.left
        for operator, right in zip(node.ops, node.comparators, strict=True):
            self._between(left, right, COMPARISONS[type(operator)])
            left = right
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if type(node.op) in ARITHMETIC and not isinstance(node.left, ast.JoinedStr | ast.Constant | ast.List):
            self._between(node.left, node.right, ARITHMETIC[type(node.op)])
            if isinstance(node.op, ast.Add | ast.Sub):
                self._replace(node, self._source(node.left))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._between(node.values[0], node.values[1], "or" if isinstance(node.op, ast.And) else "and")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.Not | ast.USub | ast.Invert):
            self._replace(node, self._source(node.operand))
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        self._replace(node.test, f"not ({self._source(node.test)})")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in CALLS and not (CALLS[name] == "mean" and isinstance(node.func, ast.Name)):
            end = (node.func.end_lineno, node.func.end_col_offset)
            if end[0] is not None and end[1] is not None:
                self.edits.append((end[0], end[1] - len(name), end[0], end[1], CALLS[name]))
        if name in DROPPED and node.args:
            self._replace(node, f"({self._source(node.args[0])})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if type(node.value) is int:
            self._replace(node, str(node.value + 1))
        elif type(node.value) is float:
            self._replace(node, repr(2.0 * node.value) if node.value else "1.0")
        elif type(node.value) is bool:
            self._replace(node, str(not node.value))

    def _source(self, node: ast.expr) -> str:
        end_line, end = node.end_lineno or node.lineno, node.end_col_offset or 0
        if end_line == node.lineno:
            return self.lines[node.lineno - 1][node.col_offset : end].decode()
        rows = [self.lines[node.lineno - 1][node.col_offset :], *self.lines[node.lineno : end_line - 1]]
        return b"\n".join([*rows, self.lines[end_line - 1][:end]]).decode()

    def _replace(self, node: ast.expr | ast.stmt, new: str) -> None:
        end_line, end = node.end_lineno or node.lineno, node.end_col_offset or 0
        self.edits.append((node.lineno, node.col_offset, end_line, end, new))

    def _between(self, left: ast.expr, right: ast.expr, operator: str) -> None:
        """Another operator between two operands of one line; brackets stay."""
        if left.end_lineno != right.lineno or left.end_col_offset is None:
            return
        gap = self.lines[right.lineno - 1][left.end_col_offset : right.col_offset].decode()
        closing, opening = len(gap) - len(gap.lstrip(") ")), len(gap.rstrip("( "))
        at = left.end_col_offset
        self.edits.append((right.lineno, at + closing, right.lineno, at + opening, operator))


def faults_of(text: str) -> Iterator[tuple[str, str]]:
    """(old, new) of every fault: whole lines, with as many lines before as make the old text unique."""
    lines = text.encode().split(b"\n")
    for line, start, end_line, end, new in Faults(text).edits:
        middle = b"\n".join(lines[line - 1 : end_line])
        tail = len(lines[end_line - 1]) - end
        changed = middle[:start] + new.encode() + middle[len(middle) - tail :]
        first = line - 1
        while text.count(b"\n".join(lines[first:end_line]).decode()) > 1 and first > 0:
            first -= 1
        before = b"".join(row + b"\n" for row in lines[first : line - 1])
        old, mutated = (before + middle).decode(), (before + changed).decode()
        if text.count(old) == 1 and old != mutated and _is_python(text.replace(old, mutated)):
            yield old, mutated


def _is_python(text: str) -> bool:
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True


def sample(text: str, count: int, rng: np.random.Generator) -> list[tuple[str, str]]:
    """Some of them, at most one per place, in the order of the file."""
    found = list(faults_of(text))
    chosen: dict[str, tuple[int, tuple[str, str]]] = {}
    for i in rng.permutation(len(found)).tolist():
        if len(chosen) < count:
            chosen.setdefault(found[i][0], (i, found[i]))
    return [fault for _i, fault in sorted(chosen.values())]
