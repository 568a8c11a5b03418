"""The paper's table again where its assumptions bend: noise, few trajectories, other policies, rows and units."""

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
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = ("joint-affine", "joint-rbf", "separate", "auto")
OWN = (*ESTIMATORS, "joint-own")
# name -> what is changed, and for which rows
VARIANTS: dict[str, tuple[Setup, tuple[str, ...]]] = {
    "noise 1 %": (Setup(noise=0.01), SELECTIONS),
    "noise 5 %": (Setup(noise=0.05), SELECTIONS),
    "noise 10 %": (Setup(noise=0.10), SELECTIONS),
    "1 trajectory": (Setup(trajectories=1), SELECTIONS),
    "5 trajectories": (Setup(trajectories=5), SELECTIONS),
    "20 trajectories": (Setup(trajectories=20), SELECTIONS),
    "100 trajectories": (Setup(trajectories=100), SELECTIONS),
    "sinusoidal policy": (Setup(policy="sinusoidal"), SELECTIONS),
    "zero policy": (Setup(policy="zero"), SELECTIONS),
    # a constant of each trajectory's own: 40 of them, for the time it takes
    "each demonstrator's own": (Setup(policy="own", trajectories=40), SELECTIONS),
    "oblique rows": (Setup(), ("oblique",)),
    "lengths x 0.01": (Setup(length=0.01), SELECTIONS),
    "lengths x 100": (Setup(length=100.0), SELECTIONS),
}


def cases() -> dict[tuple[str, str], LearningCase]:
    """(variant, rows) -> case."""
    return {
        (name, rows): LearningCase(replace(setup, rows=rows), OWN if setup.policy == "own" else ESTIMATORS)
        for name, (setup, selections) in VARIANTS.items()
        for rows in selections
    }


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials * len(cases())


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> VariantsResult:
    """All trials of all variants.

    Args:
        trials: Number of trials of each variant and constraint.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    table = cases()
    outcomes = runner.map("variants", learning_trial, list(table.values()), trials, int(rng.integers(2**53)))
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
        columns = ("auto", "joint-affine", "joint-rbf", "separate")
        header = ["demonstrations", "rows", *(f"{c}: median (worst)" for c in columns), "angle of auto [deg]"]
        header += ["rows found", "answered with a warning", "refused"]
        lines = []
        for name, block in self.to_dict().items():
            for rows, cell in block.items():
                ours = cell["ours"]
                said = [_cell(ours[c]) for c in columns]
                auto = ours["auto"]
                lines.append([name, rows.replace("rz", "theta"), *said, number(auto["angle_deg"]["median"])])
                lines[-1] += [_percent(auto["rows_right"]), _percent(auto["warned"]), _percent(auto["refused"])]
                if "joint-own" in ours:
                    own = ours["joint-own"]
                    told = "... told so (policy_model='affine-offset')"
                    lines.append([told, rows.replace("rz", "theta"), _cell(own)])
                    lines[-1] += ["", "", "", number(own["angle_deg"]["median"]), "told", "", _percent(own["refused"])]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Medians over noise and over the number of trajectories, and all policies and units beside each other."""
        figure, axes = charts.new_figure(10.0, 3.6, 1, 2)
        _lines(
            axes[0, 0],
            self.to_dict(),
            {"1": "noise 1 %", "5": "noise 5 %", "10": "noise 10 %"},
            "noise on the action [%]",
        )
        counts = {"5": "5 trajectories", "20": "20 trajectories", "100": "100 trajectories"}
        _lines(axes[0, 1], self.to_dict(), counts, "number of trajectories (10 samples each)")
        axes[0, 1].legend(fontsize=7)
        return {"variants": figure}

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


def _lines(ax: Any, block: dict[str, Any], variants: dict[str, str], label: str) -> None:
    looks = {"auto": ("blue", "-"), "joint-rbf": ("green", "-."), "separate": ("vermilion", "--")}
    for estimator, (name, dashes) in looks.items():
        for marker, rows in zip("osv", SELECTIONS, strict=True):
            ys = [block[v][rows]["ours"][estimator]["median"] for v in variants.values()]
            points = [(float(x), y) for x, y in zip(variants, ys, strict=True) if y is not None]
            if points:
                title = f"{estimator}, {rows.replace('rz', 'theta')}"
                xs, values = zip(*points, strict=True)
                ax.plot(
                    xs,
                    np.maximum(values, 1e-32),
                    dashes,
                    marker=marker,
                    markersize=4,
                    label=title,
                    color=charts.colour(name),
                    linewidth=1.2,
                )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks([float(x) for x in variants], list(variants))
    ax.minorticks_off()
    ax.set_xlabel(label)
    ax.set_ylabel("median NMIE")
