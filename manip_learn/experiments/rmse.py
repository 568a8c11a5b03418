"""How far the learnt policy that climbs the manipulability is from the true one.

The paper produces two trajectories, with the true policy and with the learnt one, and compares them; that is here, and
also the two policies at the postures of one trajectory, where nothing adds up on the way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import (
    ExperimentResult,
    markdown_table,
    mean_and_sd,
    number,
    said_rows,
    summary,
)
from manip_learn.experiments.metrics import policy_rmse
from manip_learn.experiments.paper_setup import (
    PAPER_RMSE,
    SELECTIONS,
    STEP,
    Setup,
    demonstrate,
    draw_starts,
    draw_targets,
    planar_features,
    tip,
)
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.experiments.ways import ESTIMATORS as WAYS
from manip_learn.experiments.ways import SAID

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = ("joint-affine", "joint-rbf", "separate")
# what is compared -> words for tables; all with the root mean square over 100 points of the length of the difference
KINDS = {
    "two_policies": "policies of two trajectories [rad/s]",
    "two_postures": "postures of two trajectories [rad]",
    "one_trajectory": "policies along one trajectory [rad/s]",
}
PRINTED_FOR = "x y"  # the constraint that the paper tested
ROLLOUTS, POINTS = 20, 100


@final
@dataclass(frozen=True)
class RmseCase:
    """What is learnt: the constrained rows of the paper's demonstrations."""

    rows: str


def rmse_trial(case: RmseCase, rng: np.random.Generator) -> dict[str, Any]:
    """Estimator -> each of `KINDS` -> RMSE of each of 20 rollouts of 100 points; `size` of the true policy.

    pi_mu = grad mu, equation (13), with the true Lambda and with the learnt one; the task part has the true Lambda in
    both, so that the policies alone make the difference.
    """
    setup = Setup(case.rows)
    Lambda = setup.selection(rng)
    demos = demonstrate(setup, Lambda, rng)
    true = Constraint(Lambda, planar_features())
    starts, targets = draw_starts(ROLLOUTS, rng), draw_targets(ROLLOUTS, rng)
    q, pi = climbing_rollouts(true, starts, targets)
    out: dict[str, Any] = {}
    for name in ESTIMATORS:
        selection, _ = WAYS[name](planar_features(), demos, Lambda, np.random.default_rng(rng.integers(2**63)))
        learnt = Constraint(selection, planar_features())
        own_q, own_pi = climbing_rollouts(true, starts, targets, learnt)
        along = manipulability_batch(learnt, q.reshape(-1, 3)).gradient.reshape(q.shape)
        out[name] = {
            "two_policies": policy_rmse(pi, own_pi).tolist(),
            "two_postures": policy_rmse(q, own_q).tolist(),
            "one_trajectory": policy_rmse(pi, along).tolist(),
        }
    out["size"] = float(np.sqrt(np.mean(np.sum(pi**2, axis=-1))))
    return out


def climbing_rollouts(
    constraint: Constraint,
    q: Float[np.ndarray, "m 3"],
    targets: Float[np.ndarray, "m 3"],
    climbed: Constraint | None = None,
) -> tuple[Float[np.ndarray, "m T 3"], Float[np.ndarray, "m T 3"]]:
    """Postures and pi_mu under u = A^+ b + N pi_mu, equations (2) and (13), from m starts at once, by Euler steps.

    Computed as u = pi_mu + A^+ (b - A pi_mu), with b = Lambda (r* - r(q)).

    Args:
        constraint: Of the task.
        q: Starts [rad].
        targets: r*.
        climbed: Whose mu is climbed; that of the task by default.
    """
    Lambda, postures, policies = constraint.selection, [], []
    for _ in range(POINTS):
        pi = manipulability_batch(climbed or constraint, q).gradient
        postures.append(q)
        policies.append(pi)
        A = Lambda @ constraint.features.batch(q)
        b = (targets - tip(q)) @ Lambda.T - np.einsum("nsv,nv->ns", A, pi)
        q = q + STEP * (pi + np.einsum("nvs,ns->nv", np.linalg.pinv(A), b))
    return np.array(postures).transpose(1, 0, 2), np.array(policies).transpose(1, 0, 2)


@final
@dataclass(frozen=True, eq=False)
class RmseResult(ExperimentResult):
    """RMSE of every rollout.

    Attributes:
        outcomes: Constraint -> one dictionary per trial, see `rmse_trial`.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def values(self, rows: str, estimator: str, kind: str) -> list[float]:
        """RMSE of every rollout of every trial."""
        return [v for t in self.outcomes[rows] for v in t[estimator][kind]]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours, over all rollouts; `policy_size` is the root mean square of the true policy."""
        ours = {
            rows: {name: {kind: summary(self.values(rows, name, kind)) for kind in KINDS} for name in ESTIMATORS}
            | {"policy_size": float(np.mean([t["size"] for t in trials]))}
            for rows, trials in self.outcomes.items()
        }
        return {"paper": dict(PAPER_RMSE) | {"rows": PRINTED_FOR}, "ours": ours}

    def rows(self) -> list[dict[str, Any]]:
        """One line per rollout and estimator."""
        return [
            {"rows": rows, "trial": i, "rollout": j, "estimator": name} | {kind: t[name][kind][j] for kind in KINDS}
            for rows, trials in self.outcomes.items()
            for i, t in enumerate(trials)
            for name in ESTIMATORS
            for j in range(ROLLOUTS)
        ]

    def markdown(self) -> str:
        """The paper's number beside ours, for the constraint that it was measured with."""
        lines = []
        for rows, block in self.to_dict()["ours"].items():
            if rows == PRINTED_FOR:
                said = f"{PAPER_RMSE['mean']:.3e} +- {PAPER_RMSE['sd']:.3e}"
                lines.append([said_rows(rows), "**paper, as printed**", said, "", "", ""])
            for name in ESTIMATORS:
                cells = [mean_and_sd(block[name][kind]) for kind in KINDS]
                worst = number(block[name]["two_policies"]["worst"])
                lines.append([said_rows(rows), SAID[name], cells[0], worst, *cells[1:]])
        kinds = list(KINDS.values())
        return markdown_table(["rows", "way to learn", kinds[0], "... worst", *kinds[1:]], lines)

    def figures(self) -> dict[str, Figure]:
        """Every rollout as a dot, the way of the paper above."""
        shown = ("two_policies", "one_trajectory")
        figure, axes = charts.new_figure(9.0, 6.4, len(shown), len(self.outcomes), sharey=True, sharex=True)
        for line, kind in zip(axes, shown, strict=True):
            for ax, rows in zip(line, self.outcomes, strict=True):
                paper = PAPER_RMSE["mean"] if rows == PRINTED_FOR and kind == "two_policies" else None
                charts.strip(ax, {SAID[n]: self.values(rows, n, kind) for n in ESTIMATORS}, paper)
            words = KINDS[kind].replace(" [", "\n[")
            line[0].set_ylabel(f"RMSE, {words}")
        for ax, rows in zip(axes[0], self.outcomes, strict=True):
            ax.set_title(f"constrained rows {said_rows(rows)}")
        figure.supxlabel("way to learn; a dot is a rollout, a bar the median", fontsize=9)
        return {"rmse": figure}


RMSE = of_trials("rmse", rmse_trial, {rows: RmseCase(rows) for rows in SELECTIONS}, RmseResult)
