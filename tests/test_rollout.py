"""Rollouts: their samples and parts, many at once, and a controller of one's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import tip_of

import manip_learn as ml


def reaching(robot, frame: str, axes: str, target: list[float], **settings) -> ml.ResolvedRateController:
    """Two rows to a target."""
    features = ml.FrameJacobian(robot, frame, axes)
    rows = ml.Constraint(np.eye(features.n_rows)[:2], features)
    return ml.ResolvedRateController(rows, ml.PointAttractor(target), ml.ManipulabilityAscent(rows), **settings)


def test_number_of_samples(robot_of):
    """The nearest number of whole steps, whatever the rounding of the quotient, and the start; time counts in steps."""
    robot = robot_of("planar3")
    controller = ml.ResolvedRateController(ml.Constraint(np.eye(2), ml.FrameJacobian(robot, "tip", "x y")))
    for duration, dt, steps in ((0.3, 0.1, 3), (0.7, 0.1, 7), (1.0, 0.3, 3), (1.1, 0.3, 4)):
        one = ml.simulate(robot, controller, [0.3, 0.8, -0.5], duration, dt)
        (same,) = ml.simulate(robot, controller, [[0.3, 0.8, -0.5]], duration, dt)
        for rollout in (one, same):
            assert len(rollout) == steps + 1 == len(rollout.status)
            np.testing.assert_allclose(rollout.time, dt * np.arange(steps + 1), rtol=0, atol=1e-12)
    assert ml.simulate(robot, controller, np.zeros((0, 3)), 0.1, 0.02) == ()


def test_parts_of_rollouts(robot_of):
    """`until` cuts every curve at a time; `followed_by` joins two that meet, their times and their phases."""
    robot = robot_of("planar3")
    controller = reaching(robot, "tip", "x y", [1.0, 1.0])
    first = ml.simulate(robot, controller, [0.3, 0.8, 0.4], 0.5, 0.1)
    second = ml.simulate(robot, controller, first.q[-1], 0.3, 0.1)
    cut = first.until(0.3)
    assert len(cut) == len(cut.q) == len(cut.u) == len(cut.status) == len(cut.task_error) == 4
    assert cut.time[-1] == pytest.approx(0.3) and len(first.until(0.2999)) == 3 and len(first.until(9.0)) == 6
    one = replace(first, phases=(("a", 0.0, 0.5),)).followed_by(replace(second, phases=(("b", 0.1, 0.3),)))
    np.testing.assert_allclose(one.time, 0.1 * np.arange(9))
    np.testing.assert_array_equal(one.q, np.vstack([first.q[:-1], second.q]))
    np.testing.assert_array_equal(one.u, np.vstack([first.u[:-1], second.u]))
    assert one.status == (*first.status[:-1], *second.status) and one.following_error is None
    assert one.phases == (("a", 0.0, 0.5), ("b", pytest.approx(0.6), pytest.approx(0.8)))
    with pytest.raises(ValueError, match="read-only"):
        one.q[0] = 0.0
    other = ml.Constraint([[0.3, -0.2]], controller.constraint.features)
    mean = 0.5 * (other(one.q[3]) + other(one.q[4]))
    np.testing.assert_allclose(one.violation(other)[3], np.abs(mean @ one.u[3])[0])
    np.testing.assert_allclose(one.manipulability_of(other)[3], np.linalg.norm(other(one.q[3])))


def test_a_controller_of_your_own(robot_of):
    """Any (q, t, dt) -> Command is simulated as it is, alone and in a table; `task_error` is NaN where it has none."""
    robot, q0 = robot_of("sawyer"), np.linspace(-0.5, 0.7, 7)
    controller = reaching(robot, "right_hand", "xyz", [0.5, 0.2, 0.4], limits=False)
    laws = ((controller, q0), (lambda q, t, dt: controller(q, t), q0), (lambda q, t, dt: controller(q, t), [q0, q0]))
    expected, got, (first, _) = (ml.simulate(robot, law, start, 0.05, 0.01) for law, start in laws)
    for one in (got, first):
        np.testing.assert_array_equal(one.q, expected.q)
        np.testing.assert_array_equal(one.manipulability, expected.manipulability)
        assert one.status == expected.status and np.all(np.isnan(one.task_error))


def test_what_a_simulated_loop_tells(robot_of):
    """Following errors of a loop's commands, 0 for a perfect servo; none of a plain controller; what guided both."""
    robot = robot_of("planar3")
    controller = reaching(robot, "tip", "x y", [1.0, 1.2])
    plain = ml.simulate(robot, controller, [0.3, 0.8, 0.4], 0.2, 0.01)
    loop = ml.simulate(robot, ml.ServoLoop(controller, 0.01), [0.3, 0.8, 0.4], 0.2, 0.01)
    assert plain.following_error is None and loop.following_error is not None
    np.testing.assert_allclose(loop.following_error, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(loop.q, plain.q, rtol=0, atol=1e-12)
    for rollout in (plain, loop):
        assert rollout.frame == "tip" and rollout.robot is not None and rollout.robot.name == "planar3"
        np.testing.assert_array_equal(rollout.target, [1.0, 1.2])
        np.testing.assert_array_equal(rollout.constraint["selection"], controller.constraint.selection)


@pytest.mark.parametrize("name", ["planar3", "wrist", "humanoid", "vector", "sawyer"])
def test_many_starts_are_single_starts(name, robot_of, rng):
    """What one start leaves behind in a controller is not seen by the next: every rollout is that of its start alone,
    bit for bit, and that of a servo loop; in chunks of a large table too, and with its progress told.

    Configurations come back as configurations, floating bases and plain vectors too.
    """
    robot, n, progress = None if name == "vector" else robot_of(name), 300 if name == "sawyer" else 3, []
    if robot is None:
        plain = ml.Constraint([[1.0]], ml.CustomFeatures(lambda q: q[None, :] + 1.0, ("a",), 2))
        controllers, starts = [ml.ResolvedRateController(plain)], np.array([[0.1, 0.2], [0.3, 0.4], [0.2, 0.0]])
    else:
        features = ml.FrameJacobian(robot, tip_of(name), "x y")
        target = features.coordinates(robot.random_configuration(rng))
        rows, rest = ml.Constraint([[0.6, 0.8]], features), robot.neutral()
        reach = rows, ml.PointAttractor(target), ml.ManipulabilityAscent(rows, 0.3)
        track = rows, ml.Track(lambda t: target + 0.1 * t), ml.JointAttractor(rest, 1.0, robot)
        controllers = [ml.ResolvedRateController(*reach)]
        if n == 3:
            free = ml.ResolvedRateController(rows, ml.FreeDirection(rows, 0.1, 0.5))
            controllers += [ml.ResolvedRateController(*track, limits=False), free, ml.ServoLoop(controllers[0], 0.02)]
        starts = np.stack([robot.random_configuration(rng) for _ in range(n)])
    for controller in controllers:
        many = ml.simulate(robot, controller, starts, 0.4, 0.02, progress=lambda *step: progress.append(step))
        assert len(many) == len(starts) and progress[-1] == ("simulating", 1.0) and progress == sorted(progress)
        for i in {0, 1, len(starts) - 1}:
            alone = [ml.simulate(robot, controller, starts[i], 0.4, 0.02)]
            if robot is not None and not isinstance(controller, ml.ServoLoop) and controller.limits is not None:
                alone.append(ml.simulate(robot, ml.ServoLoop(controller, 0.02, stale_after=0.1), starts[i], 0.4, 0.02))
            np.testing.assert_array_equal(many[i].q[0], starts[i])
            np.testing.assert_array_equal(many[i].task_error, alone[0].task_error)
            for one in alone:
                for what in ("time", "q", "u", "manipulability"):
                    np.testing.assert_array_equal(getattr(many[i], what), getattr(one, what), err_msg=what)
                np.testing.assert_allclose(many[i].task_error, one.task_error, rtol=0, atol=1e-12)
                assert many[i].status == one.status and many[i].joint_names == one.joint_names
        progress.clear()
