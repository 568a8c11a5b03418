"""The paper's second comparison: a folded arm next to a singularity, the pseudo-inverse not truncated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments.paper_setup import true_constraint
from manip_learn.experiments.singular_start import starts
from manip_learn.experiments.start_comparison import BadStart, Claim, StartResult, compare
from manip_learn.experiments.trial_runner import TrialRunner

# r* is not stated in the paper: that of the first comparison
SETTING = BadStart(
    "near-singular-start",
    tuple(np.deg2rad([90.0, -180.0, -180.0 + 1e-10])),
    tuple(np.deg2rad([-33.0, -283.0, 193.0])),
    (0.0, 0.0),
    "exact",
)
CLAIMED = 1e9  # [rad]


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return starts(trials)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> StartResult:
    """Three policies at 50 and 100 Hz, our controller, and perturbed starts.

    Args:
        trials: Four fifths as many perturbed starts.
        rng: For demonstrations and perturbations.
        runner: Where the perturbed starts run.
    """
    paper_law, product, perturbed = compare(SETTING, starts(trials), rng, runner)
    return StartResult(SETTING, paper_law, product, perturbed, _claims(paper_law))


def _claims(paper_law: dict[float, dict[str, Rollout]]) -> tuple[Claim, ...]:
    claims = []
    for dt, rollouts in paper_law.items():
        at = f" (dt {dt:g} s)"
        after = np.abs(rollouts["zero"].q[1])
        seen = "joints at " + ", ".join(f"{x:.1e}" for x in after) + " rad"
        claims.append(
            Claim(f"The next state is beyond 1e9 rad in each joint{at}", "paper", seen, bool(np.all(after > CLAIMED)))
        )
        seen = f"joint 2 at {after[1]:.1e} rad"
        claims.append(Claim(f"... in one joint at least{at}", "check", seen, bool(np.any(after > CLAIMED))))
        first = {p: float(np.max(np.abs(r.u[0]))) for p, r in rollouts.items()}
        seen = ", ".join(f"{p} {v:.1e}" for p, v in first.items()) + " rad/s"
        claims.append(
            Claim(
                f"The manipulability policy avoids the first leap, which is A^+ b alone{at}",
                "check",
                seen,
                first["manipulability"] < 1e3,
            )
        )
        finals = {p: float(r.task_error[-1]) for p, r in rollouts.items()}
        seen = ", ".join(f"{p} {v:.2g}" for p, v in finals.items()) + " m"
        claims.append(Claim(f"After the leap all three arrive{at}", "check", seen, max(finals.values()) < 0.05))
    other = replace(SETTING, target=(1.0, 1.0)).law("zero", true_constraint("x y"))(SETTING.start)
    speed = float(np.max(np.abs(other.velocity)))
    claims.append(
        Claim(
            "The leap does not depend on r*, which is not stated",
            "check",
            f"r* = (1, 1): {speed:.2g} rad/s",
            speed > 1e9,
        )
    )
    return tuple(claims)
