"""The paper's two comparisons of three null-space policies from bad starts: at a singularity, and next to one.

Our product controller runs beside them. The picture has the postures above, the manipulability below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, number, percent
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_arm, planar_features, true_constraint
from manip_learn.experiments.trial_runner import Experiment, TrialRunner
from manip_learn.experiments.ways import ESTIMATORS, SAID
from manip_learn.linalg import matlab_tolerance
from manip_learn.playback.palette import COLOURS
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEP = 0.02  # [s]
DURATION = 5.0  # [s]
STEPS = (STEP, 0.01)  # the paper's 50 Hz, and half of it [s]
REACHED = 0.05  # [m]
PERTURBATION = 0.01  # of the start, standard deviation [rad]
POLICIES = ("zero", "attractor", "manipulability")
LEARNT = "joint-affine"  # how Lambda is learnt, from 100 of the paper's demonstrations
WILD = 1e6  # postures beyond have no digits left below 1e-10 of a turn: chaotic [rad]
ROUNDING_STARTS = 20  # starts that differ by rounding
SETTLED = 100.0  # joint speed after the first second above which the arm still leaps [rad/s]


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
        text: The claim, or our question.
        source: `"paper"`, or `"check"` for a question of ours.
        seen: The measurement, in words.
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
        return {
            "paper": {"claims": [c.text for c in self.claims if c.source == "paper"]},
            "ours": ours,
            "claims": [vars(c) for c in self.claims],
            "perturbed": {law: _rates(runs) for law, runs in self.perturbed.items()},
            "rounding": {policy: _settled(runs) for policy, runs in self.rounding.items()},
        }

    def rows(self) -> list[dict[str, Any]]:
        """One line per sample of every rollout."""
        named = {f"paper dt {dt:g} {p}": r for dt, rs in self.paper_law.items() for p, r in rs.items()}
        named |= {f"ours {p}": r for p, r in self.product.items()}
        names = ("time", "q1", "q2", "q3", "manipulability", "task_error")
        return [
            {"law": law, **dict(zip(names, line, strict=True))}
            for law, r in named.items()
            for line in np.column_stack([r.time, r.q, r.manipulability, r.task_error]).tolist()
        ]

    def markdown(self) -> str:
        """Claims, the rollouts' key numbers, and the perturbed starts."""
        content = self.to_dict()
        claims = [["paper" if c.source == "paper" else "our question", c.text, c.seen, c.answer] for c in self.claims]
        lines = []
        for law, n in content["ours"].items():
            said = ["chaotic" if n["chaotic"] else number(n[key]) for key in ("final_error", "min_manipulability")]
            lines.append([law, *said, number(n["max_velocity"])])
        keys = ("max_velocity", "largest_step", "min_manipulability")
        runs = [
            [law, percent(r["reached"]), *(number(r[key]) for key in keys)] for law, r in content["perturbed"].items()
        ]
        speed = "largest joint speed [rad/s]"
        within = ["law", f"within {REACHED:g} m", speed, "largest step [rad]", "smallest mu after 0.1 s"]
        return "\n\n".join(
            [
                markdown_table(["whose", "claim", "measured here", "holds as printed"], claims),
                f"Lambda of the manipulability policy: learnt by *{SAID[LEARNT]}* from 100 demonstrations; the task "
                "part uses the true one.",
                markdown_table(["law", "final error [m]", "smallest mu after step 3", speed], lines),
                f"From {len(next(iter(self.perturbed.values())))} starts perturbed by {PERTURBATION:g} rad:",
                markdown_table(within, runs),
            ]
        )

    def figures(self) -> dict[str, Figure]:
        """The arm over time above, the manipulability over time below; the last column is our controller."""
        leap = "\n(chaotic after the first step)" if self.rounding else ""
        columns = {f"paper's law, {p} policy{leap}": [self.paper_law[dt][p] for dt in STEPS] for p in POLICIES}
        columns |= {"our controller, manipulability": [self.product["manipulability"]]}
        return {self.setting.name: draw_columns(columns, self.setting.target)}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Our controller with each policy; the paper's law too where the postures are drawable."""
        rollouts = {f"ours: {p}": r for p, r in self.product.items()}
        for policy, rollout in self.paper_law[STEP].items():
            if float(np.max(np.abs(rollout.q))) < 1e3:
                rollouts[f"paper's law: {policy}"] = rollout
        return {self.setting.name: (planar_arm(), rollouts)}


