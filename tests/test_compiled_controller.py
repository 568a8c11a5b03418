"""The kernel must give the commands and rollouts of the law in `controller`, compiled or as the plain Python it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np
import pytest
from conftest import tip_of
from test_batch_rollout import same
from test_control_step import close

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FrameJacobian
from manip_learn.constraint.manipulability_batch import row_inverses
from manip_learn.control import compiled_controller, kernel, kernel_linalg
from manip_learn.control.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.integration import Method
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError
from manip_learn.linalg import row_inverse
from manip_learn.robot.batch import compiled_kinematics
from manip_learn.robot.robot import Robot

needs_numba = pytest.mark.skipif(find_spec("numba") is None, reason="the extra 'fast' is not installed")
both_ways = pytest.mark.parametrize("numba", [pytest.param(True, marks=needs_numba), False])
RobotOf = Callable[[str], Robot]


@pytest.fixture
def kernels(numba: bool, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The kernels as they are compiled, or the same function objects run by the interpreter."""
    if numba:
        yield
        return
    monkeypatch.setattr(compiled_controller, "find_spec", lambda name: "plain Python instead")
    for module in (compiled_kinematics, kernel_linalg, kernel):
        for name, value in list(vars(module).items()):
            monkeypatch.setattr(module, name, getattr(value, "py_func", value))
    with np.errstate(all="ignore"):  # as compiled code, which overflows to infinity in silence
        yield


def controllers(robot: Robot, frame: str, rng: np.random.Generator) -> list[ResolvedRateController]:
    out = []
    rest = robot.positions(robot.random_configuration(rng))
    for axes, reference in (("xyz", "world"), ("z x", "world"), ("pose", "local")):
        features = FrameJacobian(robot, frame, axes, reference)
        for s in range(1, min(features.n_rows, robot.nv - 1, 4) + 1):
            constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
            target = FrameJacobian(robot, frame, "xyz").coordinates(robot.random_configuration(rng))
            target = target[["xyz".index(n) for n in features.row_names]] if axes != "pose" else None
            policies: list[NullSpacePolicy] = [
                ManipulabilityAscent(constraint, 0.5),
                ManipulabilityAscent(constraint, 3.0, logarithmic=False),
                JointAttractor(rest, 2.0, robot),
                JointAttractor(rest, 0.5),
                ZeroPolicy(robot.nv),
            ]
            for i, policy in enumerate(policies):
                task = Hold() if target is None else PointAttractor(target, 2.0, max_speed=0.2 if i % 2 else None)
                inverse = ("damped", "exact", "truncated")[(i + s) % 3]
                out.append(ResolvedRateController(constraint, task, policy, inverse, limits=bool((i + s) % 4)))
    return out


