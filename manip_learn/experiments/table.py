"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways.

Then the same where the paper's assumptions bend: few trajectories, other policies, rows and units; no noise. A trial
draws demonstrations, learns Lambda in several ways, and compares mu.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import (
    ExperimentResult,
    markdown_table,
    mean_and_sd,
    median_and_worst,
    number,
    percent,
    said_rows,
    summary,
)
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import PAPER_NMIE, SELECTIONS, Setup, demonstrate, planar_features
from manip_learn.experiments.trial_runner import of_trials, two_fifths
from manip_learn.experiments.ways import ESTIMATORS, SAID, ScaledRows
from manip_learn.linalg import row_space_angle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Matrix = Float[np.ndarray, "s p"]


@final
@dataclass(frozen=True)
class LearningCase:
    """What is learnt from what.

    Attributes:
        setup: The demonstrations.
        estimators: Names of `ESTIMATORS`.
    """

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Train on one set of demonstrations, judge on it and on another one.

    Returns:
        Estimator -> `train` and `test` NMIE, `scale_free` NMIE on the test set, `angle_deg` between the row spaces,
        `rows` found, `seconds`, and for `auto` whether it `warned`; or `refused`, the reason.
    """
    setup = case.setup
    Lambda = setup.selection(rng)
    train, test = demonstrate(setup, Lambda, rng), demonstrate(dataclasses.replace(setup, noise=0.0), Lambda, rng)
    features: FeatureMap = planar_features()
    if setup.length != 1.0:
        features = ScaledRows(features, [setup.length, setup.length, 1.0])
    seen = [np.concatenate([t.q for t in demos]) for demos in (train, test)]
    out: dict[str, Any] = {}
    for name in case.estimators:
        own = np.random.default_rng(rng.integers(2**63))
        started = time.perf_counter()
        try:
            learnt, remarks = ESTIMATORS[name](features, train, Lambda, own)
        except NotIdentifiableError as error:
            out[name] = {"refused": error.code}
            continue
        seconds = time.perf_counter() - started
        out[name] = judge(features, Lambda, learnt, seen) | {"seconds": seconds} | remarks
    return out


def judge(features: FeatureMap, true: Matrix, learnt: Matrix, seen: list[np.ndarray]) -> dict[str, Any]:
    """`rows`, `angle_deg` between the row spaces, NMIE on training and test postures, `scale_free` on the latter."""
    out: dict[str, Any] = {"rows": len(learnt), "angle_deg": float(np.degrees(row_space_angle(true, learnt)))}
    for name, q in zip(("train", "test"), seen, strict=True):
        mu, other = manipulability_along(features, true, q), manipulability_along(features, learnt, q)
        out[name] = nmie(mu, other)
        out["scale_free"] = scale_free_nmie(mu, other)
    return out


COMPARED = (
    "joint-affine",
    "joint-quadratic",
    "joint-cubic",
    "joint-rbf",
    "separate",
    "separate-row-by-row",
    "true-w",
    "auto",
)


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
            for name in COMPARED:
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
            for name in COMPARED
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
            parts.append(f"**Constrained rows {said_rows(rows)}**\n\n{markdown_table(header, lines)}")
        return "\n\n".join(parts)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot."""
        figure, axes = charts.new_figure(11.0, 4.8, 1, len(self.outcomes), sharey=True)
        for ax, rows in zip(axes[0], self.outcomes, strict=True):
            charts.strip(ax, {SAID[n]: self.values(rows, n) for n in COMPARED}, PAPER_NMIE[rows]["mean"])
            ax.set_title(f"constrained rows {said_rows(rows)}")
        axes[0, 0].set_ylabel("NMIE on the test set (no unit)")
        figure.supxlabel("way to learn; a dot is a trial, a bar the median", fontsize=9)
        return {"table": figure}


IN_VARIANTS = ("auto", "joint-affine", "separate")
CURVED = (*IN_VARIANTS, "joint-rbf")
OWN = (*IN_VARIANTS, "joint-own")
# name -> what is changed, for which rows, and what learns
VARIANTS: dict[str, tuple[Setup, tuple[str, ...], tuple[str, ...]]] = {
    "1 trajectory": (Setup(trajectories=1), SELECTIONS, IN_VARIANTS),
    "5 trajectories": (Setup(trajectories=5), SELECTIONS, IN_VARIANTS),
    "20 trajectories": (Setup(trajectories=20), SELECTIONS, IN_VARIANTS),
    "sinusoidal policy": (Setup(policy="sinusoidal"), SELECTIONS, CURVED),
    "zero policy": (Setup(policy="zero"), SELECTIONS, IN_VARIANTS),
    # a constant of each trajectory's own: 40 of them, for the time it takes
    "each demonstrator's own": (Setup(policy="own", trajectories=40), SELECTIONS, OWN),
    "oblique rows": (Setup(), ("oblique",), IN_VARIANTS),
    "lengths x 0.01": (Setup(length=0.01), SELECTIONS, IN_VARIANTS),
    "lengths x 100": (Setup(length=100.0), SELECTIONS, IN_VARIANTS),
}


def cases() -> dict[tuple[str, str], LearningCase]:
    """(variant, rows) -> case."""
    return {
        (name, rows): LearningCase(replace(setup, rows=rows), estimators)
        for name, (setup, selections, estimators) in VARIANTS.items()
        for rows in selections
    }


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
        header = ["demonstrations", "rows", *(f"{SAID[c]}: median (worst)" for c in IN_VARIANTS), "another way"]
        header += [f"angle of *{SAID['auto']}* [deg]", "rows found", "answered with a warning", "refused"]
        lines = []
        for name, block in self.to_dict().items():
            for rows, cell in block.items():
                ours = cell["ours"]
                auto, others = ours["auto"], [e for e in ours if e not in IN_VARIANTS]
                said = [_cell(ours[c]) for c in IN_VARIANTS]
                said.append("; ".join(f"{SAID[e]}: {_cell(ours[e])}" for e in others))
                lines.append([name, said_rows(rows), *said, number(auto["angle_deg"]["median"])])
                lines[-1] += [percent(auto["rows_right"]), percent(auto["warned"]), percent(auto["refused"])]
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
            ax.set_title(f"constrained rows {said_rows(rows)}")
        figure.supxlabel(
            "demonstrations, nothing where all refused (oblique rows: see the table); dot: a trial, bar: the median",
            fontsize=9,
        )
        return {"variants": figure}

    def _nmie(self, name: str, rows: str, estimator: str) -> list[float]:
        return [t[estimator]["test"] for t in self.outcomes[name, rows] if "test" in t[estimator]]


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
    return median_and_worst(statistics) if statistics["n"] else "refused"


TABLE = of_trials(
    "table", learning_trial, {rows: LearningCase(Setup(rows), COMPARED) for rows in SELECTIONS}, TableResult
)
VARIED_TABLE = of_trials("variants", learning_trial, cases(), VariantsResult, two_fifths)
