"""The controller's promises: exact null space, task first, limits, words, and no NaN, from any posture."""

from __future__ import annotations

import numpy as np
import pytest
from random_arms import Asks
from rounding import rounding

from manip_learn.constraint import manipulability
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.manipulability import svd
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError


def test_arguments_in_another_order(robot_of):
    """The error says the right call, and what was given where."""
    robot, task = robot_of("sawyer"), PointAttractor(np.zeros(2))
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot, "right_hand"))
    things = {"robot": robot, "constraint": constraint, "task": task, "nothing": None, "start": np.zeros(7)}
    things["controller"] = ResolvedRateController(constraint, task)
    for call, order, said in (
        (simulate, "controller robot start", "got a ResolvedRateController, a Robot and an ndarray of shape (7,)"),
        (simulate, "robot start controller", "got a Robot, an ndarray of shape (7,) and a ResolvedRateController"),
        (simulate, "robot constraint start", "got a Robot, a Constraint and an ndarray of shape (7,)"),
        (ResolvedRateController, "task constraint nothing", "got a PointAttractor, a Constraint and None"),
        (ResolvedRateController, "robot task nothing", "got a Robot, a PointAttractor and None"),
        (ResolvedRateController, "constraint nothing task", "got a Constraint, None and a PointAttractor"),
    ):
        right = "robot, controller, q0" if call is simulate else "constraint, task, null_policy"
        with pytest.raises((ConfigurationError, ConstraintError)) as caught:
            call(*(things[name] for name in order.split()))
        assert str(caught.value) == f"call {call.__name__}({right}): {said}, in this order"


def test_damping_only_below_the_threshold(robot_of):
    """Above the threshold the task is followed exactly; below it is damped, then stalls, and at zero it is singular."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    words = {}
    for elbow in (1.0, 0.3, 0.05, 0.02, 1e-4, 0.0):
        q = np.array([0.2, elbow, 0.0])
        controller = ResolvedRateController(
            constraint, Track(lambda t: [0.0, 0.0], gain=1e-2), limits=False, threshold=0.05, damping=0.05
        )
        command = controller(q)
        sigma = np.linalg.svd(constraint(q), compute_uv=False)[-1]
        known = rounding(4 * 2 * 3, constraint(q))  # of a singular value
        followed = np.allclose(constraint(q) @ command.velocity, command.task_velocity, rtol=1e-10, atol=0)
        assert followed == (sigma >= controller.threshold)
        assert command.smallest_singular_value == pytest.approx(sigma, rel=1e-9, abs=known)
        words[elbow] = command.status
        # A^T (A A^T + lambda^2)^-1 b, lambda = damping (1 - (sigma / threshold)^2) of the smallest singular value
        A, factor = constraint(q), 0.05 * max(0.0, 1.0 - (sigma / 0.05) ** 2)
        U, values, Vt = np.linalg.svd(A)
        gains = values / np.maximum(values**2 + factor**2, 1e-300)
        expected = Vt[:2].T @ (gains * (U.T @ command.task_velocity))
        known *= np.linalg.norm(command.task_velocity) / 0.05**2  # of sigma b / (sigma^2 + factor^2)
        np.testing.assert_allclose(command.task_part, expected, rtol=1e-9, atol=known)
    assert words == {1.0: "ok", 0.3: "ok", 0.05: "damped", 0.02: "damped", 1e-4: "stalled", 0.0: "singular"}


def test_the_words_are_right(robot_of):
    """Each word is given for what it says, the gravest first."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot, "right_hand"))
    q = np.radians([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 100.0])
    here = constraint.features.coordinates(q)

    def status(offset: float, gain: float = 0.0, posture: np.ndarray = q) -> str:
        policy = ManipulabilityAscent(constraint, gain)
        return ResolvedRateController(constraint, PointAttractor(here + offset), policy)(posture).status

    assert status(0.001) == "ok"
    assert status(0.01, gain=4.0) == "null-scaled"
    assert status(10.0) == "velocity-limited"
    task = ResolvedRateController(constraint, PointAttractor(here + 0.1))(q).task_part
    blocked = q.copy()
    j = int(np.argmax(np.abs(task)))
    blocked[j] = (robot.position_upper if task[j] > 0 else robot.position_lower)[j]
    moved = constraint.features.coordinates(blocked) + 0.1
    assert ResolvedRateController(constraint, PointAttractor(moved))(blocked).status in ("rerouted", "position-limited")


