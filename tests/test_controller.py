"""The controller's promises: exact null space, task first, limits, words, and no NaN, from any posture."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.control.command import Command
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError

ROBOTS = ["planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree", "humanoid", "rover"]


def test_arguments_in_another_order(robot_of):
    """The error says the right call, and what was given where."""
    robot, task = robot_of("sawyer"), PointAttractor(np.zeros(2))
    constraint = oblique(robot, "sawyer", np.random.default_rng(0))
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


def oblique(robot, name: str, rng: np.random.Generator, s: int = 2) -> Constraint:
    """A dense constraint on the tip's position."""
    axes = "planar" if name == "planar3" else "xyz"
    return Constraint(rng.standard_normal((s, 3)), FrameJacobian(robot, tip_of(name), axes))


def inside(robot, rng: np.random.Generator, share: float = 0.98) -> np.ndarray:
    """A posture within the joint limits; unlimited joints anywhere in a turn."""
    low = np.where(np.isfinite(robot.position_lower), robot.position_lower, -3.0)
    high = np.where(np.isfinite(robot.position_upper), robot.position_upper, 3.0)
    return 0.5 * (low + high) + 0.5 * share * (high - low) * rng.uniform(-1.0, 1.0, robot.nv)


def wild(rng: np.random.Generator, size: float):
    """A task that asks for anything."""

    class Wild(PointAttractor):
        def velocity(self, constraint, q, t):
            return size * rng.standard_normal(constraint.n_constraints)

    return Wild(np.zeros(3))


