"""Rollouts from a table of starts must be the rollouts from each start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, PointAttractor, Track
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]


@pytest.mark.parametrize(
    ("name", "method"), [("planar3", "euler"), ("wrist", "rk4"), ("humanoid", "euler"), ("vector", "rk4")]
)
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


def test_jerk_limits_are_kept(robot_of: RobotOf) -> None:
    """The average that keeps them belongs to the servo loop, which a law with limits is simulated in."""
    robot, dt, jerk = robot_of("sawyer"), 0.01, 100.0
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand"))
    law = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.4]), limits=Limits(robot, jerk=jerk))
    u = simulate(robot, law, np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4]), 0.3, dt).u
    changes = np.diff(np.vstack([np.zeros((2, 7)), u]), 2, axis=0)
    assert np.max(np.abs(changes)) <= jerk * dt**2 * (1.0 + 1e-9) and np.max(np.abs(u)) > 0.1


def test_no_start_and_bad_starts(robot_of: RobotOf) -> None:
    """An empty table gives no rollout; NaN names its row and joint."""
    robot = robot_of("sawyer")
    controller = ResolvedRateController(Constraint(np.eye(3), FrameJacobian(robot, "right_hand")))
    assert simulate(robot, controller, np.zeros((0, 7)), 0.1, 0.02) == ()
    starts = np.zeros((3, 7))
    starts[1, 4] = np.nan
    with pytest.raises(ConfigurationError, match=f"row 1, joint '{robot.joint_names[4]}'"):
        simulate(robot, controller, starts, 0.1, 0.02)
