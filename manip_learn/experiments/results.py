"""Result of an experiment, its statistics, and its tables in Markdown."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class TrialsResult:
    """Base class of results: outcomes of all trials of some cases.

    Attributes:
        outcomes: Name of a case -> one dictionary of numbers and texts per trial.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def rows(self) -> list[dict[str, Any]]:
        """Return a table for CSV: one dictionary per trial, with the case and all numbers.

        Keys of nested dictionaries are joined by dots.
        """
        entries = [(case, i, trial) for case, trials in self.outcomes.items() for i, trial in enumerate(trials)]
        return [{"case": case, "trial": i} | dict(_flat(trial)) for case, i, trial in entries]


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, json.dumps(value) if isinstance(value, list) else value


def summary(values: Iterable[float | None]) -> dict[str, Any]:
    """Compute statistics of some numbers.

    Args:
        values: Numbers; None, for a trial without an answer, is left out.

    Returns:
        Dictionary with `mean`, `sd` (sample standard deviation; 0 for a single number), `median`, `worst` (the largest)
        and the count `n`; all but `n` are None without numbers.
    """
    x = np.array([v for v in values if v is not None], dtype=np.float64)
    statistics = (np.mean, lambda x: np.std(x, ddof=1) if x.size > 1 else 0.0, np.median, np.max)
    numbers = [float(statistic(x)) if x.size else None for statistic in statistics]
    return {**dict(zip(("mean", "sd", "median", "worst"), numbers, strict=True)), "n": int(x.size)}


def share(flags: Iterable[bool]) -> float | None:
    """Return the share of flags that are True; None if there are no flags.

    Args:
        flags: Flags of all trials.
    """
    flags = list(flags)
    return sum(flags) / len(flags) if flags else None


def number(value: float | None, digits: int = 2) -> str:
    """Format a number for a table, e.g. `1.2e-07`, `0.31` or `12`; None gives a dash.

    Args:
        value: The number; None if there is none.
        digits: Significant digits of numbers whose absolute value is below 10, and of numbers with an exponent.
    """
    if not value:
        return "-" if value is None else "0"
    plain = f"{value:.{max(digits, 1)}g}" if abs(value) < 10 else f"{value:.0f}"
    return plain if 0.01 <= abs(value) < 1000.0 else f"{value:.{digits - 1}e}"


def mean_and_sd(statistics: Mapping[str, Any]) -> str:
    """Format mean and standard deviation of a summary as text, `mean +- s.d.`.

    Args:
        statistics: Result of `summary`.
    """
    return f"{number(statistics['mean'])} +- {number(statistics['sd'])}"


def row_words(rows: str) -> str:
    """Return the names of constrained rows as in the paper, e.g. `x, theta` for `"x rz"`.

    Args:
        rows: Words of `"x y rz"`.
    """
    return rows.replace("rz", "theta").replace(" ", ", ")


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown.

    Args:
        header: Titles of the columns.
        rows: Cells of each row.
    """
    lines = ["| " + " | ".join(map(str, cells)) + " |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])
