"""What the paper only mentions: curves as constraints, a legged robot's balance, and torques as actions.

Each learnt Lambda is checked against the truth that the demonstrations were made from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, number, summary
from manip_learn.experiments.other_systems import (
    BALANCE,
    CURVES,
    TORQUE_TASKS,
    curve_demonstrations,
    curve_features,
    drawn_level,
    standing_demonstrations,
    standing_features,
    torque_demonstrations,
    torque_features,
)
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOISES = (0.0, 0.01)


@final
@dataclass(frozen=True)
class BeyondCase:
    """One system.

    Attributes:
        system: `"curve"`, `"legged"` or `"torque"`.
        task: Which constraint; a key of the system's table.
        noise: Standard deviation of the noise on the action, relative to each column's root mean square.
    """

    system: str
    task: str
    noise: float


# name -> (features, demonstrations and true Lambda from a task and rng)
SYSTEMS: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
    "curve": (curve_features, curve_demonstrations),
    "legged": (standing_features, standing_demonstrations),
    "torque": (torque_features, torque_demonstrations),
}
# labels of the figure
SHORT = {
    "stand, mass over one place": "legged, place",
    "stand, mass in a slanted plane": "legged, plane",
    "tip accelerates along x and y": "torque, x y",
    "tip accelerates along 30 degrees": "torque, 30 deg",
}
CASES = tuple(
    BeyondCase(system, task, noise)
    for system, tasks in (("curve", CURVES), ("legged", BALANCE), ("torque", TORQUE_TASKS))
    for task in tasks
    for noise in NOISES
)


def trials_of(trials: int) -> int:
    """A tenth of the paper's number of trials: 5 of 50."""
    return max(1, trials // 10)


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials_of(trials) * len(CASES)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> BeyondResult:
    """All systems, without noise and with 1 %.

    Args:
        trials: Ten times the number of trials of each.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    outcomes = runner.map("beyond", beyond_trial, CASES, trials_of(trials), int(rng.integers(2**53)))
    return BeyondResult(dict(zip(CASES, outcomes, strict=True)))


def beyond_trial(case: BeyondCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn with the shipped defaults; `angle_deg` to the true row space, `rows`, `estimator`; or `refused`."""
    make_features, demonstrate = SYSTEMS[case.system]
    features = make_features()
    demos, Lambda = demonstrate(case.task, case.noise, rng)
    try:
        learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code}
    learnt, report = learner.constraint_, learner.report_
    return {
        "rows": learnt.n_constraints,
        "rows_true": len(Lambda),
        "estimator": report.estimator,
        "gap": report.gap,
        "angle_deg": float(np.degrees(row_space_angle(Lambda, learnt.selection))),
        "selection": learnt.selection.tolist() if case.system == "curve" else [],
        "seconds": report.seconds,
    }


@final
@dataclass(frozen=True, eq=False)
class BeyondResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Case -> one dictionary per trial, see `beyond_trial`.
    """

    outcomes: dict[BeyondCase, list[dict[str, Any]]]

    def to_dict(self) -> dict[str, Any]:
        """Ours; the paper gives no numbers for these."""
        ours = {}
        for case, trials in self.outcomes.items():
            ours[f"{case.system} | {case.task} | noise {100 * case.noise:g} %"] = {
                "angle_deg": summary(t["angle_deg"] for t in trials if "angle_deg" in t),
                "rows_right": sum("rows" in t and t["rows"] == t["rows_true"] for t in trials) / len(trials),
                "refused": sum("refused" in t for t in trials) / len(trials),
                "rows_true": next((t["rows_true"] for t in trials if "rows_true" in t), None),
                "estimator": next((t["estimator"] for t in trials if "estimator" in t), None),
                "seconds_per_fit": summary(t["seconds"] for t in trials if "seconds" in t)["median"],
            }
        return {"paper": None, "ours": ours}

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial."""
        return [
            {
                "system": case.system,
                "task": case.task,
                "noise": case.noise,
                "trial": i,
                **{k: t.get(k, "") for k in ("refused", "estimator", "rows_true", "rows", "gap", "angle_deg")},
            }
            for case, trials in self.outcomes.items()
            for i, t in enumerate(trials)
        ]

    def markdown(self) -> str:
        """All systems."""
        lines = []
        for key, block in self.to_dict()["ours"].items():
            lines.append([*key.split(" | "), str(block["rows_true"]), block["estimator"] or "refused"])
            lines[-1] += [
                f"{100 * block['rows_right']:.0f} %",
                number(block["angle_deg"]["median"]),
                number(block["angle_deg"]["worst"]),
            ]
        header = ["system", "constraint", "noise", "rows", "estimator", "rows found", "angle [deg], median", "worst"]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """The curves with what was learnt of them, and the angles of all systems."""
        figure, axes = charts.new_figure(12.0, 4.6, 1, len(CURVES) + 1, width_ratios=[1.0] * len(CURVES) + [1.9])
        for ax, task in zip(axes[0], CURVES, strict=False):
            case = BeyondCase("curve", task, 0.01)
            demos, Lambda = curve_demonstrations(task, case.noise, np.random.default_rng(0))
            for t in demos:
                ax.plot(t.q[:, 0], t.q[:, 1], ".", color=charts.colour("grey"), markersize=2)
            for selection, name, width in (
                (Lambda, "sky", 4.0),
                (self.outcomes[case][0].get("selection"), "vermilion", 1.2),
            ):
                if selection is not None and len(selection) == 1:
                    drawn_level(ax, np.array(selection[0]), demos[0].q[0], charts.colour(name), width)
            ax.set_aspect("equal")
            ax.set_title(f"{task}, noise 1 %")
            ax.set_xlabel("x [m]")
        axes[0, 0].set_ylabel("y [m]")
        axes[0, 0].plot([], [], color=charts.colour("sky"), linewidth=4.0, label="true")
        axes[0, 0].plot([], [], color=charts.colour("vermilion"), linewidth=1.2, label="learnt (as shipped)")
        axes[0, 0].plot([], [], ".", color=charts.colour("grey"), label="recorded")
        axes[0, 0].legend(fontsize=6.5, loc="upper left")
        angles = {
            f"{SHORT.get(c.task, c.task)}, {100 * c.noise:g} %": [t["angle_deg"] for t in trials if "angle_deg" in t]
            for c, trials in self.outcomes.items()
        }
        charts.strip(axes[0, -1], angles)
        axes[0, -1].set_ylabel("angle to the true row space [deg],\nlearnt as shipped")
        axes[0, -1].set_xlabel("system, constraint, noise; a dot is a trial, a bar the median")
        axes[0, -1].tick_params(axis="x", labelsize=6.5)
        return {"beyond": figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None."""
        return {}
