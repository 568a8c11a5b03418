"""Each number of a module has its unit or its reason beside it."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator

from library_source import Source, library, listed


def comments(source: Source) -> dict[int, str]:
    """Line -> the comment on it."""
    tokens = tokenize.generate_tokens(io.StringIO(source.text).readline)
    return {token.start[0]: token.string for token in tokens if token.type == tokenize.COMMENT}


def has_number(node: ast.AST) -> bool:
    """Whether a number beside 0 and 1 is written in a value; results of the project's functions are no constants."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool) and node.value not in (0, 1)
    computed = isinstance(node, ast.Call) and not ast.unparse(node.func).startswith("np.")
    comprehended = isinstance(node, ast.Lambda | ast.ListComp | ast.DictComp | ast.SetComp | ast.GeneratorExp)
    return not computed and not comprehended and any(map(has_number, ast.iter_child_nodes(node)))


def unexplained(source: Source) -> Iterator[str]:
    """Constants of a file that stand without a word: none on their lines or above them, and no docstring below."""
    said = comments(source)
    for node, after in zip(source.tree.body, [*source.tree.body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not has_number(node.value):
            continue
        names = [n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
        explained = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        lines = range(node.lineno - 1, (node.end_lineno or node.lineno) + 1)
        if not explained and not any(line in said for line in lines) and any(name.isupper() for name in names):
            yield f"{source.relative}:{node.lineno}: {', '.join(names)}"


def test_numbers_are_explained():
    """A number of a module has its unit or its reason beside it."""
    assert not (found := [line for source in library() for line in unexplained(source)]), listed(found)
