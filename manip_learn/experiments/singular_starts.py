"""The paper's two comparisons of three null-space policies from bad starts: at a singularity, and next to one.

Our product controller is compared with them. The figure shows the arm above and the manipulability below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.experiments.charts import INK, Figures, new_figure
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_arm, true_constraint
from manip_learn.experiments.results import markdown_table, number
from manip_learn.experiments.table import LABELS, learn
from manip_learn.linalg import matlab_tolerance
from manip_learn.playback.palette import COLOURS

Numbers = dict[str, Any]  # key numbers of one rollout, see `key_numbers`
STEPS = (0.02, 0.01)  # the paper's time step (50 Hz), and half of it [s]
REACHED = 0.05  # [m] largest final error of a rollout that arrives
POLICIES = ("zero", "attractor", "manipulability")
_ESTIMATOR = "joint-affine"  # method to learn Lambda, from 100 of the paper's demonstrations
_SETTLED = 100.0  # [rad/s] above this joint speed after the first second, the arm is not at rest


class Claim(NamedTuple):
    """Claim of the paper, and the result of checking it.

    Attributes:
        text: The claim.
        seen: Our measurement, in words.
        holds: True if the claim was reproduced as printed.
        verdict: Text to print instead of yes or no; empty for yes or no.
    """

    text: str
    seen: str
    holds: bool
    verdict: str = ""


@dataclass(frozen=True, eq=False)
class StartResult:
    """Rollouts of the paper's law and of our controller.

    Attributes:
        setting: Settings of the comparison, with the start.
        rollouts: Name of a control law (see `law_name`) -> its rollout.
        claims: Claims of the paper with their results.
        rounding: Policy -> outcomes of the paper's law with the step 0.02 s from `n` starts that differ by rounding
            errors only: the number of rollouts that end `at_rest` on the target, and the `least_late_speed` of all
            [rad/s]. Empty if no rollout is chaotic.
    """

    setting: BadStart
    rollouts: dict[str, Rollout]
    claims: list[Claim]
    rounding: dict[str, Numbers]

    def to_dict(self) -> dict[str, Any]:
        """Return claims and key numbers as a dictionary; numbers that rounding has made meaningless are None.

        This happens after a leap of 1e10 rad at a singularity.
        """
        ours = {law: key_numbers(r) for law, r in self.rollouts.items()}
        for numbers in ours.values():
            if numbers["chaotic"]:
                numbers |= dict.fromkeys(("final_error", "min_manipulability", "lowest_step", "late_speed"))
        paper, claims = {"claims": [claim.text for claim in self.claims]}, [claim._asdict() for claim in self.claims]
        return {"paper": paper, "ours": ours, "claims": claims, "rounding": self.rounding}

    def rows(self) -> list[dict[str, Any]]:
        """Return a table for CSV: one dictionary per sample of every rollout."""
        names, out = ("law", "time", "q1", "q2", "q3", "manipulability", "task_error"), list[dict[str, Any]]()
        for law, r in self.rollouts.items():
            lines = np.column_stack([r.time, r.q, r.manipulability, r.task_error]).tolist()
            out += [dict(zip(names, (law, *line), strict=True)) for line in lines]
        return out

    def markdown(self) -> str:
        """Return the claims and the key numbers of the rollouts as Markdown."""
        claims = [[c.text, c.seen, c.verdict or ("yes" if c.holds else "**no**")] for c in self.claims]
        lines = []
        for law, n in self.to_dict()["ours"].items():
            cells = ["chaotic" if n["chaotic"] else number(n[key]) for key in ("final_error", "min_manipulability")]
            lines.append([law, *cells, number(n["max_velocity"])])
        origin = f"Lambda of the manipulability policy: learnt by *{LABELS[_ESTIMATOR]}* from 100 demonstrations"
        header = ["law", "final error [m]", "smallest mu after step 3", "largest joint speed [rad/s]"]
        judged = markdown_table(["claim of the paper", "measured here", "holds as printed"], claims)
        return f"{judged}\n\n{origin}; the task part uses the true one.\n\n{markdown_table(header, lines)}"

    def figures(self) -> Figures:
        """Draw the arm over time above and the manipulability over time below; the last column is our controller.

        Returns:
            Dictionary from the name of the comparison to the figure.
        """
        leap = "\n(chaotic after the first step)" if self.rounding else ""
        columns = {f"paper's law, {p} policy{leap}": [self.rollouts[law_name(p, dt)] for dt in STEPS] for p in POLICIES}
        columns["our controller, manipulability"] = [self.rollouts[law_name("manipulability")]]
        return {self.setting.name: draw_columns(columns, self.setting.target)}


def law_name(policy: str, dt: float | None = None) -> str:
    """Return the name of a control law: the paper's with a policy and a time step, or our controller.

    Args:
        policy: One of `POLICIES`.
        dt: Time step of the paper's law [s]; None for our controller.
    """
    return f"{policy}, our controller" if dt is None else f"{policy}, dt {dt:g} s"


def key_numbers(rollout: Rollout) -> Numbers:
    """Return key numbers of a rollout, such as the smallest manipulability from step 3 on and the late speed.

    Args:
        rollout: Rollout with at least four samples.

    Returns:
        Dictionary with `final_error` [m]; `min_manipulability` from step 3 on, and its step `lowest_step`;
        `max_velocity`, and `late_speed` in the last four fifths [rad/s]; `largest_step` [rad]; `chaotic`.
    """
    speed = np.max(np.abs(rollout.u), axis=1)
    lowest = 3 + int(np.argmin(rollout.manipulability[3:]))
    numbers: Numbers = {"final_error": float(rollout.task_error[-1]), "lowest_step": lowest}
    numbers["min_manipulability"], numbers["max_velocity"] = float(rollout.manipulability[lowest]), float(np.max(speed))
    numbers["largest_step"] = float(np.max(speed) * rollout.time[1])
    numbers["late_speed"] = float(np.max(speed[len(rollout) // 5 :]))
    numbers["chaotic"] = bool(np.max(np.abs(rollout.q)) > 1e6)  # [rad] angles have no digits below 1e-10 of a turn
    return numbers


def singular_claims(rollouts: dict[str, Rollout], _rounding: object) -> list[Claim]:
    """Check the paper's claims about a start at a singularity, at the paper's 50 Hz and also at 100 Hz.

    Args:
        rollouts: Name of a control law (see `law_name`) -> its rollout.
        _rounding: Not used.
    """
    zero, attractor, climb = ([key_numbers(rollouts[law_name(p, dt)]) for dt in STEPS] for p in POLICIES)

    def describe(template: str, numbers: list[Numbers]) -> str:
        return "; ".join(f"{template.format(**n)} at {1.0 / dt:.0f} Hz" for dt, n in zip(STEPS, numbers, strict=True))

    A = true_constraint("x y")(rollouts[law_name("zero", STEPS[0])].q[0])
    sigma = np.linalg.svd(A, compute_uv=False)
    threshold = f"{matlab_tolerance(sigma, A.shape):.3e}"
    is_below = bool(sigma[-1] < float(threshold))
    measured = f"max(size(A)) eps(norm(A)) = {threshold}; the smaller singular value is {sigma[-1]:.1e}"
    dips = describe("lowest at step {lowest_step}", attractor)
    near_70 = [60 <= n["lowest_step"] <= 80 for n in attractor]
    verdict = "**no** at the paper's 50 Hz, yes at 100 Hz" if near_70 == [False, True] else ""
    stays = describe("error stays {final_error:.3g} m", zero), zero[0]["final_error"] > 2.9
    arrives = describe("final error {final_error:.2g} m", attractor), attractor[0]["final_error"] < REACHED
    nears = describe("mu {min_manipulability:.2g}, up to {max_velocity:.0f} rad/s", attractor)
    climbs = describe("final error {final_error:.2g} m, mu >= {min_manipulability:.3f} from step 3", climb)
    is_away = climb[0]["final_error"] < REACHED and climb[0]["min_manipulability"] > 0.5
    drops, lowest = "The pseudo-inverse drops singular values below 1.332e-15", attractor[0]["min_manipulability"]
    return [
        Claim(drops, measured, threshold == "1.332e-15" and is_below),
        Claim("The zero policy never leaves the singularity", *stays),
        Claim("The attractor arrives", *arrives),
        Claim("... but comes near another singularity on its way", nears, lowest < 0.1),
        Claim("... after around 70 steps", dips, near_70[0], verdict),
        Claim("The manipulability policy arrives and stays away from singularities", climbs, is_away),
    ]


def near_singular_claims(rollouts: dict[str, Rollout], rounding: dict[str, Numbers]) -> list[Claim]:
    """Check the paper's claims about a start near a singularity.

    Figure 2 is judged by many starts that differ by rounding errors, because after a huge leap the outcome of a single
    rollout is random.

    Args:
        rollouts: Name of a control law (see `law_name`) -> its rollout.
        rounding: Policy -> outcomes from starts that differ by rounding errors, see `StartResult`.
    """
    after = np.abs(rollouts[law_name("zero", STEPS[0])].q[1])
    others = 10.0 ** np.ceil(np.log10(after[[0, 2]].max()) + 1)
    (zero, attractor, climb), n = (rounding[p]["at_rest"] for p in POLICIES), rounding["zero"]["n"]
    slow = rounding["attractor"]["least_late_speed"]
    leap = f"joint 2 at {after[1]:.1e} rad, joints 1 and 3 below {others:.0e} rad"
    both = f"both arrive at rest, from {zero} and {climb} of {n} starts that differ by rounding"
    wild = f"beyond 1e{np.floor(np.log10(slow)):.0f} rad/s at some time after the first second from all {n}, at rest "
    wild += f"on the target from {attractor}: chaotic"
    away = "Figure 2: under the zero and the manipulability policy the arm moves away from the singularity"
    return [
        Claim("The next state is beyond 1e9 rad for each joint", leap, bool(np.all(after > 1e9))),
        Claim(away, both, zero == climb == n),
        Claim("Figure 2: the attractor is highly unstable", wild, slow > _SETTLED and attractor == 0),
    ]


def draw_columns(columns: Mapping[str, Sequence[Rollout]], target: tuple[float, float]) -> Any:
    """Draw one column per control law: the arm at some times (early ones pale), and the manipulability over time.

    Args:
        columns: Title of a column -> its rollouts, with the step 0.02 s and, for the paper's law, 0.01 s.
        target: Target r* (x, y) [m].

    Returns:
        The figure.
    """
    from matplotlib import colormaps

    moments = (0, 1, 2, 3, 6, 12, 25, 37, 50, 100, 250)  # indices of 251 samples
    shades = colormaps["viridis_r"](np.linspace(0.04, 1.0, len(moments)))
    reach = (-3.15, 3.15)  # [m]; the arm is 3 m long
    figure, axes = new_figure(12.0, 6.6, 2, len(columns), sharey="row", height_ratios=[1.5, 1.0])
    for (above, below), (title, rollouts) in zip(axes.T, columns.items(), strict=True):
        angles = np.cumsum(rollouts[0].q[list(moments)], axis=1)
        joints = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=1)
        for shade, arm, i in zip(shades, np.pad(joints, [(0, 0), (1, 0), (0, 0)]), moments, strict=True):
            above.plot(*arm.T, "-o", color=shade, linewidth=1.3, markersize=2.5, label=f"{STEPS[0] * i:.3g} s")
        above.plot(*target, "x", color=INK, markersize=7, linestyle="none", label="target r*")
        above.set_title(title, fontsize=9)
        above.set(xlabel="x of the links [m]", aspect="equal", xlim=reach, ylim=reach)
        for rollout, dt, style, colour in zip(rollouts, STEPS, ("-", ":"), (COLOURS["blue"], INK), strict=False):
            label = f"step {dt:g} s ({1.0 / dt:.0f} Hz)"
            below.plot(rollout.time, rollout.manipulability, style, color=colour, label=label)
        below.legend(loc="upper right", fontsize=7)
        below.set_xlabel("time [s]")
    highest = max(float(np.max(r.manipulability)) for rollouts in columns.values() for r in rollouts)
    axes[0, 0].set_ylabel("y of the links [m]")
    axes[0, -1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
    axes[1, 0].set(ylabel="manipulability of x, y [m$^2$]", ylim=(0.0, 1.3 * highest))  # leave space for the legend
    return figure


@dataclass(frozen=True)
class BadStart:
    """Settings of a comparison of null-space policies from a bad start.

    Attributes:
        name: Name of files and figures.
        start: Joint positions at the start [rad].
        rest: Configuration psi* to which the attractor policy moves [rad].
        inverse: Method to invert A in the paper's law.
        judge: Function that takes the rollouts and the outcomes from starts that differ by rounding errors (see
            `StartResult`), and returns the claims with their results.
        target: Target r* of x and y [m]. The paper does not state the target of the second comparison.
    """

    name: str
    start: tuple[float, ...]
    rest: tuple[float, ...]
    inverse: Literal["truncated", "exact"]
    judge: Callable[[dict[str, Rollout], dict[str, Numbers]], list[Claim]]
    target: tuple[float, float] = (0.0, 0.0)

    def law(self, policy: str, estimate: Constraint, *, product: bool = False) -> ResolvedRateController:
        """Return the paper's control law without limits, or our controller with its limits.

        The task uses the true A and only the policy the learnt one, because the truncated inverse works only if the row
        space is exact to 1e-16.

        Args:
            policy: One of `POLICIES`.
            estimate: Learnt constraint, for the manipulability policy.
            product: True for our controller, False for the paper's law.
        """
        null: dict[str, NullSpacePolicy] = {"zero": ZeroPolicy(3), "attractor": JointAttractor(self.rest)}
        null["manipulability"] = ManipulabilityAscent(estimate, logarithmic=product)
        bare: dict[str, Any] = {} if product else {"inverse": self.inverse, "limits": False}
        task = PointAttractor([*self.target, 0.0], gain=1.0)
        return ResolvedRateController(true_constraint("x y"), task, null[policy], **bare)

    def rollout(self, policy: str, estimate: Constraint, dt: float, q: Any = None, *, product: bool = False) -> Rollout:
        """Simulate five seconds from the start, or from another configuration.

        Args:
            policy: One of `POLICIES`.
            estimate: Learnt constraint, for the manipulability policy.
            dt: Time step [s].
            q: Joint positions (3,) at the start [rad]; None for the start of this comparison.
            product: True for our controller, False for the paper's law.
        """
        law = self.law(policy, estimate, product=product)
        return simulate(planar_arm(), law, self.start if q is None else q, 5.0, dt)

    def size(self, _trials: int) -> int:
        """Return the number of trials of this experiment, 0 because it is not repeated.

        Args:
            _trials: Not used.
        """
        return 0

    def run(self, _trials: int, rng: np.random.Generator, *_options: object) -> StartResult:
        """Compare three policies at 50 and 100 Hz, and our controller.

        Args:
            _trials: Not used.
            rng: Random generator for the demonstrations from which Lambda is learnt, and for starts that differ by
                rounding errors.
            *_options: Not used.

        Returns:
            Rollouts, and claims with their results.
        """
        true = true_constraint("x y")
        demos = demonstrate(Setup("x y"), true.selection, rng)
        selection, _ = learn(_ESTIMATOR, true.features, demos, true.selection, 0)
        estimate = Constraint(selection, true.features)
        rollouts = {law_name(p, dt): self.rollout(p, estimate, dt) for dt in STEPS for p in POLICIES}
        rollouts |= {law_name(p): self.rollout(p, estimate, STEPS[0], product=True) for p in POLICIES}
        rounding: dict[str, Numbers] = {}
        if key_numbers(rollouts[law_name("attractor", STEPS[0])])["chaotic"]:
            starts = np.array(self.start) * (1.0 + np.finfo(np.float64).eps * rng.standard_normal((20, 3)))
            for policy in POLICIES:
                runs = [key_numbers(self.rollout(policy, estimate, STEPS[0], q)) for q in starts]
                at_rest = sum(n["final_error"] < REACHED and n["late_speed"] < _SETTLED for n in runs)
                slowest = min(n["late_speed"] for n in runs)
                rounding[policy] = {"n": len(runs), "at_rest": at_rest, "least_late_speed": slowest}
        return StartResult(self, rollouts, self.judge(rollouts, rounding), rounding)


def _radians(*degrees: float) -> tuple[float, ...]:
    return tuple(np.deg2rad(degrees))


_STRAIGHT, _REST = _radians(90.0 + 1e-12, 360.0, -360.0), _radians(-190.0, 9.0, -307.0)
SINGULAR = BadStart("singular-start", _STRAIGHT, _REST, "truncated", singular_claims)
_FOLDED, _OTHER = _radians(90.0, -180.0, -180.0 + 1e-10), _radians(-33.0, -283.0, 193.0)
NEAR_SINGULAR = BadStart("near-singular-start", _FOLDED, _OTHER, "exact", near_singular_claims)
