"""The paper's drawer with a Sawyer arm: simulated from the model, and from this project's physics recordings.

The paper's arm is a real one and its data were not published. Its text says that Lambda selects x, and also that the
null space lies along x; both readings are here: one row (x) is commanded, or x is the free direction and y, z are
commanded. The physics recordings come in two kinds: one kinder than any real arm, and one with play, stick-slip, coarse
encoders and late velocities. Each trial draws 50 of the 50 recordings with replacement (a bootstrap resample), and
those that were not drawn are what the answer is tested on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.drawer_recordings import FRAME, HARD, KIND, sawyer_arm, turned_recordings
from manip_learn.experiments.metrics import mie, nmie, policy_rmse
from manip_learn.experiments.peers import closed_form_held, fit_places
from manip_learn.experiments.row_by_row import fit_row_by_row
from manip_learn.experiments.sawyer_result import SawyerResult
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

DEFAULT_POSE = np.deg2rad([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 250.0])
START_LOW, START_HIGH = np.deg2rad([0.0, 90.0] * 3 + [0.0]), np.deg2rad([10.0, 100.0] * 3 + [10.0])
STEP, DEMONSTRATIONS, POINTS = 0.01, 50, 10
ROLLOUTS, ROLLOUT_POINTS = 20, 100
DAMPING = 0.05  # of the rollouts' inverse [m]; targets may be out of reach

Source = Literal["model", "kind physics", "hard physics"]
Reading = Literal["constrained row", "free direction"]


@final
@dataclass(frozen=True)
class SawyerCase:
    """One way to read the paper's drawer.

    Attributes:
        source: Where the demonstrations come from.
        points: Samples of each demonstration; None for all.
        reading: What Lambda_x or Lambda_y says about its direction.
        direction: `"x"` or `"y"`.
    """

    source: Source
    points: int | None
    reading: Reading
    direction: str

    @property
    def said(self) -> str:
        """Source and number of samples in words."""
        return f"{self.source}, {'all samples' if self.points is None else f'{self.points} points each'}"


SOURCES: tuple[tuple[Source, int | None], ...] = (
    ("model", POINTS),
    ("kind physics", POINTS),
    ("kind physics", None),
    ("hard physics", POINTS),
    ("hard physics", None),
)
READINGS: tuple[Reading, ...] = ("constrained row", "free direction")
CASES = tuple(
    SawyerCase(source, points, reading, direction)
    for source, points in SOURCES
    for reading in READINGS
    for direction in ("x", "y")
)


def trials_of(trials: int) -> int:
    """Two fifths of the paper's number of trials: 20 of 50."""
    return max(1, round(0.4 * trials))


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials_of(trials) * len(CASES)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> SawyerResult:
    """All readings, simulated and recorded.

    Args:
        trials: Two fifths as many trials of each.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    outcomes = runner.map("sawyer", sawyer_trial, CASES, trials_of(trials), int(rng.integers(2**53)))
    return SawyerResult({(c.said, c.reading, c.direction): o for c, o in zip(CASES, outcomes, strict=True)})


def sawyer_trial(case: SawyerCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from 50 demonstrations, test on others.

    Returns:
        `mie` and `nmie` at the postures of the training set, `mie_held` and `nmie_held` at those held out,
        `angle_deg`, `rows`, `rows_true`, `rmse` of 20 rollouts; or `refused`. `others`: the published learners for
        b = 0 on the same recordings -> `angle_deg` and `nmie_held`.
    """
    features = FrameJacobian(sawyer_arm(), FRAME, _axes(case))
    Lambda = true_selection(case)
    true = Constraint(Lambda, features)
    demos, held_out = drawn(case, true, rng)
    test = np.concatenate([t.q for t in held_out])
    mu_test = manipulability_batch(true, test).mu
    others = _others(case, features, demos, true, test) if case.source != "model" else {}
    try:
        learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code, "rows_true": len(Lambda), "others": others}
    learnt, report = learner.constraint_, learner.report_
    q = np.concatenate([t.q for t in demos])
    mu, other = manipulability_batch(true, q).mu, manipulability_batch(learnt, q).mu
    other_test = manipulability_batch(learnt, test).mu
    return {
        "rows": learnt.n_constraints,
        "rows_true": len(Lambda),
        "estimator": report.estimator,
        "gap": report.gap,
        "angle_deg": float(np.degrees(row_space_angle(Lambda, learnt.selection))),
        "stated_deg": report.uncertainty_deg,
        "mie": mie(mu, other),
        "nmie": nmie(mu, other),
        "mie_held": mie(mu_test, other_test),
        "nmie_held": nmie(mu_test, other_test),
        "rmse": _rmse(true, learnt, rng),
        "others": others,
    }


