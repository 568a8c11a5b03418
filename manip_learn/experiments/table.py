"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways.

Then the same where the paper's assumptions bend: few trajectories, other policies, rows and units; no noise. A trial
draws demonstrations, learns Lambda in several ways, and compares mu.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.charts import Panel, strips
from manip_learn.experiments.experiment_result import (
    TrialsResult,
    markdown_table,
    mean_and_sd,
    median_and_worst,
    number,
    percent,
    said_rows,
    share,
    summary,
)
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import PAPER_NMIE, SELECTIONS, Setup, demonstrate, planar_features
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.experiments.ways import ESTIMATORS, SAID, scaled_rows
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Matrix = Float[np.ndarray, "s p"]


@final
@dataclass(frozen=True)
class LearningCase:
    """Demonstrations, and the ways to learn from them.

    Attributes:
        setup: The demonstrations.
        estimators: Names of `ESTIMATORS`.
    """

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Train on one set of demonstrations, judge on it and on another one.

    Returns:
        What `answers` returns.
    """
    setup = case.setup
    Lambda = setup.selection(rng)
    train, test = demonstrate(setup, Lambda, rng), demonstrate(replace(setup, noise=0.0), Lambda, rng)
    features: FeatureMap = planar_features()
    if setup.length != 1.0:
        features = scaled_rows(features, [setup.length, setup.length, 1.0])
    seen = [np.concatenate([t.q for t in demos]) for demos in (train, test)]
    return answers(case.estimators, features, train, Lambda, seen, rng)[0]


def answers(
    estimators: Iterable[str],
    features: FeatureMap,
    demos: Demonstrations,
    true: Matrix,
    seen: list[np.ndarray],
    rng: np.random.Generator,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What several ways to learn make of the same demonstrations.

    Args:
        estimators: Names of `ESTIMATORS`.
        features: Phi.
        demos: The training set.
        true: Lambda.
        seen: Postures of the training set and of the test set.
        rng: Each way gets a generator of its own.

    Returns:
        Estimator -> `train` and `test` NMIE, `scale_free` NMIE on the test set, `angle_deg` between the row spaces,
        `rows` found, `seconds`, and for `auto` whether it `warned`; or `refused`, the reason. And each answer, Lambda.
    """
    out: dict[str, Any] = {}
    learnt: dict[str, np.ndarray] = {}
    for name in estimators:
        own, started = np.random.default_rng(rng.integers(2**63)), time.perf_counter()
        try:
            learnt[name], remarks = ESTIMATORS[name](features, demos, true, own)
        except NotIdentifiableError as error:
            out[name] = {"refused": error.code}
            continue
        seconds = time.perf_counter() - started
        out[name] = judge(features, true, learnt[name], seen) | {"seconds": seconds} | remarks
    return out, learnt


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


def statistics(trials: list[dict[str, Any]], estimator: str, rows: str) -> dict[str, Any]:
    """Of one way to learn: the NMIE on the test set, then the other numbers, and the shares of what became of it."""
    outcomes = [t[estimator] for t in trials]
    true_rows = 2 if rows == "oblique" else len(rows.split())
    return summary(o.get("test") for o in outcomes) | {
        **{what: summary(o.get(what) for o in outcomes) for what in ("train", "scale_free", "angle_deg")},
        "seconds_per_fit": summary(o.get("seconds") for o in outcomes)["median"],
        "rows_right": share(o.get("rows") == true_rows for o in outcomes),
        "warned": share(bool(o.get("warned")) for o in outcomes),
        "refused": share("refused" in o for o in outcomes),
    }


def dots(trials: list[dict[str, Any]], estimator: str) -> list[float]:
    """NMIE on the test set of each trial that was not refused."""
    return [t[estimator]["test"] for t in trials if "test" in t[estimator]]


