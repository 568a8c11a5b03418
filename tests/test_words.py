"""Words of the library: phrases that a native reader stumbles over, and numbers that nobody explains, become fewer."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator

from library_source import Source, library, listed

# phrase -> how it is found in docstrings and comments, and how often it may occur: each number only falls
PHRASES = {
    "so many times as much: say the number": (
        r"\bso many times\b|\btimes as (?:much|many|far|long|often|large|fast|slow|strong|wide|high|small)\b",
        3,
    ),
    "what is ...: say the noun": (r"\b[Ww]hat (?:is|are|was|were)\b(?! to be done)", 199),
    "The same ... at a docstring's beginning: it is read without its neighbour": (r"\A(?:The s|S)ame\b", 0),
}


def comments(source: Source) -> dict[int, str]:
    """Line -> the comment on it."""
    tokens = tokenize.generate_tokens(io.StringIO(source.text).readline)
    return {token.start[0]: token.string for token in tokens if token.type == tokenize.COMMENT}


def words(source: Source) -> Iterator[tuple[int, str]]:
    """(line, text) of the docstrings and comments of a file."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield getattr(node, "lineno", 1), ast.get_docstring(node) or ""
    yield from comments(source).items()


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


def test_phrases_become_fewer():
    """Each phrase occurs in the docstrings and comments of the library at most as often as its ceiling says."""
    for phrase, (pattern, most) in PHRASES.items():
        found = [
            f"{source.relative}:{line}: {text.splitlines()[0]}"
            for source in library()
            for line, text in words(source)
            for _ in re.findall(pattern, text)
        ]
        assert len(found) <= most, f"{phrase}; at most {most}\n{listed(found)}"


def test_numbers_are_explained():
    """A number of a module has its unit or its reason beside it."""
    assert not (found := [line for source in library() for line in unexplained(source)]), listed(found)
