"""Numbers of episodes as a caller writes them: `0:50,60,75`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

from manip_learn.errors import RecordingError, advice

ITEM = re.compile(r"\s*(?:(\d{1,9})|(\d{1,9})?\s*:\s*(\d{1,9})?)\s*")
SHOWN = 4  # numbers in a message


@final
@dataclass(frozen=True)
class EpisodeSelection:
    """Numbers and half-open ranges of numbers, as Python counts: 0:50 is 0 to 49.

    Attributes:
        items: First number and the one after the last, None for no end; one pair per item.
    """

    items: tuple[tuple[int, int | None], ...]

    @staticmethod
    def of(episodes: str | int | Iterable[int]) -> EpisodeSelection:
        """From text such as `0:50,60,75`, `10:` or `:5`, or from numbers.

        Raises:
            RecordingError: Anything else.
        """
        if isinstance(episodes, int) and not isinstance(episodes, bool):
            episodes = [episodes]
        if isinstance(episodes, str):
            items = [_item(part, episodes) for part in episodes.split(",")]
        else:
            given = list(episodes) if isinstance(episodes, Iterable) else []
            numbers = [n for n in given if isinstance(n, int) and not isinstance(n, bool) and n >= 0]
            if not numbers or len(numbers) < len(given):
                raise _refused(episodes)
            items = [(n, n + 1) for n in numbers]
        return EpisodeSelection(tuple(items))

    def __str__(self) -> str:
        return ",".join(str(a) if b == a + 1 else f"{a}:{'' if b is None else b}" for a, b in self.items)

    def of_known(self, known: Sequence[int], where: str) -> frozenset[int]:
        """The selected ones among the numbers that exist.

        Raises:
            RecordingError: An item selects nothing; names the nearest numbers.
        """
        chosen: set[int] = set()
        for first, end in self.items:
            found = {n for n in known if n >= first and (end is None or n < end)}
            if not found:
                near = sorted(sorted(known, key=lambda n: abs(n - first))[:SHOWN])
                item = EpisodeSelection(((first, end),))
                raise RecordingError(
                    f"{where}: no episode is selected by {str(item)!r}; there are {len(known)}, numbered "
                    f"{min(known)} to {max(known)}; the nearest: {', '.join(map(str, near))}",
                    code="no-episode",
                )
            chosen |= found
        return frozenset(chosen)


def _item(part: str, text: str) -> tuple[int, int | None]:
    found = ITEM.fullmatch(part)
    if found is None:
        raise _refused(text)
    number, first, end = found.groups()
    if number is not None:
        return int(number), int(number) + 1
    return int(first or 0), None if end is None else int(end)


def _refused(given: object) -> RecordingError:
    return RecordingError(
        f"{advice('{}', 'episodes', '--episodes')} must be numbers and ranges such as '0:50,60,75' (counted from 0; "
        f"0:50 is 0 to 49), got {given!r}",
        code="option",
    )
