"""Refusals and warnings about one robot description, each with its place and its fix."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import final

from manip_learn.errors import RobotError

SHOWN = 4
MAX_WARNINGS = 100


@final
class Diagnostics:
    """Collects warnings about one file and words its refusals.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path):
        self.path = path
        self._warnings: list[str] = []
        self._left_out = 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences, in the order found; after a hundred only their number."""
        more = (f"{self._left_out} more warnings are left out",) if self._left_out else ()
        return (*self._warnings, *more)

    @property
    def is_full(self) -> bool:
        """True when further warnings are only counted."""
        return len(self._warnings) >= MAX_WARNINGS

    def refusal(self, code: str, line: int | None, where: str, seen: str, expected: str, fix: str) -> RobotError:
        """The error to raise: `<file>:<line>: <where>: <seen>; <expected>; <fix>`."""
        place = f"{self.path}:{line}" if line is not None else f"{self.path}"
        return RobotError(f"{place}: {where}: {seen}; {expected}; {fix}", code=code, path=self.path, line=line)

    def warn(self, line: int | None, sentence: str) -> None:
        """Keep a sentence for `Robot.warnings`."""
        if self.is_full:
            self._left_out += 1
        else:
            self._warnings.append(f"line {line}: {sentence}" if line is not None else sentence)


def quoted(names: Sequence[str]) -> str:
    """The first few names in quotes, with the number of those left out."""
    text = ", ".join(repr(shortened(n)) for n in names[:SHOWN])
    return f"{text} and {len(names) - SHOWN} more" if len(names) > SHOWN else text


def shortened(text: str, length: int = 80) -> str:
    """Text cut to a length that fits into a sentence."""
    return text if len(text) <= length else f"{text[: length - 3]}..."
