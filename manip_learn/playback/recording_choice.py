"""Which recordings a page lets a reader leave out, and the command line that does the same."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

FLAG = "--episodes"


@final
@dataclass(frozen=True)
class RecordingChoice:
    """What the page needs to write the command line for a choice.

    Attributes:
        command: Words of the command line that read the recordings; empty if there was none.
        episodes: Recording -> its number as `--episodes` counts; recordings without one cannot be chosen by it.
    """

    command: tuple[str, ...] = ()
    episodes: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def of(command: Sequence[str], names: Sequence[str], numbers: Sequence[int]) -> RecordingChoice:
        """For recordings that were read one from each number; of files that hold several, none can be left out alone.

        Args:
            command: Words of the command line.
            names: Of the recordings, in the order in which they were read.
            numbers: See `numbers_read`.
        """
        if len(names) != len(numbers):
            return RecordingChoice()
        return RecordingChoice(tuple(command), dict(zip(names, numbers, strict=True)))

    def to_dict(self, names: Sequence[str], odd: Sequence[Sequence[str]]) -> dict[str, Any]:
        """For the page.

        Args:
            names: Of the recordings that are shown.
            odd: Names and reasons of those that do not agree with the others.
        """
        numbers = [self.episodes.get(name) for name in names]
        complete = bool(self.command) and all(n is not None for n in numbers)
        return {
            "command": shlex.join(_without_flag(self.command)) if complete else "",
            "flag": FLAG,
            "episodes": numbers if complete else [],
            "odd": {name: reason for name, reason in odd if name in names},
        }


def _without_flag(command: Sequence[str]) -> list[str]:
    """The words without an earlier choice, which the numbers take into account."""
    kept, skip = [], False
    for word in command:
        if skip:
            skip = False
        elif word == FLAG:
            skip = True
        elif not word.startswith(FLAG + "="):
            kept.append(word)
    return kept