def drawn(case: SawyerCase, true: Constraint, rng: np.random.Generator) -> tuple[Demonstrations, Demonstrations]:
    """What is learnt from, and what it is tested on: none of the latter is among the former."""
    if case.source == "model":
        return simulated(true, rng), simulated(true, rng)
    opens_along_x = (case.direction == "x") == (case.reading == "free direction")
    every = turned_recordings(opens_along_x, case.points, KIND if case.source == "kind physics" else HARD)
    chosen = rng.integers(len(every), size=DEMONSTRATIONS)
    left = sorted(set(range(len(every))) - set(chosen.tolist()))
    return Demonstrations(every[int(i)] for i in chosen), Demonstrations(every[i] for i in left)


def _others(
    case: SawyerCase, features: FrameJacobian, demos: Demonstrations, true: Constraint, test: np.ndarray
) -> dict[str, dict[str, float]]:
    s = true.n_constraints
    rates = np.concatenate([np.einsum("npv,nv->np", features.batch(t.q), t.u) for t in demos if t.u is not None])
    frame, axes = sawyer_arm().frame(FRAME), ["xyz".index(a) for a in features.row_names]
    places = [batch_kinematics(sawyer_arm(), frame).pose(t.q)[:, axes, 3] for t in demos]
    answers = {"held": closed_form_held(rates, s), "line": fit_places(places, s)}
    if case.points is not None:  # nine searches over all samples would take minutes
        samples = Samples.collect(features, demos)
        answers["row-by-row"] = samples.selection(fit_row_by_row(samples, s))
    mu = manipulability_batch(true, test).mu
    return {
        name: {
            "angle_deg": float(np.degrees(row_space_angle(true.selection, learnt))),
            "nmie_held": nmie(mu, manipulability_batch(Constraint(learnt, features), test).mu),
        }
        for name, learnt in answers.items()
    }


def true_selection(case: SawyerCase) -> Float[np.ndarray, "s p"]:
    """Rows of the true Lambda."""
    axes = _axes(case).split()
    constrained = [case.direction] if case.reading == "constrained row" else [a for a in axes if a != case.direction]
    return np.eye(len(axes))[[axes.index(a) for a in constrained]]


def _axes(case: SawyerCase) -> str:
    # a drawer always holds two rows; seen in the horizontal plane alone it holds one
    flat = case.source != "model" and case.reading == "constrained row"
    return "x y" if flat else "x y z"


def simulated(true: Constraint, rng: np.random.Generator) -> Demonstrations:
    """50 demonstrations of 10 points at 100 Hz: b = r* - r on the constrained rows, pi = default pose - q."""
    arm, features, Lambda = sawyer_arm(), true.features, true.selection
    frame = arm.frame(FRAME)
    q = rng.uniform(START_LOW, START_HIGH, size=(DEMONSTRATIONS, 7))
    targets = rng.uniform(-1.0, 1.0, size=(DEMONSTRATIONS, features.n_rows))
    postures, actions = [], []
    for _ in range(POINTS):
        A, r = Lambda @ features.batch(q), batch_kinematics(arm, frame).pose(q)[:, :3, 3]
        b, pi = (targets - r) @ Lambda.T, DEFAULT_POSE - q
        u = pi + np.einsum("nvs,ns->nv", np.linalg.pinv(A), b - np.einsum("nsv,nv->ns", A, pi))
        postures.append(q)
        actions.append(u)
        q = q + STEP * u
    time, names = STEP * np.arange(POINTS), arm.joint_names
    stacked = zip(np.array(postures).transpose(1, 0, 2), np.array(actions).transpose(1, 0, 2), strict=True)
    return Demonstrations(Trajectory(time, q, u, names, f"demonstration {i}") for i, (q, u) in enumerate(stacked))


def _rmse(true: Constraint, learnt: Constraint, rng: np.random.Generator) -> list[float]:
    """RMSE of pi_mu = grad mu, equation (13), against pi_mu~ on 20 rollouts of 100 points, stepped together.

    The rollouts follow u = A^T (A A^T + d^2 I)^-1 (b - A pi_mu) + pi_mu, equation (2) with a damped inverse, d = 0.05.
    """
    arm, features, Lambda = sawyer_arm(), true.features, true.selection
    frame, axes = arm.frame(FRAME), ["xyz".index(a) for a in features.row_names]
    q = rng.uniform(START_LOW, START_HIGH, size=(ROLLOUTS, 7))
    targets = rng.uniform(-1.0, 1.0, size=(ROLLOUTS, features.n_rows))
    climbing, learnt_climbing = [], []
    for _ in range(ROLLOUT_POINTS):
        pi = manipulability_batch(true, q).gradient
        climbing.append(pi)
        learnt_climbing.append(manipulability_batch(learnt, q).gradient)
        A, r = Lambda @ features.batch(q), batch_kinematics(arm, frame).pose(q)[:, axes, 3]
        gram = A @ A.transpose(0, 2, 1) + DAMPING**2 * np.eye(len(Lambda))
        b = (targets - r) @ Lambda.T - np.einsum("nsv,nv->ns", A, pi)
        q = q + STEP * (pi + np.einsum("nsv,ns->nv", A, np.linalg.solve(gram, b[:, :, None])[:, :, 0]))
    return policy_rmse(np.stack(climbing, axis=1), np.stack(learnt_climbing, axis=1)).tolist()
