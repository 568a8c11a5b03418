"""The paper's drawer with a Sawyer arm: simulated from the model, and from this project's physics recordings.

The paper's arm is a real one and its data were not published. Its text says that Lambda selects x, and also that the
null space lies along x; both readings are here: one row (x) is commanded, or x is the free direction and y, z are
commanded. The physics recordings, turned so that the drawer opens along x or along y, come in two kinds: one easier
than any real arm, and one with backlash, stick-slip, coarse encoders and delayed velocities. Each trial
draws 50 of the 50 recordings with replacement (a bootstrap resample); the answer is tested on the recordings that were
not drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.random import Generator

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability import manipulability_batch
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments import paper_setup as paper
from manip_learn.experiments.charts import Figures, Panel, strips
from manip_learn.experiments.metrics import mie, nmie, policy_rmse
from manip_learn.experiments.results import TrialsResult, markdown_table, mean_and_sd, number, share, summary
from manip_learn.experiments.rmse import climb
from manip_learn.experiments.trials import Trials
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.load import load_demonstrations
from manip_learn.recordings.trajectory import Demonstrations, Trajectory, subsample
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

_STEP, _POINTS = 0.01, 10  # [s] time step; samples of a demonstration
FRAME = "right_gripper_tip"
# source -> recordings
FOLDERS = {"kind physics": "sawyer_drawer", "hard physics": "sawyer_drawer_hard"}
READINGS = ("constrained row", "free direction")
BETWEEN = " | "  # separator of the words of a case


@cache
def sawyer_arm() -> Robot:
    """Return the shipped Sawyer-like arm."""
    return load_robot("sawyer")


@dataclass(frozen=True)
class SawyerCase:
    """Interpretation of the paper's drawer experiment, with a source of demonstrations.

    Attributes:
        source: Origin of the demonstrations: `"model"` for motions simulated with the model, or a key of `FOLDERS` for
            recordings from a physics simulation. One kind has a grip within a micrometre, noise of 1e-4 rad, 100 Hz,
            and velocities derived from the positions. The other has 2 mm of backlash in the grip, stick-slip, noise of
            1e-3 rad, 20 Hz, and recorded velocities that are 60 ms old.
        points: Number of samples of each demonstration; None for all.
        reading: Meaning of the direction of Lambda_x or Lambda_y in the paper's text, one of `READINGS`.
        direction: `"x"` or `"y"`.
    """

    source: str
    points: int | None
    reading: str
    direction: str

    @property
    def name(self) -> str:
        """Name of the case: source, number of samples, reading and direction in words."""
        samples = "all samples" if self.points is None else f"{self.points} points each"
        return BETWEEN.join((f"{self.source}, {samples}", self.reading, self.direction))

    @property
    def constraint(self) -> Constraint:
        """True constraint, whose Lambda selects whole rows of the gripper tip's position."""
        is_row = self.reading == "constrained row"
        # a drawer always constrains two rows; in the horizontal plane alone it constrains one
        axes = ["x", "y"] if is_row and self.source != "model" else ["x", "y", "z"]
        rows = [i for i, axis in enumerate(axes) if (axis == self.direction) == is_row]
        return Constraint(np.eye(len(axes))[rows], FrameJacobian(sawyer_arm(), FRAME, " ".join(axes)))


_SOURCES: list[tuple[str, int | None]] = [("model", _POINTS), *product(FOLDERS, (_POINTS, None))]
_ALL = [SawyerCase(*source, reading, axis) for source in _SOURCES for reading in READINGS for axis in "xy"]
CASES = {case.name: case for case in _ALL}


