"""Rollouts from a table of starts must be the rollouts from each start: one by one exactly, in bulk but for rounding.

The free steps of the two agree to 1e-12. Where a program is solved, DAQP's solution is exact to 2e-9 rad/s (against
rational numbers; the one in bulk to 1e-9 and mostly 1e-14), and what follows in a run carries it on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.manipulability import smallest_gradient
from manip_learn.control.batch import FEWEST_STARTS, BatchLaw
from manip_learn.control.box_programs import nearest_in_boxes
from manip_learn.control.command import Status
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law import next_slide
from manip_learn.control.limits import Limits, approach_bound, approach_bounds
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Task, Track
from manip_learn.errors import ConfigurationError, TargetError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]
PROGRAM = 1e-7  # [rad/s or m/s] of a step whose program is solved


def starts_of(robot: Robot, rng: np.random.Generator, number: int) -> np.ndarray:
    """Joint positions: anywhere, with joints at their limits, stretched and nearly so, and outside by a little."""
    below, above = (np.clip(x, -3.0, 3.0) for x in (robot.position_lower, robot.position_upper))
    starts = rng.uniform(0.98 * below + 0.02 * above, 0.02 * below + 0.98 * above, (number, robot.nv))
    starts[1] = np.where(rng.random(robot.nv) < 0.5, above, starts[1])
    starts[2, 1:] = np.clip(0.0, below[1:], above[1:])
    starts[3] = starts[2] + np.where(starts[2] + 1e-3 < above, 1e-3, -1e-3)
    starts[4, -1] = above[-1] + 0.01
    return starts


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["planar3", "wrist", "humanoid", "vector"])
def test_many_starts_are_single_starts(name: str, method: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """What one start leaves behind in a controller is not seen by the next: every rollout is that of its start alone.

    Configurations come back as configurations, floating bases and plain vectors too.
    """
    robot = None if name == "vector" else robot_of(name)
    if robot is None:
        plain = Constraint([[1.0]], CustomFeatures(lambda q: q[None, :] + 1.0, ("a",), 2))
        controllers, starts = [ResolvedRateController(plain)], np.array([[0.1, 0.2], [0.3, 0.4], [0.2, 0.0]])
    else:
        features = FrameJacobian(robot, tip_of(name), "x y")
        target = features.coordinates(robot.random_configuration(rng))
        oblique, rest = Constraint([[0.6, 0.8]], features), robot.neutral()
        track = Track(lambda t: target + 0.1 * t)
        controllers = [
            ResolvedRateController(oblique, PointAttractor(target), ManipulabilityAscent(oblique, 0.3)),
            ResolvedRateController(oblique, track, JointAttractor(rest, 1.0, robot), limits=False),
        ]
        if method == "euler":
            controllers.append(ResolvedRateController(oblique, FreeDirection(oblique, 0.1, 0.5)))
            controllers.append(ServoLoop(controllers[0], 0.02))
        starts = np.stack([robot.random_configuration(rng) for _ in range(3)])
    for controller in controllers:
        many = simulate(robot, controller, starts, 0.4, 0.02, method)
        assert len(many) == len(starts)
        for start, got in zip(starts, many, strict=True):
            alone = simulate(robot, controller, start, 0.4, 0.02, method)
            np.testing.assert_array_equal(got.q[0], start)
            for what in ("time", "q", "u", "manipulability", "task_error"):
                np.testing.assert_array_equal(getattr(got, what), getattr(alone, what), err_msg=what)
            assert got.status == alone.status and got.joint_names == alone.joint_names


@pytest.mark.parametrize("climbs", [True, False])
@pytest.mark.parametrize("task", ["point", "far", "hold"])
@pytest.mark.parametrize(("name", "rows"), [("planar3", 2), ("sawyer", 2), ("wrist", 3), ("mimic", 1)])
def test_steps_in_bulk_are_single_steps(
    name: str, rows: int, task: str, climbs: bool, robot_of: RobotOf, rng: np.random.Generator
) -> None:
    """At limits, outside, at singularities and near them, towards what is out of reach, and where nothing moves."""
    robot = robot_of(name)
    features = FrameJacobian(robot, tip_of(name), "x y" if name == "planar3" else "xyz")
    constraint = Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:rows, : features.n_rows], features)
    target = features.coordinates(robot.random_configuration(rng))
    tasks: dict[str, Task] = {
        "point": PointAttractor(target, 2.0, 0.5),
        "far": PointAttractor(constraint.selection @ (3.0 * target + 2.0)),
        "hold": Hold(),
    }
    policy = ManipulabilityAscent(constraint) if climbs else None
    assert_single_steps(ResolvedRateController(constraint, tasks[task], policy), starts_of(robot, rng, 8), 30, 0.02)


def assert_single_steps(law: ResolvedRateController, starts: np.ndarray, steps: int, dt: float) -> np.ndarray:
    """Each step of a table is that of the law from the same posture and the same velocity before; how many were alone.

    Not whole runs: where a task presses into a singularity, or nothing but rounding says where a joint goes at a limit,
    single runs from starts that differ by 1e-15 rad part as well.
    """
    robot = law.robot
    assert robot is not None
    bulk, runs = BatchLaw.of(law, robot), simulate(robot, law, starts, steps * dt, dt)
    assert bulk is not None and len(runs) == len(starts)
    for start, run in zip(starts, runs, strict=True):
        np.testing.assert_array_equal(run.q[0], start)
        np.testing.assert_allclose(run.q[1:], run.q[:-1] + dt * run.u[:-1], atol=1e-14)
        previous, slide = np.zeros(robot.nv) if law.limits else None, 0.0
        for k, (q, u) in enumerate(zip(run.q, run.u, strict=True)):
            command = law(q, run.time[k], dt, previous, slide)
            assert run.status[k] == command.status, (k, start)
            near = 1e-12 if command.status is Status.OK else PROGRAM
            np.testing.assert_allclose(u, command.velocity, rtol=near, atol=near)
            assert run.manipulability[k] == pytest.approx(command.manipulability, rel=1e-11, abs=1e-12)
            assert run.task_error[k] == pytest.approx(law.task_error(q, run.time[k]), rel=1e-12, abs=1e-14)
            slide = next_slide(slide, command.status is Status.STALLED, command.progress, dt)
            previous = u if law.limits else None
    inside = (starts >= robot.position_lower).all(axis=1) & (starts <= robot.position_upper).all(axis=1)
    return bulk.simulate(starts[inside], steps, dt, lambda fraction: None).alone


def test_runs_in_bulk_are_single_runs(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """What differs by rounding in a step does not grow in a run that comes to its target."""
    robot = robot_of("sawyer")
    constraint = Constraint([[0.6, 0.8, 0.0], [0.0, 0.6, 0.8]], FrameJacobian(robot, "right_hand"))
    law = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.4]), ManipulabilityAscent(constraint))
    starts = np.stack([robot.random_configuration(rng) for _ in range(6)])
    told: list[float] = []
    runs = simulate(robot, law, starts, 1.0, 0.01, progress=lambda title, fraction: told.append(fraction))
    assert told == sorted(told) and told[-1] == pytest.approx(1.0)
    for start, got in zip(starts, runs, strict=True):
        alone = simulate(robot, law, start, 1.0, 0.01)
        np.testing.assert_array_equal(got.time, alone.time)
        for what in ("q", "u", "manipulability", "task_error"):
            np.testing.assert_allclose(getattr(got, what), getattr(alone, what), rtol=0, atol=PROGRAM, err_msg=what)
        assert got.status == alone.status and got.joint_names == alone.joint_names
        assert got.robot == alone.robot and got.frame == alone.frame and got.constraint == alone.constraint
        np.testing.assert_array_equal(got.target, alone.target)
        assert got.following_error is None is alone.following_error


@pytest.mark.parametrize("case", ["exact", "truncated", "no limits", "raw gradient", "unbounded", "slow", "margin"])
def test_settings_in_bulk(case: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Inverses, limits and policies with other settings are what they are for one start."""
    robot = robot_of("sawyer")
    constraint = Constraint([[0.6, 0.8, 0.0], [0.0, 0.6, 0.8]], FrameJacobian(robot, "right_hand"))
    policy = ManipulabilityAscent(constraint, logarithmic=case != "raw gradient", max_speed=None)
    task, inverse = PointAttractor([0.5, 0.3, 0.4]), case if case in ("exact", "truncated") else "damped"
    limits = Limits(robot, velocity=0.3, acceleration=0.5, margin=0.1 if case == "margin" else 0.0)
    law = ResolvedRateController(
        constraint,
        task,
        policy if case in ("raw gradient", "unbounded") else ManipulabilityAscent(constraint),
        inverse,  # pyright: ignore[reportArgumentType]
        limits=limits if case in ("slow", "margin") else case != "no limits",
    )
    starts = np.stack([robot.random_configuration(rng) for _ in range(6)])
    alone = assert_single_steps(law, starts, 30, 0.02)
    assert np.mean(alone) < 0.5  # the others start near singularities


