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
from manip_learn.experiments.experiment_result import INK, ExperimentResult, markdown_table, new_figure, number
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_arm, true_constraint
from manip_learn.experiments.table import ESTIMATORS, SAID
from manip_learn.experiments.trial_runner import Experiment, TrialRunner
from manip_learn.linalg import matlab_tolerance
from manip_learn.playback.palette import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Numbers = dict[str, Any]  # of one rollout, see `numbers_of`
Laws = dict[float, dict[str, Rollout]]  # step [s] -> policy -> rollout of the paper's law
DURATION = 5.0  # [s]
STEPS = (0.02, 0.01)  # the paper's 50 Hz, and half of it [s]
REACHED = 0.05  # [m]
POLICIES = ("zero", "attractor", "manipulability")
_LEARNT = "joint-affine"  # how Lambda is learnt, from 100 of the paper's demonstrations
_SETTLED = 100.0  # joint speed after the first second above which the arm still leaps [rad/s]


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
        null: dict[str, NullSpacePolicy] = {
            "zero": ZeroPolicy(3),
            "attractor": JointAttractor(self.rest),
            "manipulability": ManipulabilityAscent(learnt, logarithmic=product),
        }
        constraint, task = true_constraint("x y"), PointAttractor([*self.target, 0.0], gain=1.0)
        if product:
            return ResolvedRateController(constraint, task, null[policy])
        return ResolvedRateController(constraint, task, null[policy], self.inverse, limits=False)

    def rollout(self, policy: str, learnt: Constraint, dt: float, q: Any = None, *, product: bool = False) -> Rollout:
        """Five seconds from the start, or from another posture."""
        return simulate(
            planar_arm(), self.law(policy, learnt, product=product), self.start if q is None else q, DURATION, dt
        )


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
        claims: One by one.
        rounding: Policy -> numbers of the paper's law, step 0.02 s, from starts that differ by rounding; empty where
            no rollout is chaotic.
    """

    setting: BadStart
    paper_law: dict[float, dict[str, Rollout]]
    product: dict[str, Rollout]
    claims: tuple[Claim, ...]
    rounding: dict[str, list[Numbers]]

    def _named(self, paper: str, ours: str) -> dict[str, Rollout]:
        named = {paper.format(dt=dt, policy=p): r for dt, rs in self.paper_law.items() for p, r in rs.items()}
        return named | {ours.format(policy=p): r for p, r in self.product.items()}

    def to_dict(self) -> dict[str, Any]:
        """Claims, and key numbers of each law; after a leap of 1e10 rad the digits that are rounding noise are None."""
        ours = {
            name: numbers_of(r) for name, r in self._named("{policy}, dt {dt:g} s", "{policy}, our controller").items()
        }
        for numbers in ours.values():
            if numbers["chaotic"]:
                numbers |= dict.fromkeys(("final_error", "min_manipulability", "late_speed"))
        return {
            "paper": {"claims": [c.text for c in self.claims if c.source == "paper"]},
            "ours": ours,
            "claims": [vars(c) for c in self.claims],
            "rounding": {
                policy: {
                    "reached": float(np.mean([r["final_error"] < REACHED for r in runs])),
                    "settled": float(np.mean([r["late_speed"] < _SETTLED for r in runs])),
                    "least_late_speed": min(r["late_speed"] for r in runs),
                    "n": len(runs),
                }
                for policy, runs in self.rounding.items()
            },
        }

    def rows(self) -> list[dict[str, Any]]:
        """One line per sample of every rollout."""
        names = ("time", "q1", "q2", "q3", "manipulability", "task_error")
        return [
            {"law": law, **dict(zip(names, line, strict=True))}
            for law, r in self._named("paper dt {dt:g} {policy}", "ours {policy}").items()
            for line in np.column_stack([r.time, r.q, r.manipulability, r.task_error]).tolist()
        ]

    def markdown(self) -> str:
        """Claims, and the rollouts' key numbers."""
        content, speed = self.to_dict(), "largest joint speed [rad/s]"
        claims = [["paper" if c.source == "paper" else "our question", c.text, c.seen, c.answer] for c in self.claims]
        lines = []
        for law, n in content["ours"].items():
            said = ["chaotic" if n["chaotic"] else number(n[key]) for key in ("final_error", "min_manipulability")]
            lines.append([law, *said, number(n["max_velocity"])])
        return "\n\n".join(
            [
                markdown_table(["whose", "claim", "measured here", "holds as printed"], claims),
                f"Lambda of the manipulability policy: learnt by *{SAID[_LEARNT]}* from 100 demonstrations; the task "
                "part uses the true one.",
                markdown_table(["law", "final error [m]", "smallest mu after step 3", speed], lines),
            ]
        )

    def figures(self) -> dict[str, Figure]:
        """The arm over time above, the manipulability over time below; the last column is our controller."""
        leap = "\n(chaotic after the first step)" if self.rounding else ""
        columns = {f"paper's law, {p} policy{leap}": [self.paper_law[dt][p] for dt in STEPS] for p in POLICIES}
        columns |= {"our controller, manipulability": [self.product["manipulability"]]}
        return {self.setting.name: draw_columns(columns, self.setting.target)}


