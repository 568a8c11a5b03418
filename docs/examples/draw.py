"""Draw the pictures of the gallery: `python docs/examples/draw.py`. Needs the extra `experiments`."""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import manip_learn as ml
from manip_learn.learning import LearningReport

HERE = Path(__file__).parent
DRAWER = HERE.parents[1] / "examples" / "data" / "sawyer_drawer"
BLUE, VERMILION, GREEN = "#0072b2", "#d55e00", "#009e73"


def main() -> None:
    """One picture of each example that has none of its own."""
    matplotlib.rcParams.update({"font.size": 9, "svg.hashsalt": "manip_learn", "svg.fonttype": "none"})
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(DRAWER, robot)
    features = ml.FrameJacobian(robot, "right_gripper_tip", "xyz", reference="world")
    learner = ml.ConstraintLearner(features).fit(demos)
    draw_singularity(robot, features)
    draw_velocities(robot, demos)
    draw_levels(learner.report_)
    draw_policies(robot, learner.constraint_)
    draw_loop(robot, learner.constraint_)
    draw_uncertainty(features, demos)
    draw_groove()


def picture(name: str, x: str, y: str) -> tuple[Figure, Axes]:
    """An empty picture, its axes named; saved by `save`."""
    figure = Figure(figsize=(3.6, 2.4), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)
    figure.set_label(name)
    return figure, axes


def save(figure: Figure) -> None:
    """As SVG, the same on every day."""
    figure.savefig(HERE / f"{figure.get_label()}.svg", metadata={"Date": None})


def draw_singularity(robot: ml.Robot, features: ml.FrameJacobian) -> None:
    """01: mu of a task that holds y and z while the elbow is stretched."""
    constraint = ml.Constraint([[0, 1, 0], [0, 0, 1]], features)
    angles = np.linspace(-1.5, 1.5, 121)
    postures = np.zeros((len(angles), robot.nv))
    postures[:, 1], postures[:, 3] = -np.pi / 2, angles
    figure, axes = picture("load_a_robot", "elbow [rad], 0: arm upright and stretched", "manipulability of the task")
    axes.plot(angles, [ml.manipulability(constraint, q) for q in postures], color=BLUE)
    save(figure)


def draw_velocities(robot: ml.Robot, demos: ml.Demonstrations) -> None:
    """02: differences of recorded positions, and the velocities that the library derives."""
    raw, smooth = demos[0], ml.derive_velocities(demos[0], robot)
    figure, axes = picture("read_demonstrations", "time [s]", "velocity of right_j5 [rad/s]")
    axes.plot(
        raw.time[1:], np.diff(raw.q[:, 5]) / np.diff(raw.time), color="#b0b7be", linewidth=0.7, label="differences"
    )
    axes.plot(smooth.time, np.asarray(smooth.u)[:, 5], color=BLUE, label="derived")
    axes.legend(frameon=False)
    save(figure)


def draw_levels(report: LearningReport) -> None:
    """03: how strongly the motion uses each direction."""
    figure, axes = picture("learn_a_constraint", "direction of the tip", "motion (logarithmic)")
    held = report.n_constraints
    colours = [VERMILION] * held + [BLUE] * (len(report.levels) - held)
    axes.bar(["held", "held ", "free"], report.levels, color=colours)
    axes.set_yscale("log")
    axes.set_title(f"gap {report.gap:.0f}", fontsize=9)
    save(figure)


def draw_policies(robot: ml.Robot, constraint: ml.Constraint) -> None:
    """04: mu with three null-space policies."""
    figure, axes = picture("control", "time [s]", "manipulability of the task")
    policies = [
        ("ascent", ml.ManipulabilityAscent(constraint), BLUE, "-"),
        ("rest posture", ml.JointAttractor(robot.neutral()), VERMILION, "--"),
        ("none", ml.ZeroPolicy(robot.nv), GREEN, ":"),
    ]
    for name, policy, colour, style in policies:
        controller = ml.ResolvedRateController(constraint, ml.PointAttractor([0.6, 0.27, 0.35]), policy)
        r = ml.simulate(robot, controller, [1.2, -1.57, 0, 0, 0, 0, 0], duration=5.0, dt=0.01)
        axes.plot(r.time, r.manipulability, style, color=colour, label=name)
    axes.legend(frameon=False)
    save(figure)


def draw_loop(robot: ml.Robot, constraint: ml.Constraint) -> None:
    """08: commanded velocities, from rest to rest."""
    task, climb = ml.PointAttractor([0.6, 0.27, 0.35]), ml.ManipulabilityAscent(constraint)
    loop = ml.ServoLoop(ml.ResolvedRateController(constraint, task, climb), 0.002)
    q = np.array([1.2, -1.2, 0.0, 0.4, 0.0, 0.8, 0.0])
    loop.reset(q)
    u = []
    for k in range(1000):
        if k == 800:
            loop.stop()
        u.append(loop.update(q, 0.002 * k).velocity)
        q = loop.position
    figure, axes = picture("your_own_loop", "time [s]", "command [rad/s]")
    axes.plot(0.002 * np.arange(1000), np.array(u), linewidth=1.0)
    axes.axvline(1.6, color="black", linewidth=0.6, linestyle=":")
    axes.annotate("stop()", (1.62, 0.9), xycoords=("data", "axes fraction"))
    save(figure)


def draw_uncertainty(features: ml.FrameJacobian, demos: ml.Demonstrations) -> None:
    """09: the stated uncertainty after each motion."""
    counts = [2, 3, 4, 5, 6, 8, 10]
    reports = [ml.ConstraintLearner(features).fit(demos[:n]).report_ for n in counts]
    figure, axes = picture("learn_while_recording", "motions shown", "uncertainty [degrees]")
    axes.semilogy(counts, [r.uncertainty["noise"] for r in reports], "o-", color=BLUE, markersize=4)
    save(figure)


def draw_groove() -> None:
    """10: places of the puck in six pushes, and the groove of each, by the row that was learnt of twenty."""
    example = runpy.run_path(str(DRAWER.parents[1] / "10_not_kinematic.py"))
    demos = example["recorded_pushes"](0.05, np.random.default_rng(0))
    features = ml.CustomFeatures(example["gradients"], example["MONOMIALS"], nv=2)
    row = ml.ConstraintLearner(features).fit(demos).constraint_.selection[0]
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 60), np.linspace(-1.2, 1.2, 60))
    figure, axes = picture("not_kinematic", "x [m]", "y [m]")
    for demo in demos[:6]:
        axes.plot(*demo.q.T, ".", color=BLUE, markersize=2)
        heights = [np.tensordot(row, [a, b, a * a, a * b, b * b], 1) for a, b in ((x, y), demo.q[0])]
        axes.contour(x, y, heights[0], levels=[heights[1]], colors=VERMILION, linewidths=0.6)
    axes.set_aspect("equal")
    save(figure)


if __name__ == "__main__":
    main()