def test_bad_input_is_refused(robot_of):
    """NaN, wrong sizes, targets that do not fit, settings out of range: an error of this library, never a number."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    controller = ResolvedRateController(constraint, PointAttractor([1.0, 1.0]))
    for q in ([np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [0.0, 0.0], np.zeros((1, 3)), None):
        with pytest.raises(ConfigurationError):
            controller(q)
    with pytest.raises(TargetError, match="2 numbers"):
        ResolvedRateController(constraint, PointAttractor([1.0, 1.0, 1.0]))(np.ones(3))
    with pytest.raises(TargetError, match="2 numbers"):
        ResolvedRateController(constraint, None, JointAttractor(np.zeros(2), robot=None))(np.ones(3))
    for settings in ({"threshold": 0.0}, {"damping": -1.0}, {"dt": np.nan}):
        with pytest.raises(ConstraintError, match=next(iter(settings))):
            ResolvedRateController(constraint, **settings)
    for dt in (0.0, -0.01, np.nan, np.inf):  # which would turn the position limits round, or off
        with pytest.raises(ConfigurationError, match="positive"):
            controller(np.ones(3), 0.0, dt)
    with pytest.raises(ConstraintError, match="'pinv'"):
        ResolvedRateController(constraint, inverse="pinv")  # type: ignore[arg-type]


def test_features_without_a_robot():
    """A system that is no arm: no limits, the bare law, and NaN is refused all the same."""
    features = CustomFeatures(lambda q: np.array([[1.0, q[0], 0.0]]), ("r",), 3, coordinates=lambda q: q[:1])
    controller = ResolvedRateController(Constraint([[1.0]], features), PointAttractor([2.0]), inverse="exact")
    q = np.array([0.5, 0.0, 0.0])
    np.testing.assert_allclose(features(q) @ controller(q).velocity, [1.5], rtol=1e-14)
    with pytest.raises(ConfigurationError):
        controller([np.nan, 0.0, 0.0])


@pytest.mark.parametrize("limits", [True, False])
def test_a_task_that_is_not_finite_is_named(limits, robot_of):
    """NaN or infinity from a task is the task's fault, not the posture's; so is a wrong size."""
    constraint, task = Constraint(np.eye(3), FrameJacobian(robot_of("sawyer"), "right_hand")), Asks(np.zeros(3))
    for policy in (None, ManipulabilityAscent(constraint)):
        controller = ResolvedRateController(constraint, task, policy, limits=limits)
        for b in (np.array([0.1, np.nan, 0.0]), [np.inf, 0.0, 0.0], np.zeros(2)):
            task.b = b
            for q in (np.linspace(-0.5, 0.7, 7), np.zeros(7)):
                with pytest.raises(TargetError, match="task's velocity"):
                    controller(q)
        task.b = np.array([1, 0, 0])
        assert controller(np.linspace(-0.5, 0.7, 7)).task_velocity.dtype == np.float64


def test_svd_survives_a_failing_lapack(monkeypatch, rng):
    """If LAPACK reports that it did not converge, NumPy's own call has the last word."""
    A = rng.normal(size=(2, 5))
    expected = np.linalg.svd(A)
    monkeypatch.setattr(manipulability, "dgesdd", lambda A: (np.nan, np.nan, np.nan, 1))
    for got, factor in zip(svd(A), expected, strict=True):
        np.testing.assert_array_equal(got, factor)
