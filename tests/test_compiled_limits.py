"""Limits compiled, behind a law in Python and in whole steps: the commands of the other solvers, for any law."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from compiled_cases import RobotOf, agree, both_ways, compared, kernels, needs_numba, tight  # noqa: F401
from conftest import tip_of
from random_arms import random_case, random_posture

import manip_learn as ml
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FrameJacobian, RelativeFrameJacobian, Stacked
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.control import controller as controller_module
from manip_learn.control.compiled_controller import compiled_if_possible
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.policies import JointLimitAvoidance, ManipulabilityAscent, WeightedPolicies
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.tasks import FreeDirection, PointAttractor, Track
from manip_learn.errors import ConstraintError, MissingExtraError

READY = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])


@both_ways
@pytest.mark.usefixtures("kernels")
def test_random_laws_are_bounded_alike(numba: bool, tmp_path: Path) -> None:
    """Random trees, rows, tasks, policies, postures and periods, without limits of frames and with."""
    told, walled, bound = set(), set(), 0
    for seed in range(200 if numba else 60):
        free, _, q, previous, dt = random_case(seed, tmp_path)
        arguments = (0.0, dt, previous, float(seed % 3) / 2.0)
        told.add(compared(free, free.with_solver("compiled"), q, *arguments))
        if seed < (150 if numba else 40):
            law = free.with_limits(tight(free.robot, ("tip",), q, np.random.default_rng(seed)))
            walled.add(compared(law, law.with_solver("compiled"), q, *arguments))
            bound += bool(np.any(np.abs(free(q, *arguments).velocity - law(q, *arguments).velocity) > 1e-6))
    assert len(told) >= 7 and len(walled) >= 6 and bound > (75 if numba else 20)


@both_ways
@pytest.mark.usefixtures("kernels")
def test_a_singularity_is_approached_no_faster(numba: bool, robot_of: RobotOf) -> None:
    """A target out of reach stretches the arm: each step of the way has the original's bound on the approach."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    task = PointAttractor([9.0, 1.0], 5.0)
    law = ResolvedRateController(constraint, task, ManipulabilityAscent(constraint))
    compiled = law.with_solver("compiled")
    slowed = escaping = 0
    for bend in np.geomspace(1e-4, 0.6, 25):
        q = np.array([0.3, bend, 0.5 * bend])
        got, expected = compiled(q, 0.0, 0.01), law(q, 0.0, 0.01)
        agree(got, expected)
        slowed += expected.limiting_joint < 0 and expected.task_scale < 1.0  # by no joint's limit
        escaping += expected.escape_part is not None
    assert slowed > 5 and escaping > 5


def laws(robot_of: RobotOf, rng: np.random.Generator) -> list[ResolvedRateController]:
    """One for each kind of features, tasks and policies that `CompiledController` does not take."""
    arm, hand, wrist = robot_of("sawyer"), robot_of("panda"), robot_of("wrist")
    tip = tip_of("sawyer")
    maps: list[FeatureMap] = [
        CentreOfMass(arm),
        RelativeFrameJacobian(arm, tip, "head", "xyz"),
        Stacked([FrameJacobian(arm, tip, "x y"), CentreOfMass(arm, "z")]),
        MechanismRows(arm, tip, ("radial", "axial"), axis=[0.0, 0.0, 1.0], point=[0.5, 0.2, 0.3]),
    ]
    out = [
        ResolvedRateController(c, null_policy=ManipulabilityAscent(c))
        for c in (Constraint(np.eye(f.n_rows), f) for f in maps)
    ]
    for robot in (arm, hand, wrist):
        frame = tip if robot is arm else tip_of("panda" if robot is hand else "wrist")
        c = Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2], FrameJacobian(robot, frame, "xyz"))
        both = WeightedPolicies([ManipulabilityAscent(c), JointLimitAvoidance(robot)], [1.0, 0.5])
        goal = c.features.coordinates(random_posture(rng, robot))
        out.append(ResolvedRateController(c, Track(lambda t, goal=goal: goal + 0.1 * t), both))
        out.append(ResolvedRateController(c, FreeDirection(c, 0.3, 2.0), both, limits=Limits(robot, acceleration=5.0)))
    return out


