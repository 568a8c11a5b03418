"""Every public class and function says in a sentence what it is, and names the errors that exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from library_source import Source, library, listed

from manip_learn import errors

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
BUILTIN_ERRORS = set(
    "ValueError TypeError KeyError AttributeError ImportError ModuleNotFoundError OSError RuntimeError "
    "TimeoutError".split()
)


def public(source: Source) -> Iterator[tuple[str, Documented]]:
    """Public classes, functions and methods with their qualified names; overriding methods too, overloads not."""

    def walk(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, Documented]]:
        for node in body:
            if isinstance(node, Documented) and not node.name.startswith("_") and not is_overload(node):
                yield prefix + node.name, node
                if isinstance(node, ast.ClassDef):
                    yield from walk(node.body, f"{prefix}{node.name}.")

    if not any(part.startswith("_") for part in source.name.split(".")):
        yield from walk(source.tree.body, "")


def is_overload(node: Documented) -> bool:
    """A signature for type checkers only: the function that follows carries the docstring."""
    return any(ast.unparse(decorator) == "overload" for decorator in node.decorator_list)


def summary(text: str) -> str:
    """The first paragraph."""
    return text.strip().split("\n\n")[0].replace("\n", " ").strip()


def everything_public() -> Iterator[tuple[str, Source, Documented]]:
    """Every public thing of the library: where it is, its file and its syntax tree."""
    for source in library():
        yield from ((f"{source.relative}: {name}", source, node) for name, node in public(source))


def section_entries(node: Documented, title: str) -> list[str] | None:
    """Names described in a docstring's section; None if there is no such section."""
    section = re.search(rf"^{title}:\n((?:[ \t]+.*\n?|\n)+)", ast.get_docstring(node) or "", re.MULTILINE)
    return None if section is None else re.findall(r"^    (\*{0,2}\w+)(?: \(.*\))?:", section[1], re.MULTILINE)


def test_errors_named_under_raises_exist():
    """`Raises:` names errors of this library, or Python's built-in ones."""
    faults = []
    for where, source, node in everything_public():
        named = section_entries(node, "Raises")
        if named is None:
            continue
        if not named:
            faults.append(f"{where}: an empty Raises section")
        own = {n.name for n in source.tree.body if isinstance(n, ast.ClassDef)}
        unknown = [e for e in named if not hasattr(errors, e) and e not in BUILTIN_ERRORS | own]
        faults += [f"{where} raises {error}?" for error in unknown]
    assert not faults, listed(faults)


def test_arguments_that_are_described_exist():
    """`Args:` describes only arguments that the function, or the class's constructor, has."""
    faults = []
    for where, _source, node in everything_public():
        described = {name.lstrip("*") for name in section_entries(node, "Args") or ()}
        extra = described - arguments(node)
        if extra:
            faults.append(f"{where} describes {sorted(extra)}, which it does not take")
    assert not faults, listed(faults)


def arguments(node: Documented) -> set[str]:
    """Names of a function's arguments, or of a class's constructor and fields."""
    if isinstance(node, ast.ClassDef):
        fields = {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
        inits = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
        return fields.union(*(arguments(i) for i in inits)) if inits else fields
    a = node.args
    named = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(x for x in (a.vararg, a.kwarg) if x)]
    return {x.arg for x in named}


def test_our_own_errors_are_declared():
    """A public function that raises one of our errors itself says so under `Raises:`."""
    faults = []
    for where, _source, node in everything_public():
        if isinstance(node, ast.ClassDef):
            continue
        raised = {
            n.exc.func.id
            for n in ast.walk(node)
            if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call) and isinstance(n.exc.func, ast.Name)
        }
        text = ast.get_docstring(node) or ""
        for error in sorted(raised):
            declared = re.search(rf"^\s+{error}:", text, re.MULTILINE)
            if error.endswith("Error") and hasattr(errors, error) and not declared:
                faults.append(f"{where} hides {error}")
    assert not faults, listed(faults)
