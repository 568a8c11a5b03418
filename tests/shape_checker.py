"""What the import hook of conftest.py puts around the functions of the library while the tests run.

jaxtyping says what an annotation such as `Float[np.ndarray, "T nv"]` asks of an array, and its hook decorates every
function of a module. Its own decorator checks other types too, and every call; the one here looks at arrays alone, and
at a part of the calls where there are many.
"""

from __future__ import annotations

import functools
import inspect
from typing import Any

import jaxtyping
from beartype.door import is_bearable
from library_source import PACKAGE

SHAPES = ("Float[", "Int[", "Bool[", "Shaped[")
# calls of a function that are all looked at, and one in so many of the later ones: the innermost functions are called
# millions of times
ALWAYS, ONE_IN = 300, 50
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
    signature, calls = inspect.signature(function), 0

    def check(name: str, value: Any) -> None:
        hints[name] = _resolved(hints[name], function)
        if not is_bearable(value, hints[name]):
            raise TypeError(f"{function.__module__}.{function.__qualname__}: {name} is not {hints[name]}: {value!r}")

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal calls
        calls += 1
        if calls > ALWAYS and calls % ONE_IN:
            return function(*args, **kwargs)
        with _ONE_CALL("context"):
            for name, value in signature.bind(*args, **kwargs).arguments.items():
                if name in hints:
                    check(name, value)
            result = function(*args, **kwargs)
            if "return" in hints:
                check("return", result)
        return result

    return checked if hints else function


def _resolved(hint: Any, function: Any) -> Any:
    """The annotation that a text stands for; names that the module defines later are looked for again."""
    try:
        return eval(hint, function.__globals__) if isinstance(hint, str) else hint
    except NameError:
        return hint
