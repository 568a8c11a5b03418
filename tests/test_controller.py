"""The controller's promises: exact null space, task first, limits, words, and no NaN, from any posture of any tree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_arms import Asks, Drives, random_case
from rounding import rounding
from servo_cases import Arm

import manip_learn as ml
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError
from manip_learn.linalg import null_basis


@pytest.fixture(params=["", "python"])
def planar(planar3, request, monkeypatch):
    """Two rows of an arm in a plane, for the compiled law if there is one, and for the law in Python."""
    monkeypatch.setenv("MANIP_LEARN_ENGINE", request.param)
    return ml.Constraint(np.eye(2), ml.FrameJacobian(planar3, "tip", "x y"))


def test_arguments_in_another_order(sawyer):
    """The error shows the right call, and what was given where."""
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(sawyer, "right_hand"))
    task, law = ml.PointAttractor(np.zeros(2)), ml.ResolvedRateController(constraint)
    with pytest.raises(ConfigurationError) as caught:
        ml.simulate(law, sawyer, np.zeros(7))
    got = "a ResolvedRateController, a Robot and an ndarray of shape (7,), in this order"
    assert str(caught.value) == f"call simulate(robot, controller, q0): got {got}"
    with pytest.raises(ConstraintError) as caught:
        ml.ResolvedRateController(task, constraint)
    got = "a PointAttractor, a Constraint and None, in this order"
    assert str(caught.value) == f"call ResolvedRateController(constraint, task, null_policy): got {got}"


@pytest.mark.parametrize(
    ("elbow", "word"),
    [(1.0, "ok"), (0.3, "ok"), (0.02, "damped"), (0.012, "damped"), (0.0115, "stalled"), (1e-4, "stalled"),
     (0.0, "singular")],
)  # fmt: skip
def test_damping_only_below_the_threshold(elbow, word, planar):
    """Above the threshold the task is followed exactly; below it is damped, then stalls, and at zero it is singular."""
    q, task = np.array([0.2, elbow, 0.0]), ml.Track(lambda t: [0.0, 0.0], gain=1e-2)
    controller = ml.ResolvedRateController(planar, task, limits=False, threshold=0.05, damping=0.05)
    command, A = controller(q), planar(q)
    U, values, Vt = np.linalg.svd(A)
    sigma, known = values[-1], rounding(4 * 2 * 3, A)  # of a singular value
    followed = np.allclose(A @ command.velocity, command.task_velocity, rtol=1e-10, atol=0)
    assert followed == (sigma >= controller.threshold) and command.status == word
    assert word == "singular" or (word == "stalled") == (command.progress < 0.02)
    assert command.smallest_singular_value == pytest.approx(sigma, rel=1e-9, abs=known)
    # A^T (A A^T + lambda^2)^-1 b, lambda = damping (1 - (sigma / threshold)^2) of the smallest singular value
    factor = 0.05 * max(0.0, 1.0 - (sigma / 0.05) ** 2)
    expected = Vt[:2].T @ (values / np.maximum(values**2 + factor**2, 1e-300) * (U.T @ command.task_velocity))
    known *= np.linalg.norm(command.task_velocity) / 0.05**2  # of sigma b / (sigma^2 + factor^2)
    np.testing.assert_allclose(command.task_part, expected, rtol=1e-9, atol=known)


def test_what_holds_the_hand_gives_way_last(planar):
    """Below the threshold rows that are held are damped with a tenth of the lambda of those that are driven."""
    q, b, D = np.array([0.2, 0.02, 0.0]), np.array([1e-3, -2e-3]), np.array([[0.6, 0.8]])
    law = ml.ResolvedRateController(planar, Drives(b, D), limits=False, threshold=0.05, damping=0.05)
    A, sigma = planar(q), np.linalg.svd(planar(q), compute_uv=False)[-1]
    damping = (0.05 * (1.0 - (sigma / 0.05) ** 2)) ** 2 * (0.01 * np.eye(2) + 0.99 * D.T @ D)
    np.testing.assert_allclose(law(q).task_part, A.T @ np.linalg.solve(A @ A.T + damping, b), rtol=1e-9, atol=1e-12)
    for size, has_arrived in ((0.9e-6, True), (1.1e-6, False)):  # a task that asks for less has all it wants
        law = ml.ResolvedRateController(planar, Asks(size * D[0]), limits=False, threshold=0.05, damping=0.05)
        assert (law(q).progress == 1.0) == has_arrived


def test_the_words_are_right(robot_of):
    """Each word is given for what it says, the gravest first."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, "right_hand"))
    q = np.radians([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 100.0])

    def command(offset, gain=0.0, posture=q):
        task = ml.PointAttractor(constraint.features.coordinates(posture) + offset)
        return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, gain))(posture)

    for offset, gain, word in ((0.001, 0.0, "ok"), (0.01, 4.0, "null-scaled"), (10.0, 0.0, "velocity-limited")):
        assert command(offset, gain).status == word
    task, blocked = command(0.1).task_part, q.copy()
    j = int(np.argmax(np.abs(task)))
    blocked[j] = (robot.position_upper if task[j] > 0 else robot.position_lower)[j]
    assert command(0.1, 0.0, blocked).status in ("rerouted", "position-limited")


