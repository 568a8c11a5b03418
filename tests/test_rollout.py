"""Rollouts: order of the integrators, every kind of robot, files, and the paper's singular start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, PointAttractor, Track
from manip_learn.errors import ConfigurationError
from manip_learn.learning import ConstraintLearner


def reaching(robot, frame: str, axes: str, target: list[float], **settings) -> ResolvedRateController:
    features = FrameJacobian(robot, frame, axes)
    constraint = Constraint(np.eye(features.n_rows)[:2], features)
    return ResolvedRateController(constraint, PointAttractor(target), ManipulabilityAscent(constraint), **settings)


class Swaying(PointAttractor):
    """A velocity that depends on the time."""

    def velocity(self, constraint, q, t):
        """Round and round."""
        return np.array([0.5 * np.sin(3.0 * t), 0.4 * np.cos(2.0 * t)])


def test_order_of_convergence(robot_of):
    """Halving the step halves the error, with continuous joints and with a target that moves, too."""
    q0 = {name: np.linspace(0.2, 1.1, robot_of(name).nv) for name in ("planar3", "wrist")}
    cases = (
        ("planar3", PointAttractor([0.5, 1.2])),
        ("wrist", PointAttractor([0.4, 0.5])),
        ("planar3", Swaying(np.zeros(2))),
    )
    for name, task in cases:
        robot = robot_of(name)
        rows = Constraint(np.eye(2), FrameJacobian(robot, tip_of(name), "x y"))
        controller = ResolvedRateController(rows, task, ManipulabilityAscent(rows), "exact", limits=False)
        steps = (0.05, 0.025, 0.0125, 0.003125)
        ends = [simulate(robot, controller, q0[name], 0.8, dt).q[-1] for dt in steps]
        errors = [np.linalg.norm(robot.difference(ends[-1], end)) for end in ends[:3]]
        assert np.log2(errors[0] / errors[1]) > 0.6, (name, task)
        assert np.log2(errors[1] / errors[2]) > 0.6, (name, task)


def test_every_kind_of_robot(robot_of, rng):
    """Floating and planar bases and continuous joints: configurations stay valid, the task's error goes down."""
    for name in ("humanoid", "rover", "kinova"):
        robot = robot_of(name)
        features = FrameJacobian(robot, tip_of(name))
        q0 = robot.random_configuration(rng)
        task = PointAttractor(features.coordinates(q0) + 0.05)
        controller = ResolvedRateController(Constraint(np.eye(3)[:2], features), task)
        rollout = simulate(robot, controller, q0, 1.0, 0.05)
        assert rollout.q.shape == (21, robot.nq)
        for q in rollout.q:
            np.testing.assert_allclose(robot.configuration(q), q, rtol=0, atol=1e-12)
        assert rollout.task_error[-1] < 0.5 * rollout.task_error[0], name


