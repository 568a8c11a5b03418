"""Limits compiled behind a law in Python: the commands of the other solvers, for any features, task and policy."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from compiled_cases import RobotOf, agree, both_ways, kernels, needs_numba  # noqa: F401
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


@pytest.fixture
def without_numba(numba: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the kernels are plain Python they are not looked for."""
    if not numba:
        monkeypatch.setattr(controller_module, "find_spec", lambda name: "plain Python instead")


@both_ways
@pytest.mark.usefixtures("kernels", "without_numba")
def test_random_laws_are_bounded_alike(numba: bool, tmp_path: Path) -> None:
    """Random trees, rows, tasks, policies, postures and periods: every part of the command, and its words."""
    told = set()
    for seed in range(200 if numba else 60):
        law, _, q, previous, dt = random_case(seed, tmp_path)
        arguments = (0.0, dt, previous, float(seed % 3) / 2.0)
        expected, beside = law(q, *arguments), law(q * (1.0 + 4e-16), *arguments)
        agree(law.with_solver("compiled")(q, *arguments), expected, beside, at_limits=1e-9)
        told.add(str(expected.status))
    assert len(told) >= 7


@both_ways
@pytest.mark.usefixtures("kernels", "without_numba")
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
            expected, beside = law(q, 0.0, 0.01, previous), law(q * (1.0 + 4e-16), 0.0, 0.01, previous)
            agree(compiled(q, 0.0, 0.01, previous), expected, beside, at_limits=1e-9)
            bound += expected.status not in ("ok", "singular", "damped")
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