def sawyer_trial(case: SawyerCase, rng: Generator) -> dict[str, Any]:
    """Learn a constraint from 50 demonstrations, and measure its errors on others.

    Args:
        case: Source of the demonstrations and interpretation of the paper.
        rng: Random generator of the trial.

    Returns:
        Dictionary with the errors `mie` and `nmie` (see `metrics`) at the configurations of the training set,
        `mie_held` and `nmie_held` at held-out ones, the angle to the true row space `angle_deg`, the numbers of learnt
        and true rows `rows` and `rows_true`, and the `rmse` of 20 rollouts; or only `refused`, the reason why nothing
        was learnt.
    """
    true = case.constraint
    train, test = drawn(case, rng)
    out: dict[str, Any] = {"rows_true": true.n_constraints}
    try:
        learner = ConstraintLearner(true.features, velocities="recorded", seed=int(rng.integers(2**31))).fit(train)
    except NotIdentifiableError as error:
        return out | {"refused": error.code}
    estimate, report = learner.constraint_, learner.report_
    out |= {"rows": estimate.n_constraints, "estimator": report.estimator, "gap": report.gap}
    out["angle_deg"] = float(np.degrees(row_space_angle(true.selection, estimate.selection)))
    out["stated_deg"] = report.uncertainty_deg
    for suffix, demonstrations in (("", train), ("_held", test)):
        q = np.concatenate([t.q for t in demonstrations])
        mu, other = manipulability_batch(true, q).mu, manipulability_batch(estimate, q).mu
        out |= {f"mie{suffix}": mie(mu, other), f"nmie{suffix}": nmie(mu, other)}
    # compare pi_mu = grad mu, equation (13), with pi_mu~ on 20 rollouts of 100 points under pi_mu
    damping = 0.05  # [m] targets may be out of reach
    postures, _ = motions(true, partial(climb, true), 20, 100, rng, damping)
    return out | {"rmse": policy_rmse(climb(true, postures), climb(estimate, postures)).tolist()}


def motions(
    true: Constraint, policy: paper.Law, n: int, points: int, rng: Generator, damping: float = 0.0
) -> paper.Motions:
    """Simulate motions at 100 Hz from random start configurations to random targets of the gripper tip.

    Args:
        true: True constraint of the task.
        policy: Null-space policy: function from joint positions (n, 7) to velocities (n, 7) [rad/s].
        n: Number of motions.
        points: Number of samples of each motion.
        rng: Random generator.
        damping: Damping of the inverse [m], see `paper_setup.reach`.
    """
    axes = ["xyz".index(axis) for axis in true.features.row_names]
    kinematics = sawyer_arm().frame_kinematics(FRAME)
    low, high = np.deg2rad([0.0, 90.0] * 3 + [0.0]), np.deg2rad([10.0, 100.0] * 3 + [10.0])  # the paper's range
    starts = rng.uniform(low, high, size=(n, 7))
    targets = rng.uniform(-1.0, 1.0, size=(n, len(axes)))
    return paper.reach(true, policy, lambda q: kinematics.poses(q)[:, axes, 3], starts, targets, points, _STEP, damping)


def drawn(case: SawyerCase, rng: Generator) -> tuple[Demonstrations, Demonstrations]:
    """Draw demonstrations to learn from, and different ones to test on.

    Args:
        case: Source of the demonstrations and interpretation of the paper.
        rng: Random generator of the trial.
    """
    n = 50
    if case.source == "model":
        # the paper's goal of the null-space policy
        rest = np.deg2rad([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 250.0])
        settings = case.constraint, lambda q: rest - q, n, _POINTS, rng
        train, test = (paper.to_demonstrations(sawyer_arm(), _STEP, motions(*settings)) for _ in range(2))
        return train, test
    opens_along_x = (case.direction == "x") == (case.reading == "free direction")
    every = turned_recordings(FOLDERS[case.source], opens_along_x, case.points)
    indices = rng.integers(len(every), size=n)
    others = np.setdiff1d(np.arange(len(every)), indices)
    return Demonstrations(every[int(i)] for i in indices), Demonstrations(every[int(i)] for i in others)


