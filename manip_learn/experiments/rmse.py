"""How far the learnt policy that climbs the manipulability is from the true one, along the motions that it makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.rollout import Rollout
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, mean_and_sd, number, summary
from manip_learn.experiments.learning_trial import ESTIMATORS as WAYS
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
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = ("joint-affine", "joint-rbf", "separate")
ROLLOUTS, POINTS = 20, 100


@final
@dataclass(frozen=True)
class RmseCase:
    """What is learnt: the constrained rows of the paper's demonstrations."""

    rows: str


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials * len(SELECTIONS)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> RmseResult:
    """Learn, roll out, compare; all trials of all three constraints.

    Args:
        trials: Number of learnt constraints of each kind, with 20 rollouts each.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    cases = [RmseCase(rows) for rows in SELECTIONS]
    outcomes = runner.map("rmse", rmse_trial, cases, trials, int(rng.integers(2**53)))
    return RmseResult(dict(zip(SELECTIONS, outcomes, strict=True)))


def rmse_trial(case: RmseCase, rng: np.random.Generator) -> dict[str, Any]:
    """Estimator -> RMSE of pi_mu = grad mu, equation (13), against pi_mu~ on each of 20 rollouts of 100 points."""
    setup = Setup(case.rows)
    Lambda = setup.selection(rng)
    demos = demonstrate(setup, Lambda, rng)
    true = Constraint(Lambda, planar_features())
    q = climbing_rollouts(true, draw_starts(ROLLOUTS, rng), draw_targets(ROLLOUTS, rng))
    pi = manipulability_batch(true, q.reshape(-1, 3)).gradient
    out: dict[str, Any] = {}
    for name in ESTIMATORS:
        learnt, _ = WAYS[name](planar_features(), demos, Lambda, np.random.default_rng(rng.integers(2**63)))
        learnt_pi = manipulability_batch(Constraint(learnt, planar_features()), q.reshape(-1, 3)).gradient
        out[name] = policy_rmse(pi.reshape(q.shape), learnt_pi.reshape(q.shape)).tolist()
    out["size"] = float(policy_rmse(pi[None], np.zeros_like(pi)[None])[0])
    return out


def climbing_rollouts(
    constraint: Constraint, q: Float[np.ndarray, "m 3"], targets: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m T 3"]:
    """Postures under u = A^+ b + N pi_mu, equations (2) and (13), from m starts at once, by Euler steps.

    Computed as u = pi_mu + A^+ (b - A pi_mu), with b = Lambda (r* - r(q)).
    """
    Lambda, out = constraint.selection, []
    for _ in range(POINTS):
        out.append(q)
        A = Lambda @ constraint.features.batch(q)
        pi = manipulability_batch(constraint, q).gradient
        b = (targets - tip(q)) @ Lambda.T - np.einsum("nsv,nv->ns", A, pi)
        q = q + STEP * (pi + np.einsum("nvs,ns->nv", np.linalg.pinv(A), b))
    return np.array(out).transpose(1, 0, 2)


@final
@dataclass(frozen=True, eq=False)
class RmseResult(ExperimentResult):
    """RMSE of every rollout.

    Attributes:
        outcomes: Constraint -> one dictionary per trial, see `rmse_trial`.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def values(self, rows: str, estimator: str) -> list[float]:
        """RMSE of every rollout of every trial."""
        return [v for t in self.outcomes[rows] for v in t[estimator]]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours, over all rollouts; `policy_size` is the root mean square of the true policy."""
        ours = {
            rows: {name: summary(self.values(rows, name)) for name in ESTIMATORS}
            | {"policy_size": float(np.mean([t["size"] for t in trials]))}
            for rows, trials in self.outcomes.items()
        }
        return {"paper": dict(PAPER_RMSE), "ours": ours}

    def rows(self) -> list[dict[str, Any]]:
        """One line per rollout and estimator."""
        return [
            {"rows": rows, "trial": i, "rollout": j, "estimator": name, "rmse": value}
            for rows, trials in self.outcomes.items()
            for i, t in enumerate(trials)
            for name in ESTIMATORS
            for j, value in enumerate(t[name])
        ]

    def markdown(self) -> str:
        """The paper's number beside ours."""
        lines = [["**paper, as printed**", "", mean_and_sd(PAPER_RMSE), "", ""]]
        for rows, block in self.to_dict()["ours"].items():
            for name in ESTIMATORS:
                s = block[name]
                lines.append(
                    [rows.replace("rz", "theta"), name, mean_and_sd(s), number(s["median"]), number(s["worst"])]
                )
        return markdown_table(["rows", "way to learn", "RMSE, mean +- s.d.", "median", "worst"], lines)

    def figures(self) -> dict[str, Figure]:
        """Every rollout as a dot."""
        figure, axes = charts.new_figure(7.0, 3.4, 1, len(self.outcomes), sharey=True)
        for ax, rows in zip(axes[0], self.outcomes, strict=True):
            charts.strip(ax, {n: self.values(rows, n)[:400] for n in ESTIMATORS}, PAPER_RMSE["mean"])
            ax.set_title(rows.replace("rz", "theta").replace(" ", ", "))
        axes[0, 0].set_ylabel("RMSE of the policy [rad/s]")
        return {"rmse": figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None."""
        return {}