def test_targets_that_do_not_fit_are_refused(planar):
    """More numbers than rows and a posture of another arm: an error of this library, never a number."""
    for wrong in ((ml.PointAttractor([1.0, 1.0, 1.0]),), (None, ml.JointAttractor(np.zeros(2), robot=None))):
        with pytest.raises(TargetError, match="2 numbers"):
            ml.ResolvedRateController(planar, *wrong)(np.ones(3))


def test_features_without_a_robot():
    """A system that is no arm: no limits, the bare law, and NaN is refused all the same."""
    features = ml.CustomFeatures(lambda q: np.array([[1.0, q[0], 0.0]]), ("r",), 3, coordinates=lambda q: q[:1])
    controller = ml.ResolvedRateController(ml.Constraint([[1.0]], features), ml.PointAttractor([2.0]), inverse="exact")
    q = np.array([0.5, 0.0, 0.0])
    np.testing.assert_allclose(features(q) @ controller(q).velocity, [1.5], rtol=1e-14)
    with pytest.raises(ConfigurationError):
        controller([np.nan, 0.0, 0.0])


@pytest.mark.parametrize("limits", [True, False])
@pytest.mark.parametrize("climbs", [True, False])
def test_a_task_that_is_not_finite_is_named(limits, climbs, robot_of):
    """NaN or infinity from a task is the task's fault, not the posture's; so is a wrong size."""
    constraint = ml.Constraint(np.eye(3), ml.FrameJacobian(robot_of("sawyer"), "right_hand"))
    task, policy = Asks(np.zeros(3)), ml.ManipulabilityAscent(constraint) if climbs else None
    controller = ml.ResolvedRateController(constraint, task, policy, limits=limits)
    for task.b in (np.array([0.1, np.nan, 0.0]), [np.inf, 0.0, 0.0], np.zeros(2)):
        for q in (np.linspace(-0.5, 0.7, 7), np.zeros(7)):
            with pytest.raises(TargetError, match="task's velocity"):
                controller(q)
    task.b = np.array([1, 0, 0])
    assert controller(np.linspace(-0.5, 0.7, 7)).task_velocity.dtype == np.float64


# ---- random trees, random rows, any posture ----

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Where random robots are written."""
    return tmp_path_factory.mktemp("trees")


def mean_velocity(law, state, command):
    """A u over the step, as its rows turn by the motion before: that is what the law promises (see `Law`)."""
    A, v = law.constraint(state.q), state.previous
    if v is None or not v.any():
        return A @ command.velocity
    c = (law.constraint(law.robot.integrate(state.q, 0.5 * state.dt * v)) - A) @ v
    most = 0.25 * command.smallest_singular_value * float(np.linalg.norm(v))
    return A @ command.velocity + c * min(1.0, most / max(float(np.linalg.norm(c)), 1e-300))


@given(seeds)
@pytest.mark.fuzz
def test_every_command_keeps_the_promises(folder, seed):
    """Finite, within the limits, A null_part = 0, N^2 = N = N^T; the progress stated is that of the rows along b."""
    law, state = random_case(seed, folder)
    q, dt, previous, _ = state
    try:
        command = law(q, 0.0, dt, previous)
    except ConfigurationError as error:
        assert law.inverse != "damped" and "overflows at this posture" in str(error)
        return
    A, u, b = law.constraint(q), command.velocity, command.task_velocity
    assert np.all(np.isfinite(u))
    bounds = law.limits.bounds(q, dt, previous)
    assert np.all(u >= np.array(bounds.low) - 1e-12) and np.all(u <= np.array(bounds.high) + 1e-12)
    Z = null_basis(A)
    N = Z @ Z.T
    np.testing.assert_array_equal(N, N.T)
    np.testing.assert_allclose(N @ N, N, rtol=0, atol=1e-12)
    scale = max(1.0, float(np.linalg.norm(A)) * float(np.linalg.norm(command.null_part)))
    np.testing.assert_allclose(A @ command.null_part, 0.0, rtol=0, atol=1e-12 * scale)
    escape = 0.0 if command.escape_part is None else command.escape_part
    parts = command.task_part + command.null_part + escape
    np.testing.assert_allclose(parts, u, rtol=0, atol=1e-11 * max(1.0, float(np.linalg.norm(u))))
    progress = float(b @ mean_velocity(law, state, command) / (b @ b))
    assert command.progress == pytest.approx(progress, rel=2e-3, abs=2e-3)
    if command.status is ml.Status.OK:
        assert command.outside == 0.0 and progress > 0.99
        assert np.all(q <= law.limits.upper + 1e-9) and np.all(q >= law.limits.lower - 1e-9)


@given(seeds)
@pytest.mark.fuzz
def test_a_loop_keeps_every_limit(folder, seed):
    """In a closed loop from inside: positions, velocities and accelerations within their limits in every period."""
    law, state = random_case(seed, folder, inverse="damped")
    arm = Arm(ml.ServoLoop(law, state.dt, stale_after=1.0), np.clip(state.q, law.limits.lower, law.limits.upper))
    for _ in range(60):
        assert arm.call().status is not ml.Status.INVALID_INPUT
        assert np.all(arm.q <= law.limits.upper + 1e-9) and np.all(arm.q >= law.limits.lower - 1e-9)
