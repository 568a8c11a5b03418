"""Targets of every shape in compiled controllers: poses, rotations, the frame's own axes, numbers along Lambda."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from compiled_cases import RobotOf, agree, both_ways, kernels, needs_numba  # noqa: F401
from conftest import tip_of
from random_arms import random_posture, random_tree

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.compiled import control_step
from manip_learn.control.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor
from manip_learn.errors import TargetError
from manip_learn.robot.robot import Reference
from manip_learn.robot.rotations import left_jacobian_inverse, rotation_matrix, rotation_vector

ROWS: tuple[tuple[str, Reference], ...] = (
    ("pose", "world"), ("pose", "local"), ("rotation", "world"), ("rotation", "local"), ("xyz", "local"),
    ("x z rx ry rz", "world"), ("z ry", "local"), ("xyz", "world"),
)  # fmt: skip


@both_ways
@pytest.mark.parametrize("name", ["tree", "planar3", "sawyer", "panda"])
@pytest.mark.usefixtures("kernels")
def test_targets_of_every_shape(
    name: str, numba: bool, robot_of: RobotOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far from the target, at it and beside it, singular and at limits: the numbers and the words of the original."""
    told, shapes = set(), set()
    for seed in range(64 if numba else 16):
        rng = np.random.default_rng([seed, 5])
        robot = random_tree(rng, tmp_path) if name == "tree" else robot_of(name)
        axes, reference = ROWS[seed % len(ROWS)]
        features = FrameJacobian(robot, "tip" if name == "tree" else tip_of(name), axes, reference)
        s = int(rng.integers(1, min(features.n_rows, robot.nv) + 1))
        constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
        at = random_posture(rng, robot)
        whole = features.n_rows in (3, 5, 6) and not (axes == "xyz" and seed % 16 >= 8)
        target = features.coordinates(at) if whole and seed % 3 else features.pose(at)
        policy = (ManipulabilityAscent(constraint), JointAttractor(rng.normal(size=robot.nv)), None)[seed % 3]
        task = PointAttractor(target, 3.0, max_speed=0.2 if seed % 2 else None)
        inverse = ("damped", "damped", "truncated")[seed % 3]
        law = ResolvedRateController(constraint, task, policy, inverse, limits=bool(seed % 5))
        if why_not(law) == "it has more rows than joints":
            continue
        compiled = CompiledController(law)
        for q in (random_posture(rng, robot), at, at + 1e-5 * rng.normal(size=robot.nv), np.zeros(robot.nv)):
            if 0.0 < np.abs(q - at).max() < 1e-6:
                continue  # the direction of the task is known to few digits only
            previous = rng.uniform(-0.2, 0.2, robot.nv) if rng.random() < 0.6 else None
            arguments = (0.0, float(10.0 ** rng.uniform(-3.0, -1.0)), previous, float(rng.choice([0.0, 1.0])))
            expected, beside = law(q, *arguments), law(q * (1.0 + 4e-16), *arguments)
            with monkeypatch.context() as patch:
                patch.setattr(ResolvedRateController, "__call__", lambda *a: pytest.fail("handed back"))
                got = compiled(q, *arguments)
            agree(got, expected, beside, at_limits=1e-9)
            told.add(str(expected.status))
        shapes.add(target.shape)
    assert len(told) >= 5 and len(shapes) >= 3


@both_ways
@pytest.mark.usefixtures("kernels")
def test_numbers_along_the_constraint(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A target of one number per constrained row, along the rows of Lambda."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, tip_of("sawyer"), "xyz")
    constraint = Constraint(np.linalg.qr(rng.normal(size=(3, 2)))[0].T, features)
    goal = constraint.selection @ features.coordinates(random_posture(rng, robot))
    law = ResolvedRateController(constraint, PointAttractor(goal), ManipulabilityAscent(constraint))
    for _ in range(10):
        q = random_posture(rng, robot)
        agree(CompiledController(law)(q), law(q))


@pytest.mark.parametrize("numba", [False])
@pytest.mark.usefixtures("kernels")
def test_rotations_are_those_of_the_library(numba: bool, rng: np.random.Generator) -> None:
    """Rotation vectors and the rates of their rows, from no turn to half a turn."""
    for angle in (0.0, 1e-12, 1e-6, 0.05, 0.0999, 0.1001, 1.0, 3.0, np.pi - 1e-9, np.pi):
        axis = rng.normal(size=3)
        turn = angle * axis / np.linalg.norm(axis)
        R = rotation_matrix(turn)
        got = control_step.rotation_vector(R.reshape(-1))
        np.testing.assert_allclose(got, rotation_vector(R), rtol=0, atol=1e-15)
        row = rng.normal(size=3)
        expected = row @ left_jacobian_inverse(turn)
        np.testing.assert_allclose(control_step.turned_row(*row, *turn), expected, rtol=0, atol=1e-14)


@needs_numba
@pytest.mark.parametrize("reference", ["world", "local"])
def test_a_pose_is_reached(reference: Reference, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A compiled run ends at the pose, and follows the run of the original."""
    robot = robot_of("panda")
    features = FrameJacobian(robot, tip_of("panda"), "pose", reference)
    constraint = Constraint(np.eye(6), features)
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    goal = features.pose(middle + 0.2 * rng.uniform(-1.0, 1.0, robot.nv))
    law = ResolvedRateController(constraint, PointAttractor(goal, 2.0), ManipulabilityAscent(constraint, 0.2))
    expected = simulate(robot, law, middle, 6.0, 0.01, compiled=False)
    got = simulate(robot, law, middle, 6.0, 0.01, compiled=True)
    np.testing.assert_allclose(got.q, expected.q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(got.task_error, expected.task_error, rtol=0, atol=1e-8)
    assert got.task_error[-1] < 1e-4
    np.testing.assert_allclose(features.pose(got.q[-1]), goal, rtol=0, atol=1e-4)


@needs_numba
def test_targets_that_are_open_or_wrong(robot_of: RobotOf) -> None:
    """Numbers that leave a part of the rotation to the frame are the original's; a matrix that is none is refused."""
    robot = robot_of("sawyer")
    some = Constraint(np.eye(2), FrameJacobian(robot, tip_of("sawyer"), "x rz"))
    reason = why_not(ResolvedRateController(some, PointAttractor([0.4, 0.1])))
    assert reason is not None and "rz" in reason
    assert why_not(ResolvedRateController(some, PointAttractor(np.eye(4)))) is None
    wrong = ResolvedRateController(some, PointAttractor(np.diag([2.0, 1.0, 1.0, 1.0])))
    with pytest.raises(TargetError, match="not a rotation matrix"):
        wrong(np.zeros(7))
    with pytest.raises(TargetError, match="not a rotation matrix"):
        CompiledController(wrong)
