"""What a wrong choice costs: the tables of docs/how_to_choose.md.

    python benchmarks/choices.py

Learning: the shipped drawer, of which the direction is known (25 degrees from x). Control: the drawer's constraint from
a nearly singular start, as in `manip-learn demo`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

import manip_learn as ml
from manip_learn.errors import ManipLearnError

DRAWER = Path(__file__).resolve().parents[1] / "examples" / "data" / "sawyer_drawer"
TRUTH = np.array([np.cos(np.radians(25.0)), np.sin(np.radians(25.0)), 0.0])
START, TARGET = [1.2, -1.57, 0, 0, 0, 0, 0], [0.6, 0.27, 0.35]
Motions = list[tuple[np.ndarray, np.ndarray]]


def main() -> None:
    """Print all tables."""
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(DRAWER, robot)
    features = ml.FrameJacobian(robot, "right_gripper_tip", "xyz", reference="world")
    motions = [(demo.time, demo.q) for demo in demos]
    print_learning(features, motions)
    constraint = ml.ConstraintLearner(features).fit(demos).constraint_
    print_control(robot, constraint)


def print_learning(features: ml.FrameJacobian, motions: Motions) -> None:
    """Number of recordings, sampling rate, noise."""
    rng = np.random.default_rng(0)
    cases: list[tuple[str, Motions]] = [(f"{n} recordings", motions[:n]) for n in (1, 2, 3, 5, 8, 20, 50)]
    cases += [(f"8 recordings at {100 // k} Hz", [(t[::k], q[::k]) for t, q in motions[:8]]) for k in (1, 2, 5, 10, 20)]
    for noise in (0.0, 3e-4, 1e-3, 3e-3, 1e-2):
        noisy = [(t, q + noise * rng.standard_normal(q.shape)) for t, q in motions[:8]]
        cases.append((f"8 recordings, {noise:g} rad of noise added", noisy))
    cases += [(f"8 recordings, the first {s:g} s", cut(motions[:8], s)) for s in (3.0, 1.0, 0.5, 0.3)]
    row(("recordings", "rows", "gap", "unexplained", "uncertainty [deg]", "off by [deg]", "warnings"))
    for name, given in cases:
        row((name, *answer(features, given)))


def cut(motions: Motions, seconds: float) -> Motions:
    """The beginning of each motion."""
    return [(t[t < t[0] + seconds], q[t < t[0] + seconds]) for t, q in motions]


def answer(features: ml.FrameJacobian, motions: Motions) -> tuple[str, ...]:
    """What the report says, and how far the free direction is from the true one."""
    try:
        report = ml.ConstraintLearner(features).fit(motions).report_
    except ManipLearnError as refusal:
        return ("refused", "", "", "", "", str(refusal)[:60])
    spread = "" if report.uncertainty_deg is None else f"{report.uncertainty_deg:.2g}"
    off = ""
    if len(report.free_directions) == 1:
        cosine = min(1.0, abs(float(np.dot(report.free_directions[0], TRUTH))))
        off = f"{np.degrees(np.arccos(cosine)):.2g}"
    unexplained = f"{100 * report.held_out_residual:.2g} %" if np.isfinite(report.held_out_residual) else ""
    return (str(report.n_constraints), f"{report.gap:.3g}", unexplained, spread, off, str(len(report.warnings)))


def print_control(robot: ml.Robot, constraint: ml.Constraint) -> None:
    """Policy, gain, inverse, limits, rate."""
    task = ml.PointAttractor(TARGET)
    ascent = ml.ManipulabilityAscent(constraint, gain=3.0)
    cases: list[tuple[str, dict, float]] = [
        ("policy: none", {"null_policy": None}, 0.01),
        ("policy: rest posture", {"null_policy": ml.JointAttractor(robot.neutral())}, 0.01),
        ("policy: JointLimitAvoidance", {"null_policy": ml.JointLimitAvoidance(robot)}, 0.01),
    ]
    cases += [(f"policy: ascent, gain {g:g}", {"null_policy": ml.ManipulabilityAscent(constraint, gain=g)}, 0.01)
              for g in (0.3, 1.0, 3.0, 10.0)]  # fmt: skip
    for limits in (True, False):
        cases += [(f"limits={limits}, inverse={i!r}", {"inverse": i, "limits": limits, "null_policy": ascent}, 0.01)
                  for i in ("damped", "truncated", "exact")]  # fmt: skip
    cases += [(f"dt = {1e3 * dt:g} ms", {"null_policy": ascent}, dt) for dt in (0.001, 0.01, 0.05, 0.1, 0.2)]
    print()
    row(("controller", "error left [mm]", "mean mu", "least mu", "peak speed over limit", "largest step [rad/s]"))
    for name, settings, dt in cases:
        controller = ml.ResolvedRateController(constraint, task, **settings)
        row((name, *result(robot, ml.simulate(robot, controller, START, duration=5.0, dt=dt))))


def result(robot: ml.Robot, r: ml.Rollout) -> tuple[str, ...]:
    """Error, manipulability after 0.1 s, speed over the limit, and the largest change of speed between two commands."""
    speed = np.max(np.abs(r.u) / robot.velocity_limit)
    leap = np.max(np.abs(np.diff(r.u, axis=0)))
    error = float(np.linalg.norm(r.task_error[-1]))
    mu = r.manipulability
    return (f"{1e3 * error:.2g}", f"{mu.mean():.3f}", f"{mu[r.time >= 0.1].min():.3f}", f"{speed:.2g}", f"{leap:.2g}")


def row(cells: Iterable[str]) -> None:
    """One line of a Markdown table."""
    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
