"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, mean_and_sd, number, summary
from manip_learn.experiments.learning_trial import LearningCase, learning_trial
from manip_learn.experiments.paper_setup import PAPER_NMIE, SELECTIONS, Setup
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.experiments.ways import SAID
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = (
    "joint-affine",
    "joint-quadratic",
    "joint-cubic",
    "joint-rbf",
    "separate",
    "separate-row-by-row",
    "true-w",
    "auto",
)


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials * len(SELECTIONS)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> TableResult:
    """All trials of all three constraints.

    Args:
        trials: Number of trials; the paper has 50.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    cases = [LearningCase(Setup(rows), ESTIMATORS) for rows in SELECTIONS]
    outcomes = runner.map("table", learning_trial, cases, trials, int(rng.integers(2**53)))
    return TableResult(dict(zip(SELECTIONS, outcomes, strict=True)))


@final
@dataclass(frozen=True, eq=False)
class TableResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Constraint -> one dictionary per trial, see `learning_trial`.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def values(self, rows: str, estimator: str, what: str = "test") -> list[float]:
        """One number per trial that was not refused."""
        return [t[estimator][what] for t in self.outcomes[rows] if what in t[estimator]]

    def to_dict(self) -> dict[str, Any]:
        """Constraint -> paper and ours, test set first."""
        out: dict[str, Any] = {}
        for rows in self.outcomes:
            ours = {}
            for name in ESTIMATORS:
                ours[name] = summary(self.values(rows, name)) | {
                    "train": summary(self.values(rows, name, "train")),
                    "scale_free": summary(self.values(rows, name, "scale_free")),
                    "angle_deg": summary(self.values(rows, name, "angle_deg")),
                    "seconds_per_fit": summary(self.values(rows, name, "seconds"))["median"],
                    "rows_right": self._rows_right(rows, name),
                }
            out[rows] = {"paper": dict(PAPER_NMIE[rows]), "ours": ours}
        return out

    def _rows_right(self, rows: str, name: str) -> float:
        trials = self.outcomes[rows]
        return sum(t[name].get("rows") == len(rows.split()) for t in trials) / len(trials)

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial and estimator."""
        return [
            {
                "rows": rows,
                "trial": i,
                "estimator": name,
                "nmie_train": t[name].get("train"),
                "nmie_test": t[name].get("test"),
                "nmie_scale_free": t[name].get("scale_free"),
                "angle_deg": t[name].get("angle_deg"),
                "rows_found": t[name].get("rows"),
                "refused": t[name].get("refused", ""),
            }
            for rows, trials in self.outcomes.items()
            for i, t in enumerate(trials)
            for name in ESTIMATORS
        ]

    def markdown(self) -> str:
        """The table with the paper's column, one block per constraint."""
        parts = []
        for rows, block in self.to_dict().items():
            lines: list[list[str]] = [["**paper, as printed**", f"{mean_and_sd(block['paper'])}", "", "", "", ""]]
            for name, s in block["ours"].items():
                lines.append(
                    [
                        SAID[name],
                        mean_and_sd(s),
                        number(s["median"]),
                        number(s["worst"]),
                        mean_and_sd(s["train"]),
                        number(s["seconds_per_fit"]),
                    ]
                )
            header = ["way to learn", "NMIE, mean +- s.d.", "median", "worst", "on the training set", "s a fit"]
            parts.append(f"**Constrained rows {_said(rows)}**\n\n{markdown_table(header, lines)}")
        return "\n\n".join(parts)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot."""
        figure, axes = charts.new_figure(11.0, 4.8, 1, len(self.outcomes), sharey=True)
        for ax, rows in zip(axes[0], self.outcomes, strict=True):
            charts.strip(ax, {SAID[n]: self.values(rows, n) for n in ESTIMATORS}, PAPER_NMIE[rows]["mean"])
            ax.set_title(f"constrained rows {_said(rows)}")
        axes[0, 0].set_ylabel("NMIE on the test set (no unit)")
        figure.supxlabel("way to learn; a dot is a trial, a bar the median", fontsize=9)
        return {"table": figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None: no robot moves in this experiment."""
        return {}


def _said(rows: str) -> str:
    return rows.replace("rz", "theta").replace(" ", ", ")
