"""The paper's drawer with a Sawyer arm: simulated from the model, and from this project's physics recordings.

The paper's arm is a real one and its data were not published. Its text says that Lambda selects x, and also that the
null space lies along x; both readings are here: one row (x) is commanded, or x is the free direction and y, z are
commanded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.rollout import Rollout
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments import charts
from manip_learn.experiments.drawer_recordings import FRAME, sawyer_arm, turned_recordings
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, mean_and_sd, number, summary
from manip_learn.experiments.metrics import mie, nmie, policy_rmse
from manip_learn.experiments.paper_setup import PAPER_SAWYER_MIE, PAPER_SAWYER_RMSE
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT_POSE = np.deg2rad([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 250.0])
START_LOW, START_HIGH = np.deg2rad([0.0, 90.0] * 3 + [0.0]), np.deg2rad([10.0, 100.0] * 3 + [10.0])
STEP, DEMONSTRATIONS, POINTS = 0.01, 50, 10
ROLLOUTS, ROLLOUT_POINTS = 20, 100
DAMPING = 0.05  # of the rollouts' inverse [m]; targets may be out of reach

Source = Literal["model", "physics, 10 points each", "physics, all samples"]
Reading = Literal["constrained row", "free direction"]


@final
@dataclass(frozen=True)
class SawyerCase:
    """One way to read the paper's drawer.

    Attributes:
        source: Where the demonstrations come from.
        reading: What Lambda_x or Lambda_y says about its direction.
        direction: `"x"` or `"y"`.
    """

    source: Source
    reading: Reading
    direction: str


CASES = tuple(
    SawyerCase(source, reading, direction)
    for source in ("model", "physics, 10 points each", "physics, all samples")
    for reading in ("constrained row", "free direction")
    for direction in ("x", "y")
)


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials * len(CASES)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> SawyerResult:
    """All readings, simulated and recorded.

    Args:
        trials: Number of trials of each; the recordings are resampled (drawn with replacement) in each.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    outcomes = runner.map("sawyer", sawyer_trial, CASES, trials, int(rng.integers(2**53)))
    return SawyerResult(dict(zip(CASES, outcomes, strict=True)))


def sawyer_trial(case: SawyerCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from 50 demonstrations; `mie`, `nmie`, `angle_deg`, `rows`, `rmse` of 20 rollouts; or `refused`."""
    features = FrameJacobian(sawyer_arm(), FRAME, _axes(case))
    Lambda = true_selection(case)
    true = Constraint(Lambda, features)
    if case.source == "model":
        demos = simulated(true, rng)
    else:
        opens_along_x = (case.direction == "x") == (case.reading == "free direction")
        every = turned_recordings(opens_along_x, POINTS if "10" in case.source else None)
        demos = Demonstrations(every[int(i)] for i in rng.integers(len(every), size=DEMONSTRATIONS))
    try:
        learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code}
    learnt, report = learner.constraint_, learner.report_
    out = {
        "rows": learnt.n_constraints,
        "estimator": report.estimator,
        "gap": report.gap,
        "angle_deg": float(np.degrees(row_space_angle(Lambda, learnt.selection))),
    }
    q = np.concatenate([t.q for t in demos])
    mu, other = manipulability_batch(true, q).mu, manipulability_batch(learnt, q).mu
    return out | {"mie": mie(mu, other), "nmie": nmie(mu, other), "rmse": _rmse(true, learnt, rng)}


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


@final
@dataclass(frozen=True, eq=False)
class SawyerResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Case -> one dictionary per trial, see `sawyer_trial`.
    """

    outcomes: dict[SawyerCase, list[dict[str, Any]]]

    def values(self, case: SawyerCase, what: str) -> list[float]:
        """One number per trial that was not refused."""
        return [t[what] for t in self.outcomes[case] if what in t]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours; source, reading and direction make the key."""
        ours = {}
        for case, trials in self.outcomes.items():
            rows = len(true_selection(case))
            ours[f"{case.source} | {case.reading} | {case.direction}"] = {
                "mie": summary(self.values(case, "mie")),
                "nmie": summary(self.values(case, "nmie")),
                "angle_deg": summary(self.values(case, "angle_deg")),
                "rmse": summary(v for t in trials for v in t.get("rmse", ())),
                "rows_right": sum(t.get("rows") == rows for t in trials) / len(trials),
            }
        paper = {
            "mie": PAPER_SAWYER_MIE,
            "rmse": dict(PAPER_SAWYER_RMSE),
            "note": "a real Sawyer, data unpublished: the paper's numbers hold the friction, compliance and noise of "
            "an arm that we do not have",
        }
        return {"paper": paper, "ours": ours}

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial."""
        return [
            {
                "source": case.source,
                "reading": case.reading,
                "direction": case.direction,
                "trial": i,
                **{k: t.get(k, "") for k in ("refused", "estimator", "rows", "gap", "angle_deg", "mie", "nmie")},
                "rmse_mean": float(np.mean(t["rmse"])) if "rmse" in t else "",
            }
            for case, trials in self.outcomes.items()
            for i, t in enumerate(trials)
        ]

    def markdown(self) -> str:
        """All readings beside the paper's numbers."""
        lines = [
            [
                "**paper, a real arm**",
                "",
                "",
                number(PAPER_SAWYER_MIE),
                "",
                "",
                mean_and_sd(PAPER_SAWYER_RMSE),
                "",
            ]
        ]
        for case in self.outcomes:
            block = self.to_dict()["ours"][f"{case.source} | {case.reading} | {case.direction}"]
            lines.append([case.source, case.reading, case.direction, number(block["mie"]["median"])])
            lines[-1] += [
                number(block["nmie"]["median"]),
                f"{number(block['angle_deg']['median'])} ({number(block['angle_deg']['worst'])})",
            ]
            lines[-1] += [mean_and_sd(block["rmse"]), f"{100 * block['rows_right']:.0f} %"]
        header = ["demonstrations", "reading", "Lambda", "MIE, median", "NMIE, median", "angle [deg], median (worst)"]
        return markdown_table([*header, "RMSE, mean +- s.d.", "rows found"], lines)

    def figures(self) -> dict[str, Figure]:
        """MIE and RMSE of every trial."""
        figure, axes = charts.new_figure(9.0, 4.4, 1, 2)
        labels = {
            f"{c.source.replace('physics, ', 'physics ')}, {c.reading.split()[0]} {c.direction}": c
            for c in self.outcomes
        }
        charts.strip(axes[0, 0], {k: self.values(c, "mie") for k, c in labels.items()}, PAPER_SAWYER_MIE)
        axes[0, 0].set_ylabel("MIE")
        means = {k: [float(np.mean(v)) for v in self.values(c, "rmse")] for k, c in labels.items()}  # type: ignore[arg-type]
        charts.strip(axes[0, 1], means, PAPER_SAWYER_RMSE["mean"])
        axes[0, 1].set_ylabel("RMSE of the policy")
        for ax in axes[0]:
            ax.tick_params(axis="x", labelsize=6.5)
        return {"sawyer": figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None."""
        return {}
