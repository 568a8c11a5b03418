"""What every experiment returns, and the statistics and Markdown tables that results are written with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
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

    @abstractmethod
    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Name -> robot and named rollouts, for replay pages."""


def summary(values: Iterable[float]) -> dict[str, Any]:
    """Statistics of some numbers.

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


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)