Claims = Callable[[dict[float, dict[str, Rollout]], dict[str, list[dict[str, float]]]], list[Claim]]


def compare(setting: BadStart, judged: Claims) -> Experiment[StartResult]:
    """The comparison from one start: three policies at 50 and 100 Hz, our controller, and perturbed starts.

    Args:
        setting: The start.
        judged: (rollouts of the paper's law, numbers from starts that differ by rounding) -> claims.
    """

    def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> StartResult:
        runner = runner or TrialRunner(workers=1)
        learnt = _learnt(rng)
        paper_law = {dt: {p: _rollout(setting.law(p, learnt), setting.start, dt) for p in POLICIES} for dt in STEPS}
        product = {p: _rollout(setting.law(p, learnt, product=True), setting.start) for p in POLICIES}
        seed = int(rng.integers(2**53))
        runs = runner.map(setting.name, perturbed_trial, [setting], size(trials), seed)[0]
        rounding: dict[str, list[dict[str, float]]] = {}
        if any(_numbers(rollout)["chaotic"] for rollout in paper_law[STEP].values()):
            last_digit = np.finfo(np.float64).eps * rng.standard_normal((ROUNDING_STARTS, 3))
            starts = np.array(setting.start) * (1.0 + last_digit)
            rounding = {p: [_numbers(_rollout(setting.law(p, learnt), q)) for q in starts] for p in POLICIES}
        perturbed = {law: [run[law] for run in runs] for law in runs[0]}
        return StartResult(setting, paper_law, product, perturbed, tuple(judged(paper_law, rounding)), rounding)

    def size(trials: int) -> int:
        return max(1, round(0.8 * trials))  # 40 perturbed starts at the paper's 50 trials

    return Experiment(run, size)


def _rollout(law: ResolvedRateController, start: Sequence[float] | np.ndarray, dt: float = STEP) -> Rollout:
    return simulate(planar_arm(), law, start, DURATION, dt)


