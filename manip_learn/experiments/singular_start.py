"""The paper's first comparison: an arm stretched out straight, the pseudo-inverse truncated."""

from __future__ import annotations

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments.start_comparison import REACHED, BadStart, Claim, StartResult, compare
from manip_learn.experiments.trial_runner import TrialRunner

SETTING = BadStart(
    "singular-start",
    tuple(np.deg2rad([90.0 + 1e-12, 360.0, -360.0])),
    tuple(np.deg2rad([-190.0, 9.0, -307.0])),
    (0.0, 0.0),
    "truncated",
)


def starts(trials: int) -> int:
    """Number of perturbed starts: 40 at the paper's 50 trials."""
    return max(1, round(0.8 * trials))


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
        zero, attractor, climb = rollouts["zero"], rollouts["attractor"], rollouts["manipulability"]
        stuck, left = float(zero.task_error[-1]), float(attractor.task_error[-1])
        claims.append(
            Claim(
                f"The zero policy never leaves the singularity{at}", "paper", f"error stays {stuck:.3g} m", stuck > 2.9
            )
        )
        claims.append(Claim(f"The attractor arrives{at}", "paper", f"final error {left:.2g} m", left < REACHED))
        low = 3 + int(np.argmin(attractor.manipulability[3:]))
        mu = float(attractor.manipulability[low])
        seen = f"mu {mu:.2g} at step {low}, joint speed up to {np.max(np.abs(attractor.u)):.0f} rad/s"
        claims.append(Claim(f"... but comes near another singularity on its way{at}", "paper", seen, mu < 0.1))
        final, least = float(climb.task_error[-1]), float(np.min(climb.manipulability[3:]))
        seen = f"final error {final:.2g} m, mu >= {least:.3f} from step 3"
        claims.append(
            Claim(
                f"The manipulability policy arrives and stays away from singularities{at}",
                "paper",
                seen,
                final < REACHED and least > 0.5,
            )
        )
        seen = f"first steps up to {np.max(np.abs(climb.u[:3])):.0f} rad/s"
        claims.append(
            Claim(
                f"Its velocities could be followed by an arm (pi rad/s){at}",
                "check",
                seen,
                bool(np.max(np.abs(climb.u)) < np.pi),
            )
        )
    return tuple(claims)