def test_a_task_that_stalls_slides_in_bulk(robot_of: RobotOf) -> None:
    """Joints at their limits block the task: the arm leaves the task's direction, and takes it up again."""
    robot = robot_of("sawyer")
    constraint, limits = Constraint(np.eye(3), FrameJacobian(robot, "right_hand")), Limits(robot, margin=1.0)
    law = ResolvedRateController(constraint, PointAttractor([0.9, 0.3, 0.6]), limits=limits)
    blocked = np.array([[-1.6, -1.8, -1.8, 1.9, -1.0, -0.4, -1.9], [1.5, -1.9, -1.4, 1.7, -1.4, 1.0, -1.4]])
    starts = np.vstack((blocked, blocked + 0.05))
    alone = assert_single_steps(law, starts, 90, 0.02)
    words = np.array([run.status for run in simulate(robot, law, starts, 1.8, 0.02)]).T
    assert np.sum((words == "stalled") & ~alone) > 10


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_nearest_in_boxes(rows: int, rng: np.random.Generator) -> None:
    """The slope of what is minimised points out of the box at joints at a bound, and is zero at others."""
    W = rng.normal(size=(rows, 7, 200)) * np.exp(rng.uniform(-2.0, 9.0, (rows, 1, 200)))
    low = rng.normal(size=(7, 200))
    high = low + rng.exponential(size=(7, 200))
    low[0, :20] = high[0, :20]
    y, z, solved = nearest_in_boxes(W, low, high, np.zeros((rows, 200)))
    assert solved.all() and np.all(y >= low - 1e-12) and np.all(y <= high + 1e-12)
    np.testing.assert_allclose(np.einsum("sjn,jn->sn", W, y), z, rtol=1e-6, atol=1e-6 * np.abs(W).max())
    slope = y + np.einsum("sjn,sn->jn", W, z)
    size = 1e-9 * (1.0 + np.einsum("sjn,sn->jn", np.abs(W), np.abs(z)))
    inside = (y > low + 1e-9) & (y < high - 1e-9)
    assert np.all(np.abs(slope[inside]) <= size[inside])
    assert np.all(slope[(y <= low + 1e-9) & (low < high)] >= -size[(y <= low + 1e-9) & (low < high)])
    assert np.all(slope[(y >= high - 1e-9) & (low < high)] <= size[(y >= high - 1e-9) & (low < high)])
    again = nearest_in_boxes(W, low, high, z)  # begun where it ended
    np.testing.assert_allclose(again[0], y, atol=1e-9)


