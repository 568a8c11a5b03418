"""Learnt tasks in other people's solvers: the same velocity as ours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError, UnknownNameError

DT = 0.01
ROOT = Path(__file__).resolve().parents[1]


def oblique(robot, rng, tip="right_hand"):
    """Two oblique rows, a target nearby, a policy, and a posture."""
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 2)))[0].T, ml.FrameJacobian(robot, tip))
    q = 0.8 * robot.positions(robot.random_configuration(rng))
    task = ml.PointAttractor(robot.position(q, tip) + 0.1 * rng.normal(size=3))
    return constraint, task, ml.ManipulabilityAscent(constraint, 0.5), q


def test_missing_pink(monkeypatch):
    """Without Pink the error names the extra."""
    monkeypatch.setitem(sys.modules, "pink", None)
    monkeypatch.setitem(sys.modules, "pink.tasks", None)
    monkeypatch.delitem(sys.modules, "manip_learn.control.interop.pink_tasks", raising=False)
    with pytest.raises(MissingExtraError, match=r"manip_learn\[pink\]"):
        import manip_learn.control.interop.pink_tasks  # noqa: F401


@pytest.fixture
def pink():
    """Pink itself, in our environment, and our tasks for it."""
    pink = pytest.importorskip("pink", reason="Pink tasks need the extra 'pink'")
    from manip_learn.control.interop import pink_tasks

    pink.ours = pink_tasks
    return pink


def placed(pink, model, q):
    return pink.Configuration(model, model.createData(), q)


def velocity(pink, model, q, tasks, constraints=None):
    options = {"solver": "daqp", "damping": 0.0, "limits": [], "constraints": constraints}
    return pink.solve_ik(placed(pink, model, q), tasks, DT, **options)


def test_same_velocity_as_ours(pink, robot_of):
    """A hard constraint and a policy give u = A^+ b + N pi to 1e-9."""
    robot, rng = robot_of("sawyer"), np.random.default_rng(0)
    for _ in range(20):
        constraint, task, policy, q = oblique(robot, rng)
        rows = pink.ours.PinkConstraintTask(constraint, task, DT)
        climb = pink.ours.PinkPolicyTask(policy, robot, DT)
        theirs = velocity(pink, robot.pinocchio_model, q, [climb], [rows])
        law = ml.ResolvedRateController(constraint, task, policy, "exact", limits=False)
        assert np.allclose(theirs, law(q).velocity, rtol=0.0, atol=1e-9)


def test_joints_are_found_by_name(pink, robot_of):
    """Pink's model may have more joints than ours, which has some locked: the others get nothing from the task."""
    locked = ml.load_robot("sawyer", locked={"right_j2": 0.3})
    constraint, task, policy, q = oblique(locked, np.random.default_rng(2))
    rows = pink.ours.PinkConstraintTask(constraint, task, DT)
    configuration = placed(pink, robot_of("sawyer").pinocchio_model, np.insert(q, 2, 0.3))
    J = rows.compute_jacobian(configuration)
    assert np.allclose(np.delete(J, 2, axis=1), constraint(q)) and not np.any(J[:, 2])
    assert np.allclose(rows.compute_error(configuration), -DT * task.velocity(constraint, q, 0.0))
    assert pink.ours.PinkPolicyTask(policy, locked, DT).compute_jacobian(configuration).shape == (6, 7)


def test_time_of_moving_targets(pink, robot_of):
    """The task is asked at the time that the user sets."""
    robot = robot_of("sawyer")
    constraint, _, _, q = oblique(robot, np.random.default_rng(3))
    here, configuration = robot.position(q, "right_hand"), placed(pink, robot.pinocchio_model, q)
    rows = pink.ours.PinkConstraintTask(constraint, ml.Track(lambda t: here + [t, 0.0, 0.0]), DT)
    assert np.allclose(rows.compute_error(configuration), 0.0)
    rows.time = 1.0
    assert np.allclose(rows.compute_error(configuration), -DT * constraint.selection[:, 0])


def test_what_pink_cannot_have_is_refused(pink, robot_of):
    """Mimic joints, unknown joints, and steps that are not positive."""
    constraint, task, _, _ = oblique(robot_of("sawyer"), np.random.default_rng(4))
    with pytest.raises(ConstraintError, match="mimic joints"):
        pink.ours.PinkPolicyTask(ml.ZeroPolicy(robot_of("mimic").nv), robot_of("mimic"), DT)
    with pytest.raises(ConfigurationError, match="dt must be a positive"):
        pink.ours.PinkConstraintTask(constraint, task, 0.0)
    with pytest.raises(UnknownNameError, match="Pink's model"):
        rows = pink.ours.PinkConstraintTask(constraint, task, DT)
        velocity(pink, robot_of("planar3").pinocchio_model, np.zeros(3), [rows])
