"""Three null-space policies from one bad start, as in the paper's figures, and our product controller beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, number
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_arm, planar_features, true_constraint
from manip_learn.experiments.start_figures import draw_starts
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.experiments.ways import ESTIMATORS, SAID
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DURATION = 5.0  # [s]
STEPS = (0.02, 0.01)  # the paper's 50 Hz, and half of it [s]
REACHED = 0.05  # [m]
PERTURBATION = 0.01  # of the start, standard deviation [rad]
POLICIES = ("zero", "attractor", "manipulability")
LEARNT = "joint-affine"  # how Lambda is learnt, from 100 of the paper's demonstrations
WILD = 1e6  # postures beyond have no digits left below 1e-10 of a turn: chaotic [rad]
ROUNDING_STARTS = 20  # starts that differ by rounding
SETTLED = 100.0  # largest joint speed after the first second of what is no leap any more [rad/s]


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
        holds: Whether it was reproduced as printed.
        verdict: What to say in place of yes or no.
    """

    text: str
    source: str
    seen: str
    holds: bool
    verdict: str = ""

    @property
    def answer(self) -> str:
        """Yes, no, or what else there is to say."""
        return self.verdict or ("yes" if self.holds else "**no**")


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
        rounding: Policy -> numbers of the paper's law, step 0.02 s, from starts that differ by rounding; empty where
            no rollout is chaotic.
    """

    setting: BadStart
    paper_law: dict[float, dict[str, Rollout]]
    product: dict[str, Rollout]
    perturbed: dict[str, list[dict[str, float]]]
    claims: tuple[Claim, ...]
    rounding: dict[str, list[dict[str, float]]]

    def to_dict(self) -> dict[str, Any]:
        """Claims, and key numbers of each law."""
        ours: dict[str, Any] = {
            f"{policy}, dt {dt:g} s": _meant(_numbers(rollout))
            for dt, rollouts in self.paper_law.items()
            for policy, rollout in rollouts.items()
        }
        ours |= {f"{policy}, our controller": _meant(_numbers(rollout)) for policy, rollout in self.product.items()}
        perturbed = {law: _rates(runs) for law, runs in self.perturbed.items()}
        claims = [vars(c) for c in self.claims]
        stated = [c for c in claims if c["source"] == "paper"]
        return {
            "paper": {"claims": [c["text"] for c in stated]},
            "ours": ours,
            "claims": claims,
            "perturbed": perturbed,
            "rounding": {policy: _settled(runs) for policy, runs in self.rounding.items()},
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
        claims = [["paper" if c.source == "paper" else "our question", c.text, c.seen, c.answer] for c in self.claims]
        lines = []
        for law, n in self.to_dict()["ours"].items():
            said = ["chaotic" if n["chaotic"] else number(n[key]) for key in ("final_error", "min_manipulability")]
            lines.append([law, *said, number(n["max_velocity"])])
        runs = []
        for law, rates in self.to_dict()["perturbed"].items():
            runs.append(
                [law, f"{100 * rates['reached']:.0f} %", number(rates["max_velocity"]), number(rates["largest_step"])]
            )
            runs[-1].append(number(rates["min_manipulability"]))
        return "\n\n".join(
            [
                markdown_table(["whose", "claim", "measured here", "holds as printed"], claims),
                f"Lambda of the manipulability policy: learnt by *{SAID[LEARNT]}* from 100 demonstrations; the task "
                "part uses the true one.",
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
        leap = "\n(chaotic after the first step)" if self.rounding else ""
        columns = {f"paper's law, {p} policy{leap}": self.paper_law[0.02][p] for p in POLICIES}
        fine = [self.paper_law[0.01][p] for p in POLICIES]
        columns |= {"our controller, manipulability": self.product["manipulability"]}
        return {self.setting.name: draw_starts(columns, fine, self.setting.target)}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Our controller with each policy; the paper's law too where the postures are drawable."""
        rollouts = {f"ours: {p}": r for p, r in self.product.items()}
        for policy, rollout in self.paper_law[0.02].items():
            if float(np.max(np.abs(rollout.q))) < 1e3:
                rollouts[f"paper's law: {policy}"] = rollout
        return {self.setting.name: (planar_arm(), rollouts)}


def compare(
    setting: BadStart, trials: int, rng: np.random.Generator, runner: TrialRunner | None
) -> tuple[Any, Any, Any, Any]:
    """Rollouts of the paper's law, of ours, outcomes from perturbed starts, and from starts that differ by rounding.

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
    rounding: dict[str, list[dict[str, float]]] = {}
    if any(_numbers(rollout)["chaotic"] for rollout in paper_law[0.02].values()):
        last_digit = np.finfo(np.float64).eps * rng.standard_normal((ROUNDING_STARTS, 3))
        starts = np.array(setting.start) * (1.0 + last_digit)
        rounding = {
            p: [_numbers(simulate(arm, setting.law(p, learnt), q, DURATION, 0.02)) for q in starts] for p in POLICIES
        }
    return paper_law, product, {law: [run[law] for run in runs] for law in runs[0]}, rounding


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
    return Constraint(ESTIMATORS[LEARNT](planar_features(), demos, Lambda, rng)[0], planar_features())


def _numbers(rollout: Rollout, after: int = 3) -> dict[str, Any]:
    # late: the last four fifths
    dt = float(rollout.time[1])
    speed = float(np.max(np.abs(rollout.u)))
    return {
        "final_error": float(rollout.task_error[-1]),
        "min_manipulability": float(np.min(rollout.manipulability[after:])),
        "max_velocity": speed,
        "largest_step": speed * dt,
        "late_speed": float(np.max(np.abs(rollout.u[len(rollout) // 5 :]))),
        "chaotic": bool(np.max(np.abs(rollout.q)) > WILD),
    }


def _rates(runs: list[dict[str, float]]) -> dict[str, float]:
    return {
        "reached": float(np.mean([r["final_error"] < REACHED for r in runs])),
        "max_velocity": max(r["max_velocity"] for r in runs),
        "largest_step": max(r["largest_step"] for r in runs),
        "min_manipulability": min(r["min_manipulability"] for r in runs),
    }


def _meant(numbers: dict[str, Any]) -> dict[str, Any]:
    """Without the digits that are rounding noise: after a leap of 1e10 rad none of what follows the leap is known."""
    noise = ("final_error", "min_manipulability", "late_speed") if numbers["chaotic"] else ()
    return {key: None if key in noise else value for key, value in numbers.items()}


def _settled(runs: list[dict[str, float]]) -> dict[str, float]:
    """Of starts that differ by rounding: the share that arrives, and that is slower than 100 rad/s after a second."""
    return {
        "reached": float(np.mean([r["final_error"] < REACHED for r in runs])),
        "settled": float(np.mean([r["late_speed"] < SETTLED for r in runs])),
        "least_late_speed": min(r["late_speed"] for r in runs),
        "n": len(runs),
    }