@pytest.mark.parametrize("name", ["planar3", "sawyer", "wrist", "gantry"])
def test_bounds_of_a_table(name: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Bounds, their causes, what they admit and what binds are those of each posture."""
    robot, dt = robot_of(name), 0.02
    reach = np.minimum(robot.position_upper, 3.0)
    x = (reach * rng.uniform(-1.05, 1.05, (200, robot.nv))).T
    previous, wish = rng.normal(size=(2, robot.nv, 200))
    for limits in (Limits(robot), Limits(robot, acceleration=np.inf), Limits(robot, acceleration=0.2, margin=0.1)):
        table = limits.bounds_table(x, dt, previous)
        u = np.clip(wish, table.low, table.high)
        admitted, bound = table.admit(0.1 * wish), table.binding(u, wish)
        for k in range(200):
            one = limits.bounds(x[:, k].copy(), dt, previous[:, k])
            np.testing.assert_allclose(table.low[:, k], one.low, atol=1e-14)
            np.testing.assert_allclose(table.high[:, k], one.high, atol=1e-14)
            assert table.low_cause[:, k].tolist() == one.low_cause and table.high_cause[:, k].tolist() == one.high_cause
            assert table.outside[k] == pytest.approx(one.outside, abs=1e-14)
            assert admitted[k] == one.admit(0.1 * wish[:, k]) and bound[k] == one.binding(u[:, k], wish[:, k])[1]


@pytest.mark.parametrize("name", ["planar3", "sawyer", "mimic", "tree", "panda"])
def test_linear_rows_of_a_table(name: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Rows, places, products with the derivative, and the rate at which a singularity may be approached."""
    robot, dt = robot_of(name), 0.01
    features = FrameJacobian(robot, tip_of(name))
    constraint = Constraint([[0.6, 0.8, 0.0]], features)
    x = np.stack([robot.positions(robot.random_configuration(rng)) for _ in range(9)])
    J, position, vjp = batch_kinematics(robot, features.frame).linear_rows(x)
    A = np.einsum("sp,pjn->sjn", constraint.selection, J)
    smallest = np.sqrt(np.sum(A[0] ** 2, axis=0))
    slope = vjp(np.einsum("sp,sjn->pjn", constraint.selection, A / smallest))
    rates = approach_bounds(smallest, slope, Limits(robot).acceleration, dt)
    for k, q in enumerate(x):
        np.testing.assert_allclose(J[..., k], features(q), atol=1e-13)
        np.testing.assert_allclose(position[:, k], features.coordinates(q), atol=1e-13)
        one = smallest_gradient(*constraint.value_and_vjp(q))
        np.testing.assert_allclose(slope[:, k], one, atol=1e-12)
        assert rates[k] == pytest.approx(approach_bound(float(smallest[k]), one, Limits(robot).acceleration, dt))


def test_jerk_limits_are_kept(robot_of: RobotOf) -> None:
    """The average that keeps them belongs to the servo loop, which a law with limits is simulated in."""
    robot, dt, jerk = robot_of("sawyer"), 0.01, 100.0
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand"))
    law = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.4]), limits=Limits(robot, jerk=jerk))
    u = simulate(robot, law, np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4]), 0.3, dt).u
    changes = np.diff(np.vstack([np.zeros((2, 7)), u]), 2, axis=0)
    assert np.max(np.abs(changes)) <= jerk * dt**2 * (1.0 + 1e-9) and np.max(np.abs(u)) > 0.1


def test_no_start_and_bad_starts(robot_of: RobotOf) -> None:
    """An empty table gives no rollout; NaN names its row and joint; a target of the wrong size is refused."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot, "right_hand"))
    controller, starts = ResolvedRateController(constraint), np.zeros((FEWEST_STARTS, 7))
    assert simulate(robot, controller, np.zeros((0, 7)), 0.1, 0.02) == ()
    starts[1, 4] = np.nan
    with pytest.raises(ConfigurationError, match=f"row 1, joint '{robot.joint_names[4]}'"):
        simulate(robot, controller, starts, 0.1, 0.02)
    wrong = ResolvedRateController(constraint, PointAttractor([1.0]))
    with pytest.raises(TargetError, match="the target must have 3 numbers"):
        simulate(robot, wrong, np.zeros((FEWEST_STARTS, 7)), 0.1, 0.02)
