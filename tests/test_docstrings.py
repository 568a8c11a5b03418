"""Every public class and function says in a sentence what it is, and names the errors that exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from library_source import Source, library

from manip_learn import errors

SOURCES = library()
by_file = pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.relative)
Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
BUILTIN_ERRORS = {"ValueError", "TypeError", "KeyError", "AttributeError", "ImportError", "OSError", "RuntimeError"}


def public(source: Source) -> Iterator[tuple[str, Documented]]:
    """Public classes, functions and methods with their qualified names; overriding methods too."""

    def walk(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, Documented]]:
        for node in body:
            if isinstance(node, Documented) and not node.name.startswith("_"):
                yield prefix + node.name, node
                if isinstance(node, ast.ClassDef):
                    yield from walk(node.body, f"{prefix}{node.name}.")

    if not any(part.startswith("_") for part in source.name.split(".")):
        yield from walk(source.tree.body, "")


def summary(text: str) -> str:
    """The first paragraph."""
    return text.strip().split("\n\n")[0].replace("\n", " ").strip()


@by_file
def test_modules_begin_with_a_sentence(source):
    """The first thing in a file is a sentence about its one job."""
    text = ast.get_docstring(source.tree)
    assert text, f"{source.relative} has no docstring"
    assert summary(text)[-1] in ".:)", f"{source.relative}: {summary(text)!r} is no sentence"


@by_file
def test_public_things_begin_with_a_sentence(source):
    """Every public class, function and method is documented; the first paragraph is a sentence."""
    for name, node in public(source):
        text = ast.get_docstring(node)
        assert text, f"{source.relative}: {name} has no docstring"
        assert summary(text)[-1] in ".:?)", f"{source.relative}: {name}: {summary(text)!r} is no sentence"


@by_file
def test_errors_named_under_raises_exist(source):
    """`Raises:` names errors of ours, or Python's own."""
    for name, node in public(source):
        section = re.search(r"^Raises:\n((?:[ \t]+.*\n?|\n)+)", ast.get_docstring(node) or "", re.MULTILINE)
        if section is None:
            continue
        named = re.findall(r"^    (\w+):", section[1], re.MULTILINE)
        assert named, f"{source.relative}: {name}: an empty Raises section"
        own = {n.name for n in source.tree.body if isinstance(n, ast.ClassDef)}
        for error in named:
            assert hasattr(errors, error) or error in BUILTIN_ERRORS | own, f"{source.relative}: {name} raises {error}?"


@by_file
def test_arguments_that_are_described_exist(source):
    """`Args:` describes only arguments that the function, or the class's constructor, has."""
    for name, node in public(source):
        section = re.search(r"^Args:\n((?:[ \t]+.*\n?|\n)+)", ast.get_docstring(node) or "", re.MULTILINE)
        if section is None:
            continue
        described = {n.lstrip("*") for n in re.findall(r"^    (\*{0,2}\w+)(?: \(.*\))?:", section[1], re.MULTILINE)}
        extra = described - arguments(node)
        assert not extra, f"{source.relative}: {name} describes {sorted(extra)}, which it does not take"


def arguments(node: Documented) -> set[str]:
    """Names of a function's arguments, or of a class's constructor and fields."""
    if isinstance(node, ast.ClassDef):
        fields = {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
        inits = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
        return fields.union(*(arguments(i) for i in inits)) if inits else fields
    a = node.args
    named = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(x for x in (a.vararg, a.kwarg) if x)]
    return {x.arg for x in named}


@by_file
def test_our_own_errors_are_declared(source):
    """A public function that raises one of our errors itself says so under `Raises:`."""
    for name, node in public(source):
        if isinstance(node, ast.ClassDef):
            continue
        raised = {
            n.exc.func.id
            for n in ast.walk(node)
            if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call) and isinstance(n.exc.func, ast.Name)
        }
        text = ast.get_docstring(node) or ""
        for error in raised:
            if error.endswith("Error") and hasattr(errors, error):
                assert re.search(rf"^\s+{error}:", text, re.MULTILINE), f"{source.relative}: {name} hides {error}"


TESTS = sorted(Path(__file__).parent.glob("test_*.py"))


@pytest.mark.parametrize("path", TESTS, ids=lambda p: p.name)
def test_tests_say_what_must_hold(path):
    """Each test has a docstring that is a sentence."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            text = ast.get_docstring(node)
            assert text, f"{path.name}: {node.name} does not say what must hold"
            assert summary(text).endswith((".", "?", ")")), f"{path.name}: {node.name}: {summary(text)!r}"
