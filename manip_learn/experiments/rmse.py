"""RMSE between two policies that ascend the manipulability, of the true and of the learnt constraint.

The paper compares two trajectories, one with the true policy and one with the learnt one. This experiment does the
same, and also compares the two policies along one trajectory, where differences do not accumulate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability_batch
from manip_learn.experiments import paper_setup as paper
from manip_learn.experiments.charts import Figures, Panel, strips
from manip_learn.experiments.metrics import policy_rmse
from manip_learn.experiments.results import TrialsResult, markdown_table, mean_and_sd, number, row_words, summary
from manip_learn.experiments.table import LABELS, learn
from manip_learn.experiments.trials import Trials

ESTIMATORS = ("joint-affine", "joint-rbf", "separate")
# comparison -> words for tables; each is the root mean square length of the difference over 100 points
_KINDS = {
    "two_policies": "policies of two trajectories [rad/s]",
    "two_postures": "postures of two trajectories [rad]",
    "one_trajectory": "policies along one trajectory [rad/s]",
}
PRINTED_FOR = "x y"  # the constraint that the paper tested


@dataclass(frozen=True)
class RmseCase:
    """Case of the experiment: `rows` are the constrained rows of the demonstrations, words of `"x y rz"`."""

    rows: str


def rmse_trial(case: RmseCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn a constraint from one set of demonstrations, and measure the errors of its manipulability policy.

    The policy is the gradient of mu, equation (13), with the true and with the learnt Lambda. The task motion uses the
    true Lambda in both cases, so that only the policies differ.

    Args:
        case: Constrained rows.
        rng: Random generator of the trial.

    Returns:
        Nested dictionary: estimator -> kind of comparison (`_KINDS`) -> RMSE of each of 20 rollouts with 100 points.
            The
        entry `size` is the root mean square of the true policy.
    """
    true = paper.true_constraint(case.rows)
    demos = paper.demonstrate(paper.Setup(case.rows), true.selection, rng)
    reaches = paper.draw_starts(20, rng), paper.draw_targets(20, rng)
    q, pi = climbing(true, *reaches)
    out: dict[str, Any] = {}
    for name in ESTIMATORS:
        seed = int(rng.integers(2**63))
        estimate = Constraint(learn(name, true.features, demos, true.selection, seed)[0], true.features)
        own_q, own_pi = climbing(true, *reaches, estimate)
        errors = (policy_rmse(pi, own_pi), policy_rmse(q, own_q), policy_rmse(pi, climb(estimate, q)))
        out[name] = {kind: error.tolist() for kind, error in zip(_KINDS, errors, strict=True)}
    out["size"] = float(np.sqrt(np.mean(np.sum(pi**2, axis=-1))))
    return out


def climbing(
    constraint: Constraint, q: np.ndarray, targets: np.ndarray, climbed: Constraint | None = None
) -> paper.Motions:
    """Simulate motions u = A^+ b + N pi to targets, with the manipulability gradient as policy pi, equations (2), (13).

    Args:
        constraint: Constraint of the task, with b = Lambda (r* - r(q)).
        q: Start configurations (g, 3) [rad].
        targets: Target r* of each rollout (g, 3) [m, m, rad].
        climbed: Constraint whose manipulability the policy increases; None for `constraint`.

    Returns:
        Joint positions [rad] and policy velocities [rad/s] of g rollouts.
    """
    climbed = climbed or constraint
    postures, _ = paper.reach(constraint, partial(climb, climbed), paper.tip, q, targets, points=100)
    return postures, climb(climbed, postures)


def climb(constraint: Constraint, q: Float[np.ndarray, "*n nq"]) -> Float[np.ndarray, "*n nv"]:
    """Return the policy grad mu, equation (13), at configurations.

    Args:
        constraint: Constraint whose manipulability is mu.
        q: Joint positions (..., nq) [rad].
    """
    return manipulability_batch(constraint, q.reshape(-1, q.shape[-1])).gradient.reshape(q.shape)


class RmseResult(TrialsResult):
    """RMSE of every rollout of every trial, see `rmse_trial`."""

    def _values(self, rows: str, estimator: str, kind: str) -> list[float]:
        return [v for t in self.outcomes[rows] for v in t[estimator][kind]]

    def to_dict(self) -> dict[str, Any]:
        """Return the paper's numbers (`paper`) and statistics of all rollouts (`ours`) as a dictionary.

        `policy_size` is the root mean square of the true policy.
        """
        ours: dict[str, dict[str, Any]] = {}
        for rows, trials in self.outcomes.items():
            ours[rows] = {e: {kind: summary(self._values(rows, e, kind)) for kind in _KINDS} for e in ESTIMATORS}
            ours[rows]["policy_size"] = float(np.mean([t["size"] for t in trials]))
        return {"paper": paper.PAPER_RMSE | {"rows": PRINTED_FOR}, "ours": ours}

    def markdown(self) -> str:
        """Return a Markdown table of the results, with the paper's number for the constraint that it states."""
        printed = f"{paper.PAPER_RMSE['mean']:.3e} +- {paper.PAPER_RMSE['sd']:.3e}"
        lines = [[row_words(PRINTED_FOR), "**paper, as printed**", printed, "", "", ""]]
        for rows, block in self.to_dict()["ours"].items():
            for name in ESTIMATORS:
                first, *others = (mean_and_sd(block[name][kind]) for kind in _KINDS)
                worst = number(block[name]["two_policies"]["worst"])
                lines.append([row_words(rows), LABELS[name], first, worst, *others])
        first, *others = _KINDS.values()
        return markdown_table(["rows", "estimator", first, "... worst", *others], lines)

    def figures(self) -> Figures:
        """Draw every rollout as a dot, with the paper's comparison in the upper row.

        Returns:
            Dictionary from the name of the figure to the figure.
        """

        def panel(rows: str, kind: str) -> Panel:
            values = {LABELS[name]: self._values(rows, name, kind) for name in ESTIMATORS}
            label, above = f"RMSE, {_KINDS[kind]}".replace(" [", "\n["), kind == "two_policies"
            printed = paper.PAPER_RMSE["mean"] if above and rows == PRINTED_FOR else None
            return Panel(values, label, f"constrained rows {row_words(rows)}" if above else "", printed)

        panels = [[panel(rows, kind) for rows in self.outcomes] for kind in ("two_policies", "one_trajectory")]
        return {"rmse": strips(panels, "estimator; a dot is a rollout, a bar the median", 9.0, 6.4)}


RMSE = Trials("rmse", rmse_trial, {rows: RmseCase(rows) for rows in paper.SELECTIONS}, RmseResult)
