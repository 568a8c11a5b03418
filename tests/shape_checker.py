"""What the import hook of conftest.py puts around the functions of the library while the tests run."""

from __future__ import annotations

from collections.abc import Callable

from beartype import beartype
from library_source import PACKAGE

SHAPES = ("Float[", "Int[", "Bool[", "Shaped[")


def checked_modules() -> list[str]:
    """All modules but those whose functions numba compiles: it cannot see through a wrapper."""
    names = []
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "__init__.py" and "kernel_cache import compiled" not in text:
            names.append(".".join(("manip_learn", *path.relative_to(PACKAGE).with_suffix("").parts)))
    return names


def check_shapes(function: Callable) -> Callable:
    """Check the arrays of a signature, and nothing else: other types are the business of pyright.

    (Pinocchio's compiled classes do not tell the truth about their own inheritance.)
    """
    if function.__name__ == "__init__":  # constructors take what can be made into an array, and check it themselves
        return function
    annotations = getattr(function, "__annotations__", {})
    shapes = {name: hint for name, hint in annotations.items() if any(kind in str(hint) for kind in SHAPES)}
    if not shapes:
        return function
    function.__annotations__ = shapes
    return beartype(function)