def turned_recordings(folder: str, along_x: bool, points: int | None) -> Demonstrations:
    """Return all recorded demonstrations as if the arm's base were rotated, so that the drawer opens along x or y.

    A rotation of the base about its vertical axis is exactly an offset of the first joint.

    Args:
        folder: Name of the shipped recordings.
        along_x: True if the drawer opens along x; else it opens along y.
        points: Number of samples of each demonstration; None for all.
    """
    offset = -np.deg2rad(25.0) + (0.0 if along_x else np.pi / 2)  # the recorded drawer opens at 25 degrees from x
    shift = np.eye(7)[sawyer_arm().joint_names.index("right_j0")] * offset
    turned = (Trajectory(t.time, t.q + shift, t.u, t.joint_names, t.name) for t in _recordings(folder))
    return Demonstrations(t if points is None else subsample(t, points) for t in turned)


@cache
def _recordings(folder: str) -> Demonstrations:
    return with_velocities(load_demonstrations(folder, sawyer_arm(), velocities="recorded"), sawyer_arm())


class SawyerResult(TrialsResult):
    """Outcomes of all trials of each `SawyerCase`, see `sawyer_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Return the paper's numbers (`paper`) and statistics of all trials (`ours`) as a dictionary."""
        ours, errors = {}, ("mie", "nmie", "mie_held", "nmie_held", "angle_deg")
        for case, trials in self.outcomes.items():
            ours[case] = {error: summary(t.get(error) for t in trials) for error in errors} | {
                "rmse": summary(v for t in trials for v in t.get("rmse", ())),
                "rows_right": share(t.get("rows") == t["rows_true"] for t in trials),
                "inside": share(t["angle_deg"] <= t["stated_deg"] for t in trials if t.get("stated_deg") is not None),
            }
        note = "a real Sawyer, data unpublished: friction, compliance and noise of an arm that we do not have"
        printed = {"mie": paper.PAPER_SAWYER_MIE, "rmse": dict(paper.PAPER_SAWYER_RMSE), "note": note}
        return {"paper": printed, "ours": ours}

    def markdown(self) -> str:
        """Return a Markdown table of all cases, with the paper's numbers."""
        printed = [number(paper.PAPER_SAWYER_MIE), "", "", "", mean_and_sd(paper.PAPER_SAWYER_RMSE), ""]
        lines = [["**paper, a real arm**", "", "", *printed]]
        for case, block in self.to_dict()["ours"].items():
            errors = [number(block[error]["median"]) for error in ("mie", "mie_held", "nmie_held", "angle_deg")]
            errors[-1] += f" ({number(block['angle_deg']['worst'])})"
            rows_right = f"{100.0 * block['rows_right']:.0f} %"
            lines.append([*case.split(BETWEEN), *errors, mean_and_sd(block["rmse"]), rows_right])
        header = ["demonstrations", "reading", "Lambda", "MIE, training", "MIE, held out", "NMIE, held out"]
        return markdown_table([*header, "angle [deg], median (worst)", "RMSE, mean +- s.d.", "rows found"], lines)

    def figures(self) -> Figures:
        """Draw the manipulability error (MIE) on held-out recordings and the policy error (RMSE) of every trial.

        Returns:
            Dictionary from the name of the figure to the figure.
        """
        completed: dict[str, list[dict[str, Any]]] = {}
        for case, trials in self.outcomes.items():
            source, reading, direction = case.split(BETWEEN)
            completed[f"{source}: {reading.split()[0]} {direction}"] = [t for t in trials if "rmse" in t]
        errors = {label: [t["mie_held"] for t in trials] for label, trials in completed.items()}
        means = {label: [float(np.mean(t["rmse"])) for t in trials] for label, trials in completed.items()}
        mie_label = "MIE on held-out recordings\n[m$^2$ for one row, m$^4$ for two]"
        rmse_label = "RMSE of the policy, mean of 20 rollouts\n[m/rad for one row, m$^2$/rad for two]"
        first = Panel(errors, mie_label, paper=paper.PAPER_SAWYER_MIE)
        panels = [[first], [Panel(means, rmse_label, paper=paper.PAPER_SAWYER_RMSE["mean"])]]
        return {"sawyer": strips(panels, "recordings: reading of Lambda; a dot is a trial, a bar the median", 9.0, 9.0)}


SAWYER = Trials("sawyer", sawyer_trial, CASES, SawyerResult, 0.4)
