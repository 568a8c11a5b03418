"""The paper's two comparisons of null-space policies from bad starts: at a singularity, and next to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments.paper_setup import true_constraint
from manip_learn.experiments.start_comparison import REACHED, BadStart, Claim, StartResult, compare
from manip_learn.experiments.trial_runner import TrialRunner

# first comparison: the arm is stretched out straight, the pseudo-inverse truncated
SINGULAR = BadStart(
    "singular-start",
    tuple(np.deg2rad([90.0 + 1e-12, 360.0, -360.0])),
    tuple(np.deg2rad([-190.0, 9.0, -307.0])),
    (0.0, 0.0),
    "truncated",
)
# second comparison: a folded arm, the pseudo-inverse not truncated; the paper does not state r*: that of the first
NEAR_SINGULAR = BadStart(
    "near-singular-start",
    tuple(np.deg2rad([90.0, -180.0, -180.0 + 1e-10])),
    tuple(np.deg2rad([-33.0, -283.0, 193.0])),
    (0.0, 0.0),
    "exact",
)
CLAIMED = 1e9  # [rad]


def size(trials: int) -> int:
    """Number of perturbed starts, which are the trials that are reported as progress: 40 at the paper's 50 trials."""
    return max(1, round(0.8 * trials))


def run_singular(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> StartResult:
    """Three policies at 50 and 100 Hz, our controller, and perturbed starts; from a singular posture.

    Args:
        trials: Four fifths as many perturbed starts.
        rng: For demonstrations and perturbations.
        runner: Where the perturbed starts run.
    """
    paper_law, product, perturbed = compare(SINGULAR, size(trials), rng, runner)
    return StartResult(SINGULAR, paper_law, product, perturbed, _singular_claims(paper_law))


def run_near_singular(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> StartResult:
    """The same from a posture 1e-10 degrees away from a singular one.

    Args:
        trials: Four fifths as many perturbed starts.
        rng: For demonstrations and perturbations.
        runner: Where the perturbed starts run.
    """
    paper_law, product, perturbed = compare(NEAR_SINGULAR, size(trials), rng, runner)
    return StartResult(NEAR_SINGULAR, paper_law, product, perturbed, _near_singular_claims(paper_law))


def _singular_claims(paper_law: dict[float, dict[str, Rollout]]) -> tuple[Claim, ...]:
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


def _near_singular_claims(paper_law: dict[float, dict[str, Rollout]]) -> tuple[Claim, ...]:
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
    other = replace(NEAR_SINGULAR, target=(1.0, 1.0)).law("zero", true_constraint("x y"))(NEAR_SINGULAR.start)
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
