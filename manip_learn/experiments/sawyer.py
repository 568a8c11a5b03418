"""The paper's drawer with a Sawyer arm: simulated from the model, and from this project's physics recordings.

The paper's arm is a real one and its data were not published. Its text says that Lambda selects x, and also that the
null space lies along x; both readings are here: one row (x) is commanded, or x is the free direction and y, z are
commanded. The physics recordings, turned so that the drawer opens along x or along y, come in two kinds: one kinder
than any real arm, and one with play, stick-slip, coarse encoders and late velocities. Each trial draws 50 of the 50
recordings with replacement (a bootstrap resample), and those that were not drawn are what the answer is tested on.
"""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import (
    ExperimentResult,
    compare_pairs,
    markdown_table,
    mean_and_sd,
    median_and_worst,
    number,
    percent,
    said_pair,
    summary,
)
from manip_learn.experiments.metrics import mie, nmie, policy_rmse
from manip_learn.experiments.paper_setup import PAPER_SAWYER_MIE, PAPER_SAWYER_RMSE
from manip_learn.experiments.trial_runner import of_trials, two_fifths
from manip_learn.experiments.ways import SAID, closed_form_held, fit_places, fit_row_by_row
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import load_demonstrations
from manip_learn.recordings.preprocessing import subsample
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME = "right_gripper_tip"
KIND, HARD = "sawyer_drawer", "sawyer_drawer_hard"
DRAWER_DIRECTION = np.deg2rad(25.0)  # of the recordings, about the vertical, from x


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
    offset = -DRAWER_DIRECTION + (0.0 if along_x else np.pi / 2)
    shift = np.eye(7)[sawyer_arm().joint_names.index("right_j0")] * offset
    out = []
    for t in _recordings(folder):
        turned = Trajectory(t.time, t.q + shift, t.u, t.joint_names, t.name)
        out.append(turned if points is None else subsample(turned, points))
    return Demonstrations(out)


@cache
def _recordings(name: str) -> Demonstrations:
    files = sorted(recordings_folder(name).glob("*.csv"))
    return with_velocities(load_demonstrations(files, sawyer_arm()), sawyer_arm())


def recordings_folder(name: str) -> Path:
    """A folder of shipped recordings, of the installed package or of the repository.

    Raises:
        RecordingError: It is in neither.
    """
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_recordings"
    here = Path(__file__).resolve().parents[2] / "examples" / "data"
    for folder in (installed / name, here / name):
        if folder.is_dir():
            return folder
    raise RecordingError(
        f"the shipped recordings are missing: neither {installed} nor {here} holds {name}; install again",
        code="missing",
    )


Key = tuple[str, str, str]  # source and number of samples, reading, direction
ERRORS = ("mie", "nmie", "mie_held", "nmie_held", "angle_deg")