def bounds_of(robot, x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    low = np.maximum(-robot.velocity_limit, np.minimum((robot.position_lower - x) / dt, 0.0))
    high = np.minimum(robot.velocity_limit, np.maximum((robot.position_upper - x) / dt, 0.0))
    return low, high


def test_every_command_keeps_the_promises(robot_of, rng):
    """A null_part = 0, A u = task_scale b (away from singularities), limits, finite numbers, on every kind of robot.

    Where limits change the law, 1e-3 of what they take of the task may go beside its direction, and 1e-4 of what the
    policy asks for along it.
    """
    for name, inverse in product(ROBOTS, ("exact", "truncated", "damped")):
        robot = robot_of(name)
        for k in range(25):
            constraint = oblique(robot, name, rng, 1 + k % 2)
            size = 10.0 ** rng.uniform(-2.0, 1.5)
            policy = ManipulabilityAscent(constraint, gain=10.0 ** rng.uniform(-1.0, 1.0))
            controller = ResolvedRateController(constraint, wild(rng, size), policy, inverse)
            q = robot.configuration(inside(robot, rng)) if k % 2 else robot.random_configuration(rng)
            command, A = controller(q), constraint(q)
            scale = max(1.0, float(np.linalg.norm(A)) * float(np.linalg.norm(command.null_part)))
            assert np.max(np.abs(A @ command.null_part)) <= 1e-12 * scale
            if command.smallest_singular_value > 0.05:
                b, moved = command.task_velocity, A @ command.velocity
                along = b / np.linalg.norm(b)
                forward, taken = float(along @ moved), (1.0 - command.task_scale) * float(np.linalg.norm(b))
                free = command.status == "ok"
                asked = 0.0 if free else float(np.linalg.norm(policy(q)))
                rounding = 1e-11 * max(1.0, size)
                beside = float(np.linalg.norm(moved - forward * along))
                assert beside <= rounding + 1e-6 * asked + 1e-3 * taken
                assert abs(forward + taken - np.linalg.norm(b)) <= rounding + 1e-4 * asked
            low, high = bounds_of(robot, robot.positions(q), controller.dt)
            assert np.all(command.velocity <= high + 1e-9) and np.all(command.velocity >= low - 1e-9)
            assert 0.0 <= command.task_scale <= 1.0 and 0.0 <= command.null_scale <= 1.0
            np.testing.assert_allclose(command.task_part + command.null_part, command.velocity, rtol=0, atol=1e-12)


def test_from_outside_the_limits_the_arm_only_comes_back(robot_of, rng):
    """A start outside the limits is no error: no joint goes farther out, and the task may bring it in."""
    robot = robot_of("sawyer")
    for _ in range(6):
        q = inside(robot, rng)
        j = int(rng.integers(robot.nv))
        q[j] = robot.position_upper[j] + 0.2
        constraint = oblique(robot, "sawyer", rng)
        target = constraint.features.coordinates(inside(robot, rng))
        controller = ResolvedRateController(constraint, PointAttractor(target), ManipulabilityAscent(constraint))
        rollout = simulate(robot, controller, q, 1.0, 0.02)
        assert np.all(np.diff(rollout.q[:, j])[rollout.q[:-1, j] > robot.position_upper[j]] <= 1e-15)


class Scaled:
    """A^+ b, as fast as the limits allow: what has no use for the null space."""

    def __init__(self, law: ResolvedRateController):
        self.law, self.task_error = law, law.task_error

    def __call__(self, q: np.ndarray, t: float = 0.0, dt: float | None = None) -> Command:
        """The command at posture q."""
        plain = ResolvedRateController(self.law.constraint, self.law.task, inverse="truncated", limits=False)(q, t, dt)
        low, high = bounds_of(self.law.robot, q, self.law.dt if dt is None else dt)
        u = plain.velocity
        most = np.where(u > 0.0, high, low) / np.where(u == 0.0, 1.0, u)
        return plain._replace(velocity=u * np.clip(np.min(most[u != 0.0], initial=1.0), 0.0, 1.0))


def test_the_null_space_leads_round_position_limits(robot_of):
    """Where joints at their limits stop the plain law, null-space motion lets most targets be reached all the same."""
    robot = robot_of("sawyer")
    rng = np.random.default_rng(5)
    reached = {True: 0, False: 0}
    for _ in range(10):
        constraint, start = oblique(robot, "sawyer", rng), inside(robot, rng, 0.96)
        target = constraint.features.coordinates(inside(robot, rng, 0.8))
        law = ResolvedRateController(constraint, PointAttractor(target, gain=2.0, max_speed=0.5))
        for helped, controller in ((True, law), (False, Scaled(law))):
            reached[helped] += simulate(robot, controller, start, 4.0, 0.02).task_error[-1] < 0.01
    assert reached[True] >= reached[False] + 3
    assert reached[True] >= 8


def test_singular_postures_give_finite_commands_or_a_reason(robot_of, rng):
    """Stretched arms, and postures within 1e-14 ... 1e-3 of them: finite and within limits, or an error."""
    distances = (0.0, 1e-16, 1e-14, 1e-10, 1e-6, 1e-3)
    for name, inverse in product(("planar3", "sawyer", "ur5", "panda"), ("exact", "truncated", "damped")):
        robot = robot_of(name)
        features = FrameJacobian(robot, tip_of(name), "x y" if name == "planar3" else "pose")
        stretched = np.clip(np.zeros(robot.nv), robot.position_lower, robot.position_upper)
        for distance, s in product(distances, (1, features.n_rows)):
            q = stretched + distance * rng.standard_normal(robot.nv)
            constraint = Constraint(np.eye(features.n_rows)[:s], features)
            policy = ManipulabilityAscent(constraint)
            controller = ResolvedRateController(constraint, wild(rng, 1.0), policy, inverse, limits=distance != 1e-10)
            try:
                command = controller(q)
            except ConfigurationError as error:
                assert inverse != "damped" and "use inverse='damped'" in str(error)
                continue
            assert np.all(np.isfinite(command.velocity)) and np.isfinite(command.manipulability)
            scale = max(1.0, float(np.linalg.norm(command.null_part)))
            assert np.max(np.abs(constraint(q) @ command.null_part)) <= 1e-12 * scale
            if inverse == "damped":
                assert np.linalg.norm(command.task_part) <= 23.0 * np.linalg.norm(command.task_velocity)


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
        followed = np.allclose(constraint(q) @ command.velocity, command.task_velocity, rtol=1e-10, atol=0)
        assert followed == (sigma >= controller.threshold)
        assert command.smallest_singular_value == pytest.approx(sigma, rel=1e-9, abs=1e-15)
        words[elbow] = command.status
        # A^T (A A^T + lambda^2)^-1 b, lambda = damping (1 - (sigma / threshold)^2) of the smallest singular value
        A, factor = constraint(q), 0.05 * max(0.0, 1.0 - (sigma / 0.05) ** 2)
        U, values, Vt = np.linalg.svd(A)
        gains = values / np.maximum(values**2 + factor**2, 1e-300)
        expected = Vt[:2].T @ (gains * (U.T @ command.task_velocity))
        np.testing.assert_allclose(command.task_part, expected, rtol=1e-9, atol=1e-14)
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


def test_the_papers_law(robot_of, rng):
    """limits=False with the exact inverse is equation (2), A^+ b + N pi, to the last digits."""
    robot = robot_of("sawyer")
    for _ in range(10):
        constraint = oblique(robot, "sawyer", rng)
        q, rest = inside(robot, rng), inside(robot, rng)
        target = rng.standard_normal(3)
        controller = ResolvedRateController(
            constraint, PointAttractor(target), JointAttractor(rest), "exact", limits=False
        )
        A = constraint(q)
        b = constraint.selection @ (target - constraint.features.coordinates(q))
        expected = np.linalg.pinv(A) @ b + (np.eye(7) - np.linalg.pinv(A) @ A) @ (rest - q)
        np.testing.assert_allclose(controller(q).velocity, expected, rtol=0, atol=1e-11 * np.linalg.norm(expected))


def test_commands_do_not_depend_on_the_past(robot_of, rng):
    """The same posture gives the same command, whatever was asked in between."""
    robot = robot_of("sawyer")
    constraint = oblique(robot, "sawyer", rng)
    controller = ResolvedRateController(constraint, PointAttractor(np.zeros(3)), ManipulabilityAscent(constraint))
    q = inside(robot, rng)
    first = controller(q).velocity.copy()
    for _ in range(20):
        controller(inside(robot, rng))
    np.testing.assert_array_equal(controller(q).velocity, first)
    assert "inverse='damped'" in repr(controller)
