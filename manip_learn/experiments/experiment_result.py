"""What every experiment returns, and the statistics and Markdown tables that results are written with."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ExperimentResult(ABC):
    """Numbers beside the paper's, as a table, as figures and as replays; the children are frozen dataclasses."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings for JSON, with `paper` and `ours`."""

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """One dictionary per line of the CSV file, all with the same keys."""

    @abstractmethod
    def markdown(self) -> str:
        """Tables and findings for the documentation."""

    @abstractmethod
    def figures(self) -> dict[str, Figure]:
        """Name -> figure."""

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Name -> robot and named rollouts, for replay pages; none where no robot moves."""
        return {}


@dataclass(frozen=True, eq=False)
class TrialsResult(ExperimentResult):
    """Outcome of every trial of some cases.

    Attributes:
        outcomes: Name of a case -> one dictionary of plain values per trial.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial: its case, and every number under its key; nested keys are joined by dots."""

        def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
            for key, value in values.items():
                if isinstance(value, dict):
                    yield from flat(value, f"{prefix}{key}.")
                else:
                    yield prefix + key, json.dumps(value) if isinstance(value, list) else value

        named = [(case, i, trial) for case, trials in self.outcomes.items() for i, trial in enumerate(trials)]
        lines = [{"case": case, "trial": i} | dict(flat(trial)) for case, i, trial in named]
        names = dict.fromkeys(name for line in lines for name in line)
        return [{name: line.get(name, "") for name in names} for line in lines]


def summary(values: Iterable[float | None]) -> dict[str, Any]:
    """Statistics of some numbers; None stands for an answer that was refused, and is left out.

    Returns:
        `mean`, `sd` (of the sample; 0 for a single number), `median`, `worst` (largest) and `n`; None without numbers.
    """
    array = np.array([v for v in values if v is not None], dtype=np.float64)
    if array.size == 0:
        return {"mean": None, "sd": None, "median": None, "worst": None, "n": 0}
    return {
        "mean": float(np.mean(array)),
        "sd": float(np.std(array, ddof=1)) if array.size > 1 else 0.0,
        "median": float(np.median(array)),
        "worst": float(np.max(array)),
        "n": int(array.size),
    }


def share(flags: Iterable[bool]) -> float | None:
    """Share of the flags that are true; None without any."""
    found = list(flags)
    return sum(found) / len(found) if found else None


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table: 1.2e-07, 0.31, 12, or a dash where there is none."""
    if value is None:
        return "-"
    if value == 0.0:
        return "0"
    if 0.01 <= abs(value) < 1000.0:
        return f"{value:.{max(digits, 1)}g}" if abs(value) < 10 else f"{value:.0f}"
    return f"{value:.{digits - 1}e}"


def mean_and_sd(statistics: dict[str, Any]) -> str:
    """`mean +- s.d.` of a summary."""
    return f"{number(statistics['mean'])} +- {number(statistics['sd'])}"


def percent(share: float) -> str:
    """A share for a table: 98 %."""
    return f"{100.0 * share:.0f} %"


def said_rows(rows: str) -> str:
    """Constrained rows in words: `x, theta` of `"x rz"`."""
    return rows.replace("rz", "theta").replace(" ", ", ")


def median_and_worst(statistics: dict[str, Any]) -> str:
    """`median (worst)` of a summary."""
    return f"{number(statistics['median'])} ({number(statistics['worst'])})"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)
