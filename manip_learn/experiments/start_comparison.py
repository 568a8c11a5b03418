"""Three null-space policies from one bad start, as in the paper's figures, and our product controller beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies.joint_attractor import JointAttractor
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.policy import NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, number
from manip_learn.experiments.learning_trial import ESTIMATORS
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_arm, planar_features, true_constraint
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DURATION = 5.0  # [s]
STEPS = (0.02, 0.01)  # the paper's 50 Hz, and half of it [s]
REACHED = 0.05  # [m]
PERTURBATION = 0.01  # of the start, standard deviation [rad]
SHOWN = (0, 1, 2, 3, 6, 12, 25, 37, 50, 100, 250)  # samples drawn at 0.02 s
POLICIES = {"zero": "grey", "attractor": "vermilion", "manipulability": "blue"}


@final
@dataclass(frozen=True)
class BadStart:
    """Where and how the comparison is made.

    Attributes:
        name: For files and figures.
        start: Posture [rad].
        rest: psi* of the attractor [rad].
        target: r* [m], rows x, y.
        inverse: How A is inverted.
    """

    name: str
    start: tuple[float, ...]
    rest: tuple[float, ...]
    target: tuple[float, float]
    inverse: Literal["truncated", "exact"]

    def law(self, policy: str, learnt: Constraint, *, product: bool = False) -> ResolvedRateController:
        """The paper's bare law with one policy, or our controller with its limits.

        Truncation fires only if the row space is right to 1e-16: the task uses the true A, the policy the learnt one.
        """
        task = PointAttractor([*self.target, 0.0], gain=1.0)
        constraint = true_constraint("x y")
        climb = ManipulabilityAscent(learnt, logarithmic=product)
        null: dict[str, NullSpacePolicy] = {
            "zero": ZeroPolicy(3),
            "attractor": JointAttractor(self.rest),
            "manipulability": climb,
        }
        if product:
            return ResolvedRateController(constraint, task, null[policy])
        return ResolvedRateController(constraint, task, null[policy], self.inverse, limits=False)


@final
@dataclass(frozen=True)
class Claim:
    """A statement, and whether it holds here.

    Attributes:
        text: What is claimed or expected.
        source: `"paper"`, or `"check"` for a question of ours.
        seen: What was measured.
        holds: Whether it was reproduced.
    """

    text: str
    source: str
    seen: str
    holds: bool


@final
@dataclass(frozen=True, eq=False)
class StartResult(ExperimentResult):
    """Rollouts of the paper's law and of ours.

    Attributes:
        setting: The start.
        paper_law: Step [s] -> policy -> rollout.
        product: Policy -> rollout of our controller, step 0.02 s.
        perturbed: Law -> of each perturbed start: final error [m], largest speed [rad/s], smallest mu after 0.1 s.
        claims: One by one.
    """

    setting: BadStart
    paper_law: dict[float, dict[str, Rollout]]
    product: dict[str, Rollout]
    perturbed: dict[str, list[dict[str, float]]]
    claims: tuple[Claim, ...]

    def to_dict(self) -> dict[str, Any]:
        """Claims, and key numbers of each law."""
        ours: dict[str, Any] = {
            f"{policy}, dt {dt:g} s": _numbers(rollout)
            for dt, rollouts in self.paper_law.items()
            for policy, rollout in rollouts.items()
        }
        ours |= {f"{policy}, our controller": _numbers(rollout) for policy, rollout in self.product.items()}
        perturbed = {law: _rates(runs) for law, runs in self.perturbed.items()}
        claims = [vars(c) for c in self.claims]
        stated = [c for c in claims if c["source"] == "paper"]
        return {
            "paper": {"claims": [c["text"] for c in stated]},
            "ours": ours,
            "claims": claims,
            "perturbed": perturbed,
        }

    def rows(self) -> list[dict[str, Any]]:
        """One line per sample of every rollout."""
        named = {f"paper dt {dt:g} {p}": r for dt, rs in self.paper_law.items() for p, r in rs.items()}
        named |= {f"ours {p}": r for p, r in self.product.items()}
        return [
            {
                "law": law,
                "time": float(r.time[i]),
                **{f"q{j + 1}": float(r.q[i, j]) for j in range(3)},
                "manipulability": float(r.manipulability[i]),
                "task_error": float(r.task_error[i]),
            }
            for law, r in named.items()
            for i in range(len(r))
        ]

    def markdown(self) -> str:
        """Claims, the rollouts' key numbers, and the perturbed starts."""
        claims = [
            ["paper" if c.source == "paper" else "our question", c.text, c.seen, "**yes**" if c.holds else "**no**"]
            for c in self.claims
        ]
        lines = []
        for law, n in self.to_dict()["ours"].items():
            lines.append([law, number(n["final_error"]), number(n["min_manipulability"]), number(n["max_velocity"])])
        runs = []
        for law, rates in self.to_dict()["perturbed"].items():
            runs.append(
                [law, f"{100 * rates['reached']:.0f} %", number(rates["max_velocity"]), number(rates["largest_step"])]
            )
            runs[-1].append(number(rates["min_manipulability"]))
        return "\n\n".join(
            [
                markdown_table(["whose", "claim", "measured here", "holds"], claims),
                markdown_table(
                    ["law", "final error [m]", "smallest mu after step 3", "largest joint speed [rad/s]"], lines
                ),
                f"From {len(next(iter(self.perturbed.values())))} starts perturbed by {PERTURBATION:g} rad:",
                markdown_table(
                    [
                        "law",
                        f"within {REACHED:g} m",
                        "largest joint speed [rad/s]",
                        "largest step [rad]",
                        "smallest mu after 0.1 s",
                    ],
                    runs,
                ),
            ]
        )

    def figures(self) -> dict[str, Figure]:
        """The arm over time above, the manipulability over time below; the last column is our controller."""
        columns = [(f"{p} policy", self.paper_law[0.02][p], POLICIES[p]) for p in POLICIES]
        columns.append(("ours: manipulability", self.product["manipulability"], "green"))
        figure, axes = charts.new_figure(10.0, 5.2, 2, len(columns), sharey="row", height_ratios=[1.5, 1.0])
        for i, (title, rollout, name) in enumerate(columns):
            _arms(axes[0, i], rollout, self.setting.target, name)
            axes[0, i].set_title(title)
            below = axes[1, i]
            below.plot(rollout.time, rollout.manipulability, color=charts.colour(name), label="dt 0.02 s")
            if i < len(POLICIES):
                fine = self.paper_law[0.01][list(POLICIES)[i]]
                below.plot(fine.time, fine.manipulability, ":", color=charts.INK, label="dt 0.01 s")
                below.legend(loc="upper right", fontsize=7)
            below.set_xlabel("time [s]")
            below.set_ylim(0, 3)
        axes[0, 0].set_ylabel("y [m]")
        axes[1, 0].set_ylabel("manipulability")
        return {self.setting.name: figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Our controller with each policy; the paper's law too where the postures are drawable."""
        rollouts = {f"ours: {p}": r for p, r in self.product.items()}
        for policy, rollout in self.paper_law[0.02].items():
            if float(np.max(np.abs(rollout.q))) < 1e3:
                rollouts[f"paper's law: {policy}"] = rollout
        return {self.setting.name: (planar_arm(), rollouts)}


def compare(
    setting: BadStart, trials: int, rng: np.random.Generator, runner: TrialRunner | None
) -> tuple[Any, Any, Any]:
    """Rollouts of the paper's law, of ours, and the outcomes from perturbed starts.

    Args:
        setting: The start.
        trials: Number of perturbed starts.
        rng: For the demonstrations that Lambda is learnt from, and the seeds.
        runner: Where the perturbed starts run.
    """
    arm, learnt = planar_arm(), _learnt(rng)
    paper_law = {
        dt: {p: simulate(arm, setting.law(p, learnt), setting.start, DURATION, dt) for p in POLICIES} for dt in STEPS
    }
    product = {p: simulate(arm, setting.law(p, learnt, product=True), setting.start, DURATION, 0.02) for p in POLICIES}
    runner = runner or TrialRunner(workers=1)
    runs = runner.map(setting.name, perturbed_trial, [setting], trials, int(rng.integers(2**53)))[0]
    return paper_law, product, {law: [run[law] for run in runs] for law in runs[0]}


def perturbed_trial(setting: BadStart, rng: np.random.Generator) -> dict[str, Any]:
    """Law -> numbers of the rollout from one perturbed start."""
    learnt = _learnt(rng)
    q = np.array(setting.start) + PERTURBATION * rng.standard_normal(3)
    return {
        f"{whose}: {policy}": _numbers(
            simulate(planar_arm(), setting.law(policy, learnt, product=product), q, DURATION, 0.02), after=5
        )
        for whose, product in (("paper's law", False), ("ours", True))
        for policy in POLICIES
    }


def _learnt(rng: np.random.Generator) -> Constraint:
    setup = Setup("x y")
    Lambda = setup.selection(rng)
    demos = demonstrate(setup, Lambda, rng)
    return Constraint(ESTIMATORS["joint-affine"](planar_features(), demos, Lambda, rng)[0], planar_features())


def _numbers(rollout: Rollout, after: int = 3) -> dict[str, float]:
    dt = float(rollout.time[1])
    speed = float(np.max(np.abs(rollout.u)))
    return {
        "final_error": float(rollout.task_error[-1]),
        "min_manipulability": float(np.min(rollout.manipulability[after:])),
        "max_velocity": speed,
        "largest_step": speed * dt,
    }


def _rates(runs: list[dict[str, float]]) -> dict[str, float]:
    return {
        "reached": float(np.mean([r["final_error"] < REACHED for r in runs])),
        "max_velocity": max(r["max_velocity"] for r in runs),
        "largest_step": max(r["largest_step"] for r in runs),
        "min_manipulability": min(r["min_manipulability"] for r in runs),
    }


def _arms(ax: Any, rollout: Rollout, target: tuple[float, float], name: str) -> None:
    shown = [i for i in SHOWN if i < len(rollout)]
    for n, i in enumerate(shown):
        angles = np.cumsum(rollout.q[i])
        joints = np.concatenate([[[0.0, 0.0]], np.cumsum(np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)])
        charts.draw_arm(ax, joints, n / (len(shown) - 1), name)
    ax.plot(*target, "x", color=charts.INK, markersize=7, markeredgewidth=1.6)
    ax.set_aspect("equal")
    ax.set_xlim(-2.1, 2.1)
    ax.set_ylim(-1.6, 3.2)