@needs_numba
def test_any_controller_is_bounded_alike(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Centres of mass, two frames, stacked rows, doors, driven motions, moving targets, sums of policies."""
    bound = 0
    for law in laws(robot_of, rng):
        robot = law.robot
        assert robot is not None
        compiled = law.with_solver("compiled")
        for i in range(12):
            q = random_posture(rng, robot)
            previous = rng.uniform(-0.5, 0.5, robot.nv) if i % 2 else None
            law.task.reset()
            bound += compared(law, compiled, q, 0.0, 0.01, previous) not in ("ok", "singular", "damped")
    assert bound > 30


@needs_numba
def test_loops_take_it_where_the_law_is_not_compiled(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """`ServoLoop` compiles what can be compiled by default; a solver of the user's choice stays."""
    law = laws(robot_of, rng)[-1]
    loop = ServoLoop(law, 0.01)
    assert isinstance(loop.controller, ResolvedRateController) and loop.controller.solver == "compiled"
    assert ServoLoop(law, 0.01, compiled=False).controller.solver == "qp"  # type: ignore[union-attr]
    own = law.with_solver("active-set")
    assert compiled_if_possible(own, None) is own
    with pytest.raises(ConstraintError, match="cannot be compiled"):
        compiled_if_possible(law, True)
    q = np.full(7, 0.1)
    copy = pickle.loads(pickle.dumps(centre_of_mass_law(robot_of)))
    np.testing.assert_array_equal(copy(q).velocity, centre_of_mass_law(robot_of)(q).velocity)


def centre_of_mass_law(robot_of: RobotOf) -> ResolvedRateController:
    """A law that can be pickled."""
    constraint = Constraint(np.eye(3), CentreOfMass(robot_of("sawyer")))
    return ResolvedRateController(constraint, PointAttractor([9.0, 0.0, 0.0]), solver="compiled")


def test_without_numba_it_is_refused(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the name of the extra; and an unknown solver by the names of those that there are."""
    constraint = Constraint(np.eye(3), CentreOfMass(robot_of("sawyer")))
    with pytest.raises(ConstraintError, match="'qp', 'active-set' or 'compiled'"):
        ml.ResolvedRateController(constraint, solver="simplex")  # type: ignore[arg-type]
    monkeypatch.setattr(controller_module, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="fast"):
        ml.ResolvedRateController(constraint, solver="compiled")


@needs_numba
def test_a_drawer_is_opened_within_walls(robot_of: RobotOf) -> None:
    """A free direction in a loop, whose velocity is given, and a wall on its way: as with the law in Python."""
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    wall = [1.0, 0.0, 0.0, robot.position(READY, tip)[0] + 0.05]
    positions = []
    for compiled in (None, False):
        constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, tip, "xyz"))
        task = ml.FreeDirection(constraint, 0.15, 0.1)
        law = ml.ResolvedRateController(constraint, task, limits=ml.Limits(robot, tip_walls=[wall], frames=tip))
        loop = ml.ServoLoop(law, 0.0023, compiled=compiled)
        q, path = READY, []
        for k in range(700):
            loop.update(q, 0.0023 * k)
            q = loop.position
            assert q is not None
            path.append(q)
        positions.append(np.array(path))
        assert isinstance(loop.controller, ml.CompiledController) == (compiled is None)
    np.testing.assert_allclose(positions[0], positions[1], rtol=0, atol=1e-9)
    assert robot.position(positions[0][-1], tip)[0] == pytest.approx(wall[3], abs=2e-3)


@needs_numba
def test_a_hand_far_from_every_joint_limit_is_slowed_down(robot_of: RobotOf) -> None:
    """Behind a law in Python the short way past the limits does not pass those of frames by."""
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.CentreOfMass(robot))
    goal = constraint.features.coordinates(READY) + [0.02, 0.05, 0.0]
    limits = ml.Limits(robot, tip_speed=0.02, frames=tip)
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(goal), limits=limits)
    expected, got = law(READY), law.with_solver("compiled")(READY)
    agree(got, expected, at_limits=1e-9)
    assert 0.0199 < np.linalg.norm(robot.jacobian(READY, tip)[:3] @ got.velocity) <= 0.02