@both_ways
@pytest.mark.parametrize("name", ["planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree"])
@pytest.mark.usefixtures("kernels")
def test_commands_are_the_same(name: str, numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Every part of the command, its numbers to 1e-12 and its status, at random, extreme and singular postures."""
    robot = robot_of(name)
    statuses = set()
    for controller in controllers(robot, tip_of(name), rng):
        compiled = CompiledController(controller)
        q = robot.positions(robot.random_configuration(rng))
        postures = [q, 1.1 * q, np.zeros(robot.nv), 1e-4 * q]
        if not (isinstance(controller.null_policy, JointAttractor) and controller.null_policy.robot is None):
            postures.append(robot.random_configuration(rng))
        for x in postures:
            if np.linalg.cond(controller.constraint(x)) > 1e6 and controller.inverse != "damped":
                continue  # A^+ b is rounding there
            command = controller(x)
            close(compiled(x), command)
            statuses.add(command.status)
            close(compiled(x, 0.0, 0.1), controller(x, 0.0, 0.1))
    assert len(statuses) >= 3


@both_ways
@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["planar3", "sawyer", "kinova"])
@pytest.mark.usefixtures("kernels")
def test_rollouts_are_the_same(
    name: str, method: Method, numba: bool, robot_of: RobotOf, rng: np.random.Generator
) -> None:
    """A rollout of the kernel follows that of the law to 1e-9, through singular starts and damped stretches."""
    robot = robot_of(name)
    features = FrameJacobian(robot, tip_of(name), "x y")
    constraint = Constraint(np.eye(2), features)
    target = features.coordinates(robot.random_configuration(rng))
    controller = ResolvedRateController(constraint, PointAttractor(target), ManipulabilityAscent(constraint, 0.2))
    for start in (robot.positions(robot.random_configuration(rng)), np.full(robot.nv, 1e-3)):
        expected = simulate(robot, controller, start, 1.0, 0.02, method)
        got = CompiledController(controller).rollout(start, 50, 0.02, method)
        np.testing.assert_allclose(got.q, expected.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.u, expected.u, rtol=0, atol=1e-8)
        np.testing.assert_allclose(got.mu, expected.manipulability, rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.error, expected.task_error, rtol=0, atol=1e-9)
        assert got.status == expected.status


@both_ways
@pytest.mark.usefixtures("kernels")
def test_row_inverses_are_the_same(numba: bool, rng: np.random.Generator) -> None:
    """The law's row inverse, the kernel's and that for many postures agree to 1e-12 where the law's does not refuse."""
    for _ in range(100):
        s = int(rng.integers(1, 5))
        A = rng.normal(size=(s, int(rng.integers(s + 1, 9))))
        expected = row_inverse(A)
        X, G, L = np.zeros(A.shape), np.zeros((s, s)), np.zeros((s, s))
        volume, smallest = kernel_linalg.row_inverse(A, X, G, L)
        assert (expected is None) == (volume == 0.0)
        if expected is None:
            continue
        many, mu, ill = row_inverses(A[:, :, None])
        assert not ill[0]
        for got in (X, many[..., 0]):
            np.testing.assert_allclose(got, expected[0], rtol=0, atol=1e-12 / expected[2])
        np.testing.assert_allclose([volume, mu[0]], expected[1], rtol=1e-12)
        np.testing.assert_allclose(smallest, expected[2], rtol=1e-11)


@needs_numba
def test_compiled_controllers_are_simulated(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """`simulate` takes a compiled controller, from one start or many, as postures or configurations."""
    robot = robot_of("wrist")
    features = FrameJacobian(robot, tip_of("wrist"), "x y")
    constraint = Constraint([[0.6, 0.8]], features)
    controller = ResolvedRateController(constraint, PointAttractor([0.4, 0.5]), ManipulabilityAscent(constraint, 0.2))
    positions = np.stack([0.8 * robot.positions(robot.random_configuration(rng)) for _ in range(3)])
    for starts in (positions, np.stack([robot.configuration(x) for x in positions])):
        expected = [simulate(robot, controller, start, 0.4, 0.02) for start in starts]
        same(simulate(robot, CompiledController(controller), starts, 0.4, 0.02), expected)
        same((simulate(robot, CompiledController(controller), starts[0], 0.4, 0.02),), expected[:1])


def test_unsupported_controllers_are_refused(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each unsupported part is named; without numba the extra is."""
    robot, arm = robot_of("humanoid"), robot_of("sawyer")
    features = FrameJacobian(arm, "right_hand")
    constraint = Constraint(np.eye(3), features)
    other = Constraint(np.eye(3)[:2], features)
    local = FrameJacobian(arm, "right_hand", "xyz", "local")
    refused = {
        "CentreOfMass": ResolvedRateController(Constraint(np.eye(3), CentreOfMass(arm))),
        "revolute": ResolvedRateController(Constraint(np.eye(3), FrameJacobian(robot, "tip"))),
        "another robot": ResolvedRateController(constraint, robot=robot_of("planar3")),
        "Track": ResolvedRateController(constraint, Track(lambda t: [0.5, 0.1, 0.2])),
        "local": ResolvedRateController(Constraint(np.eye(3), local), PointAttractor([0.5, 0.1, 0.2])),
        "another constraint": ResolvedRateController(constraint, null_policy=ManipulabilityAscent(other)),
        "rest posture": ResolvedRateController(constraint, null_policy=JointAttractor(np.zeros(3))),
        "more rows": ResolvedRateController(Constraint(np.eye(6), FrameJacobian(robot_of("planar3"), "tip", "pose"))),
    }
    for words, controller in refused.items():
        assert words in (why_not(controller) or ""), words
        with pytest.raises(ConstraintError, match=words):
            CompiledController(controller)
    monkeypatch.setattr(compiled_controller, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="fast"):
        CompiledController(ResolvedRateController(constraint))


@needs_numba
def test_bad_postures_are_refused(robot_of: RobotOf) -> None:
    """NaN, infinity and wrong sizes raise what the original raises."""
    features = FrameJacobian(robot_of("sawyer"), "right_hand")
    controller = ResolvedRateController(Constraint(np.eye(3), features))
    compiled = CompiledController(controller)
    for wrong in (np.full(7, np.nan), [np.inf] * 7, np.zeros(6), "text"):
        with pytest.raises(ConfigurationError):
            compiled(wrong)
    q = np.linspace(-0.5, 0.7, 7)
    for equal in (list(q), q.astype(">f8"), np.repeat(q, 2)[::2]):
        np.testing.assert_array_equal(compiled(equal).velocity, compiled(q).velocity)


@both_ways
@pytest.mark.usefixtures("kernels")
def test_velocities_near_limits_are_admitted_alike(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Each sense of motion has the braking distance to its own limit, as in `Limits.admit`, at every place."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand", "xyz"))
    controller = ResolvedRateController(constraint, null_policy=ZeroPolicy(robot.nv))
    limits, table = controller.limits, compiled_controller._packed(controller)
    assert limits is not None
    dofs, dt, told = kernel.CHAIN + kernel.JOINTS + int(table[0, kernel.N_JOINTS]), 0.01, set()
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    for j in range(robot.nv):
        for edge, outward in ((robot.position_upper[j], 1.0), (robot.position_lower[j], -1.0)):
            for distance in (-1e-6, 1e-4, 0.01, 0.1):
                for speed in (-1.5, -0.5, -0.05, 0.05, 0.5, 1.5):
                    q, u = middle.copy(), np.zeros(robot.nv)
                    q[j], u[j] = edge - outward * distance, outward * speed
                    for before in (u, u + 1.01 * limits.acceleration * dt):
                        expected = limits.admit(q, dt, u, before)
                        assert kernel.admitted(table, dofs, robot.nv, q, dt, u, before) == expected
                        told.add((expected, speed > 0.0))
    assert len(told) == 4
