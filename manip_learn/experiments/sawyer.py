"""The paper's drawer with a Sawyer arm: simulated from the model, and from this project's physics recordings.

The paper's arm is a real one and its data were not published. Its text says that Lambda selects x, and also that the
null space lies along x; both readings are here: one row (x) is commanded, or x is the free direction and y, z are
commanded. The physics recordings, turned so that the drawer opens along x or along y, come in two kinds: one kinder
than any real arm, and one with play, stick-slip, coarse encoders and late velocities. Each trial draws 50 of the 50
recordings with replacement (a bootstrap resample), and those that were not drawn are what the answer is tested on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.experiment_result import (
    Panel,
    TrialsResult,
    markdown_table,
    mean_and_sd,
    median_and_worst,
    number,
    percent,
    share,
    strips,
    summary,
)
from manip_learn.experiments.metrics import mie, nmie, policy_rmse
from manip_learn.experiments.paper_setup import (
    PAPER_SAWYER_MIE,
    PAPER_SAWYER_RMSE,
    constrained_motion,
    euler_steps,
    recorded,
)
from manip_learn.experiments.rmse import climb_along
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.load import load_demonstrations
from manip_learn.recordings.trajectory import Demonstrations, Trajectory, subsample
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# the paper's numbers: the pose that the null-space policy leads to [rad], and the starts
DEFAULT_POSE = np.deg2rad([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 250.0])
_START_LOW, _START_HIGH = np.deg2rad([0.0, 90.0] * 3 + [0.0]), np.deg2rad([10.0, 100.0] * 3 + [10.0])  # [rad]
_STEP, DEMONSTRATIONS, _POINTS = 0.01, 50, 10  # [s]
_ROLLOUTS, ROLLOUT_POINTS = 20, 100  # that the RMSE is taken over, samples of each
FRAME = "right_gripper_tip"
KIND, HARD = "sawyer_drawer", "sawyer_drawer_hard"
Source = Literal["model", "kind physics", "hard physics"]
Reading = Literal["constrained row", "free direction"]
BETWEEN = " | "  # the words of a case


@cache
def sawyer_arm() -> Robot:
    """The shipped Sawyer-like arm."""
    return load_robot("sawyer")


def turned_recordings(along_x: bool, points: int | None, folder: str = KIND) -> Demonstrations:
    """All demonstrations, as from an arm whose base is turned.

    The first joint turns about the vertical through the base: turning the base is an offset of that joint, exactly.

    Args:
        along_x: The drawer opens along x; else along y.
        points: So many samples of each demonstration; None for all.
        folder: `KIND`: grip within a micrometre, noise of 1e-4 rad, 100 Hz, velocities derived from the positions.
            `HARD`: 2 mm of play in the grip, stick and slip, 1e-3 rad, 20 Hz, velocities as recorded, 60 ms old.
    """
    offset = -np.deg2rad(25.0) + (0.0 if along_x else np.pi / 2)  # the recorded drawer opens at 25 degrees from x
    shift = np.eye(7)[sawyer_arm().joint_names.index("right_j0")] * offset
    out = []
    for t in _recordings(folder):
        turned = Trajectory(t.time, t.q + shift, t.u, t.joint_names, t.name)
        out.append(turned if points is None else subsample(turned, points))
    return Demonstrations(out)


@cache
def _recordings(name: str) -> Demonstrations:
    return with_velocities(load_demonstrations(name, sawyer_arm(), velocities="recorded"), sawyer_arm())


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


CASES = {
    BETWEEN.join((case.said, case.reading, case.direction)): case
    for source in get_args(Source)
    for points in ((_POINTS,) if source == "model" else (_POINTS, None))
    for reading in ("constrained row", "free direction")
    for direction in ("x", "y")
    for case in [SawyerCase(source, points, reading, direction)]
}


def sawyer_trial(case: SawyerCase, rng: Generator) -> dict[str, Any]:
    """Learn from 50 demonstrations, test on others.

    Returns:
        `mie` and `nmie` at the postures of the training set, `mie_held` and `nmie_held` at those held out,
        `angle_deg`, `rows`, `rows_true`, `rmse` of 20 rollouts; or `refused`.
    """
    features = FrameJacobian(sawyer_arm(), FRAME, _axes(case))
    Lambda = true_selection(case)
    true = Constraint(Lambda, features)
    demos, held_out = drawn(case, true, rng)
    test = np.concatenate([t.q for t in held_out])
    mu_test = manipulability_batch(true, test).mu
    try:
        learner = ConstraintLearner(features, velocities="recorded", seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code, "rows_true": len(Lambda)}
    learnt, report = learner.constraint_, learner.report_
    damping = 0.05  # [m] of the inverse: targets may be out of reach
    climbed, _ = steps(true, lambda q: manipulability_batch(true, q).gradient, _ROLLOUTS, ROLLOUT_POINTS, damping, rng)
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
        # of pi_mu = grad mu, equation (13), against pi_mu~ on 20 rollouts of 100 points under pi_mu
        "rmse": policy_rmse(climb_along(true, climbed), climb_along(learnt, climbed)).tolist(),
    }


def drawn(case: SawyerCase, true: Constraint, rng: Generator) -> tuple[Demonstrations, Demonstrations]:
    """Demonstrations to learn from, and others to test on: none is in both."""
    if case.source == "model":
        return simulated(true, rng), simulated(true, rng)
    opens_along_x = (case.direction == "x") == (case.reading == "free direction")
    every = turned_recordings(opens_along_x, case.points, KIND if case.source == "kind physics" else HARD)
    chosen = rng.integers(len(every), size=DEMONSTRATIONS)
    left = sorted(set(range(len(every))) - set(chosen.tolist()))
    return Demonstrations(every[int(i)] for i in chosen), Demonstrations(every[i] for i in left)


def true_selection(case: SawyerCase) -> Float[np.ndarray, "s p"]:
    """Rows of the true Lambda."""
    axes = _axes(case).split()
    constrained = [case.direction] if case.reading == "constrained row" else [a for a in axes if a != case.direction]
    return np.eye(len(axes))[[axes.index(a) for a in constrained]]


def _axes(case: SawyerCase) -> str:
    # a drawer always holds two rows; seen in the horizontal plane alone it holds one
    flat = case.source != "model" and case.reading == "constrained row"
    return "x y" if flat else "x y z"


def places(features: FeatureMap, q: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n p"]:
    """r, the coordinates of the grip whose rates are the rows of Phi [m]."""
    axes = ["xyz".index(axis) for axis in features.row_names]
    return batch_kinematics(sawyer_arm(), sawyer_arm().frame(FRAME)).pose(q)[:, axes, 3]


def steps(
    true: Constraint, policy: Callable[[np.ndarray], np.ndarray], n: int, points: int, damping: float, rng: Generator
) -> tuple[Float[np.ndarray, "n T 7"], Float[np.ndarray, "n T 7"]]:
    """Postures and velocities of n motions from random starts to random targets, b = Lambda (r* - r), at 100 Hz."""
    start = rng.uniform(_START_LOW, _START_HIGH, size=(n, 7))
    targets = rng.uniform(-1.0, 1.0, size=(n, true.features.n_rows))

    def law(q: np.ndarray) -> np.ndarray:
        b = (targets - places(true.features, q)) @ true.selection.T
        return constrained_motion(true.selection @ true.features.batch(q), b, policy(q), damping)

    return euler_steps(law, start, points, _STEP)


def simulated(true: Constraint, rng: Generator) -> Demonstrations:
    """50 demonstrations of 10 points at 100 Hz: b = r* - r on the constrained rows, pi = default pose - q."""
    q, u = steps(true, lambda q: DEFAULT_POSE - q, DEMONSTRATIONS, _POINTS, 0.0, rng)
    return recorded(_STEP, q, u, sawyer_arm().joint_names, "demonstration")


@final
class SawyerResult(TrialsResult):
    """Outcome of every trial, see `sawyer_trial`; a case is its source, its reading and its direction."""

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours."""
        ours, errors = {}, ("mie", "nmie", "mie_held", "nmie_held", "angle_deg")
        for case, trials in self.outcomes.items():
            ours[case] = {what: summary(t.get(what) for t in trials) for what in errors} | {
                "rmse": summary(v for t in trials for v in t.get("rmse", ())),
                "rows_right": share(t.get("rows") == t["rows_true"] for t in trials),
                "inside": share(t["angle_deg"] <= t["stated_deg"] for t in trials if t.get("stated_deg") is not None),
            }
        paper = {
            "mie": PAPER_SAWYER_MIE,
            "rmse": dict(PAPER_SAWYER_RMSE),
            "note": "a real Sawyer, data unpublished: the paper's numbers hold the friction, compliance and noise of "
            "an arm that we do not have",
        }
        return {"paper": paper, "ours": ours}

    def markdown(self) -> str:
        """All readings beside the paper's numbers."""
        mie_of_paper, rmse_of_paper = number(PAPER_SAWYER_MIE), mean_and_sd(PAPER_SAWYER_RMSE)
        lines = [["**paper, a real arm**", "", "", mie_of_paper, "", "", "", rmse_of_paper, ""]]
        for key, block in self.to_dict()["ours"].items():
            case = key.split(BETWEEN)
            lines.append([*case, *(number(block[w]["median"]) for w in ("mie", "mie_held", "nmie_held"))])
            lines[-1].append(median_and_worst(block["angle_deg"]))
            lines[-1] += [mean_and_sd(block["rmse"]), percent(block["rows_right"])]
        header = ["demonstrations", "reading", "Lambda", "MIE, training", "MIE, held out", "NMIE, held out"]
        header += ["angle [deg], median (worst)", "RMSE, mean +- s.d.", "rows found"]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """MIE on held-out recordings and RMSE of every trial."""
        errors, means = {}, {}
        for case, trials in self.outcomes.items():
            source, reading, direction = case.split(BETWEEN)
            label = f"{source}: {reading.split()[0]} {direction}"
            errors[label] = [t["mie_held"] for t in trials if "mie_held" in t]
            means[label] = [float(np.mean(t["rmse"])) for t in trials if "rmse" in t]
        panels = [
            [Panel(errors, "MIE on held-out recordings\n[m$^2$ for one row, m$^4$ for two]", paper=PAPER_SAWYER_MIE)],
            [
                Panel(
                    means,
                    "RMSE of the policy, mean of 20 rollouts\n[m/rad for one row, m$^2$/rad for two]",
                    paper=PAPER_SAWYER_RMSE["mean"],
                )
            ],
        ]
        return {"sawyer": strips(panels, "recordings: reading of Lambda; a dot is a trial, a bar the median", 9.0, 9.0)}


SAWYER = of_trials("sawyer", sawyer_trial, CASES, SawyerResult, 0.4)