def numbers_of(rollout: Rollout) -> Numbers:
    """Key numbers of a rollout: its least manipulability from step 3 on, its speed in the last four fifths, ..."""
    speed = float(np.max(np.abs(rollout.u)))
    return {
        "final_error": float(rollout.task_error[-1]),
        "min_manipulability": float(np.min(rollout.manipulability[3:])),
        "max_velocity": speed,
        "largest_step": speed * float(rollout.time[1]),
        "late_speed": float(np.max(np.abs(rollout.u[len(rollout) // 5 :]))),
        "chaotic": bool(np.max(np.abs(rollout.q)) > 1e6),  # [rad] beyond which no digit is left below 1e-10 of a turn
    }


def _compare(
    setting: BadStart, judged: Callable[[Laws, dict[str, list[Numbers]]], list[Claim]]
) -> Experiment[StartResult]:
    """The comparison from one start: three policies at 50 and 100 Hz, and our controller.

    Args:
        setting: The start.
        judged: (rollouts of the paper's law, numbers from starts that differ by rounding) -> claims.
    """

    def run(_trials: int, rng: np.random.Generator, _runner: TrialRunner | None = None) -> StartResult:
        true, setup = true_constraint("x y"), Setup("x y")
        demos = demonstrate(setup, true.selection, rng)
        learnt = Constraint(ESTIMATORS[_LEARNT](true.features, demos, true.selection, rng)[0], true.features)
        paper_law = {dt: {p: setting.rollout(p, learnt, dt) for p in POLICIES} for dt in STEPS}
        product = {p: setting.rollout(p, learnt, STEPS[0], product=True) for p in POLICIES}
        rounding: dict[str, list[Numbers]] = {}
        if any(numbers_of(rollout)["chaotic"] for rollout in paper_law[STEPS[0]].values()):
            last_digit = np.finfo(np.float64).eps * rng.standard_normal((20, 3))  # 20 starts
            starts = np.array(setting.start) * (1.0 + last_digit)
            rounding = {p: [numbers_of(setting.rollout(p, learnt, STEPS[0], q)) for q in starts] for p in POLICIES}
        return StartResult(setting, paper_law, product, tuple(judged(paper_law, rounding)), rounding)

    return Experiment(run, lambda _trials: 0)


def singular_claims(paper_law: Laws, _rounding: object) -> list[Claim]:
    """Of the first comparison at the paper's 50 Hz, with 100 Hz beside it, and whether an arm could follow."""

    def said(tell: Callable[[Rollout], str], policy: str) -> str:
        return "; ".join(f"{tell(rollouts[policy])} at {1.0 / dt:.0f} Hz" for dt, rollouts in paper_law.items())

    def dip(r: Rollout) -> tuple[int, float]:  # step of the lowest manipulability from step 3 on, and that
        low = 3 + int(np.argmin(r.manipulability[3:]))
        return low, float(r.manipulability[low])

    def final(r: Rollout) -> float:
        return float(r.task_error[-1])

    def fastest(r: Rollout) -> float:
        return float(np.max(np.abs(r.u)))

    A = true_constraint("x y")(np.array(SINGULAR.start))
    sigma = np.linalg.svd(A, compute_uv=False)
    threshold = matlab_tolerance(sigma, A.shape)
    zero, attractor, climb = (paper_law[STEPS[0]][p] for p in POLICIES)
    dips = {dt: dip(rollouts["attractor"])[0] for dt, rollouts in paper_law.items()}
    in_time = [60 <= step <= 80 for step in dips.values()]  # "around 70 steps"
    late = "" if in_time[0] else "**no** at the paper's 50 Hz, yes at 100 Hz" if in_time[1] else "**no**"
    # fmt: off
    claims: list[tuple[Any, ...]] = [
        ("The pseudo-inverse drops singular values below 1.332e-15", "paper",
         f"max(size(A)) eps(norm(A)) = {threshold:.3e}; the smaller singular value is {sigma[-1]:.1e}",
         f"{threshold:.3e}" == "1.332e-15" and bool(sigma[-1] < threshold)),
        ("The zero policy never leaves the singularity", "paper",
         said(lambda r: f"error stays {final(r):.3g} m", "zero"), final(zero) > 2.9),
        ("The attractor arrives", "paper",
         said(lambda r: f"final error {final(r):.2g} m", "attractor"), final(attractor) < REACHED),
        ("... but comes near another singularity on its way", "paper",
         said(lambda r: f"mu {dip(r)[1]:.2g}, up to {fastest(r):.0f} rad/s", "attractor"), dip(attractor)[1] < 0.1),
        ("... after around 70 steps", "paper",
         "lowest at step " + ", ".join(f"{step} at {1.0 / dt:.0f} Hz" for dt, step in dips.items()), in_time[0], late),
        ("The manipulability policy arrives and stays away from singularities", "paper",
         said(lambda r: f"final error {final(r):.2g} m, mu >= {dip(r)[1]:.3f} from step 3", "manipulability"),
         final(climb) < REACHED and dip(climb)[1] > 0.5),
        ("The manipulability policy's velocities could be followed by an arm (pi rad/s)", "check",
         said(lambda r: f"first steps up to {fastest(r):.0f} rad/s", "manipulability"),
         max(fastest(rollouts["manipulability"]) for rollouts in paper_law.values()) < np.pi),
    ]
    # fmt: on
    return [Claim(*claim) for claim in claims]


def near_singular_claims(paper_law: Laws, rounding: dict[str, list[Numbers]]) -> list[Claim]:
    """Of the second comparison, and what the leap depends on.

    What Figure 2 shows is judged over starts that differ by rounding: a single one is chance after such a leap.
    """
    rollouts = paper_law[STEPS[0]]
    after = np.abs(rollouts["zero"].q[1])
    others = 10.0 ** np.ceil(np.log10(after[[0, 2]].max()) + 1)
    n = len(rounding["zero"])
    rest = {p: sum(r["final_error"] < REACHED and r["late_speed"] < _SETTLED for r in rounding[p]) for p in rounding}
    slow = min(r["late_speed"] for r in rounding["attractor"])
    first = {p: float(np.max(np.abs(r.u[0]))) for p, r in rollouts.items()}
    other = replace(NEAR_SINGULAR, target=(1.0, 1.0)).law("zero", true_constraint("x y"))(NEAR_SINGULAR.start)
    speed = float(np.max(np.abs(other.velocity)))
    # fmt: off
    claims: list[tuple[Any, ...]] = [
        ("The next state is beyond 1e9 rad for each joint", "paper",
         f"joint 2 at {after[1]:.1e} rad, joints 1 and 3 below {others:.0e} rad", bool(np.all(after > 1e9))),
        ("Figure 2: under the zero and the manipulability policy the arm moves away from the singularity", "paper",
         f"both arrive at rest, from {rest['zero']} and {rest['manipulability']} of {n} starts that differ by rounding",
         rest["zero"] == n and rest["manipulability"] == n),
        ("Figure 2: the attractor is highly unstable", "paper",
         f"beyond 1e{np.floor(np.log10(slow)):.0f} rad/s at some time after the first second from all {n}, at rest "
         f"on the target from {rest['attractor']}: chaotic", slow > _SETTLED and rest["attractor"] == 0),
        ("The manipulability policy avoids the first leap, which is A^+ b alone", "check",
         ", ".join(f"{p} {v:.1e}" for p, v in first.items()) + " rad/s", first["manipulability"] < 1e3),
        ("The leap does not depend on r*, which is not stated", "check",
         f"r* = (1, 1): {speed:.2g} rad/s", speed > 1e9),
    ]
    # fmt: on
    return [Claim(*claim) for claim in claims]


FROM_SINGULAR, FROM_NEAR_SINGULAR = _compare(SINGULAR, singular_claims), _compare(NEAR_SINGULAR, near_singular_claims)


def draw_columns(columns: Mapping[str, Sequence[Rollout]], target: tuple[float, float]) -> Figure:
    """One column a law: the arm at some moments, early ones pale, and the manipulability of every sample.

    Args:
        columns: Title -> rollout at 0.02 s, and at 0.01 s for the paper's law.
        target: r* [m].
    """
    from matplotlib import colormaps

    moments = (0, 1, 2, 3, 6, 12, 25, 37, 50, 100, 250)  # of 251 samples
    shades = colormaps["viridis_r"](np.linspace(0.04, 1.0, len(moments)))
    reach = (-3.15, 3.15)  # [m]; the arm is 3 m long
    figure, axes = new_figure(12.0, 6.6, 2, len(columns), sharey="row", height_ratios=[1.5, 1.0])
    for (above, below), (title, rollouts) in zip(axes.T, columns.items(), strict=True):
        shown = [i for i in moments if i < len(rollouts[0])]
        angles = np.cumsum(rollouts[0].q[shown], axis=1)
        joints = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=1)
        for shade, arm, i in zip(shades, np.pad(joints, [(0, 0), (1, 0), (0, 0)]), shown, strict=False):
            above.plot(*arm.T, "-o", color=shade, linewidth=1.3, markersize=2.5, label=f"{STEPS[0] * i:.3g} s")
        above.plot(*target, "x", color=INK, markersize=7, linestyle="none", label="target r*")
        above.set_title(title, fontsize=9)
        above.set(xlabel="x of the links [m]", aspect="equal", xlim=reach, ylim=reach)
        for rollout, look, said in zip(rollouts, ("-", ":"), ("0.02 s (50 Hz)", "0.01 s (100 Hz)"), strict=False):
            colour = COLOURS["blue"] if look == "-" else INK
            below.plot(rollout.time, rollout.manipulability, look, color=colour, label=f"step {said}")
        below.legend(loc="upper right", fontsize=7)
        below.set_xlabel("time [s]")
    highest = max(float(np.max(r.manipulability)) for rollouts in columns.values() for r in rollouts)
    axes[1, 0].set_ylim(0.0, 1.3 * highest)  # room for the key
    axes[0, 0].set_ylabel("y of the links [m]")
    axes[1, 0].set_ylabel("manipulability of x, y [m$^2$]")
    axes[0, -1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
    return figure