def perturbed_trial(setting: BadStart, rng: np.random.Generator) -> dict[str, Any]:
    """Law -> numbers of the rollout from one perturbed start."""
    learnt = _learnt(rng)
    q = np.array(setting.start) + PERTURBATION * rng.standard_normal(3)
    return {
        f"{whose}: {policy}": _numbers(_rollout(setting.law(policy, learnt, product=product), q), after=5)
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
THRESHOLD = 1.332e-15  # of the truncation, as printed
AROUND = (60, 80)  # "around 70 steps"


def singular_claims(paper_law: dict[float, dict[str, Rollout]], _rounding: object) -> list[Claim]:
    """Of the first comparison, and whether an arm could follow."""
    return [_threshold_claim(), *_figure_1_claims(paper_law), *_speed_checks(paper_law)]


def near_singular_claims(
    paper_law: dict[float, dict[str, Rollout]], rounding: dict[str, list[dict[str, float]]]
) -> list[Claim]:
    """Of the second comparison, and what the leap depends on."""
    return [_leap_claim(paper_law[STEP]["zero"]), *_figure_2_claims(rounding), *_leap_checks(paper_law[STEP])]


def _threshold_claim() -> Claim:
    A = true_constraint("x y")(np.array(SINGULAR.start))
    sigma = np.linalg.svd(A, compute_uv=False)
    threshold = matlab_tolerance(sigma, A.shape)
    return Claim(
        f"The pseudo-inverse drops singular values below {THRESHOLD:.3e}",
        "paper",
        f"max(size(A)) eps(norm(A)) = {threshold:.3e}; the smaller singular value is {sigma[-1]:.1e}",
        f"{threshold:.3e}" == f"{THRESHOLD:.3e}" and bool(sigma[-1] < threshold),
    )


def _figure_1_claims(paper_law: dict[float, dict[str, Rollout]]) -> list[Claim]:
    """At the paper's 50 Hz, with what 100 Hz gives beside it."""

    def said(tell: Callable[[dict[str, Rollout]], str]) -> str:
        return "; ".join(f"{tell(rollouts)} at {1.0 / dt:.0f} Hz" for dt, rollouts in paper_law.items())

    zero, attractor, climb = (paper_law[STEP][p] for p in ("zero", "attractor", "manipulability"))
    dips = {dt: _dip(rollouts["attractor"]) for dt, rollouts in paper_law.items()}
    step, mu = dips[STEP]
    in_time = {dt: AROUND[0] <= dip[0] <= AROUND[1] for dt, dip in dips.items()}
    steps = ", ".join(f"{dip[0]} at {1.0 / dt:.0f} Hz" for dt, dip in dips.items())
    least = float(np.min(climb.manipulability[3:]))
    return [
        Claim(
            "The zero policy never leaves the singularity",
            "paper",
            said(lambda r: f"error stays {float(r['zero'].task_error[-1]):.3g} m"),
            float(zero.task_error[-1]) > 2.9,
        ),
        Claim(
            "The attractor arrives",
            "paper",
            said(lambda r: f"final error {float(r['attractor'].task_error[-1]):.2g} m"),
            float(attractor.task_error[-1]) < REACHED,
        ),
        Claim(
            "... but comes near another singularity on its way",
            "paper",
            said(lambda r: f"mu {_dip(r['attractor'])[1]:.2g}, up to {np.max(np.abs(r['attractor'].u)):.0f} rad/s"),
            mu < 0.1,
        ),
        Claim(
            "... after around 70 steps",
            "paper",
            f"lowest at step {steps}",
            in_time[STEP],
            "" if in_time[STEP] else "**no** at the paper's 50 Hz, yes at 100 Hz" if in_time[0.01] else "**no**",
        ),
        Claim(
            "The manipulability policy arrives and stays away from singularities",
            "paper",
            said(
                lambda r: (
                    f"final error {float(r['manipulability'].task_error[-1]):.2g} m, "
                    f"mu >= {float(np.min(r['manipulability'].manipulability[3:])):.3f} from step 3"
                )
            ),
            float(climb.task_error[-1]) < REACHED and least > 0.5,
        ),
    ]


def _dip(rollout: Rollout) -> tuple[int, float]:
    """Step of the lowest manipulability from step 3 on, and that manipulability."""
    low = 3 + int(np.argmin(rollout.manipulability[3:]))
    return low, float(rollout.manipulability[low])


def _speed_checks(paper_law: dict[float, dict[str, Rollout]]) -> list[Claim]:
    speeds = {dt: float(np.max(np.abs(rollouts["manipulability"].u))) for dt, rollouts in paper_law.items()}
    seen = "; ".join(f"first steps up to {v:.0f} rad/s at {1.0 / dt:.0f} Hz" for dt, v in speeds.items())
    text = "The manipulability policy's velocities could be followed by an arm (pi rad/s)"
    return [Claim(text, "check", seen, max(speeds.values()) < np.pi)]


def _leap_claim(zero: Rollout) -> Claim:
    after = np.abs(zero.q[1])
    seen = (
        f"joint 2 at {after[1]:.1e} rad, joints 1 and 3 below {10.0 ** np.ceil(np.log10(after[[0, 2]].max()) + 1):.0e}"
    )
    return Claim(
        "The next state is beyond 1e9 rad for each joint", "paper", f"{seen} rad", bool(np.all(after > CLAIMED))
    )


def _figure_2_claims(rounding: dict[str, list[dict[str, float]]]) -> list[Claim]:
    """What Figure 2 shows, judged over starts that differ by rounding: a single one is chance after such a leap."""
    n = len(rounding["zero"])
    found = {p: sum(r["final_error"] < REACHED and r["late_speed"] < SETTLED for r in rounding[p]) for p in rounding}
    slow = min(r["late_speed"] for r in rounding["attractor"])
    calm = found["zero"] == n and found["manipulability"] == n
    return [
        Claim(
            "Figure 2: under the zero and the manipulability policy the arm moves away from the singularity",
            "paper",
            f"both arrive at rest, from {found['zero']} and {found['manipulability']} of {n} starts that differ by "
            "rounding",
            calm,
        ),
        Claim(
            "Figure 2: the attractor is highly unstable",
            "paper",
            f"beyond 1e{np.floor(np.log10(slow)):.0f} rad/s at some time after the first second from all {n}, at rest "
            f"on the target from {found['attractor']}: chaotic",
            slow > SETTLED and found["attractor"] == 0,
        ),
    ]


def _leap_checks(rollouts: dict[str, Rollout]) -> list[Claim]:
    first = {p: float(np.max(np.abs(r.u[0]))) for p, r in rollouts.items()}
    seen = ", ".join(f"{p} {v:.1e}" for p, v in first.items()) + " rad/s"
    text = "The manipulability policy avoids the first leap, which is A^+ b alone"
    other = replace(NEAR_SINGULAR, target=(1.0, 1.0)).law("zero", true_constraint("x y"))(NEAR_SINGULAR.start)
    speed = float(np.max(np.abs(other.velocity)))
    return [
        Claim(text, "check", seen, first["manipulability"] < 1e3),
        Claim(
            "The leap does not depend on r*, which is not stated",
            "check",
            f"r* = (1, 1): {speed:.2g} rad/s",
            speed > 1e9,
        ),
    ]


FROM_SINGULAR, FROM_NEAR_SINGULAR = compare(SINGULAR, singular_claims), compare(NEAR_SINGULAR, near_singular_claims)

SHOWN = (0, 1, 2, 3, 6, 12, 25, 37, 50, 100, 250)  # the samples of 251 that are drawn as postures, dt 0.02 s
REACH = 3.15  # of the axes [m]; the arm is 3 m long


def draw_columns(columns: Mapping[str, Sequence[Rollout]], target: tuple[float, float]) -> Figure:
    """One column a law: the arm at the moments `SHOWN`, and the manipulability of every sample.

    Args:
        columns: Title -> rollout at 0.02 s, and at 0.01 s for the paper's law.
        target: r* [m].
    """
    figure, axes = charts.new_figure(12.0, 6.6, 2, len(columns), sharey="row", height_ratios=[1.5, 1.0])
    shades = charts.shades(len(SHOWN))
    for (above, below), (title, rollouts) in zip(axes.T, columns.items(), strict=True):
        angles = np.cumsum(rollouts[0].q[[i for i in SHOWN if i < len(rollouts[0])]], axis=1)
        joints = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=1)
        for shade, arm in zip(shades, np.pad(joints, [(0, 0), (1, 0), (0, 0)]), strict=False):
            above.plot(*arm.T, "-o", color=shade, linewidth=1.3, markersize=2.5, solid_capstyle="round", alpha=0.9)
        above.plot(
            *target, "x", color=charts.INK, markersize=7, markeredgewidth=1.6, linestyle="none", label="target r*"
        )
        above.set_title(title, fontsize=9)
        above.set(xlabel="x of the links [m]", aspect="equal", xlim=(-REACH, REACH), ylim=(-REACH, REACH))
        for rollout, look, said in zip(rollouts, ("-", ":"), ("0.02 s (50 Hz)", "0.01 s (100 Hz)"), strict=False):
            colour = COLOURS["blue"] if look == "-" else charts.INK
            below.plot(rollout.time, rollout.manipulability, look, color=colour, label=f"step {said}")
        below.legend(loc="upper right", fontsize=7)
        below.set_xlabel("time [s]")
        steps = below.secondary_xaxis("top", functions=(lambda t: t / STEP, lambda k: k * STEP))
        steps.set_xlabel("step of 0.02 s", fontsize=8)
        steps.tick_params(labelsize=7)
    highest = max(float(np.max(r.manipulability)) for rollouts in columns.values() for r in rollouts)
    axes[1, 0].set_ylim(0.0, 1.3 * highest)  # room for the key
    axes[0, 0].set_ylabel("y of the links [m]")
    axes[1, 0].set_ylabel("manipulability of x, y [m$^2$]")
    axes[0, 0].legend(loc="lower left", fontsize=7)
    charts.time_key(figure, axes[0], [STEP * i for i in SHOWN])
    return figure
