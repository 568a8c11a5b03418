"""What the import hook of conftest.py puts around the functions of the library while the tests run.

jaxtyping says what an annotation such as `Float[np.ndarray, "T nv"]` asks of an array, and its hook decorates every
function of a module. Its own decorator binds the arguments of every call by reflection, which took more than half of
the time of the tests; the one here looks at the shapes and the types of the elements alone, and asks jaxtyping only
about combinations that the function has not been called with before.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import jaxtyping
import numpy as np
from beartype.door import is_bearable
from library_source import PACKAGE

SHAPES = ("Float[", "Int[", "Bool[", "Shaped[")
# calls of a function that are all looked at, and one in so many of the later ones: the innermost functions are called
# millions of times with few forms, and looking at each call took a fifth of the time of the tests
ALWAYS, ONE_IN = 1000, 16
_ONE_CALL = jaxtyping.jaxtyped  # within one call, a letter stands for one number


def install_shape_checks() -> None:
    """Check every shape in every signature of the library; must come before the first import of it."""
    jaxtyping.jaxtyped = lambda *, typechecker: typechecker  # by this name the hook decorates functions
    jaxtyping.install_import_hook(checked_modules(), "shape_checker.check_shapes")


def checked_modules() -> list[str]:
    """All modules of the library that hold code."""
    files = [path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"]
    return [".".join(("manip_learn", *file.parts)) for file in files]


def check_shapes(function: Any) -> Any:
    """Check the arrays of a signature, and nothing else: other types are the business of pyright.

    (Pinocchio's compiled classes do not tell the truth about their own inheritance.)
    """
    # constructors take what can be made into an array, and check it themselves; classes are their functions
    if inspect.isclass(function) or function.__name__ == "__init__":
        return function
    written = getattr(function, "__annotations__", {})
    hints = {name: _resolved(hint, function) for name, hint in written.items()}
    hints = {name: hint for name, hint in hints.items() if any(kind in str(hint) for kind in SHAPES)}
    return _checking(function, hints) if hints else function


def _checking(function: Callable, hints: dict[str, Any]) -> Callable:
    parameters = inspect.signature(function).parameters.values()
    order = {p.name: i for i, p in enumerate(parameters) if p.kind is not p.KEYWORD_ONLY}
    places = [(name, order.get(name, sys.maxsize)) for name in hints if name != "return"]
    passed: dict[Hashable, set[Hashable]] = {}  # forms of arguments that are as annotated: forms of their results

    calls = 0

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal calls
        calls += 1
        if calls > ALWAYS and calls % ONE_IN:
            return function(*args, **kwargs)
        given = [args[i] if i < len(args) else kwargs.get(name) for name, i in places]
        forms = tuple([_form(value) for value in given])
        results = passed.get(forms)
        if results is None:
            _check(function, hints, _named(places, args, kwargs))
            results = passed[forms] = set()
        result = function(*args, **kwargs)
        if "return" in hints and (form := _form(result)) not in results:
            _check(function, hints, {**_named(places, args, kwargs), "return": result})
            results.add(form)
        return result

    return checked


def _form(value: Any) -> Hashable:
    """All that an annotation of arrays can ask about: shapes and types of elements, also within containers."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype
    if isinstance(value, (tuple, list)):
        return type(value), *[_form(item) for item in value]
    if isinstance(value, Mapping):
        return type(value), *[_form(item) for item in value.values()]
    return type(value)


def _named(places: list[tuple[str, int]], args: tuple, kwargs: dict[str, Any]) -> dict[str, Any]:
    """The annotated arguments of a call that are not left to their defaults."""
    given = {name: args[i] for name, i in places if i < len(args)}
    return given | {name: kwargs[name] for name, _ in places if name in kwargs}


def _check(function: Callable, hints: dict[str, Any], values: dict[str, Any]) -> None:
    with _ONE_CALL("context"):
        for name, value in values.items():
            hint = hints[name] = _resolved(hints[name], function)
            if not is_bearable(value, hint):
                said = {other: _form(values[other]) for other in values}
                raise TypeError(f"{function.__module__}.{function.__qualname__}: {name} is not {hint}: {said}")


def _resolved(hint: Any, function: Callable) -> Any:
    """The annotation that a text stands for; names that the module defines later are looked for again."""
    try:
        return eval(hint, function.__globals__) if isinstance(hint, str) else hint
    except NameError:
        return hint
