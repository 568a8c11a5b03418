"""Resolve every annotation of the library, in a process of its own: conftest.py's shape checker edits annotations.

Prints one line per annotation that is wrong, and the number of objects looked at on the last line.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import sys
import types
import typing
from collections.abc import Iterator

import manip_learn
from manip_learn.errors import MissingExtraError

RESULTS_OF_ANY_KIND = ("manip_learn.learning.cluster.",)
# these load what is heavy or optional at first use, so names of such types are there for type checkers only
LATE = ("manip_learn.commands.", "manip_learn.experiments.")


def modules() -> Iterator[types.ModuleType]:
    """Every module of the library; those that run as a program when imported are left out."""
    yield manip_learn
    for found in pkgutil.walk_packages(manip_learn.__path__, "manip_learn."):
        if not found.name.endswith("__main__"):
            try:
                yield importlib.import_module(found.name)
            except MissingExtraError as missing:  # of extras that are not installed for the tests
                print(f"{found.name} left out: {missing}", file=sys.stderr)


def names_for_types(module: types.ModuleType) -> dict[str, typing.Any]:
    """What a module imports under `if TYPE_CHECKING:`, imported now: those names must exist too."""
    names: dict[str, typing.Any] = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), str(module.__file__), "exec"), names)
    return names


def functions(owner: types.ModuleType | type, prefix: str) -> Iterator[tuple[str, typing.Any]]:
    """Classes and functions defined in a module or class, methods and properties included, with their full names."""
    for name, value in vars(owner).items():
        value = value.__func__ if isinstance(value, staticmethod | classmethod) else value
        value = value.fget if isinstance(value, property) else getattr(value, "py_func", value)
        value = inspect.unwrap(value) if callable(value) else value
        own = getattr(value, "__module__", None) == (owner.__name__ if inspect.ismodule(owner) else owner.__module__)
        if own and inspect.isclass(value) and value is not owner:
            yield f"{prefix}.{name}", value
            yield from functions(value, f"{prefix}.{name}")
        elif own and inspect.isfunction(value):
            yield f"{prefix}.{name}", value


def is_public(name: str) -> bool:
    """No part of the full name begins with an underscore."""
    return not any(part.startswith("_") for part in name.split("."))


def main() -> int:
    """Number of annotations that are wrong."""
    count, problems = 0, []
    for module in modules():
        late, is_late = names_for_types(module), module.__name__.startswith(LATE)
        for name, thing in functions(module, module.__name__):
            count += 1
            try:
                hints = typing.get_type_hints(
                    thing, localns=late if is_late or not is_public(name) else {}, include_extras=True
                )
            except (NameError, TypeError, AttributeError, SyntaxError, MissingExtraError) as problem:
                problems.append(f"{name}: {problem}")
                continue
            returned = hints.get("return")
            if (
                is_public(name)
                and not name.startswith(RESULTS_OF_ANY_KIND)
                and (returned is typing.Any or typing.Any in typing.get_args(returned)[: _inner(returned)])
            ):
                problems.append(f"{name}: returns Any")
    print(*problems, f"{count} annotated objects", sep="\n")
    return len(problems)


def _inner(hint: object) -> int:
    """How many arguments of a hint are alternatives of the value itself: all of a union, none of a container."""
    return len(typing.get_args(hint)) if typing.get_origin(hint) in (typing.Union, types.UnionType) else 0


if __name__ == "__main__":
    sys.exit(min(main(), 1))
