"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.charts import Panel, strips
from manip_learn.experiments.experiment_result import (
    TrialsResult,
    markdown_table,
    mean_and_sd,
    number,
    said_rows,
    share,
    summary,
)
from manip_learn.experiments.learners import ESTIMATORS, SAID
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import PAPER_NMIE, SELECTIONS, Setup, demonstrate, planar_features
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.linalg import row_space_angle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPARED = tuple(ESTIMATORS)


@final
@dataclass(frozen=True)
class LearningCase:
    """Demonstrations, and the ways to learn from them, names of `ESTIMATORS`."""

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Train on one set of demonstrations, judge on it and on another one.

    Returns:
        Estimator -> `train` and `test` NMIE, `scale_free` NMIE on the test set, `angle_deg` between the row spaces,
        `rows` found, `seconds`, and for `auto` whether it `warned`; or `refused`, the reason.
    """
    features, Lambda = planar_features(), case.setup.selection(rng)
    train, test = demonstrate(case.setup, Lambda, rng), demonstrate(replace(case.setup, noise=0.0), Lambda, rng)
    seen = {name: np.concatenate([t.q for t in demos]) for name, demos in (("train", train), ("test", test))}
    out: dict[str, Any] = {}
    for estimator in case.estimators:
        own, started = np.random.default_rng(rng.integers(2**63)), time.perf_counter()
        try:
            learnt, remarks = ESTIMATORS[estimator](features, train, Lambda, own)
        except NotIdentifiableError as error:
            out[estimator] = {"refused": error.code}
            continue
        answer = {"seconds": time.perf_counter() - started, "rows": len(learnt), **remarks}
        answer["angle_deg"] = float(np.degrees(row_space_angle(Lambda, learnt)))
        for name, q in seen.items():
            mu, other = manipulability_along(features, Lambda, q), manipulability_along(features, learnt, q)
            answer[name], answer["scale_free"] = nmie(mu, other), scale_free_nmie(mu, other)
        out[estimator] = answer
    return out


def statistics(trials: list[dict[str, Any]], estimator: str, rows: str) -> dict[str, Any]:
    """Of one way to learn: the NMIE on the test set, then the other numbers, and the shares of what became of it."""
    outcomes = [t[estimator] for t in trials]
    return summary(o.get("test") for o in outcomes) | {
        **{what: summary(o.get(what) for o in outcomes) for what in ("train", "scale_free", "angle_deg")},
        "seconds_per_fit": summary(o.get("seconds") for o in outcomes)["median"],
        "rows_right": share(o.get("rows") == len(rows.split()) for o in outcomes),
        "warned": share(bool(o.get("warned")) for o in outcomes),
        "refused": share("refused" in o for o in outcomes),
    }


@final
class TableResult(TrialsResult):
    """Outcome of every trial of the paper's three constraints, see `learning_trial`."""

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
                {SAID[name]: [t[name]["test"] for t in trials if "test" in t[name]] for name in COMPARED},
                "NMIE on the test set (no unit)",
                f"constrained rows {said_rows(rows)}",
                PAPER_NMIE[rows]["mean"],
            )
            for rows, trials in self.outcomes.items()
        ]
        return {"table": strips([panels], "way to learn; a dot is a trial, a bar the median")}


TABLE = of_trials(
    "table", learning_trial, {rows: LearningCase(Setup(rows), COMPARED) for rows in SELECTIONS}, TableResult
)