def test_number_of_samples(robot_of):
    """The nearest number of whole steps, whatever the rounding of the quotient, and the start; time counts in steps."""
    robot = robot_of("planar3")
    controller = ResolvedRateController(Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y")))
    for duration, dt, steps in ((0.3, 0.1, 3), (0.7, 0.1, 7), (1.0, 0.3, 3), (1.1, 0.3, 4)):
        one = simulate(robot, controller, [0.3, 0.8, -0.5], duration, dt)
        (same,) = simulate(robot, controller, [[0.3, 0.8, -0.5]], duration, dt)
        for rollout in (one, same):
            assert len(rollout) == steps + 1 == len(rollout.status)
            np.testing.assert_allclose(rollout.time, dt * np.arange(steps + 1), rtol=0, atol=1e-12)


def test_escape_from_the_papers_singular_start(robot_of):
    """From (90 + 1e-12, 360, -360) degrees the product's law arrives; the paper's law with no policy is stuck."""
    robot = robot_of("planar3")
    q0 = np.radians([90.0 + 1e-12, 360.0, -360.0])
    zero = np.zeros(2)
    rows = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    climbing = ResolvedRateController(rows, PointAttractor(zero), ManipulabilityAscent(rows))
    rollout = simulate(robot, climbing, q0, 8.0, 0.02)
    assert rollout.task_error[0] == pytest.approx(3.0)
    assert rollout.task_error[-1] < 0.01
    assert np.min(rollout.manipulability[50:]) > 0.5
    plain = ResolvedRateController(rows, PointAttractor(zero), inverse="truncated", limits=False)
    assert simulate(robot, plain, q0, 8.0, 0.02).task_error[-1] == pytest.approx(3.0, abs=1e-6)


def test_a_rollout_can_be_learnt_from_again(robot_of):
    """Rollouts are demonstrations: from reaching ones with a resting policy the controller's own rows come back."""
    robot = robot_of("planar3")
    features = FrameJacobian(robot, "tip", "planar")
    truth, rng = Constraint(np.array([[1.0, 0.3, 0.2], [-0.2, 0.9, 0.1]]), features), np.random.default_rng(21)
    demos = []
    for _ in range(20):
        q0 = np.array([0.1, 1.5, 0.2]) + 0.2 * rng.uniform(-1, 1, 3)
        task = PointAttractor(features.coordinates(q0) + rng.uniform(-1, 1, 3))
        controller = ResolvedRateController(truth, task, JointAttractor([0.3, -0.2, 0.4]), "exact", limits=False)
        demos.append(simulate(robot, controller, q0, 0.3, 0.02).trajectory())
    learner = ConstraintLearner(features).fit(demos)
    outside = learner.constraint_.selection - learner.constraint_.selection @ truth.selection.T @ truth.selection
    assert np.linalg.norm(outside) < 1e-9


def test_parts_of_rollouts(robot_of):
    """`until` cuts every curve at a time; `followed_by` joins two that meet, their times and their phases."""
    robot = robot_of("planar3")
    controller = reaching(robot, "tip", "x y", [1.0, 1.0])
    first = simulate(robot, controller, [0.3, 0.8, 0.4], 0.5, 0.1)
    second = simulate(robot, controller, first.q[-1], 0.3, 0.1)
    cut = first.until(0.3)
    assert len(cut) == len(cut.q) == len(cut.u) == len(cut.status) == len(cut.task_error) == 4
    assert cut.time[-1] == pytest.approx(0.3) and len(first.until(0.2999)) == 3 and len(first.until(9.0)) == 6
    one = replace(first, phases=(("a", 0.0, 0.5),)).followed_by(replace(second, phases=(("b", 0.1, 0.3),)))
    np.testing.assert_allclose(one.time, 0.1 * np.arange(9))
    np.testing.assert_array_equal(one.q, np.vstack([first.q[:-1], second.q]))
    np.testing.assert_array_equal(one.u, np.vstack([first.u[:-1], second.u]))
    assert one.status == (*first.status[:-1], *second.status) and one.following_error is None
    assert one.phases == (("a", 0.0, 0.5), ("b", pytest.approx(0.6), pytest.approx(0.8)))
    motion = first.trajectory("again")
    assert motion.name == "again" and motion.joint_names == robot.joint_names
    np.testing.assert_array_equal(motion.u, first.u)
    with pytest.raises(ValueError, match="read-only"):
        one.q[0] = 0.0
    other = Constraint([[0.3, -0.2]], controller.constraint.features)
    mean = 0.5 * (other(one.q[3]) + other(one.q[4]))
    np.testing.assert_allclose(one.violation(other)[3], np.abs(mean @ one.u[3])[0])
    np.testing.assert_allclose(one.manipulability_of(other)[3], np.linalg.norm(other(one.q[3])))
    words = repr(one)
    assert "9 samples over 0.8 s, 3 joints" in words and f"{one.task_error[-1]:.3g} (in m or rad)" in words
    assert f"{one.manipulability.min():.4g} to {one.manipulability.max():.4g}" in words and "robot planar3" in words


def test_bad_arguments(robot_of):
    """Steps that are not positive, and starts of the wrong size or with NaN: refused."""
    robot = robot_of("planar3")
    controller = reaching(robot, "tip", "x y", [1.0, 1.0])
    for settings in ({"dt": 0.0}, {"dt": np.nan}, {"duration": -1.0}, {"duration": np.inf}):
        with pytest.raises(ConfigurationError):
            simulate(robot, controller, np.ones(3), **settings)
    for q0 in (np.ones(2), [np.nan, 0.0, 0.0]):
        with pytest.raises(ConfigurationError):
            simulate(robot, controller, q0)
    assert simulate(robot, controller, np.zeros((0, 3)), 0.1, 0.02) == ()
    with pytest.raises(ConfigurationError, match=f"row 1, joint '{robot.joint_names[2]}'"):
        simulate(robot, controller, [[0.0, 0.0, 0.0], [0.0, 0.0, np.nan]], 0.1, 0.02)


def test_a_controller_of_your_own(robot_of):
    """Any (q, t, dt) -> Command is simulated as it is; `task_error` is NaN where it has none, the rest is the same."""
    robot = robot_of("sawyer")
    controller = reaching(robot, "right_hand", "xyz", [0.5, 0.2, 0.4], limits=False)
    q0 = np.linspace(-0.5, 0.7, 7)

    class Mine:
        def __call__(self, q, t=0.0, dt=None):
            return controller(q, t)

    expected = simulate(robot, controller, q0, 0.05, 0.01)
    got = simulate(robot, Mine(), q0, duration=0.05, dt=0.01)
    np.testing.assert_array_equal(got.q, expected.q)
    np.testing.assert_array_equal(got.manipulability, expected.manipulability)
    assert got.status == expected.status and np.all(np.isnan(got.task_error))
    table = simulate(robot, Mine(), np.stack([q0, q0]), 0.05, 0.01)
    assert len(table) == 2 and all(np.isnan(r.task_error).all() for r in table)


def test_what_a_simulated_loop_tells(robot_of):
    """Following errors of a loop's commands, 0 for a perfect servo; none of a plain controller; what guided both."""
    robot = robot_of("planar3")
    controller = reaching(robot, "tip", "x y", [1.0, 1.2])
    plain = simulate(robot, controller, [0.3, 0.8, 0.4], 0.2, 0.01)
    loop = simulate(robot, ServoLoop(controller, 0.01), [0.3, 0.8, 0.4], 0.2, 0.01)
    assert plain.following_error is None and loop.following_error is not None
    np.testing.assert_allclose(loop.following_error, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(loop.q, plain.q, rtol=0, atol=1e-12)
    for rollout in (plain, loop):
        assert rollout.frame == "tip" and rollout.robot is not None and rollout.robot.name == "planar3"
        np.testing.assert_array_equal(rollout.target, [1.0, 1.2])
        np.testing.assert_array_equal(rollout.constraint["selection"], controller.constraint.selection)
    with pytest.raises(TypeError, match="rk4.*: each command is held for its step, give a smaller dt"):
        simulate(robot, controller, [0.3, 0.8, 0.4], 0.2, 0.01, method="rk4")


def test_progress_is_reported_with_a_title(robot_of):
    """The signature is that of the learner's progress: a title and a fraction that ends at 1."""
    robot, seen = robot_of("planar3"), []
    controller = reaching(robot, "tip", "x y", [0.5, 1.2])
    starts = np.array([[0.2, 0.5, 0.3], [0.3, 0.8, -0.5]])
    for q0 in (starts[0], starts):
        seen.clear()
        simulate(robot, controller, q0, 0.05, 0.01, progress=lambda title, fraction: seen.append((title, fraction)))
        assert seen[-1] == ("simulating", 1.0) and [f for _, f in seen] == sorted(f for _, f in seen)


@pytest.mark.parametrize("name", ["planar3", "wrist", "humanoid", "vector"])
def test_many_starts_are_single_starts(name, robot_of, rng):
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
        controllers.append(ResolvedRateController(oblique, FreeDirection(oblique, 0.1, 0.5)))
        controllers.append(ServoLoop(controllers[0], 0.02))
        starts = np.stack([robot.random_configuration(rng) for _ in range(3)])
    for controller in controllers:
        many = simulate(robot, controller, starts, 0.4, 0.02)
        assert len(many) == len(starts)
        for start, got in zip(starts, many, strict=True):
            alone = simulate(robot, controller, start, 0.4, 0.02)
            np.testing.assert_array_equal(got.q[0], start)
            for what in ("time", "q", "u", "manipulability", "task_error"):
                np.testing.assert_array_equal(getattr(got, what), getattr(alone, what), err_msg=what)
            assert got.status == alone.status and got.joint_names == alone.joint_names
