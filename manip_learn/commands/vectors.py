"""Vectors on the command line."""

from __future__ import annotations

import math

from manip_learn.errors import ManipLearnError

VECTORS = ("--start", "--target", "--rest", "--direction")


def joined_vectors(arguments: list[str]) -> list[str]:
    """The arguments with the numbers behind a vector option joined: `--start 0.1 -0.2` means `--start 0.1,-0.2`."""
    out: list[str] = []
    numbers: list[str] | None = None  # open while the values of a vector option follow
    for argument in arguments:
        if numbers is not None and _is_vector(argument):
            numbers.append(argument)
            continue
        if numbers:
            out.append(",".join(numbers))
        numbers = [] if argument in VECTORS else None
        out.append(argument)
    return [*out, ",".join(numbers)] if numbers else out


def _is_vector(text: str) -> bool:
    try:
        [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        return False
    return bool(text.strip())


def direction(text: str | None) -> list[float] | str | None:
    """The numbers of a direction, or the name of the row of a mechanism."""
    if text is None or text.strip().isidentifier():
        return text if text is None else text.strip()
    return vector("--direction", text)


def vector(option: str, text: str | None) -> list[float] | None:
    """The numbers of an option's text; None if it was not given.

    Raises:
        ManipLearnError: Not finite numbers.
    """
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.strip("[]() ").replace(",", " ").split()]
    except ValueError as error:
        raise ManipLearnError(f"{option} must be numbers such as 0.1,-0.2,0.3, got {text!r}") from error
    if not numbers or not all(map(math.isfinite, numbers)):
        raise ManipLearnError(f"{option} must be finite numbers such as 0.1,-0.2,0.3, got {text!r}")
    return numbers