@final
@dataclass(frozen=True, eq=False)
class SawyerResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Case in words -> one dictionary per trial, see `sawyer.sawyer_trial`.
    """

    outcomes: dict[Key, list[dict[str, Any]]]

    def values(self, case: Key, what: str) -> list[Any]:
        """One value per trial that was not refused."""
        return [t[what] for t in self.outcomes[case] if what in t]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours; source, reading and direction make the key."""
        ours = {}
        for case, trials in self.outcomes.items():
            inside = [t["angle_deg"] <= t["stated_deg"] for t in trials if t.get("stated_deg") is not None]
            ours[" | ".join(case)] = {what: summary(self.values(case, what)) for what in ERRORS} | {
                "rmse": summary(v for t in trials for v in t.get("rmse", ())),
                "rows_right": sum(t.get("rows") == t["rows_true"] for t in trials) / len(trials),
                "inside": float(np.mean(inside)) if inside else None,
                "others": {name: self._other(case, name) for name in trials[0]["others"]},
            }
        paper = {
            "mie": PAPER_SAWYER_MIE,
            "rmse": dict(PAPER_SAWYER_RMSE),
            "note": "a real Sawyer, data unpublished: the paper's numbers hold the friction, compliance and noise of "
            "an arm that we do not have",
        }
        return {"paper": paper, "ours": ours}

    def _other(self, case: Key, name: str) -> dict[str, Any]:
        trials = self.outcomes[case]
        angles = [t["others"][name]["angle_deg"] for t in trials]
        return {
            "angle_deg": summary(angles),
            "nmie_held": summary(t["others"][name]["nmie_held"] for t in trials),
            "pair": compare_pairs([t.get("angle_deg") for t in trials], angles),
        }

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial."""
        return [
            {
                "source": case[0],
                "reading": case[1],
                "direction": case[2],
                "trial": i,
                **{k: t.get(k, "") for k in ("refused", "estimator", "rows", "gap", *ERRORS)},
                "rmse_mean": float(np.mean(t["rmse"])) if "rmse" in t else "",
            }
            for case, trials in self.outcomes.items()
            for i, t in enumerate(trials)
        ]

    def markdown(self) -> str:
        """All readings beside the paper's numbers, then the published learners on the same recordings."""
        mie_of_paper, rmse_of_paper = number(PAPER_SAWYER_MIE), mean_and_sd(PAPER_SAWYER_RMSE)
        lines = [["**paper, a real arm**", "", "", mie_of_paper, "", "", "", rmse_of_paper, ""]]
        pairs = []
        for key, block in self.to_dict()["ours"].items():
            case = key.split(" | ")
            lines.append([*case, *(number(block[w]["median"]) for w in ("mie", "mie_held", "nmie_held"))])
            lines[-1].append(median_and_worst(block["angle_deg"]))
            lines[-1] += [mean_and_sd(block["rmse"]), percent(block["rows_right"])]
            if block["others"]:
                said = [_other_cell(block["others"].get(n)) for n in ("held", "row-by-row", "line")]
                pairs.append([*case, number(block["angle_deg"]["median"]), *said])
        header = ["demonstrations", "reading", "Lambda", "MIE, training", "MIE, held out", "NMIE, held out"]
        header += ["angle [deg], median (worst)", "RMSE, mean +- s.d.", "rows found"]
        against = ["recordings", "reading", "Lambda", SAID["auto"], SAID["held"], SAID["row-by-row"], SAID["line"]]
        return "\n\n".join(
            [
                markdown_table(header, lines),
                "Published learners for b = 0 on the same recordings, told the number of rows: median angle [deg]; the "
                f"median of its ratio to that of *{SAID['auto']}* [95 % interval], resamples at which "
                f"*{SAID['auto']}* is better. A ratio below 1 is a loss of ours.",
                markdown_table(against, pairs),
            ]
        )

    def figures(self) -> dict[str, Figure]:
        """MIE on held-out recordings and RMSE of every trial."""
        figure, axes = charts.new_figure(12.0, 5.6, 1, 2)
        labels = {f"{source}: {reading.split()[0]} {d}": (source, reading, d) for source, reading, d in self.outcomes}
        charts.strip(axes[0, 0], {k: self.values(c, "mie_held") for k, c in labels.items()}, PAPER_SAWYER_MIE)
        axes[0, 0].set_ylabel("MIE on held-out recordings\n[m$^2$ for one row, m$^4$ for two]")
        means = {k: [float(np.mean(v)) for v in self.values(c, "rmse")] for k, c in labels.items()}
        charts.strip(axes[0, 1], means, PAPER_SAWYER_RMSE["mean"])
        axes[0, 1].set_ylabel("RMSE of the policy, mean of 20 rollouts\n[m/rad for one row, m$^2$/rad for two]")
        for ax in axes[0]:
            ax.tick_params(axis="x", labelsize=6.5)
        figure.supxlabel("recordings: reading of Lambda; a dot is a trial, a bar the median", fontsize=9)
        return {"sawyer": figure}


def _other_cell(other: dict[str, Any] | None) -> str:
    if other is None:
        return "not run"
    return f"{number(other['angle_deg']['median'])}; {said_pair(other['pair'])}"


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


SAWYER = of_trials(
    "sawyer", sawyer_trial, {(c.said, c.reading, c.direction): c for c in CASES}, SawyerResult, two_fifths
)
