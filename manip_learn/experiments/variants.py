"""The paper's table again where its assumptions bend: few trajectories, other policies, rows and units; no noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, number, summary
from manip_learn.experiments.learning_trial import LearningCase, learning_trial
from manip_learn.experiments.paper_setup import SELECTIONS, Setup
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.experiments.ways import SAID
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = ("auto", "joint-affine", "separate")
CURVED = (*ESTIMATORS, "joint-rbf")
OWN = (*ESTIMATORS, "joint-own")
# name -> what is changed, for which rows, and what learns
VARIANTS: dict[str, tuple[Setup, tuple[str, ...], tuple[str, ...]]] = {
    "1 trajectory": (Setup(trajectories=1), SELECTIONS, ESTIMATORS),
    "5 trajectories": (Setup(trajectories=5), SELECTIONS, ESTIMATORS),
    "20 trajectories": (Setup(trajectories=20), SELECTIONS, ESTIMATORS),
    "sinusoidal policy": (Setup(policy="sinusoidal"), SELECTIONS, CURVED),
    "zero policy": (Setup(policy="zero"), SELECTIONS, ESTIMATORS),
    # a constant of each trajectory's own: 40 of them, for the time it takes
    "each demonstrator's own": (Setup(policy="own", trajectories=40), SELECTIONS, OWN),
    "oblique rows": (Setup(), ("oblique",), ESTIMATORS),
    "lengths x 0.01": (Setup(length=0.01), SELECTIONS, ESTIMATORS),
    "lengths x 100": (Setup(length=100.0), SELECTIONS, ESTIMATORS),
}


def trials_of(trials: int) -> int:
    """Two fifths of the paper's number of trials: 20 of 50."""
    return max(1, round(0.4 * trials))


def cases() -> dict[tuple[str, str], LearningCase]:
    """(variant, rows) -> case."""
    return {
        (name, rows): LearningCase(replace(setup, rows=rows), estimators)
        for name, (setup, selections, estimators) in VARIANTS.items()
        for rows in selections
    }


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials_of(trials) * len(cases())


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> VariantsResult:
    """All trials of all variants.

    Args:
        trials: Two fifths as many trials of each variant and constraint.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    table = cases()
    outcomes = runner.map("variants", learning_trial, list(table.values()), trials_of(trials), int(rng.integers(2**53)))
    return VariantsResult(dict(zip(table, outcomes, strict=True)))


@final
@dataclass(frozen=True, eq=False)
class VariantsResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: (variant, rows) -> one dictionary per trial, see `learning_trial`.
    """

    outcomes: dict[tuple[str, str], list[dict[str, Any]]]

    def to_dict(self) -> dict[str, Any]:
        """Variant -> rows -> ours; the paper says nothing about these."""
        out: dict[str, Any] = {}
        for (name, rows), trials in self.outcomes.items():
            ours = {e: _statistics(trials, e, rows) for e in trials[0]}
            out.setdefault(name, {})[rows] = {"paper": None, "ours": ours}
        return out

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial and estimator."""
        return [
            {
                "variant": name,
                "rows": rows,
                "trial": i,
                "estimator": e,
                "nmie_test": t[e].get("test"),
                "nmie_scale_free": t[e].get("scale_free"),
                "angle_deg": t[e].get("angle_deg"),
                "rows_found": t[e].get("rows"),
                "warned": t[e].get("warned", ""),
                "refused": t[e].get("refused", ""),
            }
            for (name, rows), trials in self.outcomes.items()
            for i, t in enumerate(trials)
            for e in t
        ]

    def markdown(self) -> str:
        """Medians and worst cases side by side, with how often the number of rows was found."""
        header = ["demonstrations", "rows", *(f"{SAID[c]}: median (worst)" for c in ESTIMATORS), "another way"]
        header += [f"angle of *{SAID['auto']}* [deg]", "rows found", "answered with a warning", "refused"]
        lines = []
        for name, block in self.to_dict().items():
            for rows, cell in block.items():
                ours = cell["ours"]
                auto, others = ours["auto"], [e for e in ours if e not in ESTIMATORS]
                said = [_cell(ours[c]) for c in ESTIMATORS]
                said.append("; ".join(f"{SAID[e]}: {_cell(ours[e])}" for e in others))
                lines.append([name, _said(rows), *said, number(auto["angle_deg"]["median"])])
                lines[-1] += [_percent(auto["rows_right"]), _percent(auto["warned"]), _percent(auto["refused"])]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot: what ships above, the paper's route without its row-by-row search below."""
        shown = ("auto", "separate")
        figure, axes = charts.new_figure(11.0, 6.8, len(shown), len(SELECTIONS), sharex="col", sharey="row")
        for line, estimator in zip(axes, shown, strict=True):
            for ax, rows in zip(line, SELECTIONS, strict=True):
                names = [name for name, other in self.outcomes if other == rows]
                charts.strip(ax, {name: self._nmie(name, rows, estimator) for name in names})
            line[0].set_ylabel(f"NMIE on the test set (no unit),\n{SAID[estimator]}")
        for ax, rows in zip(axes[0], SELECTIONS, strict=True):
            ax.set_title(f"constrained rows {_said(rows)}")
        figure.supxlabel(
            "demonstrations, nothing where all refused (oblique rows: see the table); dot: a trial, bar: the median",
            fontsize=9,
        )
        return {"variants": figure}

    def _nmie(self, name: str, rows: str, estimator: str) -> list[float]:
        return [t[estimator]["test"] for t in self.outcomes[name, rows] if "test" in t[estimator]]

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None: no robot moves in this experiment."""
        return {}


def rank_found(outcomes: Mapping[tuple[str, str], list[dict[str, Any]]], variants: tuple[str, ...]) -> float:
    """Share of the runs of some variants in which the learner found the number of rows by itself."""
    runs = [(t["auto"], rows) for (name, rows), trials in outcomes.items() if name in variants for t in trials]
    return sum(t.get("rows") == _count(rows) for t, rows in runs) / max(len(runs), 1)


def _count(rows: str) -> int:
    return 2 if rows == "oblique" else len(rows.split())


def _statistics(trials: list[dict[str, Any]], estimator: str, rows: str) -> dict[str, Any]:
    outcomes = [t[estimator] for t in trials]
    n = len(outcomes)
    return summary(o["test"] for o in outcomes if "test" in o) | {
        "scale_free": summary(o["scale_free"] for o in outcomes if "test" in o),
        "angle_deg": summary(o["angle_deg"] for o in outcomes if "test" in o),
        "seconds_per_fit": summary(o["seconds"] for o in outcomes if "test" in o)["median"],
        "rows_right": sum(o.get("rows") == _count(rows) for o in outcomes) / n,
        "warned": sum(bool(o.get("warned")) for o in outcomes) / n,
        "refused": sum("refused" in o for o in outcomes) / n,
    }


def _cell(statistics: dict[str, Any]) -> str:
    return f"{number(statistics['median'])} ({number(statistics['worst'])})" if statistics["n"] else "refused"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _said(rows: str) -> str:
    return rows.replace("rz", "theta").replace(" ", ", ")
