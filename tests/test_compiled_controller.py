"""A compiled controller must give the commands of the one that it was made from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import tip_of
from test_control_step import close

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FrameJacobian
from manip_learn.control.compiled import compiled_controller
from manip_learn.control.compiled.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import simulate
from manip_learn.control.tasks import Hold, PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError
from manip_learn.robot.robot import Robot

pytest.importorskip("numba", reason="the extra 'fast' is not installed")
RobotOf = Callable[[str], Robot]


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


@pytest.mark.parametrize("name", ["planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree"])
def test_commands_are_the_same(name: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
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


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["planar3", "sawyer", "kinova"])
def test_rollouts_are_the_same(name: str, method: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A compiled rollout follows the one in Python to 1e-10, through singular starts and damped stretches."""
    robot = robot_of(name)
    features = FrameJacobian(robot, tip_of(name), "x y")
    constraint = Constraint(np.eye(2), features)
    target = features.coordinates(robot.random_configuration(rng))
    controller = ResolvedRateController(constraint, PointAttractor(target), ManipulabilityAscent(constraint, 0.2))
    for start in (robot.positions(robot.random_configuration(rng)), np.full(robot.nv, 1e-3)):
        wanted = simulate(robot, controller, start, 1.0, 0.02, method)
        got = CompiledController(controller).rollout(start, 50, 0.02, method)
        np.testing.assert_allclose(got.q, wanted.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.u, wanted.u, rtol=0, atol=1e-8)
        np.testing.assert_allclose(got.mu, wanted.manipulability, rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.error, wanted.task_error, rtol=0, atol=1e-9)
        assert got.status == wanted.status


def test_what_cannot_be_compiled_says_why(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_bad_postures_are_refused(robot_of: RobotOf) -> None:
    """NaN, infinity and wrong sizes raise what the original raises."""
    features = FrameJacobian(robot_of("sawyer"), "right_hand")
    controller = ResolvedRateController(Constraint(np.eye(3), features))
    compiled = CompiledController(controller)
    for wrong in (np.full(7, np.nan), [np.inf] * 7, np.zeros(6), "text"):
        with pytest.raises(ConfigurationError):
            compiled(wrong)
    q = np.linspace(-0.5, 0.7, 7)
    for same in (list(q), q.astype(">f8"), np.repeat(q, 2)[::2]):
        np.testing.assert_array_equal(compiled(same).velocity, compiled(q).velocity)
