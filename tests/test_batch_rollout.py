"""Rollouts from a table of starts must be the rollouts from each start."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.control import compiled_controller
from manip_learn.control import simulation as simulation_module
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]


def same(many: tuple[Rollout, ...], singles: list[Rollout]) -> None:
    assert len(many) == len(singles)
    for a, b in zip(many, singles, strict=True):
        for name in ("time", "q", "u", "manipulability", "task_error"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=1e-9, err_msg=name)
        assert a.status == b.status and a.joint_names == b.joint_names


def starts_of(robot: Robot, rng: np.random.Generator, n: int) -> np.ndarray:
    return np.stack([0.8 * robot.positions(robot.random_configuration(rng)) for _ in range(n)])


@pytest.fixture(params=["compiled", "start by start"])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What computes a table of starts: the kernel wherever the controller can be compiled, or the law."""
    if request.param == "compiled":
        pytest.importorskip("numba", reason="the extra 'fast' is not installed")
    monkeypatch.setattr(simulation_module, "COMPILED_FROM", 0 if request.param == "compiled" else math.inf)


@pytest.mark.usefixtures("engine")
def test_many_starts_are_single_starts(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Postures, velocities, mu, distances and statuses to 1e-9 after 0.4 s, for every task and policy."""
    for name, method in product(("planar3", "sawyer", "wrist", "gantry", "mimic", "tree"), ("euler", "rk4")):
        robot = robot_of(name)
        starts, features = starts_of(robot, rng, 3), FrameJacobian(robot, tip_of(name), "x y")
        target = features.coordinates(robot.random_configuration(rng))
        oblique, plain = Constraint([[0.6, 0.8]], features), Constraint(np.eye(2), features)
        steep = ManipulabilityAscent(oblique, 1.0, logarithmic=False)
        track = Track(lambda t, target=target: target + 0.1 * t)
        for controller in (
            ResolvedRateController(oblique, PointAttractor(target), ManipulabilityAscent(oblique, 0.3)),
            ResolvedRateController(plain, PointAttractor(target, 2.0, 0.1), steep),
            ResolvedRateController(oblique, Hold(), JointAttractor(starts[0], 1.0), limits=False),
            ResolvedRateController(oblique, track, JointAttractor(starts[0], 1.0, robot)),
            ResolvedRateController(plain, PointAttractor(target), ZeroPolicy(robot.nv), "damped", threshold=0.3),
        ):
            singles = [simulate(robot, controller, q, 0.4, 0.02, method, compiled=False) for q in starts]
            same(simulate(robot, controller, starts, 0.4, 0.02, method), singles)


@pytest.mark.usefixtures("engine")
def test_singular_starts(robot_of: RobotOf) -> None:
    """Arms that start stretched out leave the singularity, beside arms that do not."""
    robot = robot_of("planar3")
    features = FrameJacobian(robot, "tip", "x y")
    constraint = Constraint(np.eye(2), features)
    controller = ResolvedRateController(constraint, PointAttractor([0.5, 1.0]), ManipulabilityAscent(constraint, 0.2))
    starts = np.array([[0.3, 0.0, 0.0], [0.3, 0.8, -0.5], [0.1, 1e-9, 0.0]])
    many = simulate(robot, controller, starts, 0.5, 0.01)
    same(many, [simulate(robot, controller, q, 0.5, 0.01, compiled=False) for q in starts])
    assert many[0].status[0] == "singular" and many[0].status[-1] != "singular"


@pytest.mark.usefixtures("engine")
def test_configurations_come_back_as_configurations(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Starts as (cos, sin) of continuous joints give postures of the same kind."""
    robot = robot_of("wrist")
    constraint = Constraint(np.eye(3)[:1], FrameJacobian(robot, "tip"))
    controller = ResolvedRateController(constraint, null_policy=ManipulabilityAscent(constraint))
    starts = np.stack([robot.configuration(q) for q in starts_of(robot, rng, 3)])
    singles = [simulate(robot, controller, q, 0.2, 0.02, compiled=False) for q in starts]
    same(simulate(robot, controller, starts, 0.2, 0.02), singles)


def test_systems_that_cannot_be_compiled(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Floating bases and plain vectors take a table of starts too."""
    robot = robot_of("humanoid")
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot, "tip"))
    controller = ResolvedRateController(constraint, null_policy=ManipulabilityAscent(constraint, 0.1))
    starts = np.stack([robot.random_configuration(rng) for _ in range(2)])
    same(simulate(robot, controller, starts, 0.1, 0.02), [simulate(robot, controller, q, 0.1, 0.02) for q in starts])
    plain = Constraint([[1.0]], CustomFeatures(lambda q: q[None, :] + 1.0, ("a",), 2))
    controller = ResolvedRateController(plain)
    starts = np.array([[0.1, 0.2], [0.3, 0.4]])
    same(simulate(None, controller, starts, 0.1, 0.02), [simulate(None, controller, q, 0.1, 0.02) for q in starts])


def test_long_rollouts_are_compiled(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel is used from `COMPILED_FROM` commands on, four per step of Runge-Kutta, where numba is, or as told."""
    pytest.importorskip("numba", reason="the extra 'fast' is not installed")
    robot, used, compiled_rollout = robot_of("sawyer"), [], simulation_module._compiled_rollout
    controller = ResolvedRateController(Constraint(np.eye(3), FrameJacobian(robot, "right_hand")))
    monkeypatch.setattr(simulation_module, "COMPILED_FROM", 3 * 11 * 4)
    monkeypatch.setattr(simulation_module, "_compiled_rollout", lambda *a: used.append(a[-1]) or compiled_rollout(*a))
    starts = np.tile(np.linspace(-0.5, 0.7, 7), (3, 1))
    simulate(robot, controller, starts, 0.1, 0.01, "euler")
    simulate(robot, controller, starts, 0.1, 0.01, "rk4", compiled=False)
    assert not used
    simulate(robot, controller, starts, 0.1, 0.01, "rk4")
    assert used == ["rk4"] * 3
    simulate(robot, controller, starts[0], 1.5, 0.01)
    simulate(robot, controller, starts[0], 0.1, 0.01, compiled=True)
    assert used[3:] == ["euler"] * 2
    monkeypatch.setattr(compiled_controller, "find_spec", lambda name: None)
    simulate(robot, controller, starts, 0.1, 0.01, "rk4")
    assert len(used) == 5
    with pytest.raises(MissingExtraError, match="fast"):
        simulate(robot, controller, starts, 0.1, 0.01, compiled=True)
    with pytest.raises(ConstraintError, match="ResolvedRateController"):
        simulate(robot, ServoLoop(controller, compiled=False), starts[0], 0.1, 0.01, compiled=True)


def test_jerk_limits_are_kept_by_compiled_controllers_too(robot_of: RobotOf) -> None:
    """The average that keeps them belongs to the servo loop, which a compiled controller then runs in."""
    pytest.importorskip("numba", reason="the extra 'fast' is not installed")
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand"))
    limits = Limits(robot, jerk=100.0)
    controller = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.4]), limits=limits)
    start = np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4])
    expected = simulate(robot, controller, start, 0.3, 0.01, compiled=False)
    same((simulate(robot, controller, start, 0.3, 0.01, compiled=True),), [expected])


def test_no_start_and_bad_starts(robot_of: RobotOf) -> None:
    """An empty table gives no rollout; NaN names its row and joint."""
    robot = robot_of("sawyer")
    controller = ResolvedRateController(Constraint(np.eye(3), FrameJacobian(robot, "right_hand")))
    assert simulate(robot, controller, np.zeros((0, 7)), 0.1, 0.02) == ()
    starts = np.zeros((3, 7))
    starts[1, 4] = np.nan
    with pytest.raises(ConfigurationError, match=f"row 1, joint '{robot.joint_names[4]}'"):
        simulate(robot, controller, starts, 0.1, 0.02)
