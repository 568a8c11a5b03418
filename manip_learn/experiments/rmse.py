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
from manip_learn.experiments.experiment_result import (
    Panel,
    TrialsResult,
    markdown_table,
    mean_and_sd,
    number,
    said_rows,
    strips,
    summary,
)
from manip_learn.experiments.metrics import policy_rmse
from manip_learn.experiments.paper_setup import (
    PAPER_RMSE,
    SELECTIONS,
    Setup,
    constrained_motion,
    demonstrate,
    draw_starts,
    draw_targets,
    euler_steps,
    planar_features,
    tip,
)
from manip_learn.experiments.table import ESTIMATORS as WAYS
from manip_learn.experiments.table import SAID
from manip_learn.experiments.trial_runner import of_trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATORS = ("joint-affine", "joint-rbf", "separate")
# comparison -> words for tables; all with the root mean square over 100 points of the length of the difference
_KINDS = {
    "two_policies": "policies of two trajectories [rad/s]",
    "two_postures": "postures of two trajectories [rad]",
    "one_trajectory": "policies along one trajectory [rad/s]",
}
PRINTED_FOR = "x y"  # the constraint that the paper tested
_ROLLOUTS, _POINTS = 20, 100


@final
@dataclass(frozen=True)
class RmseCase:
    """The constrained rows of the paper's demonstrations, which are to be learnt."""

    rows: str


def rmse_trial(case: RmseCase, rng: np.random.Generator) -> dict[str, Any]:
    """Estimator -> each of `_KINDS` -> RMSE of each of 20 rollouts of 100 points; `size` of the true policy.

    pi_mu = grad mu, equation (13), with the true Lambda and with the learnt one; the task part has the true Lambda in
    both, so that the policies alone make the difference.
    """
    setup = Setup(case.rows)
    Lambda = setup.selection
    demos = demonstrate(setup, Lambda, rng)
    true = Constraint(Lambda, planar_features())
    starts, targets = draw_starts(_ROLLOUTS, rng), draw_targets(_ROLLOUTS, rng)
    q, pi = climbing_rollouts(true, starts, targets)
    out: dict[str, Any] = {}
    for name in ESTIMATORS:
        selection, _ = WAYS[name](planar_features(), demos, Lambda, np.random.default_rng(rng.integers(2**63)))
        learnt = Constraint(selection, planar_features())
        own_q, own_pi = climbing_rollouts(true, starts, targets, learnt)
        out[name] = {
            "two_policies": policy_rmse(pi, own_pi).tolist(),
            "two_postures": policy_rmse(q, own_q).tolist(),
            "one_trajectory": policy_rmse(pi, climb_along(learnt, q)).tolist(),
        }
    out["size"] = float(np.sqrt(np.mean(np.sum(pi**2, axis=-1))))
    return out


def climbing_rollouts(
    constraint: Constraint,
    q: Float[np.ndarray, "m 3"],
    targets: Float[np.ndarray, "m 3"],
    climbed: Constraint | None = None,
) -> tuple[Float[np.ndarray, "m T 3"], Float[np.ndarray, "m T 3"]]:
    """Postures and pi_mu under u = A^+ b + N pi_mu, equations (2) and (13), from m starts [rad] to m targets r*.

    b = Lambda (r* - r(q)); `climbed` is the constraint whose mu is climbed, that of the task by default.
    """

    def law(q: np.ndarray) -> np.ndarray:
        b = (targets - tip(q)) @ constraint.selection.T
        A = constraint.selection @ constraint.features.batch(q)
        return constrained_motion(A, b, manipulability_batch(climbed or constraint, q).gradient)

    postures, _ = euler_steps(law, q, _POINTS)
    return postures, climb_along(climbed or constraint, postures)


def climb_along(constraint: Constraint, q: Float[np.ndarray, "m T nq"]) -> Float[np.ndarray, "m T nv"]:
    """pi_mu = grad mu, equation (13), along trajectories."""
    return manipulability_batch(constraint, q.reshape(-1, q.shape[2])).gradient.reshape(q.shape)


@final
class RmseResult(TrialsResult):
    """RMSE of every rollout of every trial, see `rmse_trial`."""

    def _values(self, rows: str, estimator: str, kind: str) -> list[float]:
        return [v for t in self.outcomes[rows] for v in t[estimator][kind]]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours, over all rollouts; `policy_size` is the root mean square of the true policy."""
        ours = {
            rows: {name: {kind: summary(self._values(rows, name, kind)) for kind in _KINDS} for name in ESTIMATORS}
            | {"policy_size": float(np.mean([t["size"] for t in trials]))}
            for rows, trials in self.outcomes.items()
        }
        return {"paper": dict(PAPER_RMSE) | {"rows": PRINTED_FOR}, "ours": ours}

    def markdown(self) -> str:
        """The paper's number beside ours, for the constraint that it was measured with."""
        lines = []
        for rows, block in self.to_dict()["ours"].items():
            if rows == PRINTED_FOR:
                said = f"{PAPER_RMSE['mean']:.3e} +- {PAPER_RMSE['sd']:.3e}"
                lines.append([said_rows(rows), "**paper, as printed**", said, "", "", ""])
            for name in ESTIMATORS:
                first, *others = (mean_and_sd(block[name][kind]) for kind in _KINDS)
                worst = number(block[name]["two_policies"]["worst"])
                lines.append([said_rows(rows), SAID[name], first, worst, *others])
        first, *others = _KINDS.values()
        return markdown_table(["rows", "way to learn", first, "... worst", *others], lines)

    def figures(self) -> dict[str, Figure]:
        """Every rollout as a dot, the way of the paper above."""
        panels = [
            [
                Panel(
                    {SAID[name]: self._values(rows, name, kind) for name in ESTIMATORS},
                    f"RMSE, {_KINDS[kind]}".replace(" [", "\n["),
                    f"constrained rows {said_rows(rows)}" if kind == "two_policies" else "",
                    PAPER_RMSE["mean"] if (rows, kind) == (PRINTED_FOR, "two_policies") else None,
                )
                for rows in self.outcomes
            ]
            for kind in ("two_policies", "one_trajectory")
        ]
        return {"rmse": strips(panels, "way to learn; a dot is a rollout, a bar the median", 9.0, 6.4)}


RMSE = of_trials("rmse", rmse_trial, {rows: RmseCase(rows) for rows in SELECTIONS}, RmseResult)