@final
class TableResult(TrialsResult):
    """Outcome of every trial of the paper's three constraints, see `answers`."""

    def to_dict(self) -> dict[str, Any]:
        """Constraint -> paper and ours, test set first."""
        return {
            rows: {
                "paper": dict(PAPER_NMIE[rows]),
                "ours": {name: statistics(trials, name, rows) for name in COMPARED},
            }
            for rows, trials in self.outcomes.items()
        }

    def markdown(self) -> str:
        """The table with the paper's column, one block per constraint."""
        header = ["way to learn", "NMIE, mean +- s.d.", "median", "worst", "on the training set", "s a fit"]
        parts = []
        for rows, block in self.to_dict().items():
            lines = [["**paper, as printed**", mean_and_sd(block["paper"]), "", "", "", ""]]
            for name, s in block["ours"].items():
                lines.append([SAID[name], mean_and_sd(s), number(s["median"]), number(s["worst"])])
                lines[-1] += [mean_and_sd(s["train"]), number(s["seconds_per_fit"])]
            parts.append(f"**Constrained rows {said_rows(rows)}**\n\n{markdown_table(header, lines)}")
        return "\n\n".join(parts)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot."""
        panels = [
            Panel(
                {SAID[name]: dots(trials, name) for name in COMPARED},
                "NMIE on the test set (no unit)",
                f"constrained rows {said_rows(rows)}",
                PAPER_NMIE[rows]["mean"],
            )
            for rows, trials in self.outcomes.items()
        ]
        return {"table": strips([panels], "way to learn; a dot is a trial, a bar the median")}


IN_VARIANTS = ("auto", "joint-affine", "separate")
CURVED = (*IN_VARIANTS, "joint-rbf")
OWN = (*IN_VARIANTS, "joint-own")
# name -> the changed setup, the rows it is used for, and the ways to learn
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
BETWEEN = " | "  # the variant and its rows, in the name of a case
VARIED = {
    f"{name}{BETWEEN}{rows}": LearningCase(replace(setup, rows=rows), estimators)
    for name, (setup, selections, estimators) in VARIANTS.items()
    for rows in selections
}


@final
class VariantsResult(TrialsResult):
    """Outcome of every trial of every variant, see `answers`."""

    def to_dict(self) -> dict[str, Any]:
        """Variant -> rows -> ours; the paper says nothing about these."""
        out: dict[str, Any] = {}
        for case, trials in self.outcomes.items():
            name, rows = case.split(BETWEEN)
            ours = {estimator: statistics(trials, estimator, rows) for estimator in trials[0]}
            out.setdefault(name, {})[rows] = {"paper": None, "ours": ours}
        return out

    def markdown(self) -> str:
        """Medians and worst cases side by side, with how often the number of rows was found."""
        header = ["demonstrations", "rows", *(f"{SAID[c]}: median (worst)" for c in IN_VARIANTS), "another way"]
        header += [f"angle of *{SAID['auto']}* [deg]", "rows found", "answered with a warning", "refused"]
        lines = []
        for name, block in self.to_dict().items():
            for rows, cell in block.items():
                said = {e: median_and_worst(s) if s["n"] else "refused" for e, s in cell["ours"].items()}
                others = "; ".join(f"{SAID[e]}: {text}" for e, text in said.items() if e not in IN_VARIANTS)
                auto = cell["ours"]["auto"]
                lines.append([name, said_rows(rows), *(said[e] for e in IN_VARIANTS), others])
                lines[-1] += [number(auto["angle_deg"]["median"])]
                lines[-1] += [percent(auto[what]) for what in ("rows_right", "warned", "refused")]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot: what ships above, the paper's route without its row-by-row search below."""
        panels = [
            [
                Panel(
                    {
                        case.split(BETWEEN)[0]: dots(trials, estimator)
                        for case, trials in self.outcomes.items()
                        if case.endswith(BETWEEN + rows)
                    },
                    f"NMIE on the test set (no unit),\n{SAID[estimator]}",
                    f"constrained rows {said_rows(rows)}" if estimator == "auto" else "",
                )
                for rows in SELECTIONS
            ]
            for estimator in ("auto", "separate")
        ]
        across = "demonstrations, nothing where all refused; a dot is a trial, a bar the median"
        return {"variants": strips(panels, across, height=6.8)}


TABLE = of_trials(
    "table", learning_trial, {rows: LearningCase(Setup(rows), COMPARED) for rows in SELECTIONS}, TableResult
)
VARIED_TABLE = of_trials("variants", learning_trial, VARIED, VariantsResult, 0.4)
